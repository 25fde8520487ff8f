"""Two resources at once: the smooth maximum of two sums, as of a CPU beside a GPU or of bandwidth beside arithmetic."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tuning.law import Law, combined
from tuning.robust_fit import Problems, solve
from tuning.subsets import Problem, n_folds_of
from tuning.terms import CONSTANT, Term

SIZE = 3  # two terms, and that the larger of them counts
_FEWEST_ROWS = 10
_FEWEST_ON_A_SIDE = 3
_MOST_SURPRISE = 1.5
_MOST_CANDIDATES = 14
_TRIED_IN_A_FOLD = 40
_LEAST_SHARE = 0.02  # a constant that is nowhere a larger part than this is dropped


@dataclass(frozen=True)
class Overlap:
    """The best law of this kind.

    - `error`, `standard_error`: of rows predicted by the pair of terms that was best without them.
    - `merit`: as of the sets of terms; smaller is better.
    """

    law: Law
    error: float
    standard_error: float
    merit: float


def best_overlap(problem: Problem, terms: Sequence[Term], delta: float) -> Overlap | None:
    """Over all pairs of plain terms, each with a constant beside it; `None` where no pair has rows on both sides.

    **Arguments:**

    - `terms`: of the columns of `problem`, the first is the constant.
    - `delta`: see `robust_fit.Problems`.
    """
    plain = [k for k, t in enumerate(terms) if t.factors and t.shape == "whole" and t.surprise <= _MOST_SURPRISE]
    plain = sorted(plain, key=lambda k: terms[k].surprise)[:_MOST_CANDIDATES]
    pairs = np.array(list(itertools.combinations(plain, 2)), int).reshape(-1, 2)
    n_rows = len(problem.times_ms)
    if n_rows < _FEWEST_ROWS or not len(pairs):
        return None
    scale = (problem.columns / problem.times_ms[:, None]).max(axis=0)
    scaled = problem.columns / scale
    starts = np.concatenate([_starts(problem, scaled, pairs, part) for part in (0.3, 0.5, 0.7)])
    log_costs, losses = _solve(problem, scaled, np.tile(pairs, (3, 1)), problem.weights, starts, delta)
    # The best start of each pair.
    of_start = losses.reshape(3, len(pairs))
    best_start = of_start.argmin(axis=0) * len(pairs) + np.arange(len(pairs))
    log_costs, losses = log_costs[best_start], losses[best_start]
    sound = np.isfinite(losses) & _has_two_sides(scaled, pairs, log_costs)
    merits = _merits(problem, terms, pairs, losses)
    ranked = np.flatnonzero(sound)[np.argsort(merits[sound], kind="stable")][:_TRIED_IN_A_FOLD]
    if not len(ranked):
        return None
    pairs, log_costs, merits = pairs[ranked], log_costs[ranked], merits[ranked]

    n_folds = n_folds_of(problem)
    fold = problem.folds(n_folds)
    weights = np.concatenate([np.tile(problem.weights * (fold != k), (len(pairs), 1)) for k in range(n_folds)])
    refitted, loss = _solve(
        problem, scaled, np.tile(pairs, (n_folds, 1)), weights, np.tile(log_costs, (n_folds, 1)), delta
    )
    left_out = np.empty(n_rows)
    for k in range(n_folds):
        lanes = slice(k * len(pairs), (k + 1) * len(pairs))
        best = int(_merits(problem, terms, pairs, loss[lanes]).argmin())
        held = fold == k
        predicted = combined(_design(scaled, pairs[best])[held], np.exp(refitted[lanes][best]), _SIDES)
        left_out[held] = np.abs(np.log(problem.times_ms[held] / predicted))
    costs = np.exp(log_costs[0]) / scale[[0, pairs[0, 0], 0, pairs[0, 1]]]
    law = _without_idle(
        Law(
            (CONSTANT, terms[pairs[0, 0]], CONSTANT, terms[pairs[0, 1]]),
            tuple(map(float, costs)),
            tuple(_SIDES.tolist()),
        ),
        _design(problem.columns, pairs[0]),
    )
    error, spread = float(left_out.mean()), float(np.std(left_out, ddof=1) / np.sqrt(n_rows))
    return Overlap(law, error, spread, float(merits[0]))


_SIDES = np.array([0, 0, 1, 1])


def _design(columns: np.ndarray, pair: np.ndarray) -> np.ndarray:
    return columns[:, [0, pair[0], 0, pair[1]]]


def _solve(
    problem: Problem, scaled: np.ndarray, pairs: np.ndarray, weights: np.ndarray, starts: np.ndarray, delta: float
) -> tuple[np.ndarray, np.ndarray]:
    lanes, n_rows = len(pairs), len(problem.times_ms)
    constant = np.zeros(lanes, int)
    chosen = np.stack([constant, pairs[:, 0], constant, pairs[:, 1]], axis=1)
    return solve(
        Problems(
            scaled.T[chosen].transpose(0, 2, 1),
            np.broadcast_to(_SIDES, (lanes, 4)),
            np.broadcast_to(np.log(problem.times_ms), (lanes, n_rows)),
            np.broadcast_to(weights, (lanes, n_rows)),
            starts,
            delta,
        )
    )


def _starts(problem: Problem, scaled: np.ndarray, pairs: np.ndarray, part: float) -> np.ndarray:
    """One side explains the rows where its term is large against the other's, the other side the rest."""
    starts = np.empty((len(pairs), 4))
    log_times = np.log(problem.times_ms)
    for k, (one, other) in enumerate(pairs):
        logs = np.log(np.maximum(scaled[:, [one, other]], 1e-12))
        first = np.argsort(np.argsort(logs[:, 1] - logs[:, 0])) < part * len(log_times)
        starts[k, 1] = np.median((log_times - logs[:, 0])[first])
        starts[k, 3] = np.median((log_times - logs[:, 1])[~first])
    starts[:, [0, 2]] = np.log(0.2)  # a fifth of the shortest time: columns are scaled by the times
    return starts


def _has_two_sides(scaled: np.ndarray, pairs: np.ndarray, log_costs: np.ndarray) -> np.ndarray:
    fewest = np.empty(len(pairs), int)
    for k, pair in enumerate(pairs):
        parts = _design(scaled, pair) * np.exp(np.clip(log_costs[k], -60, 60))
        first = parts[:, :2].sum(axis=1) > parts[:, 2:].sum(axis=1)
        # Both terms must count where their side does: a constant beside a term is a saturation, and that is a cut.
        fewest[k] = min(
            int((first & (parts[:, 1] > 0.2 * parts[:, 0])).sum()),
            int((~first & (parts[:, 3] > 0.2 * parts[:, 2])).sum()),
        )
    return fewest >= _FEWEST_ON_A_SIDE


def _merits(problem: Problem, terms: Sequence[Term], pairs: np.ndarray, losses: np.ndarray) -> np.ndarray:
    surprise = np.array([terms[a].surprise + terms[b].surprise for a, b in pairs])
    return len(problem.times_ms) / 2 * np.log(losses + 1e-12) + surprise


def _without_idle(law: Law, design: np.ndarray) -> Law:
    parts = design * np.array(law.costs_ms)
    sides = np.array(law.sides)
    total = np.stack([parts[:, sides == side].sum(axis=1) for side in (0, 1)], axis=1)
    works = (parts / total[:, sides]).max(axis=0) > _LEAST_SHARE
    keep = [k for k, term in enumerate(law.terms) if term.factors or works[k]]
    return Law(
        tuple(law.terms[k] for k in keep), tuple(law.costs_ms[k] for k in keep), tuple(law.sides[k] for k in keep)
    )
