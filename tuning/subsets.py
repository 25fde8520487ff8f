"""Every small set of terms, fitted and left out at once: which sums of terms explain the times.

Costs are never negative. The non-negative optimum is the plain least-squares optimum of the terms it keeps, so it is
found by solving all small sets without a bound and keeping those whose costs are positive: thousands of solves of at
most six unknowns are one batched call, and leaving a row out is a formula and no refit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

_SCORED = 200  # sets of a size that are fitted robustly, those with the smallest plain residual
_MOST_NUMBERS = 400_000  # rows times sets at once: they are copied a few times, for each term
_BEAM = 30  # sets of a size that are grown
_MOST_PAIRS = 120_000
_ROUNDS = 5
_HUBER = 1.5  # residuals beyond this many standard deviations count by their size, not their square


@dataclass(frozen=True)
class Scored:
    """A set of terms, its costs, and how far off it is for each row it was not fitted to.

    - `support`: indices of the terms, 0 is the constant; sorted.
    - `left_out`: float64 `[rows]`, log of measured over predicted; `error` is its mean size.
    """

    support: tuple[int, ...]
    costs: np.ndarray
    left_out: np.ndarray
    size: int
    error: float


@dataclass(frozen=True)
class Problem:
    """Times and what they may be made of.

    - `columns`: float64 `[rows, terms]`, the first is the constant 1; none negative.
    - `times_ms`: `[rows]`, positive.
    - `weights`: `[rows]`, of squared relative residuals, mean 1.
    - `sizes`: int `[terms]`, what a term adds to the size of a set.
    - `surprise`: `[terms]`, how unlikely a term is beforehand, in nats: of two that fit alike the plainer is taken.
    - `group`: int `[rows]`, from 0 without gaps: rows of a group, as the frames of one configuration, are no
      independent evidence and leave together. Each row by itself unless given.
    """

    columns: np.ndarray
    times_ms: np.ndarray
    weights: np.ndarray
    sizes: np.ndarray
    surprise: np.ndarray
    group: np.ndarray | None = None

    def rows(self, keep: np.ndarray) -> Problem:
        group = None if self.group is None else np.unique(self.group[keep], return_inverse=True)[1]
        return Problem(self.columns[keep], self.times_ms[keep], self.weights[keep], self.sizes, self.surprise, group)

    @property
    def n_groups(self) -> int:
        return len(self.times_ms) if self.group is None else int(self.group.max()) + 1

    def folds(self, n: int) -> np.ndarray:
        """Which of `n` folds a row is in: neighbours in time in different ones, so that each sees the whole range."""
        of_group = np.empty(self.n_groups, int)
        of_group[np.argsort(self.group_means(self.times_ms), kind="stable")] = np.arange(len(of_group)) % n
        return of_group if self.group is None else of_group[self.group]

    def group_means(self, of_rows: np.ndarray) -> np.ndarray:
        """`[groups]`, of one number a row."""
        return of_rows if self.group is None else np.bincount(self.group, of_rows) / np.bincount(self.group)

    def merit(self, one: Scored) -> float:
        """Smaller is better: what the left-out rows say, and what was known beforehand."""
        return self.merit_of(one.error, one.support)

    def merit_of(self, error: float, support: Sequence[int]) -> float:
        """The same for any law of these terms whose rows that it was not fitted to are off by `error` in the mean."""
        return len(self.times_ms) * float(np.log(error + 1e-6)) + float(self.surprise[list(support)].sum())


def score_subsets(problem: Problem, most_terms: int, most_scored: int = _SCORED) -> list[Scored]:
    """The best sets of up to `most_terms` terms beside the constant, best first within each size, smallest first."""
    n_rows, n_terms = problem.columns.shape
    most_scored = min(most_scored, max(_MOST_NUMBERS // n_rows, _BEAM))
    scaled, scale = _scaled(problem)
    times_ms, weights, sizes = problem.times_ms, problem.weights, problem.sizes
    scored = _scored(scaled, times_ms, weights, np.zeros((1, 1), int), sizes)
    # The plain residual that picks sets to look at is ruled by an outlier: weights from the best set so far, twice.
    for again in range(2):
        outlying = _row_weights(scored[0].left_out)
        if again and outlying.min() > 0.5:
            break
        if not again:
            outlying = np.ones(n_rows)
        by_support = {found.support: found for found in scored}
        beam = np.zeros((1, 1), int)
        for level in range(1, min(most_terms, max(n_rows - 2, 1), n_rows - 1, n_terms - 1) + 1):
            if level == 2 and (n_terms - 1) * (n_terms - 2) // 2 <= _MOST_PAIRS:
                one, other = np.triu_indices(n_terms - 1, 1)
                grown = np.column_stack([np.zeros_like(one), one + 1, other + 1])
            else:
                grown = _grown(beam, n_terms)
            ranked = _ranked(problem, scaled, weights * outlying, grown)[:most_scored]
            if not len(ranked):
                break
            beam = ranked[:_BEAM]
            by_support |= {one.support: one for one in _scored(scaled, times_ms, weights, ranked, sizes)}
        scored = sorted(by_support.values(), key=problem.merit)
    unscaled = [replace(one, costs=one.costs / scale[list(one.support)]) for one in scored]
    return sorted(unscaled, key=lambda one: (one.size, problem.merit(one)))


def positive_costs(problem: Problem, support: tuple[int, ...]) -> np.ndarray | None:
    """The costs of one set, robustly fitted; `None` where one of them would not be positive."""
    scaled, scale = _scaled(problem)
    costs, _, sound = _fitted(scaled, problem.times_ms, problem.weights, np.array([support]))
    return costs[0] / scale[list(support)] if sound[0] and (costs > 0).all() else None


def _scaled(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    scale = (problem.columns / problem.times_ms[:, None]).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return problem.columns / scale, scale


def _grown(beam: np.ndarray, n_terms: int) -> np.ndarray:
    term = np.arange(1, n_terms)
    sets = np.column_stack([np.repeat(beam, len(term), axis=0), np.tile(term, len(beam))])
    sets = sets[~(sets[:, :-1] == sets[:, -1:]).any(axis=1)]
    return np.unique(np.sort(sets, axis=1), axis=0)


def _ranked(problem: Problem, columns: np.ndarray, weights: np.ndarray, supports: np.ndarray) -> np.ndarray:
    """Those of the sets that have positive costs (but for the constant), best first by the relative residual."""
    relative = columns / problem.times_ms[:, None]
    gram = relative.T @ (weights[:, None] * relative)
    against = relative.T @ weights
    matrix = gram[supports[:, :, None], supports[:, None, :]]
    target = against[supports]
    # A constant that would be negative is left out, as its bound would.
    costs = _solved(matrix, target)
    explained = np.einsum("sk,sk->s", costs, target)
    without = _solved(matrix[:, 1:, 1:], target[:, 1:]) if supports.shape[1] > 1 else np.empty((len(supports), 0))
    floating = costs[:, 0] <= 0
    explained = np.where(floating, np.einsum("sk,sk->s", without, target[:, 1:]), explained)
    positive = np.where(floating, (without > 0).all(axis=1), (costs[:, 1:] > 0).all(axis=1))
    unexplained = np.maximum(weights.sum() - explained, 1e-12 * weights.sum())
    merit = len(weights) / 2 * np.log(unexplained) + problem.surprise[supports].sum(axis=1)
    order = np.argsort(np.where(positive, merit, np.inf), kind="stable")
    return supports[order[: int(positive.sum())]]


def _solved(matrix: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Batched symmetric solves; sets of columns that are nearly dependent come out as NaN."""
    if matrix.shape[1] == 0:
        return np.empty(target.shape)
    diagonal = np.sqrt(np.einsum("skk->sk", matrix))
    unit = matrix / (diagonal[:, :, None] * diagonal[:, None, :] + 1e-300)
    dependent = np.linalg.det(unit) < 1e-10
    unit[dependent] = np.eye(matrix.shape[1])
    solved = np.linalg.solve(unit, (target / (diagonal + 1e-300))[:, :, None])[:, :, 0] / (diagonal + 1e-300)
    solved[dependent] = np.nan
    return solved


def _scored(
    columns: np.ndarray, times_ms: np.ndarray, weights: np.ndarray, supports: np.ndarray, sizes: np.ndarray
) -> list[Scored]:
    """Fitted to log times with robust weights, each set with its own; without those whose costs are not positive."""
    found: dict[tuple[int, ...], Scored] = {}
    supports = supports.copy()
    with_constant = np.ones(len(supports), bool)
    for keep_constant in (True, False):
        chosen = supports[with_constant == keep_constant]
        chosen = chosen if keep_constant else chosen[:, 1:]
        if not len(chosen) or not chosen.shape[1]:
            continue
        costs, left_out, sound = _fitted(columns, times_ms, weights, chosen)
        if keep_constant:
            with_constant = ~(sound & (costs[:, 0] <= 0))  # rounding may leave nothing of it
        errors = np.abs(left_out).mean(axis=1)
        size = np.where(chosen > 0, sizes[chosen], 0).sum(axis=1)
        for k in np.flatnonzero(sound & (costs > 0).all(axis=1)):
            support = tuple(chosen[k].tolist())
            found[support] = Scored(support, costs[k], left_out[k], int(size[k]), float(errors[k]))
    return sorted(found.values(), key=lambda one: one.error)


def _fitted(
    columns: np.ndarray, times_ms: np.ndarray, weights: np.ndarray, supports: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robust Gauss-Newton on log times: costs `[sets, k]`, left-out residuals `[sets, rows]`, sound ones `[sets]`."""
    design = columns.T[supports].transpose(0, 2, 1)  # [sets, rows, k]
    relative = design / times_ms[:, None]
    row_weights = np.broadcast_to(weights, (len(supports), len(times_ms)))
    costs = _weighted(relative, np.ones_like(row_weights), row_weights)
    floor_ms = 1e-3 * times_ms
    for _ in range(_ROUNDS):
        predicted = np.maximum(np.einsum("snk,sk->sn", design, np.nan_to_num(costs)), floor_ms)
        residual = np.log(times_ms / predicted)
        row_weights = weights * _row_weights(residual)
        slope = design / predicted[:, :, None]
        step = np.clip(residual, -1.0, 1.0)  # a start far off must not overshoot
        costs = _weighted(slope, step + np.einsum("snk,sk->sn", slope, costs), row_weights)
    sound = np.asarray(np.isfinite(costs).all(axis=1))
    predicted = np.maximum(np.einsum("snk,sk->sn", design, np.nan_to_num(costs)), floor_ms)
    residual = np.log(times_ms / predicted)
    slope = design / predicted[:, :, None]
    weighted = slope * row_weights[:, :, None]
    matrix = np.einsum("snk,snl->skl", slope, weighted)
    unit = np.broadcast_to(np.eye(matrix.shape[1]), matrix.shape)
    matrix = np.where(sound[:, None, None], matrix, unit)
    inverse = np.linalg.inv(matrix + 1e-12 * np.einsum("skk->s", matrix)[:, None, None] * unit)
    leverage = ((weighted @ inverse) * slope).sum(axis=2)
    return costs, residual / np.maximum(1 - leverage, 1e-3), sound


def _weighted(design: np.ndarray, target: np.ndarray, weights: np.ndarray) -> np.ndarray:
    weighted = design * weights[:, :, None]
    matrix = np.einsum("snk,snl->skl", weighted, design)
    return _solved(matrix, np.einsum("snk,sn->sk", weighted, target))


def _row_weights(residual: np.ndarray) -> np.ndarray:
    """Pseudo-Huber weights, `1 / sqrt(1 + (r / delta)^2)`, delta from the median size of a row's residuals."""
    sigma = 1.4826 * np.median(np.abs(residual), axis=-1, keepdims=True)
    return 1 / np.sqrt(1 + (residual / (_HUBER * np.maximum(sigma, 1e-4))) ** 2)
