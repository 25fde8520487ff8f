"""What can be tuned: every parameter's values and default, and which technique has which."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vtfs.input_error import InputError

Value = int | float | str


@dataclass(frozen=True)
class Parameter:
    """One tunable parameter.

    Either `choices` lists its values, or it is a number in `[low, high]` (a whole one where `default`
    is an `int`).
    """

    name: str
    default: Value
    meaning: str
    choices: tuple[Value, ...] = ()
    low: float = 0.0
    high: float = 0.0

    @property
    def allowed(self) -> str:
        """The values, for a message to the user."""
        if self.choices:
            return ", ".join(str(choice) for choice in self.choices)
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        return f"{kind} from {self.low:g} to {self.high:g}"

    def parse(self, value: object) -> Value:
        """The value as the right type, from text or from a number.

        **Raises:** `InputError` that names the parameter, the value and what is allowed.
        """
        try:
            parsed = _as_type(value, type(self.default))
        except (TypeError, ValueError, OverflowError):
            parsed = None
        if parsed is None or not self._holds(parsed):
            raise InputError(f"parameter `{self.name}` = {value!r}: must be {self.allowed}.")
        return parsed

    def _holds(self, value: Value) -> bool:
        if self.choices:
            return value in self.choices
        return not isinstance(value, str) and self.low <= value <= self.high


def _as_type(value: object, wanted: type) -> Value:
    if isinstance(value, bool):
        raise TypeError("a flag is not a number")
    if wanted is int:
        as_float = float(value)  # type: ignore[arg-type]  # what cannot be a number raises
        if as_float != int(as_float):
            raise ValueError("not whole")
        return int(as_float)
    return wanted(value)


_BATCHES = (0, *(2**k for k in range(5, 25)))

PARAMETERS: dict[str, Parameter] = {
    parameter.name: parameter
    for parameter in (
        Parameter("tile_px", 32, "width and height of a tile in pixels", low=2, high=256),
        Parameter("depth_slices", 0, "depth slices of the grid; 0: as many as make cells cubic", low=0, high=1024),
        Parameter("branching", 32, "children of a node of the light tree", choices=(2, 4, 8, 16, 32, 64)),
        Parameter(
            "batch",
            0,
            "queries in one chunk: clusters when assigning, samples when shading; "
            "0: all at once (on a CPU: what fits its cache)",
            choices=_BATCHES,
        ),
        Parameter(
            "prepass",
            "on",
            "depth pre-pass: without one, fragments are shaded that end up hidden",
            choices=("on", "off"),
        ),
        Parameter("bounds", "implicit", "what stands for the samples of a cell", choices=("implicit", "explicit")),
        Parameter(
            "gbuffer",
            "float32",
            "precision of G-buffer channels; depth stays float32",
            choices=("float32", "float16", "bfloat16"),
        ),
        Parameter("light_cutoff", 0.0, "lights reach only where their window is above this", low=0.0, high=0.99),
    )
}

_SHADING = ("batch", "gbuffer", "light_cutoff")

TECHNIQUES: dict[str, tuple[str, ...]] = {
    "forward": ("prepass", *_SHADING),
    "deferred": _SHADING,
    "deferred_stencil": _SHADING,
    "tiled_forward": ("tile_px", *_SHADING),
    "tiled_forward_prez": ("tile_px", *_SHADING),
    "tiled_deferred": ("tile_px", *_SHADING),
    "clustered_deferred": ("tile_px", "depth_slices", "branching", "bounds", *_SHADING),
    "clustered_forward": ("tile_px", "depth_slices", "branching", "bounds", *_SHADING),
    "volume_tiled": ("tile_px", "depth_slices", *_SHADING),
    "volume_tiled_bvh": ("tile_px", "depth_slices", "branching", "bounds", *_SHADING),
}
"""Techniques and the parameters each one has, in the order in which they are shown."""

TUNED_TECHNIQUES = ("forward", "tiled_deferred", "volume_tiled_bvh")
"""What a search compares unless the user says otherwise. Nothing is rasterised here, so that techniques which differ
in their passes over the geometry run the same programs: `tiled_forward_prez` those of `tiled_deferred`,
`clustered_forward` and `clustered_deferred` those of `volume_tiled_bvh`."""


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
        changed = [f"{name}={value}" for name, value in self.items if value != PARAMETERS[name].default]
        return " ".join([self.technique, *changed])

    def replaced(self, **changes: Value) -> Configuration:
        """The same configuration with some values changed."""
        return configuration(self.technique, {**self.params, **changes})


def configuration(technique: str, params: Mapping[str, object] | None = None) -> Configuration:
    """A complete, validated configuration; what `params` leaves out takes its default.

    **Raises:** `InputError` for an unknown technique, a parameter that the technique does not have,
    or a value out of range.
    """
    if technique not in TECHNIQUES:
        raise InputError(f"technique `{technique}`: unknown; choose from {', '.join(TECHNIQUES)}.")
    names = TECHNIQUES[technique]
    given = dict(params or {})
    for name in given:
        if name not in PARAMETERS:
            raise InputError(f"parameter `{name}`: unknown; `{technique}` has {', '.join(names)}.")
        if name not in names:
            raise InputError(f"parameter `{name}`: `{technique}` does not have it; it has {', '.join(names)}.")
    return Configuration(
        technique,
        tuple((name, PARAMETERS[name].parse(given.get(name, PARAMETERS[name].default))) for name in names),
    )
