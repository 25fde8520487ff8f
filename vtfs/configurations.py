"""A configuration: one technique with a value for each of its parameters, checked, and those that derive from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vtfs.input_error import InputError
from vtfs.parameters import (
    ACCURACY,
    GRID_OFF,
    ONLY_WITH,
    PARAMETERS,
    SHADING,
    TECHNIQUES,
    Value,
    default_value,
    grid_cells,
    parameter_of,
)
from vtfs.technique_names import SHADOW_NAMES, require_technique

LISTS_OF_SHADOWED = "clustered_deferred"
"""Whose light lists, at its defaults, a shadow technique shades with."""

_TILE_SIZES = ("tile_px", "tile_px_x", "tile_px_y")


class ConflictError(InputError):
    """Values that are right by themselves and not together."""


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
    require_technique(technique)
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


def lists_configuration(config: Configuration) -> Configuration:
    """The configuration whose light lists a frame is shaded with: its own, but for shadow techniques."""
    if config.technique not in SHADOW_NAMES:
        return config
    return configuration(LISTS_OF_SHADOWED, {name: config[name] for name in SHADING})


def counted_configuration(config: Configuration) -> Configuration:
    """The configuration that has the same counts of technique: a batch of clusters or samples changes none of them,
    a batch of triangles does where what it shadows is left out afterwards."""
    return config if config.technique in SHADOW_NAMES else config.replaced(batch=0)


def shading_batch(config: Configuration) -> int:
    """Samples that are shaded at once; 0: all."""
    return int(lists_configuration(config)["batch"])


def changes_shadows(config: Configuration) -> bool:
    """May its shadows be others than those of its casters, as those of a stencil of 8 bits?"""
    return any(
        config.params.get(name, value) != value for name, value in (("stencil", "unlimited"), ("around_eye", "on"))
    )


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
        default(*_TILE_SIZES, "depth_slices")
    elif "tile_px_x" in params:
        width, height = params["tile_px_x"] or params["tile_px"], params["tile_px_y"] or params["tile_px"]
        default(*_TILE_SIZES)
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
