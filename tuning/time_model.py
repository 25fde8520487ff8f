"""A fitted law with its error bars: what a table's times say about times that were not measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import ndtri, stdtr, stdtrit

from tuning.law import Law, combined

COVERAGE = 0.9
_EXPONENT_SPREAD = 0.5
"""Standard deviation of the exponent by which a law may be wrong beyond its data, times the degrees of freedom."""


_MOST_MOVED = 60.0
"""Logs of costs move no further in a sample: a cost that is all but zero has a spread without an end."""


@dataclass(frozen=True)
class Prediction:
    """Milliseconds; a measured time lies within `[low_ms, high_ms]` with 90 % probability.

    - `extrapolated`: outside what the model was fitted to; the interval is wider there.
    """

    time_ms: float
    low_ms: float
    high_ms: float
    extrapolated: bool


@dataclass(frozen=True)
class PlausibleLaw:
    """A law that the data cannot rule out.

    - `weight`: of all laws of a model they add up to 1.
    - `covariance`: of the logs of the costs, `[terms, terms]`.
    - `spread`: standard deviation of the relative error of a row.
    """

    law: Law
    weight: float
    covariance: np.ndarray
    spread: float


@dataclass(frozen=True)
class LeftOut:
    """A term that was not taken, and the left-out error the law would have with it."""

    term: str
    error: float


@dataclass(frozen=True)
class Influence:
    """A fitted row that moves predictions.

    - `columns`: which row it is.
    - `slope`: a time of that row 1 % longer makes the times of all fitted rows this many per cent longer, root of the
      mean of squares.
    """

    columns: dict[str, float]
    slope: float


@dataclass(frozen=True)
class TimeModel:
    """The times of one technique and stage.

    - `laws`: the one that was chosen first, then those that explain the data about as well: they widen the interval.
    - `n_rows`: rows with different columns.
    - `error`, `constant_error`: mean size of log(measured / predicted) for rows that were left out of the whole fit,
      selection included; of the law and of a constant. Infinite where there was one row only.
    - `hull`: the columns that the law depends on, float64 `[points]` each: what it was fitted to.
    - `ranges`: least and most of the other columns it was fitted to: beyond them they may matter after all.
    - `left_out`, `messages`: what was not taken, and what could not be told apart.
    - `cost_intervals_ms`: 90 % intervals of the costs of the chosen law, by bootstrap.
    - `influential`: the rows that move predictions most.
    """

    laws: tuple[PlausibleLaw, ...]
    n_rows: int
    error: float
    constant_error: float
    hull: dict[str, np.ndarray]
    ranges: dict[str, tuple[float, float]]
    left_out: tuple[LeftOut, ...]
    messages: tuple[str, ...]
    cost_intervals_ms: tuple[tuple[float, float], ...] = ()
    influential: tuple[Influence, ...] = ()

    @property
    def law(self) -> Law:
        return self.laws[0].law

    @property
    def columns(self) -> tuple[str, ...]:
        return tuple(self.hull)

    @property
    def degrees_of_freedom(self) -> int:
        return max(self.n_rows - 1 - self.law.size, 1)

    def times_ms(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """float64 `[rows]`, of the chosen law alone."""
        return self.law.predict(columns)

    def predict(self, columns: Mapping[str, np.ndarray]) -> tuple[Prediction, ...]:
        """One for each row.

        **Raises:** `InputError` where a column is missing.
        """
        n_rows = len(next(iter(columns.values())))
        times_ms = self.law.predict(columns)
        beyond = self.beyond(columns)
        low_ms, high_ms = self.interval_ms(columns, beyond)
        return tuple(
            Prediction(float(t), float(min(low, t)), float(max(high, t)), bool(far > 0))
            for t, low, high, far in zip(times_ms, low_ms, high_ms, beyond, strict=True)
        )[:n_rows]

    def samples_ms(self, columns: Mapping[str, np.ndarray], n: int, seed: int) -> np.ndarray:
        """Times as they may really be, `[n, rows]`: a plausible law with plausible costs for each sample, no noise.

        Beyond the data also with an exponent that may be wrong, the same for all rows of a sample.
        """
        rng = np.random.default_rng(seed)
        weights = np.array([one.weight for one in self.laws])
        of_law = rng.choice(len(self.laws), size=n, p=weights / weights.sum())
        exponent = rng.normal(0, _EXPONENT_SPREAD / self.degrees_of_freedom, n)
        sampled = np.empty((n, len(next(iter(columns.values())))))
        for k, one in enumerate(self.laws):
            own = of_law == k
            moved = rng.multivariate_normal(np.zeros(len(one.covariance)), one.covariance, own.sum(), method="eigh")
            costs = np.array(one.law.costs_ms) * np.exp(np.clip(moved, -_MOST_MOVED, _MOST_MOVED))
            sampled[own] = combined(one.law.design(columns), costs, np.array(one.law.sides))
        return sampled * np.exp(exponent[:, None] * self.beyond(columns))

    def beyond(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """How far outside the fitted rows, as a log of the ratio of sizes, `[rows]`; 0 inside.

        Inside the convex hull for what the law depends on, and within the range of every other column that is given.
        """
        squared = np.zeros(len(next(iter(columns.values()))))
        for name, ends in self.ranges.items():
            if name in columns:
                least, most, x = (stretched(np.asarray(v, float), np.array(ends)) for v in (*ends, columns[name]))
                squared += np.maximum(np.maximum(x - most, least - x), 0) ** 2
        if self.hull:
            points = np.stack([stretched(self.hull[name], self.hull[name]) for name in self.hull], axis=1)
            asked = np.stack([stretched(np.asarray(columns[n], float), self.hull[n]) for n in self.hull], axis=1)
            # A convex combination: non-negative weights that add up to 1, the last row made too stiff to bend.
            stiff = 1e3 * (1 + np.abs(points).max())
            corners = np.vstack([points.T, np.full(len(points), stiff)])
            for row, point in enumerate(asked):
                if ((point >= points.min(axis=0)) & (point <= points.max(axis=0))).all() and len(self.hull) == 1:
                    continue
                weights, _ = nnls(corners, np.append(point, stiff), maxiter=100 * len(points))
                squared[row] += np.sum((points.T @ weights / max(weights.sum(), 1e-12) - point) ** 2)
        return np.where(squared > 1e-10, np.sqrt(squared), 0.0)

    def interval_ms(self, columns: Mapping[str, np.ndarray], beyond: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the 90 % interval, `[rows]` each: quantiles of the mixture of all plausible laws."""
        centres, widths = [], []
        quantile = (1 + COVERAGE) / 2
        normal = float(ndtri(quantile) / stdtrit(self.degrees_of_freedom, quantile))
        for one in self.laws:
            slopes = one.law.slopes(columns)
            of_costs = np.einsum("rk,kl,rl->r", slopes, one.covariance, slopes)
            of_exponent = (_EXPONENT_SPREAD / self.degrees_of_freedom * beyond) ** 2
            centres.append(np.log(np.maximum(one.law.predict(columns), 1e-300)))
            # Few rows say little about the scatter, hence Student's t; the exponent's is no estimate, but normal.
            widths.append(np.sqrt(one.spread**2 + np.maximum(of_costs, 0) + of_exponent * normal**2))
        weights = np.array([one.weight for one in self.laws])
        ends = _mixture_quantiles(np.array(centres), np.array(widths), weights, self.degrees_of_freedom)
        return np.exp(ends[0]), np.exp(ends[1])

    def as_json(self) -> dict[str, object]:
        return {
            "laws": [
                one.law.as_json() | {"weight": one.weight, "covariance": one.covariance.tolist(), "spread": one.spread}
                for one in self.laws
            ],
            "n_rows": self.n_rows,
            "error": _finite(self.error),
            "constant_error": _finite(self.constant_error),
            "hull": {name: column.tolist() for name, column in self.hull.items()},
            "ranges": {name: list(ends) for name, ends in self.ranges.items()},
            "left_out": [{"term": one.term, "error": _finite(one.error)} for one in self.left_out],
            "messages": list(self.messages),
            "cost_intervals_ms": [list(ends) for ends in self.cost_intervals_ms],
            "influential": [{"columns": row.columns, "slope": row.slope} for row in self.influential],
        }

    @classmethod
    def from_json(cls, entry: Mapping[str, object]) -> TimeModel:
        laws = tuple(
            PlausibleLaw(
                Law.from_json(one), float(one["weight"]), np.array(one["covariance"], float), float(one["spread"])
            )
            for one in entry["laws"]  # type: ignore[union-attr]
        )
        return cls(
            laws,
            int(entry["n_rows"]),  # type: ignore[call-overload]
            _or_infinite(entry["error"]),
            _or_infinite(entry["constant_error"]),
            {name: np.array(column, float) for name, column in entry["hull"].items()},  # type: ignore[union-attr]
            {name: (float(low), float(high)) for name, (low, high) in entry["ranges"].items()},  # type: ignore[union-attr]
            tuple(LeftOut(one["term"], _or_infinite(one["error"])) for one in entry["left_out"]),  # type: ignore[union-attr]
            tuple(entry["messages"]),  # type: ignore[arg-type]
            tuple((float(low), float(high)) for low, high in entry["cost_intervals_ms"]),  # type: ignore[union-attr]
            tuple(Influence(dict(row["columns"]), float(row["slope"])) for row in entry["influential"]),  # type: ignore[union-attr]
        )


def stretched(x: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Logarithms above the smallest size that was fitted, linear below it: sizes may be 0."""
    positive = fitted[fitted > 0]
    least = float(positive.min()) if len(positive) else 1.0
    return np.where(x > least, np.log(np.maximum(x, least) / least), x / least - 1)


def _mixture_quantiles(
    centres: np.ndarray, widths: np.ndarray, weights: np.ndarray, degrees: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of Student's t distributions `[laws, rows]`, by bisection."""
    ends = []
    for wanted in ((1 - COVERAGE) / 2, (1 + COVERAGE) / 2):
        low = (centres - 1e3 * widths - 1e-9).min(axis=0)
        high = (centres + 1e3 * widths + 1e-9).max(axis=0)
        for _ in range(60):
            middle = (low + high) / 2
            below = weights @ stdtr(degrees, (middle - centres) / np.maximum(widths, 1e-12)) < wanted
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        ends.append((low + high) / 2)
    return ends[0], ends[1]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _or_infinite(value: object) -> float:
    return math.inf if value is None else float(value)  # type: ignore[arg-type]
