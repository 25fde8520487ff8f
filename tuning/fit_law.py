"""From rows of one technique and stage to a model: candidates, selection, robust fit, error bars."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from tuning.family import candidate_terms
from tuning.law import Law
from tuning.subsets import Problem, Scored, select_subset
from tuning.terms import CONSTANT, Term
from tuning.time_model import LeftOut, PlausibleLaw, TimeModel

MOST_TERMS = 4
_MOST_PLAUSIBLE = 8
_NOISE_FLOOR = 0.005
"""Relative: clocks and rounding leave no time better known than this."""


def fit_law(
    columns: Mapping[str, np.ndarray], repeats_ms: Sequence[Sequence[float]], stage: str | None, seed: int
) -> TimeModel:
    """The smallest law that the times support.

    **Arguments:**

    - `columns`: float64 `[rows]` each, finite.
    - `repeats_ms`: positive and finite.
    - `stage`: of the technique, where it is known.
    """
    columns, repeats_ms = _merged(columns, repeats_ms)
    times_ms = np.array([float(np.median(repeats)) for repeats in repeats_ms])
    terms, messages = candidate_terms(columns, stage)
    every = [CONSTANT, *terms]
    problem = Problem(
        np.stack([term.values(columns) for term in every], axis=1) if columns else np.ones((len(times_ms), 1)),
        times_ms,
        _weights(repeats_ms),
        np.array([term.size if term.factors else 0 for term in every]),
        np.array([term.surprise for term in every]),
    )
    selection = select_subset(problem, MOST_TERMS)
    chosen = selection.chosen
    near = [one for one in selection.scored if one.size <= chosen.size and one.support != chosen.support]
    near = [one for one in near if problem.merit(one) < problem.merit(chosen) + 4]
    plausible = [chosen, *sorted(near, key=problem.merit)[: _MOST_PLAUSIBLE - 1]]
    merits = np.array([problem.merit(one) for one in plausible])
    weights = np.exp(-(merits - merits.min()))
    laws = tuple(
        _with_error_bars(problem, every, one, float(weight))
        for one, weight in zip(plausible, weights / weights.sum(), strict=True)
    )
    errors = dict(zip((one.size for one in selection.path), selection.errors, strict=True))
    larger = [one for one in selection.scored if set(one.support) > set(chosen.support)]
    left_out = {
        every[next(iter(set(one.support) - set(chosen.support)))].name: one.error
        for one in sorted(larger, key=lambda one: -one.error)
        if len(one.support) == len(chosen.support) + 1
    }
    used = laws[0].law.columns
    return TimeModel(
        laws=laws,
        n_rows=len(times_ms),
        error=errors.get(chosen.size, math.inf) if len(times_ms) > 1 else math.inf,
        constant_error=errors.get(0, math.inf) if len(times_ms) > 1 else math.inf,
        hull={name: np.asarray(columns[name], float) for name in used},
        left_out=tuple(LeftOut(term, error) for term, error in reversed(left_out.items())),
        messages=tuple(messages),
    )


def _with_error_bars(problem: Problem, every: Sequence[Term], one: Scored, weight: float) -> PlausibleLaw:
    terms = tuple(every[k] for k in one.support)
    law = Law(terms, tuple(map(float, one.costs)), (0,) * len(terms))
    design = problem.columns[:, list(one.support)]
    predicted = design @ one.costs
    slopes = design * one.costs / predicted[:, None]
    residual = np.log(problem.times_ms / predicted)
    degrees = max(len(residual) - len(terms), 1)
    spread = max(math.sqrt(float(np.sum(problem.weights * residual**2)) / degrees), _NOISE_FLOOR)
    covariance = np.linalg.pinv(slopes.T @ (problem.weights[:, None] * slopes), hermitian=True) * spread**2
    return PlausibleLaw(law, weight, covariance, spread)


def _merged(
    columns: Mapping[str, np.ndarray], repeats_ms: Sequence[Sequence[float]]
) -> tuple[dict[str, np.ndarray], list[tuple[float, ...]]]:
    """Rows that agree in every column are repeats of one: they are no independent evidence."""
    rows: dict[tuple[float, ...], list[float]] = {}
    for k, repeats in enumerate(repeats_ms):
        rows.setdefault(tuple(float(column[k]) for column in columns.values()), []).extend(repeats)
    keys = np.array(list(rows)).reshape(len(rows), len(columns))
    merged = {name: keys[:, k] for k, name in enumerate(columns)}
    return merged, [tuple(repeats) for repeats in rows.values()]


def _weights(repeats_ms: Sequence[Sequence[float]]) -> np.ndarray:
    """Of squared relative residuals, mean 1: rows whose repeats scatter count less.

    The variance of a row is that of its median plus what no repeat shows, taken as the median of the former.
    """
    scatter = np.full(len(repeats_ms), np.nan)
    for k, repeats in enumerate(repeats_ms):
        if len(repeats) >= 3:
            logs = np.log(repeats)
            sigma = 1.4826 * np.median(np.abs(logs - np.median(logs)))
            scatter[k] = sigma**2 * math.pi / 2 / len(repeats)
    known = scatter[np.isfinite(scatter)]
    if not len(known):
        return np.ones(len(repeats_ms))
    typical = max(float(np.median(known)), _NOISE_FLOOR**2)
    weights = 1 / (np.where(np.isfinite(scatter), scatter, typical) + typical)
    return weights / weights.mean()
