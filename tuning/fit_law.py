"""From rows of one technique and stage to a model: candidates, selection, robust fit, error bars."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuning.bootstrap import bootstrap_costs
from tuning.family import candidate_terms
from tuning.law import Law
from tuning.overlap import best_overlaps
from tuning.robust_fit import MOST_COSTS, Problems, influence, solve
from tuning.subsets import DIFFERENCE, Problem, Scored, Selection, select_subset
from tuning.terms import CONSTANT, Term
from tuning.time_model import COVERAGE, Influence, LeftOut, PlausibleLaw, TimeModel, stretched

MOST_TERMS = 4
_MOST_PLAUSIBLE = 8
_MOST_WORSE = 4.0  # nats: what is less likely than that is no longer plausible
_STARTS = 8
_FEWEST_ROWS = 4
_HUBER = 1.5
_SOFTENED = 0.700  # mean of z^2 / sqrt(1 + (z / _HUBER)^2) for a normal z: what softening leaves of the variance
_CHI2_90 = 2.71
_REFITS = 256
_DIRECTIONS = 512
_MOST_INFLUENTIAL = 3
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
    columns = columns or {"": np.zeros(len(times_ms))}  # a constant needs no column, but as many times as rows
    every = [CONSTANT, *terms]
    problem = Problem(
        np.stack([term.values(columns) for term in every], axis=1),
        times_ms,
        _weights(repeats_ms),
        np.array([term.size if term.factors else 0 for term in every]),
        np.array([term.surprise for term in every]),
    )
    n_rows = len(times_ms)
    if terms and n_rows < _FEWEST_ROWS:
        messages.append(f"{n_rows} rows: too few to tell how wrong the law is; measure at least {_FEWEST_ROWS}.")
    selection = select_subset(problem, min(MOST_TERMS, max(n_rows - 3, int(n_rows == 3))))
    delta = _HUBER * max(1.4826 * float(np.median(np.abs(selection.chosen.left_out))), _NOISE_FLOOR)
    found = [
        _Found(_law(every, one), one.size, error, spread, problem.merit(one))
        for one, error, spread in zip(selection.path, selection.errors, selection.standard_errors, strict=True)
    ]
    # One term may be enough; what two resources make of a time takes at least two.
    overlaps = best_overlaps(problem, every, delta) if selection.chosen.size > 1 else []
    found += [_Found(one.law, one.size, one.error, one.standard_error, one.merit) for one in overlaps]
    best = min(found, key=lambda one: one.error)
    enough = [one for one in found if one.error <= best.error + DIFFERENCE * best.spread]
    chosen = min(enough, key=lambda one: (one.size, one.error))
    law, dropped = _identified(problem, columns, chosen.law, delta)
    if dropped:
        messages += dropped
        chosen = replace(chosen, law=law)
    alike = [_Found(_law(every, one), one.size, one.error, 0.0, problem.merit(one)) for one in selection.scored]
    alike = [one for one in alike if one.size <= chosen.size and one.law.terms != chosen.law.terms]
    alike = sorted((one for one in alike if one.merit < chosen.merit + _MOST_WORSE), key=lambda one: one.merit)
    plausible = [chosen, *alike[: _MOST_PLAUSIBLE - 1]]
    weights = np.exp(-(np.array([one.merit for one in plausible]) - min(one.merit for one in plausible)))
    laws = _with_error_bars(problem, columns, [one.law for one in plausible], weights / weights.sum(), delta)
    best_law = laws[0].law
    resampled = bootstrap_costs(best_law, columns, repeats_ms, problem.weights, delta, _REFITS, seed)
    ends = np.quantile(resampled, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], axis=0)
    constant = next((one.error for one in found if one.size == 0), math.inf)
    return TimeModel(
        laws=laws,
        n_rows=n_rows,
        error=chosen.error if n_rows > 1 else math.inf,
        constant_error=constant if n_rows > 1 else math.inf,
        hull=_hull({name: columns[name] for name in laws[0].law.columns}),
        ranges={
            name: (float(column.min()), float(column.max()))
            for name, column in columns.items()
            if name and name not in laws[0].law.columns
        },
        left_out=_left_out(every, selection, chosen.law),
        messages=tuple(messages),
        cost_intervals_ms=tuple((float(low), float(high)) for low, high in ends.T),
        influential=_influential(problem, columns, best_law, delta),
    )


@dataclass(frozen=True)
class _Found:
    """A law of some size, and what rows say that it, or rather its selection, had not seen."""

    law: Law
    size: int
    error: float
    spread: float
    merit: float


def _law(every: Sequence[Term], one: Scored) -> Law:
    return Law(tuple(every[k] for k in one.support), tuple(map(float, one.costs)), (0,) * len(one.support))


def _identified(problem: Problem, columns: Mapping[str, np.ndarray], law: Law, delta: float) -> tuple[Law, list[str]]:
    """Without the terms whose profile likelihood at a cost of zero is within the 90 % region, and messages.

    Terms that grow together on these rows can stand in for each other: neither is then needed beside the other.
    """
    messages: list[str] = []
    while sum(bool(term.factors) for term in law.terms) > 1 and not any(law.sides):
        without = [_without(law, k) for k, term in enumerate(law.terms) if term.factors]
        refitted, losses = refit(problem.times_ms, problem.weights, columns, [law, *without], delta)
        degrees = max(len(problem.times_ms) - len(law.terms), 1)
        # Log of the likelihood ratio, the noise profiled out as well.
        ratio = degrees * np.log(np.maximum(losses[1:], 1e-12) / max(losses[0], 1e-12))
        weakest = int(ratio.argmin())
        if ratio[weakest] >= _CHI2_90:
            break
        gone = next(term.name for term in law.terms if term not in without[weakest].terms)
        law = refitted[1 + weakest]
        messages.append(f"`{gone}` cannot be told from the other terms on these rows: dropped.")
    return law, messages


def _without(law: Law, k: int) -> Law:
    return Law(
        law.terms[:k] + law.terms[k + 1 :], law.costs_ms[:k] + law.costs_ms[k + 1 :], law.sides[:k] + law.sides[k + 1 :]
    )


def _left_out(every: Sequence[Term], selection: Selection, law: Law) -> tuple[LeftOut, ...]:
    """Each term that was tried with the chosen ones, and the error with it, best first."""
    taken = set(law.terms) - {CONSTANT}
    errors: dict[str, float] = {}
    for one in selection.scored:
        terms = {every[k] for k in one.support} - {CONSTANT}
        if len(terms) == len(taken) + 1 and terms > taken:
            errors.setdefault(next(iter(terms - taken)).name, one.error)
    return tuple(LeftOut(term, error) for term, error in sorted(errors.items(), key=lambda item: item[1]))


def _hull(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rows whose convex hull is that of all, or hardly smaller: the furthest in many directions."""
    if not columns:
        return {}
    points = np.stack([stretched(column, column) for column in columns.values()], axis=1)
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, len(columns)))
    directions = np.vstack([directions, np.eye(len(columns)), -np.eye(len(columns))])
    furthest = np.unique((points @ directions.T).argmax(axis=0))
    return {name: np.asarray(column, float)[furthest] for name, column in columns.items()}


def _influential(problem: Problem, columns: Mapping[str, np.ndarray], law: Law, delta: float) -> tuple[Influence, ...]:
    design = law.design(columns)
    scale = (design / problem.times_ms[:, None]).max(axis=0)
    at_optimum = Problems(
        (design / scale)[None],
        np.array(law.sides)[None],
        np.log(problem.times_ms)[None],
        problem.weights[None],
        np.log(np.array(law.costs_ms) * scale)[None],
        delta,
    )
    moved = np.sqrt(np.mean((law.slopes(columns) @ influence(at_optimum)) ** 2, axis=0))
    return tuple(
        Influence({name: float(column[row]) for name, column in columns.items() if name}, float(moved[row]))
        for row in np.argsort(-moved, kind="stable")[:_MOST_INFLUENTIAL]
    )


def _with_error_bars(
    problem: Problem, columns: Mapping[str, np.ndarray], laws: Sequence[Law], weights: np.ndarray, delta: float
) -> tuple[PlausibleLaw, ...]:
    """All laws fitted again from many starts, with the covariance of their costs from the Jacobian."""
    refitted, _ = refit(problem.times_ms, problem.weights, columns, laws, delta)
    found = []
    for law, weight in zip(refitted, weights, strict=True):
        slopes = law.slopes(columns)
        residual = np.log(problem.times_ms / law.predict(columns))
        softened = problem.weights / np.sqrt(1 + (residual / delta) ** 2)
        degrees = max(len(residual) - len(law.terms), 1)
        spread = max(math.sqrt(float(np.sum(softened * residual**2)) / degrees / _SOFTENED), _NOISE_FLOOR)
        covariance = np.linalg.pinv(slopes.T @ (softened[:, None] * slopes), hermitian=True) * spread**2
        found.append(PlausibleLaw(law, float(weight), covariance, spread))
    return tuple(found)


def refit(
    times_ms: np.ndarray,
    weights: np.ndarray,
    columns: Mapping[str, np.ndarray],
    laws: Sequence[Law],
    delta: float,
    seed: int = 0,
) -> tuple[list[Law], np.ndarray]:
    """The same laws at the optimum of the robust loss, and that loss: from their costs, and starts about them."""
    rng = np.random.default_rng(seed)
    n_rows = len(times_ms)
    lanes = len(laws) * _STARTS
    designs = np.zeros((lanes, n_rows, MOST_COSTS))
    sides = np.full((lanes, MOST_COSTS), -1)
    starts = np.zeros((lanes, MOST_COSTS))
    scales = []
    for k, law in enumerate(laws):
        own, n = slice(k * _STARTS, (k + 1) * _STARTS), len(law.terms)
        design = law.design(columns)
        scales.append((design / times_ms[:, None]).max(axis=0))
        designs[own, :, :n] = design / scales[-1]
        sides[own, :n] = law.sides
        starts[own, :n] = np.log(np.array(law.costs_ms) * scales[-1])
        starts[own, :n][1:] += rng.normal(0, 1, (_STARTS - 1, n))
    log_costs, losses = solve(
        Problems(
            designs,
            sides,
            np.broadcast_to(np.log(times_ms), (lanes, n_rows)),
            np.broadcast_to(weights, (lanes, n_rows)),
            starts,
            delta,
        )
    )
    refitted, lowest = [], np.empty(len(laws))
    for k, (law, scale) in enumerate(zip(laws, scales, strict=True)):
        best = k * _STARTS + int(losses[k * _STARTS : (k + 1) * _STARTS].argmin())
        costs = np.exp(log_costs[best, : len(law.terms)]) / scale
        refitted.append(replace(law, costs_ms=tuple(map(float, costs))))
        lowest[k] = losses[best]
    return refitted, lowest


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
