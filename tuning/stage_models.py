"""The models of the search: sums of counts, selected as those of `vtfs fit` are, without its robust refits by JAX.

Those compile for longer than a run may take. What is left out with them: smooth maxima, laws about as plausible, and
intervals by bootstrap; how far off a model is says its left-out error.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tuning.cost_model import CostModel
from tuning.features import STAGE_TERMS, StageTimes, stage_times
from tuning.measurement import Measurement
from tuning.select import errors_with, select_of_few
from tuning.subsets import Problem

FEWEST_ROWS = 3
"""Below this a stage gets a constant."""

MOST_TERMS = 4


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
    """The model of one stage, from the measurements of one technique; `None` where none of them timed it.

    Frames of a configuration leave together when errors are taken: they are no independent evidence.
    """
    data = stage_times(measurements, stage, available)
    n_rows = len(data.times_ms)
    if not n_rows:
        return None
    problem = _problem(data)
    enough = n_rows >= FEWEST_ROWS and data.n_configurations >= 2
    selection = select_of_few(problem, min(MOST_TERMS, n_rows - 2) if enough else 0)
    chosen = selection.chosen
    costs = dict(zip(chosen.support, map(float, chosen.costs), strict=True))
    fixed_ms = costs.pop(0, 0.0)
    others = [k + 1 for k in range(len(data.terms)) if k + 1 not in costs]
    loo_error = selection.error_of(chosen.size)
    errors = errors_with(problem, chosen.support, others)
    return CostModel(
        technique=technique,
        stage=stage,
        terms=tuple(data.terms[k - 1] for k in costs),
        fixed_ms=fixed_ms,
        ms_per_op=tuple(costs.values()),
        loo_error=loo_error,
        constant_loo_error=selection.error_of(0),
        dropped=tuple((data.terms[k - 1], error) for k, error in zip(others, errors, strict=True)),
        n=n_rows,
        n_configurations=data.n_configurations,
    )


def _problem(data: StageTimes) -> Problem:
    n_terms = len(data.terms)
    return Problem(
        np.column_stack([np.ones(len(data.times_ms)), data.ops]),
        data.times_ms,
        data.weights,
        np.array([0, *[1] * n_terms]),
        np.zeros(1 + n_terms),  # counts are all as likely beforehand
        data.configuration,
    )
