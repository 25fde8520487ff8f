"""What can be tuned: every parameter's values and default, and which technique has which."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from vtfs.input_error import InputError

Value = int | float | str
GRID_OFF = "off"
_GRID = re.compile(r"([1-9]\d{0,3})x([1-9]\d{0,3})x([1-9]\d{0,3})")


@dataclass(frozen=True)
class Parameter:
    """One tunable parameter.

    Either `choices` lists its values, or it is a number in `[low, high]` (a whole one where `default`
    is an `int`), or, where `zero` says what it means, 0; `grid` is a text of its own.
    """

    name: str
    default: Value
    meaning: str
    choices: tuple[Value, ...] = ()
    low: float = 0.0
    high: float = 0.0
    zero: str = ""

    @property
    def allowed(self) -> str:
        """The values, for a message to the user."""
        if self.choices == _BATCHES:
            return f"0, or a power of two from {_BATCHES[1]} to {_BATCHES[-1]}"
        if self.choices:
            return ", ".join(str(choice) for choice in self.choices)
        if isinstance(self.default, str):
            return f'{GRID_OFF}, or columns x rows x slices as "16x9x24", up to 8192x8192x1024'
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.low:g} to {self.high:g}" + (f", or 0: {self.zero}" if self.zero else "")

    def parse(self, value: object) -> Value:
        """The value as the right type, from text or from a number.

        **Raises:** `InputError` that names the parameter, the value and what is allowed.
        """
        try:
            parsed = _as_type(value, type(self.default))
        except (TypeError, ValueError, OverflowError):
            parsed = None
        if parsed is None or not self._holds(parsed):
            one_of = "one of " if self.choices and self.choices != _BATCHES else ""
            raise InputError(f"parameter `{self.name}` = {value!r}: must be {one_of}{self.allowed}.")
        return parsed

    def _holds(self, value: Value) -> bool:
        if self.choices:
            return value in self.choices
        if isinstance(value, str):
            named = grid_cells(value)
            return value == GRID_OFF or bool(named and max(named[:2]) <= 8192 and named[2] <= 1024)
        return self.low <= value <= self.high or bool(self.zero and value == 0)


def _as_type(value: object, wanted: type) -> Value:
    if isinstance(value, bool):
        raise TypeError("a flag is not a number")
    if wanted is int:
        as_float = float(value)  # type: ignore[arg-type]  # what cannot be a number raises
        if as_float != int(as_float):
            raise ValueError("not whole")
        return int(as_float)
    return wanted(value)


def grid_cells(grid: str) -> tuple[int, int, int] | None:
    """Columns, rows and slices that a value of `grid` names; `None` where it is off, or names none."""
    named = _GRID.fullmatch(grid)
    return (int(named[1]), int(named[2]), int(named[3])) if named else None


_BATCHES = (0, *(2**k for k in range(5, 25)))

PARAMETERS: dict[str, Parameter] = {
    parameter.name: parameter
    for parameter in (
        Parameter("tile_px", 32, "width and height of a tile in pixels", low=2, high=256),
        Parameter("tile_px_x", 0, "width of a tile in pixels", low=2, high=256, zero="tile_px"),
        Parameter("tile_px_y", 0, "height of a tile in pixels", low=2, high=256, zero="tile_px"),
        Parameter("grid", GRID_OFF, "tiles and slices by their number instead, as engines have them"),
        Parameter("depth_slices", 0, "depth slices of the grid; 0: as many as make cells cubic", low=0, high=1024),
        Parameter(
            "depth_scheme",
            "self_similar",
            "how slices grow: by a factor, not at all, or as the values of the depth buffer",
            choices=("self_similar", "linear", "ndc"),
        ),
        Parameter("branching", 32, "children of a node of the tree", choices=(2, 4, 8, 16, 32, 64)),
        Parameter(
            "resort_every",
            1,
            "frames from one sort of the light tree to the next; between them its order is kept and its boxes are "
            "refitted. Above 1 lists are made as published, by that tree",
            low=1,
            high=64,
        ),
        Parameter(
            "assigner",
            "auto",
            "how lists are made, which never changes them: as published (all lights against all cells, or a tree of "
            "lights), from groups of cells to cells, or, as faster on the device, all pairs while lights are few, "
            "then groups",
            choices=("auto", "published", "coarse_to_fine"),
        ),
        Parameter(
            "batch",
            0,
            "queries in one chunk: clusters when assigning, samples when shading, triangles when casting shadows; "
            "0: all at once (on a CPU: what fits its cache)",
            choices=_BATCHES,
        ),
        Parameter(
            "prepass",
            "on",
            "depth pre-pass: without one, fragments are shaded that end up hidden",
            choices=("on", "off"),
        ),
        Parameter(
            "bounds",
            "implicit",
            "what stands for the samples of a cell: its box, their box, that in tenths of its own, the cell itself, "
            "its part at their depths",
            choices=("implicit", "explicit", "packed", "frustum", "depth_range"),
        ),
        Parameter(
            "cull",
            "box",
            "light test of a tile or cell: projected rectangle, six planes, box, exact",
            choices=("screen_rect", "planes", "box", "frustum"),
        ),
        Parameter(
            "leaf_test",
            "sphere",
            "at the leaves of the tree: the light's sphere by `cull`, or its box against the cell's",
            choices=("sphere", "box"),
        ),
        Parameter("unique", "page_table", "how occupied clusters are found", choices=("sort", "page_table")),
        Parameter("normal_bins", 0, "bins of normals that split clusters, along a cube's edge; 0: none", low=0, high=8),
        Parameter(
            "normal_cones",
            "implicit",
            "cones that cull lights behind all surfaces of a cluster: of its bin, or of its samples",
            choices=("implicit", "explicit"),
        ),
        Parameter(
            "gbuffer",
            "float32",
            "precision of G-buffer channels; depth stays float32",
            choices=("float32", "float16", "bfloat16"),
        ),
        Parameter("light_cutoff", 0.0, "lights reach only where their window is above this", low=0.0, high=0.99),
        Parameter(
            "planes", "on", "planes that reject nodes besides the four of a shadow volume", choices=("on", "off")
        ),
        Parameter(
            "front_faces",
            "cast",
            "triangles that face the light: they cast shadows, or are culled, which is right for closed meshes",
            choices=("cast", "culled"),
        ),
        Parameter(
            "blending",
            "grey",
            "what alpha-masked and blended triangles do to light: masked ones cast where they are opaque, blended ones "
            "stop the share alpha (grey), let what their alpha covers through in their colour (coloured), or stop all "
            "light of a sample with the chance alpha (stochastic); or only opaque triangles cast",
            choices=("grey", "coloured", "stochastic", "opaque"),
        ),
        Parameter(
            "feedback",
            "on",
            "triangles go on only into nodes that no other one has shadowed as a whole",
            choices=("on", "off"),
        ),
        Parameter("passes", 1, "walks down the tree: one, or two with a restart at `level`", choices=(1, 2)),
        Parameter("level", 0, "where the first of two passes ends", low=1, high=24, zero="halfway down the tree"),
        Parameter("tree", "compact", "over the occupied clusters, or all cells", choices=("compact", "full")),
        Parameter(
            "stencil",
            "unlimited",
            "counts of a stencil: without limit, or 8 bits that wrap or saturate",
            choices=("unlimited", "wrap", "saturate"),
        ),
        Parameter(
            "around_eye",
            "on",
            "z-pass starts with the volumes around the eye; off, as in textbooks, it fails inside of one",
            choices=("on", "off"),
        ),
        Parameter(
            "approximate",
            0.0,
            "lights that vary by at most this over a cluster, as a share of all light there, are evaluated once for it",
            low=0.0,
            high=1.0,
        ),
    )
}

_TILES = ("tile_px", "tile_px_x", "tile_px_y", "grid")
_SLICES = ("depth_slices", "depth_scheme")
_CLUSTERS = ("bounds", "cull", "unique", "normal_bins", "normal_cones")
GRID_PARAMETERS = (*_TILES, *_SLICES, *_CLUSTERS)
SHADING = ("gbuffer", "light_cutoff")  # every technique shades
_BRUTE_FORCE = ("assigner", "batch", *_CLUSTERS, *SHADING, "approximate")
_TREE = ("branching", "resort_every", "assigner")
_BY_TREE = (*_TILES, *_SLICES, *_TREE, "batch", *_CLUSTERS, "leaf_test", *SHADING, "approximate")
_VOLUMES = ("tile_px", "branching", "batch", "planes", "feedback", "passes", "level", "front_faces", "blending")
_STENCIL = ("tile_px", "branching", "stencil", "front_faces", "blending")

ONLY_WITH: dict[str, tuple[str, Value]] = {"level": ("passes", 2)}
"""Parameters that say something beside one value of another parameter only; beside others they are at their default."""

ACCURACY = ("gbuffer", "light_cutoff", "approximate", "front_faces", "stencil", "around_eye")
"""Parameters that change the image: their defaults are exact."""

TECHNIQUES: dict[str, tuple[str, ...]] = {
    "forward": ("prepass", "batch", *SHADING),
    "deferred": ("batch", *SHADING),
    "deferred_stencil": ("batch", *SHADING),
    "tiled_forward": (*_TILES, "assigner", "batch", "cull", *SHADING),
    "tiled_forward_prez": (*_TILES, *_BRUTE_FORCE),
    "tiled_deferred": (*_TILES, *_BRUTE_FORCE),
    "clustered_deferred": _BY_TREE,
    "clustered_forward": _BY_TREE,
    "volume_tiled": (*_TILES, *_SLICES, *_BRUTE_FORCE),
    "volume_tiled_bvh": _BY_TREE,
    "z_pass": (*_STENCIL, "around_eye", *SHADING),
    "z_fail": (*_STENCIL, *SHADING),
    "ptsv": (*_VOLUMES, *SHADING),
    "cluster_hierarchy": ("tile_px", "depth_slices", "bounds", "tree", *_VOLUMES[1:], *SHADING),
    "shadow_rays": ("front_faces", "blending", *SHADING),
    "brute_force": ("front_faces", "blending", *SHADING),
}
"""Techniques and the parameters each one has, in the order in which they are shown."""

_OWN_DEFAULTS: dict[tuple[str, str], Value] = {
    ("tiled_deferred", "bounds"): "depth_range",
    ("tiled_forward_prez", "bounds"): "depth_range",
    ("cluster_hierarchy", "bounds"): "explicit",
    **{(name, "tile_px"): 8 for name in ("z_pass", "z_fail", "ptsv", "cluster_hierarchy")},
    # What tells these from one another is how they make their lists.
    ("volume_tiled", "assigner"): "published",
    ("volume_tiled_bvh", "assigner"): "published",
    ("clustered_deferred", "assigner"): "published",
    ("clustered_forward", "assigner"): "published",
}

_OWN_CHOICES: dict[tuple[str, str], tuple[Value, ...]] = {("cluster_hierarchy", "bounds"): ("implicit", "explicit")}


def default_value(technique: str, name: str) -> Value:
    """What a technique does where the configuration does not say."""
    return _OWN_DEFAULTS.get((technique, name), PARAMETERS[name].default)


def parameter_of(technique: str, name: str) -> Parameter:
    """A parameter with the default and the choices that a technique has."""
    parameter = PARAMETERS[name]
    choices = _OWN_CHOICES.get((technique, name), parameter.choices)
    return replace(parameter, default=default_value(technique, name), choices=choices)
