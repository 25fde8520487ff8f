"""The search: measure a design, fit a model, measure what it expects to be fastest, until nothing is left to gain."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path

from tuning.budget import Budget
from tuning.choose import (
    Objective,
    choose_next,
    initial_design,
    pareto_front,
    predict_ms,
    time_ms,
)
from tuning.cost_model import CostModel
from tuning.measurement import Measurement
from tuning.search_run import Progress, SearchRun, Workload
from tuning.space import Space, accuracy_values
from tuning.stage_models import fit_models
from vtfs.configurations import Configuration
from vtfs.technique_names import SHADOW_NAMES

HOPELESS = 12
"""A technique whose default needs this many times the lighting computations of the thriftiest is not measured."""

TOO_SLOW = 4
"""A technique whose default takes this many times as long as the fastest one's is measured at its default only."""

PATIENCE = 6
"""So many choices in a row that gained nothing end the search: no model is sure of that on a noisy machine."""

_ACCURACY_SHARE = 0.2  # of the budget, kept for the chart of speed against error


@dataclass(frozen=True)
class Prediction:
    """The model's opinion of one configuration, with a 90 % interval, and the truth where it was measured."""

    configuration: Configuration
    predicted_ms: float
    low_ms: float
    high_ms: float
    measured_ms: float | None


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    - `measurements`: all of this scene, device and frames, earlier runs' too, failed ones too.
    - `default`: the default of the best configuration's technique; `None` if it could not be timed.
    - `fastest_default`: the fastest default of all techniques.
    - `models`: by technique, then by stage.
    - `predictions`: the whole space, but for techniques whose model cannot say how far off it is, and of shadow
      techniques what was counted for the search.
    - `not_measured`, `not_explored`: techniques that were left out, or measured at their default only, and why.
    """

    measurements: tuple[Measurement, ...]
    best: Measurement
    default: Measurement | None
    fastest_default: Measurement | None
    models: dict[str, dict[str, CostModel]]
    predictions: tuple[Prediction, ...]
    stop_reason: str
    pareto: tuple[Measurement, ...]
    not_measured: dict[str, str] = field(default_factory=dict)
    not_explored: dict[str, str] = field(default_factory=dict)


def search(
    space: Space,
    workload: Workload,
    record_path: Path | str,
    budget: Budget,
    objective: Objective = "max",
    max_error: float | None = None,
    seed: int = 0,
    progress: Callable[[Progress], None] | None = None,
    keep: Collection[str] = (),
    clock: Callable[[], float] = time.perf_counter,
) -> SearchResult:
    """Find the fastest configuration with few measurements; every one is appended to `record_path` at once.

    What `record_path` already holds of the same scene, device and frames is not measured again and counts
    against the budget: as measurements, or as the seconds of its repeats (its sizing runs are not known any more).
    The configuration being measured when the budget is used up is completed.

    A fifth of the budget is kept for the settings that trade accuracy for speed, tried at the best exact
    configuration.

    **Arguments:**

    - `max_error`: what may be best has at most this error. `None`: only exact settings may be best.
    - `keep`: techniques that are measured however hopeless they look.

    **Raises:** `InputError` where the record is damaged or cannot be written, where nothing could be timed, and
    where nothing meets `max_error`.
    """
    run = SearchRun(space, workload, Path(record_path), budget, objective, max_error, progress, clock)
    hopeful, not_measured = _hopeful(space, run, keep)

    defaults = [hopeful.default(name) for name in hopeful.techniques]
    # Thrifty ones first: what is there to beat is then known when the slow ones are measured.
    in_budget = all(run.measure(candidate) for candidate in sorted(defaults, key=run.main_work))
    explored, not_explored = _explored(hopeful, run)

    share = 1 - _ACCURACY_SHARE
    design: list[Configuration] = []
    candidates = initial_design(explored, run.counts, seed)
    while in_budget and (candidate := next(candidates, None)) is not None:
        design.append(candidate)
        in_budget = run.measure(candidate, share) and run.spent < share
    stop_reason = f"the budget of {budget} was used"
    while in_budget:
        if run.fruitless(explored, design) >= PATIENCE:
            stop_reason = f"the last {PATIENCE} choices gained nothing"
            break
        models = run.frame_models(explored)
        choice = choose_next(explored, run.measured, run.counts, models, objective)
        if choice.stop_reason is not None:
            stop_reason = choice.stop_reason
            break
        in_budget = all(run.measure(candidate, share) for candidate in choice.configurations)

    exact = run.fastest(candidate for candidate in run.measured if candidate in hopeful and candidate.is_exact)
    if exact is not None:
        for candidate in _less_accurate(exact):
            if not run.measure(candidate):
                break

    best = run.best(hopeful, max_error)
    fitted = run.fitted(hopeful)
    models = {name: fit_models(fitted, name, run.available(name)) for name in hopeful.techniques}
    models = {name: stages for name, stages in models.items() if stages}
    return SearchResult(
        measurements=tuple(run.measured.values()),
        best=run.measured[best],
        default=run.timed(space.default(best.technique)),
        fastest_default=_measurement(run, run.fastest(defaults)),
        models=models,
        predictions=_predictions(hopeful, run, models, objective),
        stop_reason=stop_reason,
        pareto=pareto_front(run.measured.values(), objective),
        not_measured=not_measured,
        not_explored=not_explored,
    )


def _hopeful(space: Space, run: SearchRun, keep: Collection[str]) -> tuple[Space, dict[str, str]]:
    """The techniques that are measured at all, and for the others, why not."""
    reachable = {candidate.technique for candidate in space.configurations()}
    unreachable = [name for name in space.techniques if name not in reachable]
    excluded = dict.fromkeys(unreachable, "the constraints leave no configuration of it")
    space = space.limited_to(reachable)
    defaults = {name: space.default(name) for name in space.techniques}
    work = {name: run.main_work(default) for name, default in defaults.items() if run.counts(default)}
    least = min(work.values(), default=0)
    unit = "tests" if set(space.techniques) & set(SHADOW_NAMES) else "lighting computations"
    reasons = {
        name: f"its default needs {work[name] / least:.0f} times the {unit} of "
        f"{min(work, key=work.__getitem__)}'s ({work[name]:,} and {least:,})"
        for name in work
        if least > 0 and work[name] > HOPELESS * least and name not in keep
    }
    return space.limited_to(name for name in space.techniques if name not in reasons), excluded | reasons


def _explored(space: Space, run: SearchRun) -> tuple[Space, dict[str, str]]:
    """The techniques whose parameters are searched, and for the others, why not."""
    times = {
        name: time_ms(measurement, run.objective)
        for name in space.techniques
        if (measurement := run.timed(space.default(name))) is not None
    }
    least = min(times.values(), default=0.0)
    reasons = {
        name: f"its default takes {ms / least:.1f} times as long as the fastest default"
        for name, ms in times.items()
        if ms > TOO_SLOW * least
    }
    return space.limited_to(name for name in space.techniques if name not in reasons), reasons


def _less_accurate(exact: Configuration) -> list[Configuration]:
    changed = [{k: v for k, v in setting.items() if k in exact.params} for setting in accuracy_values()]
    return [c for c in dict.fromkeys(exact.replaced(**change) for change in changed) if c != exact]


def _measurement(run: SearchRun, candidate: Configuration | None) -> Measurement | None:
    return None if candidate is None else run.measured[candidate]


def _predictions(
    space: Space, run: SearchRun, models: dict[str, dict[str, CostModel]], objective: Objective
) -> tuple[Prediction, ...]:
    predictions = []
    # Each tile size and branching of a shadow technique compiles for seconds to be counted: too long for a chart alone,
    # where the budget ended the search before it asked.
    known = [
        c for c in space.configurations() if c.technique not in SHADOW_NAMES or c in run.measured or run.has_counted(c)
    ]
    for technique in space.techniques:
        model = models.get(technique, {}).get("frame")
        if model is None or not math.isfinite(model.loo_error):
            continue
        candidates = [c for c in known if c.technique == technique and run.counts(c)]
        predicted = predict_ms(model, [run.counts(c) for c in candidates], objective)
        for candidate, ms in zip(candidates, map(float, predicted), strict=True):
            measurement = run.timed(candidate)
            measured_ms = None if measurement is None else time_ms(measurement, objective)
            predictions.append(Prediction(candidate, ms, ms / model.factor, ms * model.factor, measured_ms))
    return tuple(predictions)
