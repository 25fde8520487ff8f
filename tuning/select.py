"""The smallest cost model that the data supports: forward selection by leaving configurations out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tuning.cost_model import CostModel
from tuning.features import STAGE_TERMS, StageTimes, stage_times
from tuning.fit import fit_costs, relative_design
from tuning.measurement import Measurement

FEWEST_ROWS = 3
"""Below this a stage gets a constant."""

MOST_FOLDS = 24
"""With more configurations than this, several are left out at once: the time of a fit stays bounded."""

_MOST_TERMS = 6
_PATIENCE = 2  # terms tried past the best model: two may help only together


def fit_models(
    measurements: Iterable[Measurement], technique: str, available: frozenset[str] | None = None
) -> dict[str, CostModel]:
    """A model for every stage of a technique that was timed, in the order of the stages' table.

    **Arguments:**

    - `measurements`: of any techniques; failed ones are skipped.
    - `available`: counts that are known before measuring; `None`: all.
    """
    own = [measurement for measurement in measurements if measurement.technique == technique]
    timed = {stage for measurement in own for stage in measurement.stages_ms}
    ordered = [stage for stage in STAGE_TERMS if stage in timed] + sorted(timed - STAGE_TERMS.keys())
    models = {stage: fit_stage(own, technique, stage, available) for stage in ordered}
    return {stage: model for stage, model in models.items() if model is not None}


def fit_stage(
    measurements: Iterable[Measurement], technique: str, stage: str, available: frozenset[str] | None = None
) -> CostModel | None:
    """The model of one stage, from the measurements of one technique; `None` where none of them timed it."""
    data = stage_times(measurements, stage, available)
    if not len(data.times_ms):
        return None
    constant = _left_out(data, ())
    path = [constant]
    if len(data.times_ms) >= FEWEST_ROWS and data.n_configurations >= 2:
        path = _forward(data, constant)
    chosen = _smallest_good(path)
    costs = fit_costs(_design(data, chosen.terms))
    # A term that costs nothing in the fit to everything says nothing.
    kept = {term: float(cost) for term, cost in zip(chosen.terms, costs[1:], strict=True) if cost > 0}
    others = [term for term in data.terms if term not in kept]
    return CostModel(
        technique=technique,
        stage=stage,
        terms=tuple(kept),
        fixed_ms=float(costs[0]),
        ms_per_op=tuple(kept.values()),
        loo_error=chosen.loo_error,
        constant_loo_error=constant.loo_error,
        dropped=tuple((term, _left_out(data, (*kept, term)).loo_error) for term in others),
        n=len(data.times_ms),
        n_configurations=data.n_configurations,
    )


@dataclass(frozen=True)
class _Candidate:
    """A set of terms, and how far off it is for what it was not fitted to: one number a fold."""

    terms: tuple[str, ...]
    fold_errors: np.ndarray

    @property
    def loo_error(self) -> float:
        return float(np.mean(self.fold_errors)) if len(self.fold_errors) else math.inf

    @property
    def standard_error(self) -> float:
        n = len(self.fold_errors)
        return float(np.std(self.fold_errors, ddof=1) / math.sqrt(n)) if n > 1 else 0.0


def _forward(data: StageTimes, constant: _Candidate) -> list[_Candidate]:
    """The constant, then each time the term that helps most, for as long as the last few helped."""
    path = [constant]
    while len(path[-1].terms) < min(_MOST_TERMS, len(data.terms)):
        terms = path[-1].terms
        tried = [_left_out(data, (*terms, term)) for term in data.terms if term not in terms]
        path.append(min(tried, key=lambda candidate: candidate.loo_error))
        best = min(range(len(path)), key=lambda k: path[k].loo_error)
        if len(path) - 1 - best >= _PATIENCE:
            break
    return path


def _smallest_good(path: list[_Candidate]) -> _Candidate:
    """The one-standard-error rule (Breiman et al. 1984): the first whose error is within one of the best's."""
    best = min(path, key=lambda candidate: candidate.loo_error)
    return next(c for c in path if c.loo_error <= best.loo_error + best.standard_error)


def _left_out(data: StageTimes, terms: tuple[str, ...]) -> _Candidate:
    """Errors of predictions for configurations that were left out.

    The mean size of `predicted / measured - 1`. Not its median, which is blind to the few configurations that are
    predicted badly and so mislead a search (in simulated searches its worst choices were tens of times slower); not
    its mean square, which one disturbed measurement rules. Frames of a configuration leave together: they are no
    independent evidence.
    """
    n_folds = min(data.n_configurations, MOST_FOLDS)
    if n_folds < 2:
        return _Candidate(terms, np.empty(0))
    design = _design(data, terms)
    fold = data.configuration % n_folds
    errors = np.empty(n_folds)
    for k in range(n_folds):
        out = fold == k
        errors[k] = np.mean(np.abs(design[out] @ fit_costs(design[~out]) - 1))
    return _Candidate(terms, errors)


def _design(data: StageTimes, terms: tuple[str, ...]) -> np.ndarray:
    return relative_design(data.ops[:, [data.terms.index(term) for term in terms]], data.times_ms)
