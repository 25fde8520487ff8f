"""Which terms a time may be made of: one frozen family, by what a column means.

Sizes and counts whose meaning is known get the terms of the published algorithms (van Oosten 2017, chapters 5 to 8;
Olsson et al. 2012); columns without a known meaning get `x^a log2(x)^b` and products of two.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from tuning.terms import Factor, Term

POWERS = (-1.0, -0.5, 0.0, 0.5, 1.0, 2.0)
LOG_POWERS = (0, 1)

LIGHTS = frozenset({"lights", "num_lights", "n_lights", "light_count"})
TILES = frozenset({"tile", "tile_px", "tile_px_x", "tile_size"})
COUNTS = frozenset(
    {
        "samples",
        "cells_total",
        "clusters_occupied",
        "light_cluster_pairs",
        "lighting_computations",
        "tree_tests",
        "leaf_tests",
        "tests",
        "tree_nodes",
        "test_and_set",
        "extra_plane_tests",
        "bytes_moved",
        "shading_lanes",
        "shading_steps",
        "assign_steps",
        "divergence",
    }
)
"""Work that was counted, see `vtfs.op_counts`: linear."""
STAGES = {"build_bvh": "build_tree", "assign_lights": "assign", "light_culling": "assign"}
"""Names that publications use for our stages."""

_MOST_KNOTS = 6  # of a column; of the only one at every second value: a cut is to be found where it is
_FEWEST_VALUES = 10
_MOST_PRODUCTS = 400


def candidate_terms(columns: Mapping[str, np.ndarray], stage: str | None = None) -> tuple[list[Term], list[str]]:
    """The terms that this table can tell from a constant and from each other, simplest first, and messages.

    **Arguments:**

    - `columns`: float64 `[rows]` each.
    - `stage`: of the technique, where it is known: it narrows down what the number of lights can cost.
    """
    messages: list[str] = []
    usable: dict[str, np.ndarray] = {}
    for name, column in columns.items():
        if np.ptp(column) == 0:
            messages.append(f"column `{name}` has one value only: no term of it can be fitted.")
        elif column.min() < 0:
            messages.append(f"column `{name}` has negative values: not used, as work is not negative.")
        else:
            usable[name] = column
    terms: list[Term] = []
    for name, column in usable.items():
        terms += [Term((factor,)) for factor in _factors(name, column, stage)]
    terms += _products(usable, stage)
    for name, column in usable.items():
        terms += _cut(name, column, _MOST_KNOTS if len(usable) > 1 else max(_MOST_KNOTS, len(column) // 2))
    return _told_apart(terms, usable, messages), messages


def _factors(name: str, column: np.ndarray, stage: str | None) -> tuple[Factor, ...]:
    if name in COUNTS:
        return (Factor(name),)  # a unit of work costs what it costs
    if name in LIGHTS:
        linear, n_log_n, log_n = Factor(name), Factor(name, 1.0, 1), Factor(name, 0.0, 1)
        # Sorting by merges: N log N (van Oosten ch. 5); N / 31 nodes; N reductions and Morton codes.
        by_stage = {"sort": (n_log_n,), "build_tree": (linear,), "unlisted": (linear,)}
        return by_stage.get(STAGES.get(stage or "", stage or ""), (linear, n_log_n, log_n))
    if name in TILES:
        powers = (1.0, -1.0, 2.0, -2.0) if column.min() > 0 else (1.0, 2.0)
        return tuple(Factor(name, power) for power in powers)
    return _generic(name, column)


def _generic(name: str, column: np.ndarray) -> tuple[Factor, ...]:
    factors = [Factor(name, a, b) for b in LOG_POWERS for a in sorted(POWERS, key=lambda a: (a != 1, abs(a)))]
    return tuple(
        factor for factor in factors if (factor.power or factor.log_power) and (factor.power > 0 or column.min() > 0)
    )


def _products(usable: Mapping[str, np.ndarray], stage: str | None) -> list[Term]:
    """Of two columns; counts of work are products already."""
    pairs = list(itertools.combinations([name for name in usable if name not in COUNTS], 2))
    whole = [
        Term((a, b))
        for one, other in pairs
        for a in _factors(one, usable[one], stage)
        for b in _factors(other, usable[other], stage)
    ]
    return whole if len(whole) <= _MOST_PRODUCTS else [Term((Factor(a), Factor(b))) for a, b in pairs]


def _cut(name: str, column: np.ndarray, most_knots: int) -> list[Term]:
    """Cut at values that leave at least three on either side; not where there are few to tell a cut from a curve."""
    values = np.unique(column)
    inner = values[2:-3]
    if len(values) < _FEWEST_VALUES:
        return []
    knots = inner[np.unique(np.linspace(0, len(inner) - 1, most_knots).round().astype(int))]
    return [Term((Factor(name),), shape, float(k)) for k in knots for shape in ("up_to", "beyond", "step")]


def _told_apart(terms: list[Term], columns: Mapping[str, np.ndarray], messages: list[str]) -> list[Term]:
    """Without terms that are constant here, or proportional to one before."""
    kept: list[Term] = []
    directions = np.empty((0, 0))
    for term in terms:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            values = term.values(columns)
        if not np.isfinite(values).all() or values.max() <= 0 or np.ptp(values) <= 1e-9 * values.max():
            continue
        direction = (values / values.max()) / np.linalg.norm(values / values.max())
        if kept and (same := np.flatnonzero(directions @ direction > 1 - 1e-10)).size:
            if len(term.columns) == 1 and term.shape == "whole" and kept[same[0]].columns != term.columns:
                messages.append(f"`{term.name}` is proportional to `{kept[same[0]].name}`: the two are one term here.")
            continue
        kept.append(term)
        directions = np.vstack([directions, direction]) if len(kept) > 1 else direction[None]
    return kept
