"""One visual identity for page and charts: the font, the inks, and a colour and a mark for every technique."""

from __future__ import annotations

from collections.abc import Iterable

FONT = '"Segoe UI", -apple-system, BlinkMacSystemFont, "Helvetica Neue", "Liberation Sans", Arial, sans-serif'
INK = "#17212b"
QUIET_INK = "#55606c"
RULE = "#d9dee2"

# Told apart by readers who do not see red and green alike, and at least 3:1 against white.
_COLOURS = {
    "forward": "#b4531c",
    "deferred": "#8a5a9e",
    "deferred_stencil": "#a33b63",
    "tiled_forward": "#6b7f1d",
    "tiled_forward_prez": "#2590a8",
    "tiled_deferred": "#2a67b1",
    "clustered_forward": "#97741a",
    "clustered_deferred": "#5b5f97",
    "volume_tiled": "#4a9a4f",
    "volume_tiled_bvh": "#0b857a",
    "z_pass": "#8c6d1f",
    "z_fail": "#b4531c",
    "ptsv": "#2a67b1",
    "cluster_hierarchy": "#0b857a",
}
_SYMBOLS = {
    "forward": "triangle-up",
    "tiled_deferred": "square",
    "volume_tiled_bvh": "circle",
    "deferred": "diamond",
    "deferred_stencil": "triangle-down",
    "tiled_forward": "cross",
    "tiled_forward_prez": "x",
    "clustered_forward": "pentagon",
    "clustered_deferred": "hexagon",
    "volume_tiled": "star",
    "z_pass": "triangle-up",
    "z_fail": "triangle-down",
    "ptsv": "square",
    "cluster_hierarchy": "circle",
}
_OTHER_COLOURS = ("#44546a", "#7a4b2a", "#2f7d5b", "#7a3f8c", "#8c6d1f")

# In the order in which a frame runs them, from preparation (cool) to shading (warm).
_STAGE_COLOURS = {
    "clusters": "#7c97b4",
    "reduce": "#a9bccd",
    "morton": "#8fb3a9",
    "sort": "#5f9488",
    "build_tree": "#3f6f75",
    "assign": "#39587d",
    "approximate": "#5b7fa6",
    "shade_opaque": "#d9a25f",
    "shade_transparent": "#c47a4a",
    "shadow_planes": "#b4a7c6",
    "shadow_build": "#8d7fa8",
    "shadow_traverse": "#6a5b8a",
    "shadow_merge": "#c5b2a0",
    "shadow_transmit": "#8fa39a",
    "shadow_bits": "#a08f86",
}
_OTHER_STAGE_COLOUR = "#b9bfc5"


def technique_colour(technique: str) -> str:
    """The same colour for a technique wherever it is drawn."""
    return _COLOURS.get(technique) or _OTHER_COLOURS[sum(technique.encode()) % len(_OTHER_COLOURS)]


def technique_symbol(technique: str) -> str:
    """Plotly's name of the technique's mark, so that charts can be read without colour."""
    return _SYMBOLS.get(technique, "circle")


def stage_colour(stage: str) -> str:
    return _STAGE_COLOURS.get(stage, _OTHER_STAGE_COLOUR)


def in_stage_order(stages: Iterable[str]) -> list[str]:
    """Stages as a frame runs them; unknown ones last, by name."""
    order = list(_STAGE_COLOURS)
    return sorted(set(stages), key=lambda stage: (order.index(stage) if stage in order else len(order), stage))


# Of stability: right, a few wrong samples, failing, without an answer; read with their words, not by colour alone.
HOLDS = "#cfe8d5"
FEW = ("#fdf0c8", "#f3cf73")
FAILS = ("#efa083", "#b3362b")
NOT_RUN = "#dfe3e6"
