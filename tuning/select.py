"""How many terms a law is allowed: cross-validation with the selection inside, and the one-standard-error rule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tuning.subsets import Problem, Scored, positive_costs, score_subsets

_SCORED_IN_A_FOLD = 30
_FEW_TERMS = 60


@dataclass(frozen=True)
class Selection:
    """The set that was taken, and what else was looked at.

    - `path`: the best set of each size, on all rows.
    - `errors`, `standard_errors`: of each size, each row predicted by the set that was *selected* without it. The
      best of thousands of sets looks better than it is; this does not.
    """

    chosen: Scored
    path: tuple[Scored, ...]
    errors: tuple[float, ...]
    standard_errors: tuple[float, ...]
    scored: tuple[Scored, ...]

    def error_of(self, size: int) -> float:
        """Infinite where it is not known: there was one group only."""
        return next((e for one, e in zip(self.path, self.errors, strict=True) if one.size == size), math.inf)


def select_subset(problem: Problem, most_terms: int) -> Selection:
    """The smallest size whose error is within one standard error of the best's (Breiman et al. 1984).

    The error of a size is cross-validated with the selection inside: Hastie, Tibshirani, Friedman 2009, 7.10.2.
    """
    scored = score_subsets(problem, most_terms)
    path = _best_of_each_size(problem, scored, most_terms)
    n_rows = len(problem.times_ms)
    if problem.n_groups == 1:
        return Selection(path[0], tuple(path[:1]), (math.inf,), (math.inf,), tuple(scored))
    n_folds = n_folds_of(problem)
    fold = problem.folds(n_folds)
    out = np.full((most_terms + 1, n_rows), np.nan)
    for k in range(n_folds):
        held = fold == k
        seen = problem.rows(~held)
        within = _best_of_each_size(seen, score_subsets(seen, most_terms, _SCORED_IN_A_FOLD), most_terms)
        for one in within:
            predicted = problem.columns[held][:, list(one.support)] @ one.costs
            out[one.size, held] = np.abs(np.log(problem.times_ms[held] / np.maximum(predicted, 1e-300)))
    return _smallest_good(problem, scored, path, out)


def select_of_few(problem: Problem, most_terms: int) -> Selection:
    """The same rule for few candidates, each with a physical reason, and few groups: the sets are selected once, on all
    rows, and only their costs are fitted without the rows that they are to predict.

    A selection inside each fold would throw out evidence that a handful of configurations cannot spare.
    """
    scored = score_subsets(problem, most_terms)
    path = _best_of_each_size(problem, scored, most_terms)
    if problem.n_groups == 1:
        return Selection(path[0], tuple(path[:1]), (math.inf,), (math.inf,), tuple(scored))
    out = np.full((most_terms + 1, len(problem.times_ms)), np.nan)
    out[[one.size for one in path]] = _left_out(problem, [one.support for one in path])
    return _smallest_good(problem, scored, path, out)


def _smallest_good(problem: Problem, scored: list[Scored], path: list[Scored], out: np.ndarray) -> Selection:
    """By left-out errors `[sizes, rows]`; a size that could not be fitted in every fold is not taken."""
    sizes = [one.size for one in path if np.isfinite(out[one.size]).all()]
    of_groups = {size: problem.group_means(out[size]) for size in sizes}
    errors = {size: float(own.mean()) for size, own in of_groups.items()}
    best = min(sizes, key=errors.__getitem__)
    spread = {size: float(np.std(own, ddof=1) / np.sqrt(problem.n_groups)) for size, own in of_groups.items()}
    size = next(size for size in sorted(sizes) if errors[size] <= errors[best] + spread[best])
    return Selection(
        chosen=next(one for one in path if one.size == size),
        path=tuple(path),
        errors=tuple(errors.get(one.size, math.inf) for one in path),
        standard_errors=tuple(spread.get(one.size, math.inf) for one in path),
        scored=tuple(scored),
    )


def errors_with(problem: Problem, support: tuple[int, ...], terms: Sequence[int]) -> list[float]:
    """The left-out error of a set with each of these terms added, as `select_of_few` takes it.

    Where a cost would not be positive in a fold the term is not used there, and the set as it is counts.
    """
    if problem.n_groups == 1:
        return [math.inf] * len(terms)
    out = _left_out(problem, [support, *(tuple(sorted((*support, term))) for term in terms)])
    return [float(problem.group_means(np.where(np.isnan(own), out[0], own)).mean()) for own in out[1:]]


def _left_out(problem: Problem, supports: Sequence[tuple[int, ...]]) -> np.ndarray:
    """Size of log(measured / predicted), `[sets, rows]`; NaN where a fold has no positive costs of a set."""
    out = np.full((len(supports), len(problem.times_ms)), np.nan)
    fold = problem.folds(n_folds_of(problem))
    for k in range(int(fold.max()) + 1):
        held = fold == k
        seen = problem.rows(~held)
        for row, support in enumerate(supports):
            costs = positive_costs(seen, support)
            if costs is not None:
                predicted = problem.columns[held][:, list(support)] @ costs
                out[row, held] = np.abs(np.log(problem.times_ms[held] / np.maximum(predicted, 1e-300)))
    return out


def n_folds_of(problem: Problem) -> int:
    """Each group by itself where there are few; many candidates take too long for more than five folds."""
    n_groups, n_terms = problem.n_groups, problem.columns.shape[1]
    return n_groups if n_groups <= 12 else 10 if n_terms <= _FEW_TERMS else 5


def _best_of_each_size(problem: Problem, scored: list[Scored], most: int) -> list[Scored]:
    """Of the sets that are as good as the best, within one standard error of their difference, the plainest."""
    best: dict[int, Scored] = {}
    chosen: dict[int, Scored] = {}
    for one in scored:  # best first within each size
        if one.size > most:
            continue
        first = best.setdefault(one.size, one)
        plainest = chosen.setdefault(one.size, one)
        if problem.surprise[list(one.support)].sum() < problem.surprise[list(plainest.support)].sum():
            worse = np.abs(one.left_out) - np.abs(first.left_out)
            if worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)):
                chosen[one.size] = one
    return [chosen[size] for size in sorted(chosen)]
