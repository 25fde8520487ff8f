"""Two resources at once: the smooth maximum of two sums, as of a CPU beside a GPU or of bandwidth beside arithmetic."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tuning.law import Law, combined
from tuning.robust_fit import Problems, solve
from tuning.select import n_folds_of
from tuning.subsets import Problem
from tuning.terms import Term

_FEWEST_ROWS = 10
_FEWEST_ON_A_SIDE = 3
_MOST_SURPRISE = 1.5
_MOST_CANDIDATES = 14
_MOST_TERMS = 4  # beside a constant on either side
_TRIED_IN_A_FOLD = 30
_LEAST_SHARE = 0.02  # a constant that is nowhere a larger part than this is dropped

_Spec = tuple[tuple[int, ...], tuple[int, ...]]
"""The terms on either side, beside a constant each."""


@dataclass(frozen=True)
class Overlap:
    """A law of this kind.

    - `size`: its terms, and one for the larger of two.
    - `error`, `standard_error`: of rows predicted by the terms that were best without them.
    - `merit`: as of the sets of terms; smaller is better.
    """

    law: Law
    size: int
    error: float
    standard_error: float
    merit: float


def best_overlaps(problem: Problem, terms: Sequence[Term], delta: float) -> list[Overlap]:
    """The best pair of plain terms, then one more term at a time for as long as the left-out rows gain by it.

    None where no pair has rows on both sides.

    **Arguments:**

    - `terms`: of the columns of `problem`, the first is the constant.
    - `delta`: see `robust_fit.Problems`.
    """
    plain = [k for k, t in enumerate(terms) if t.factors and t.shape == "whole" and t.surprise <= _MOST_SURPRISE]
    plain = sorted(plain, key=lambda k: terms[k].surprise)[:_MOST_CANDIDATES]
    if len(problem.times_ms) < _FEWEST_ROWS or len(plain) < 2:
        return []
    scale = (problem.columns / problem.times_ms[:, None]).max(axis=0)
    table = _Table(problem, problem.columns / scale, np.array([term.surprise for term in terms]), delta)
    pairs: list[_Spec] = [((a,), (b,)) for a, b in itertools.combinations(plain, 2)]
    starts = np.concatenate([_starts(table, pairs, part) for part in (0.3, 0.5, 0.7)])
    found = table.best(pairs * 3, starts)
    overlaps: list[Overlap] = []
    while found:
        best = _judged(table, terms, scale, found[:_TRIED_IN_A_FOLD])
        if overlaps and best.error >= overlaps[-1].error:
            break
        overlaps.append(best)
        spec, log_costs = found[0].spec, found[0].log_costs
        if len(spec[0]) + len(spec[1]) == _MOST_TERMS:
            break
        grown, starts = [], []
        for k, side in itertools.product(plain, (0, 1)):
            if k not in spec[side]:
                at = (0, 1 + len(spec[0]))[side] + 1  # a term goes first, after its side's constant
                grown.append(((k, *spec[0]), spec[1]) if side == 0 else (spec[0], (k, *spec[1])))
                starts.append(np.insert(log_costs, at, np.log(0.1)))
        found = table.best(grown, np.array(starts)) if grown else []
    return overlaps


@dataclass(frozen=True)
class _Fitted:
    spec: _Spec
    log_costs: np.ndarray
    merit: float


@dataclass(frozen=True)
class _Table:
    """A problem with its columns scaled such that a cost of 1 is the whole time of some row."""

    problem: Problem
    scaled: np.ndarray
    surprise: np.ndarray
    delta: float

    def solve(self, specs: Sequence[_Spec], weights: np.ndarray, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        lanes, n_rows = len(specs), len(self.problem.times_ms)
        chosen = np.array([_places(spec) for spec in specs])
        return solve(
            Problems(
                self.scaled.T[chosen].transpose(0, 2, 1),
                np.array([_sides(spec) for spec in specs]),
                np.broadcast_to(np.log(self.problem.times_ms), (lanes, n_rows)),
                np.broadcast_to(weights, (lanes, n_rows)),
                starts,
                self.delta,
            )
        )

    def best(self, specs: Sequence[_Spec], starts: np.ndarray) -> list[_Fitted]:
        """Those with rows on both sides, each at its best start, best first."""
        log_costs, losses = self.solve(specs, self.problem.weights, starts)
        merits = self.merits(specs, losses)
        found: dict[_Spec, _Fitted] = {}
        for k in np.argsort(merits, kind="stable"):
            if np.isfinite(losses[k]) and specs[k] not in found and self._has_two_sides(specs[k], log_costs[k]):
                found[specs[k]] = _Fitted(specs[k], log_costs[k], float(merits[k]))
        return list(found.values())

    def merits(self, specs: Sequence[_Spec], losses: np.ndarray) -> np.ndarray:
        surprise = np.array([self.surprise[[*one, *other]].sum() for one, other in specs])
        return len(self.problem.times_ms) / 2 * np.log(losses + 1e-12) + surprise

    def _has_two_sides(self, spec: _Spec, log_costs: np.ndarray) -> bool:
        parts = self.scaled[:, _places(spec)] * np.exp(np.clip(log_costs, -60, 60))
        sides = np.array(_sides(spec))
        first = parts[:, sides == 0].sum(axis=1) > parts[:, sides == 1].sum(axis=1)
        # Terms must count where their side does: a constant beside a term is a saturation, and that is a cut.
        at = 1 + len(spec[0])
        works = (
            first & (parts[:, 1:at].sum(axis=1) > 0.2 * parts[:, 0]),
            ~first & (parts[:, at + 1 :].sum(axis=1) > 0.2 * parts[:, at]),
        )
        return min(int(rows.sum()) for rows in works) >= _FEWEST_ON_A_SIDE


def _places(spec: _Spec) -> list[int]:
    return [0, *spec[0], 0, *spec[1]]


def _sides(spec: _Spec) -> list[int]:
    return [0] * (1 + len(spec[0])) + [1] * (1 + len(spec[1]))


def _judged(table: _Table, terms: Sequence[Term], scale: np.ndarray, tried: Sequence[_Fitted]) -> Overlap:
    """The first, with the error of rows predicted by whichever is best without them."""
    problem = table.problem
    n_folds = n_folds_of(problem)
    fold = problem.folds(n_folds)
    specs = [one.spec for one in tried]
    weights = np.concatenate([np.tile(problem.weights * (fold != k), (len(specs), 1)) for k in range(n_folds)])
    starts = np.tile(np.array([one.log_costs for one in tried]), (n_folds, 1))
    refitted, losses = table.solve(specs * n_folds, weights, starts)
    left_out, of_first = np.empty(len(fold)), np.empty(len(fold))
    for k in range(n_folds):
        lanes = slice(k * len(specs), (k + 1) * len(specs))
        best = int(table.merits(specs, losses[lanes]).argmin())
        for which, errors in ((best, left_out), (0, of_first)):
            design, sides = table.scaled[fold == k][:, _places(specs[which])], np.array(_sides(specs[which]))
            predicted = combined(design, np.exp(refitted[lanes][which]), sides)
            errors[fold == k] = np.abs(np.log(problem.times_ms[fold == k] / predicted))
    places = _places(specs[0])
    costs = np.exp(tried[0].log_costs) / scale[places]
    law = Law(tuple(terms[k] for k in places), tuple(map(float, costs)), tuple(_sides(specs[0])))
    return Overlap(
        _without_idle(law, problem.columns[:, places]),
        sum(terms[k].size for k in places if k) + 1,
        float(left_out.mean()),
        float(np.std(left_out, ddof=1) / np.sqrt(len(fold))),
        # By rows it was not fitted to, as sets of terms are: the two are weighed against each other.
        problem.merit_of(float(of_first.mean()), [k for k in places if k]),
    )


def _starts(table: _Table, pairs: Sequence[_Spec], part: float) -> np.ndarray:
    """One side explains the rows where its term is large against the other's, the other side the rest."""
    starts = np.full((len(pairs), 4), np.log(0.2))  # constants of a fifth of the shortest time
    log_times = np.log(table.problem.times_ms)
    for k, ((one,), (other,)) in enumerate(pairs):
        logs = np.log(np.maximum(table.scaled[:, [one, other]], 1e-12))
        first = np.argsort(np.argsort(logs[:, 1] - logs[:, 0])) < part * len(log_times)
        starts[k, 1] = np.median((log_times - logs[:, 0])[first])
        starts[k, 3] = np.median((log_times - logs[:, 1])[~first])
    return starts


def _without_idle(law: Law, design: np.ndarray) -> Law:
    parts = design * np.array(law.costs_ms)
    sides = np.array(law.sides)
    total = np.stack([parts[:, sides == side].sum(axis=1) for side in (0, 1)], axis=1)
    works = (parts / total[:, sides]).max(axis=0) > _LEAST_SHARE
    keep = [k for k, term in enumerate(law.terms) if term.factors or works[k]]
    return Law(
        tuple(law.terms[k] for k in keep), tuple(law.costs_ms[k] for k in keep), tuple(law.sides[k] for k in keep)
    )
