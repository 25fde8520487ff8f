"""How much of a size fits in a frame at 60 and at 30 frames a second, as lines to read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tuning.family import COUNTS, TILES
from tuning.questions import BUDGETS_MS, Answer, largest_within
from tuning.table_model import FRAME, TableModel

_FURTHEST = 4.0
"""Times the largest size of the table: extrapolation is measured there (`benchmarks/cost_cases/synthetic.py`)."""
_NOTHING = 1e-6


@dataclass(frozen=True)
class SizesWithin:
    """What fits in the budgets.

    - `low`, `high`: the sizes that were looked at.
    - `within`: one for each of `BUDGETS_MS`.
    """

    key: tuple[str, ...]
    column: str
    low: float
    high: float
    within: tuple[Answer, ...]

    @property
    def line(self) -> str:
        sizes = ", ".join(
            f"{_size(one, self.low, self.high)} within {ms:.1f} ms"
            for one, ms in zip(self.within, BUDGETS_MS, strict=True)
        )
        return ", ".join(self.key) + f"{': ' if self.key else ''}{self.column} {sizes}"


def frame_keys(model: TableModel) -> list[tuple[str, ...]]:
    """The labels of whole frames: where stages are told apart, a stage may not take all of the time."""
    stage = model.label_names.index("stage") if "stage" in model.label_names else None
    return [key for key in dict.fromkeys((*model.models, *model.sums)) if stage is None or key[stage] == FRAME]


def is_size(column: str) -> bool:
    """A tile has a best size, not a largest; a count of work follows from sizes."""
    return column not in TILES | COUNTS


def sizes_within(model: TableModel) -> Iterator[SizesWithin]:
    """For each frame time that depends on one column, the size that grows."""
    for key in frame_keys(model):
        parts = model.parts(key)
        columns = sorted({name for part in parts for name in part.columns})
        if len(columns) != 1 or not is_size(columns[0]):
            continue
        (column,) = columns
        low, high = asked_sizes(np.concatenate([part.hull[column] for part in parts if column in part.columns]))
        within = tuple(largest_within(parts, budget_ms, column, low, high, {}) for budget_ms in BUDGETS_MS)
        yield SizesWithin(key, column, low, high, within)


def asked_sizes(fitted: np.ndarray) -> tuple[float, float]:
    """The smallest and the largest size that is looked at."""
    # Sizes are spaced by logarithms: a table that begins at 0 needs a start above it. The hull has no inner sizes.
    return max(float(fitted.min()), _NOTHING * float(fitted.max())), _FURTHEST * float(fitted.max())


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
