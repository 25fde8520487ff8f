"""What can be tuned: every parameter's values and default, and which technique has which."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from vtfs.input_error import InputError

Value = int | float | str

GRID_OFF = "off"
_GRID = re.compile(r"([1-9]\d{0,3})x([1-9]\d{0,3})x([1-9]\d{0,3})")


class ConflictError(InputError):
    """Values that are right by themselves and not together."""


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
_SHADING = ("gbuffer", "light_cutoff")
_BRUTE_FORCE = ("assigner", "batch", *_CLUSTERS, *_SHADING, "approximate")
_TREE = ("branching", "resort_every", "assigner")
_BY_TREE = (*_TILES, *_SLICES, *_TREE, "batch", *_CLUSTERS, "leaf_test", *_SHADING, "approximate")
_VOLUMES = ("tile_px", "branching", "batch", "planes", "feedback", "passes", "level", "front_faces", "blending")
_STENCIL = ("tile_px", "branching", "stencil", "front_faces", "blending")

ONLY_WITH: dict[str, tuple[str, Value]] = {"level": ("passes", 2)}
"""Parameters that say something beside one value of another parameter only; beside others they are at their default."""

ACCURACY = ("gbuffer", "light_cutoff", "approximate", "front_faces", "stencil", "around_eye")
"""Parameters that change the image: their defaults are exact."""

TECHNIQUES: dict[str, tuple[str, ...]] = {
    "forward": ("prepass", "batch", *_SHADING),
    "deferred": ("batch", *_SHADING),
    "deferred_stencil": ("batch", *_SHADING),
    "tiled_forward": (*_TILES, "assigner", "batch", "cull", *_SHADING),
    "tiled_forward_prez": (*_TILES, *_BRUTE_FORCE),
    "tiled_deferred": (*_TILES, *_BRUTE_FORCE),
    "clustered_deferred": _BY_TREE,
    "clustered_forward": _BY_TREE,
    "volume_tiled": (*_TILES, *_SLICES, *_BRUTE_FORCE),
    "volume_tiled_bvh": _BY_TREE,
    "z_pass": (*_STENCIL, "around_eye", *_SHADING),
    "z_fail": (*_STENCIL, *_SHADING),
    "ptsv": (*_VOLUMES, *_SHADING),
    "cluster_hierarchy": ("tile_px", "depth_slices", "bounds", "tree", *_VOLUMES[1:], *_SHADING),
    "shadow_rays": ("front_faces", "blending", *_SHADING),
    "brute_force": ("front_faces", "blending", *_SHADING),
}
"""Techniques and the parameters each one has, in the order in which they are shown."""

SHADOW_NAMES = ("z_pass", "z_fail", "ptsv", "cluster_hierarchy", "shadow_rays", "brute_force")
"""Those that find which samples lie in the shadow of which light, and then shade by `LISTS_OF_SHADOWED`."""

STENCIL_NAMES = ("z_pass", "z_fail")
"""Those that cannot cast by alpha-masked and blended triangles: a stencil cannot tell surfaces apart."""

SHADOW_REFERENCES = ("shadow_rays", "brute_force")
"""What the others are checked against; they run on the host."""

LISTS_OF_SHADOWED = "clustered_deferred"
"""Whose light lists, at its defaults, a shadow technique shades with."""

TECHNIQUE_GROUPS: dict[str, tuple[str, ...]] = {
    "all": tuple(name for name in TECHNIQUES if name not in SHADOW_NAMES),
    "shadows": tuple(name for name in SHADOW_NAMES if name not in SHADOW_REFERENCES),
}
"""Names that stand for several techniques wherever several can be named."""

TUNED_TECHNIQUES = ("forward", "tiled_deferred", "volume_tiled_bvh")
"""What a search compares unless the user says otherwise. Nothing is rasterised here, so that techniques which differ
in their passes over the geometry run the same programs: `tiled_forward_prez` those of `tiled_deferred`,
`clustered_forward` and `clustered_deferred` those of `volume_tiled_bvh`."""

_OWN_DEFAULTS: dict[tuple[str, str], Value] = {
    ("tiled_deferred", "bounds"): "depth_range",
    ("tiled_forward_prez", "bounds"): "depth_range",
    ("cluster_hierarchy", "bounds"): "explicit",
    # The papers have 32 children, for a warp; 8 are as fast or faster in every scene, on GPUs and CPUs.
    **{(name, of): 8 for name in ("z_pass", "z_fail", "ptsv", "cluster_hierarchy") for of in ("tile_px", "branching")},
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


@dataclass(frozen=True)
class Configuration:
    """A technique with a value for every one of its parameters, in the order of `TECHNIQUES`.

    Made by `configuration`; two that would do the same are equal.
    """

    technique: str
    items: tuple[tuple[str, Value], ...]

    @property
    def params(self) -> dict[str, Value]:
        return dict(self.items)

    def __getitem__(self, name: str) -> Value:
        return self.params[name]

    def __str__(self) -> str:
        changed = [f"{name}={value}" for name, value in self.items if value != default_value(self.technique, name)]
        return " ".join([self.technique, *changed])

    def exact(self) -> Configuration:
        """The same without what trades accuracy for speed."""
        exact = {name: default_value(self.technique, name) for name in ACCURACY if name in self.params}
        return self.replaced(**exact)

    @property
    def is_exact(self) -> bool:
        return self == self.exact()

    def replaced(self, **changes: Value) -> Configuration:
        """The same configuration with some values changed."""
        return configuration(self.technique, {**self.params, **changes})


def configuration(technique: str, params: Mapping[str, object] | None = None) -> Configuration:
    """A complete, validated configuration; what `params` leaves out takes its default.

    What has no effect beside other values takes its default: `tile_px` beside `grid`, say.

    **Raises:** `InputError` for an unknown technique, a parameter that the technique does not have,
    or a value out of range; `ConflictError` for values that exclude each other, and for one that goes with a value of
    another parameter only (`ONLY_WITH`).
    """
    _require_technique(technique)
    names = TECHNIQUES[technique]
    given = dict(params or {})
    for name in given:
        if name not in PARAMETERS:
            raise InputError(f"parameter `{name}`: unknown; `{technique}` has {', '.join(names)}.")
        if name not in names:
            raise InputError(f"parameter `{name}`: `{technique}` does not have it; it has {', '.join(names)}.")
    parsed = {
        name: parameter_of(technique, name).parse(given.get(name, default_value(technique, name))) for name in names
    }
    settled = _settled(technique, parsed)
    return Configuration(technique, tuple((name, settled[name]) for name in names))


def named_techniques(names: Sequence[str]) -> tuple[str, ...]:
    """Techniques by their own names or those of groups: each once, in the order of the names.

    **Raises:** `InputError` for an unknown name, or none.
    """
    members = [TECHNIQUE_GROUPS.get(name, (name,)) for name in names]
    found = tuple(dict.fromkeys(name for group in members for name in group))
    for name in found or ("",):
        _require_technique(name)
    return found


def _require_technique(name: str) -> None:
    if name in TECHNIQUE_GROUPS:
        members = ", ".join(TECHNIQUE_GROUPS[name])
        raise InputError(f"technique `{name}`: is a group, and one technique is needed; choose from {members}.")
    if name not in TECHNIQUES:
        raise InputError(f"technique `{name}`: unknown; choose from {', '.join(TECHNIQUES)}.")


def casts_shadows(techniques: Sequence[str]) -> bool:
    """Do the techniques cast shadows?

    **Raises:** `InputError` where some do and others do not, and for references, which run on the host.
    """
    casting = [name for name in techniques if name in SHADOW_NAMES]
    references = [name for name in casting if name in SHADOW_REFERENCES]
    if references:
        raise InputError(
            f"--techniques {references[0]}: is what others are checked against and is not timed; leave it out."
        )
    if casting and len(casting) < len(techniques):
        other = next(name for name in techniques if name not in casting)
        raise InputError(
            f"--techniques {casting[0]},{other}: one casts shadows, the other does not, so that their times cannot be "
            "compared; tune one kind at a time."
        )
    return bool(casting)


def changes_shadows(config: Configuration) -> bool:
    """May its shadows be others than those of its casters, as those of a stencil of 8 bits?"""
    return any(
        config.params.get(name, value) != value for name, value in (("stencil", "unlimited"), ("around_eye", "on"))
    )


def lists_configuration(config: Configuration) -> Configuration:
    """The configuration whose light lists a frame is shaded with: its own, but for shadow techniques."""
    if config.technique not in SHADOW_NAMES:
        return config
    return configuration(LISTS_OF_SHADOWED, {name: config[name] for name in _SHADING})


def counted_configuration(config: Configuration) -> Configuration:
    """The configuration that has the same counts of technique: a batch of clusters or samples changes none of them,
    a batch of triangles does where what it shadows is left out afterwards."""
    return config if config.technique in SHADOW_NAMES else config.replaced(batch=0)


def shading_batch(config: Configuration) -> int:
    """Samples that are shaded at once; 0: all."""
    return int(lists_configuration(config)["batch"])


def _settled(technique: str, params: dict[str, Value]) -> dict[str, Value]:
    """The same for all values that do the same."""
    params = dict(params)

    def default(*names: str) -> None:
        params.update({name: default_value(technique, name) for name in names if name in params})

    named = grid_cells(str(params.get("grid", GRID_OFF)))
    if named:
        if "depth_slices" not in params and named[2] != 1:
            raise ConflictError(
                f"parameter `grid` = {params['grid']!r}: tiles of `{technique}` are not cut into slices; "
                f'give "{named[0]}x{named[1]}x1".'
            )
        default(*_TILES[:3], "depth_slices")
    elif "tile_px_x" in params:
        width, height = params["tile_px_x"] or params["tile_px"], params["tile_px_y"] or params["tile_px"]
        default(*_TILES[:3])
        params |= {"tile_px": width} if width == height else {"tile_px_x": width, "tile_px_y": height}
    if "depth_scheme" in params:
        n_slices = named[2] if named else params["depth_slices"]
        if n_slices == 1:
            default("depth_scheme")
        if n_slices == 0 and params["depth_scheme"] != "self_similar":
            raise ConflictError(
                f"parameter `depth_scheme` = {params['depth_scheme']!r} with depth_slices=0: cubic cells are "
                "`self_similar`; give depth_slices of 1 or more."
            )
    for name, (other, needed) in ONLY_WITH.items():
        if name in params and params[name] != default_value(technique, name) and params[other] != needed:
            raise ConflictError(
                f"parameter `{name}` = {params[name]!r} with {other}={params[other]}: has no effect; give "
                f"{other}={needed}, or leave {name} out."
            )
    if params.get("leaf_test") == "box":
        default("cull")  # the sphere is not tested
    if "cull" in params and "bounds" in params:
        exact = params["cull"] == "frustum"
        if params["bounds"] == "implicit" and exact:
            params["bounds"] = "frustum"  # the exact test does not see the cell's box
        elif params["bounds"] == "frustum" and params["cull"] == "box" and params.get("leaf_test") != "box":
            params["cull"] = "frustum"  # nor is the cell a box
        elif params["bounds"] == "frustum" and not exact:
            params["bounds"] = "implicit"
    if params.get("assigner") == "coarse_to_fine" and not passes_only_what_meets_the_box(params):
        name = "leaf_test" if params.get("leaf_test") == "box" else "cull"
        raise ConflictError(
            f"parameter `assigner` = 'coarse_to_fine' with {name}={params[name]}: groups are tested by their boxes, "
            "which that test does not keep to; give cull=box or frustum and leaf_test=sphere, or assigner=published."
        )
    return params


def passes_only_what_meets_the_box(params: Mapping[str, Value]) -> bool:
    """Is a light listed only where its sphere meets the box of the cell? Lists of groups of cells rely on it."""
    return params.get("cull", "box") in ("box", "frustum") and params.get("leaf_test", "sphere") == "sphere"
