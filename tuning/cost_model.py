"""`time_ms = fixed_ms + sum(ms_per_op * ops)`: what a stage of a technique costs on one device."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from tuning.features import operations

_COVERAGE = 0.9


@dataclass(frozen=True)
class CostModel:
    """A fitted stage.

    - `terms`: the counts it depends on, in the order in which they were taken; none is a constant model.
    - `fixed_ms`, `ms_per_op`: costs, none negative.
    - `loo_error`: mean size of `predicted / measured - 1` for configurations left out of the fit; infinite where
      there was only one configuration to fit.
    - `constant_loo_error`: the same for a constant: what the terms are worth.
    - `dropped`: candidates that were not taken, each with the error it would give if it were added.
    - `n`: rows; `n_configurations`: how many configurations they belong to.
    """

    technique: str
    stage: str
    terms: tuple[str, ...]
    fixed_ms: float
    ms_per_op: tuple[float, ...]
    loo_error: float
    constant_loo_error: float
    dropped: tuple[tuple[str, float], ...]
    n: int
    n_configurations: int

    def predict(self, counts: Sequence[Mapping[str, int]]) -> np.ndarray:
        """Milliseconds, float64 `[len(counts)]`, one for each frame.

        **Raises:** `KeyError` where a frame lacks a term.
        """
        return self.fixed_ms + operations(counts, self.terms) @ np.array(self.ms_per_op)

    @property
    def spread(self) -> float:
        """Standard deviation of the relative error, if it is normal."""
        return math.sqrt(math.pi / 2) * self.loo_error

    @property
    def factor(self) -> float:
        """The measured time is within `predicted / factor` and `predicted * factor` with 90 % probability.

        Student's t, as a handful of left-out configurations says little about the error.
        """
        if not math.isfinite(self.loo_error):
            return math.inf
        return 1 + float(stdtrit(max(self.n_configurations - 1, 1), (1 + _COVERAGE) / 2)) * self.spread

    def as_json(self) -> dict[str, object]:
        """The entry of `cost_models` in `result.json`; what is not finite is null."""
        return {
            "technique": self.technique,
            "stage": self.stage,
            "terms": list(self.terms),
            "dropped": [{"term": term, "loo_error": _finite(error)} for term, error in self.dropped],
            "coefficients": {"fixed_ms": self.fixed_ms, **dict(zip(self.terms, self.ms_per_op, strict=True))},
            "loo_error": _finite(self.loo_error),
            "constant_loo_error": _finite(self.constant_loo_error),
            "interval_factor": _finite(self.factor),
            "n": self.n,
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
