"""What a cost model is asked: where two techniques cross, what fits in a budget, what matters, and what if it is wrong.

A time is the sum of `parts`: the models that `TableModel.parts` gives for a technique and stage. Intervals come from
plausible laws and costs (`TimeModel.samples_ms`): each sample answers the question for itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tuning.time_model import COVERAGE, TimeModel
from vtfs.input_error import InputError

Parts = Sequence[TimeModel]

BUDGETS_MS = (1000 / 60, 1000 / 30)
"""60 and 30 frames a second."""

_POINTS = 512
_SAMPLES = 512


@dataclass(frozen=True)
class Answer:
    """A size with its 90 % interval; NaN where there is none in the range that was asked for.

    - `probability`: of the samples that have one.
    - `extrapolated`: the size is beyond what the models were fitted to.
    """

    value: float
    low: float
    high: float
    probability: float
    extrapolated: bool


@dataclass(frozen=True)
class Choice:
    """The configuration that is predicted to be fastest.

    - `row`: of the candidates; or the number of the configuration, where several rows are one.
    - `expected_regret`, `worst_regret`: how much slower than the fastest it is, as a part of that, should the model be
      wrong: the mean over the samples, and what 95 % of them stay below.
    """

    row: int
    time_ms: float
    expected_regret: float
    worst_regret: float


def crossover(
    first: Parts, second: Parts, column: str, low: float, high: float, at: Mapping[str, float], seed: int = 0
) -> Answer:
    """The smallest size in `[low, high]` at which the other of the two becomes the faster one.

    **Arguments:**

    - `column`: the size that grows.
    - `at`: all other columns that the models depend on.

    **Raises:** `InputError` for an empty range or a missing column.
    """
    sizes, columns = _along(column, low, high, at)
    gap = np.log(_times_ms(first, columns) / _times_ms(second, columns))
    sampled = np.log(_samples_ms(first, columns, seed) / _samples_ms(second, columns, seed + 1))
    return _answer(sizes, gap, sampled, column, at, (*first, *second))


def largest_within(
    parts: Parts, budget_ms: float, column: str, low: float, high: float, at: Mapping[str, float], seed: int = 0
) -> Answer:
    """The largest size up to which the time stays within the budget; `high` where it does so in the whole range.

    **Raises:** `InputError` for a budget that is not positive, an empty range or a missing column.
    """
    if not budget_ms > 0:
        raise InputError(f"budget {budget_ms} ms: must be positive, such as 16.7.")
    sizes, columns = _along(column, low, high, at)
    gap = np.log(_times_ms(parts, columns) / budget_ms)
    sampled = np.log(_samples_ms(parts, columns, seed) / budget_ms)
    if gap[0] > 0:
        within = float((sampled[:, 0] <= 0).mean())
        return Answer(np.nan, np.nan, np.nan, within, False)
    # What never leaves the budget ends with the range.
    gap = np.append(gap, 1.0)
    sampled = np.column_stack([sampled, np.ones(len(sampled))])
    return _answer(np.append(sizes, sizes[-1]), gap, sampled[sampled[:, 0] <= 0], column, at, tuple(parts))


def sensitivities(parts: Parts, point: Mapping[str, float]) -> dict[str, float]:
    """d log(time) / d log(column) for every column: 1 where twice as much takes twice as long. By `jax.grad`.

    **Raises:** `InputError` where a column is missing.
    """
    import jax
    import jax.numpy as jnp

    names = list(dict.fromkeys(name for part in parts for name in part.columns))
    for name in names:
        if name not in point:
            raise InputError(f"column `{name}`: missing; the model depends on it, say where to look.")
    if not names:
        return {}

    def log_time(values):
        columns = dict(zip(names, values, strict=True))
        return jnp.log(sum(part.law.predict_one(columns) for part in parts))

    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        values = jnp.array([float(point[name]) for name in names])
        slopes = np.asarray(jax.grad(log_time)(values) * values)
    return dict(zip(names, map(float, slopes), strict=True))


def best_configuration(
    parts: Parts, candidates: Mapping[str, np.ndarray], seed: int = 0, configuration: np.ndarray | None = None
) -> Choice:
    """The row that is predicted to be fastest, and what it costs should the model be wrong.

    **Arguments:**

    - `configuration`: int `[rows]`, from 0 without gaps: where a configuration has a row for each of some frames, their
      mean decides. `None`: each row is one.

    **Raises:** `InputError` where there is no row, or a column is missing.
    """
    if not len(next(iter(candidates.values()), ())):
        raise InputError("candidates: there are none; give at least one configuration.")
    times_ms = _times_ms(parts, candidates)
    sampled = _samples_ms(parts, candidates, seed)
    if configuration is not None:
        means = np.eye(int(configuration.max()) + 1)[configuration] / np.bincount(configuration)
        times_ms, sampled = times_ms @ means, sampled @ means
    return fastest_of(times_ms, sampled)


def fastest_of(times_ms: np.ndarray, sampled_ms: np.ndarray) -> Choice:
    """The choice by predicted times `[configurations]`; `sampled_ms`, `[samples, configurations]`, is what may be."""
    row = int(times_ms.argmin())
    regret = sampled_ms[:, row] / sampled_ms.min(axis=1) - 1
    return Choice(row, float(times_ms[row]), float(regret.mean()), float(np.quantile(regret, 0.95)))


def _along(column: str, low: float, high: float, at: Mapping[str, float]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    if not 0 < low < high < np.inf:
        raise InputError(f"range of `{column}`, {low:g} to {high:g}: must be two positive numbers, the smaller first.")
    sizes = np.geomspace(low, high, _POINTS)
    return sizes, {name: np.full(_POINTS, float(value)) for name, value in at.items()} | {column: sizes}


def _times_ms(parts: Parts, columns: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.sum([part.times_ms(columns) for part in parts], axis=0)


def _samples_ms(parts: Parts, columns: Mapping[str, np.ndarray], seed: int) -> np.ndarray:
    return np.sum([part.samples_ms(columns, _SAMPLES, seed + 7 * k) for k, part in enumerate(parts)], axis=0)


def _answer(
    sizes: np.ndarray,
    gap: np.ndarray,
    sampled: np.ndarray,
    column: str,
    at: Mapping[str, float],
    parts: Parts,
) -> Answer:
    value = float(_first_zero(sizes, gap[None])[0])
    zeros = _first_zero(sizes, sampled) if len(sampled) else np.array([np.nan])
    found = zeros[np.isfinite(zeros)]
    ends = np.quantile(found, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2]) if len(found) else (np.nan, np.nan)
    extrapolated = False
    if np.isfinite(value):
        point = {name: np.array([float(number)]) for name, number in at.items()} | {column: np.array([value])}
        extrapolated = any(float(part.beyond(point)[0]) > 0 for part in parts)
    return Answer(value, float(ends[0]), float(ends[1]), len(found) / max(len(zeros), 1), extrapolated)


def _first_zero(sizes: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Where each row of `gaps` first changes sign, between two sizes by a straight line over the log of the size."""
    changed = np.signbit(gaps[:, 1:]) != np.signbit(gaps[:, :-1])
    k = changed.argmax(axis=1)
    rows = np.arange(len(gaps))
    before, after = gaps[rows, k], gaps[rows, k + 1]
    logs = np.log(sizes)
    crossed = changed.any(axis=1)
    at = logs[k] + (logs[k + 1] - logs[k]) * before / np.where(crossed, before - after, 1.0)
    return np.exp(np.where(crossed, at, np.nan))
