"""How much of a size fits in a frame at 60 and at 30 frames a second, as lines to read."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tuning.family import COUNTS, TILES
from tuning.questions import BUDGETS_MS, Answer, largest_within
from tuning.table_model import TableModel

_FURTHEST = 4.0
"""Times the largest size of the table: extrapolation is measured there (`benchmarks/cost_cases/synthetic.py`)."""
_NOTHING = 1e-6


def budget_lines(model: TableModel) -> Iterator[str]:
    """A line for each frame time that depends on one column, the size that grows.

    Where stages are told apart only the frame is asked: a stage may not take all of the time.
    """
    stage = model.label_names.index("stage") if "stage" in model.label_names else None
    for key in dict.fromkeys((*model.models, *model.sums)):
        if stage is not None and key[stage] != "frame":
            continue
        parts = model.parts(key)
        columns = sorted({name for part in parts for name in part.columns})
        # A tile has a best size, not a largest; a count of work follows from sizes.
        if len(columns) != 1 or columns[0] in TILES | COUNTS:
            continue
        (column,) = columns
        fitted = np.concatenate([part.hull[column] for part in parts if column in part.columns])
        # Sizes are spaced by logarithms: a table that begins at 0 needs a start above it. The hull has no inner sizes.
        low, high = max(float(fitted.min()), _NOTHING * float(fitted.max())), _FURTHEST * float(fitted.max())
        within = [largest_within(parts, budget_ms, column, low, high, {}) for budget_ms in BUDGETS_MS]
        sizes = ", ".join(
            f"{_size(one, low, high)} within {ms:.1f} ms" for one, ms in zip(within, BUDGETS_MS, strict=True)
        )
        yield ", ".join(key) + f"{': ' if key else ''}{column} {sizes}"


def _size(one: Answer, low: float, high: float) -> str:
    if np.isnan(one.value):
        return f"below {low:,.4g}"
    # The last of sizes that are spaced by logarithms is the end but for rounding.
    end = (1 - 1e-9) * high
    if one.value >= end:
        return f"over {high:,.4g}"
    far = ", extrapolated" if one.extrapolated else ""
    above = f"over {high:,.4g}" if one.high >= end else f"{one.high:,.0f}"
    return f"{one.value:,.0f} ({one.low:,.0f} to {above}{far})"
