"""The search: measure a design, fit a model, measure what it expects to be fastest, until nothing is left to gain."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from tuning.choose import (
    Counts,
    Objective,
    choose_next,
    initial_design,
    is_timed,
    pareto_front,
    predict_ms,
    time_ms,
)
from tuning.cost_model import CostModel
from tuning.features import main_work
from tuning.measurement import Measurement
from tuning.record import append_measurement, read_measurements
from tuning.select import fit_models, fit_stage
from tuning.space import Space, accuracy_values
from vtfs.input_error import InputError
from vtfs.parameters import SHADOW_NAMES, Configuration, configuration

HOPELESS = 12
"""A technique whose default needs this many times the lighting computations of the thriftiest is not measured."""

TOO_SLOW = 4
"""A technique whose default takes this many times as long as the fastest one's is measured at its default only."""

PATIENCE = 6
"""So many choices in a row that gained nothing end the search: no model is sure of that on a noisy machine."""

_ACCURACY_SHARE = 0.2  # of the budget, kept for the chart of speed against error


class Workload(Protocol):
    """What can be counted and measured: one scene, some frames of its path, one device."""

    @property
    def scene_key(self) -> str: ...

    @property
    def device(self) -> str: ...

    @property
    def frames(self) -> tuple[int, ...]: ...

    def counts(self, configuration: Configuration, /) -> tuple[dict[str, int], ...]:
        """Exact counts, one record a frame, without timing. None where counting fails: measuring then says why."""
        ...

    def measure(self, configuration: Configuration, best_ms: float | None, /) -> Measurement:
        """Never raises for a configuration that fails: that is an outcome. `best_ms`: what there is to beat."""
        ...


@dataclass(frozen=True)
class Budget:
    """How much may be measured: a number of configurations, or seconds spent in `Workload.measure`."""

    measurements: int | None = None
    seconds: float | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """`"40"`: measurements. `"120s"`: seconds.

        **Raises:** `InputError` for anything else, and for nothing at all.
        """
        stripped = text.strip()
        try:
            if stripped.endswith("s"):
                seconds = float(stripped[:-1])
                if 0 < seconds < math.inf:
                    return cls(seconds=seconds)
            elif (measurements := int(stripped)) > 0:
                return cls(measurements=measurements)
        except ValueError:
            pass
        raise InputError(f"budget {text!r}: must be a number of measurements, as `40`, or of seconds, as `120s`.")

    def __str__(self) -> str:
        return f"{self.measurements} measurements" if self.seconds is None else f"{self.seconds:g} s of measuring"


@dataclass(frozen=True)
class Progress:
    """Where a search is, before it measures `configuration`.

    - `spent`: share of the budget, from 0.
    """

    configuration: Configuration
    n_measured: int
    spent: float
    best_ms: float | None


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
    - `predictions`: the whole space, but for techniques whose model cannot say how far off it is.
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
    against the budget: as measurements, or as the seconds of its repeats and its compiling (its sizing runs are
    not known any more). The configuration being measured when the budget is used up is completed.

    A fifth of the budget is kept for the settings that trade accuracy for speed, tried at the best exact
    configuration.

    **Arguments:**

    - `max_error`: what may be best has at most this error. `None`: only exact settings may be best.
    - `keep`: techniques that are measured however hopeless they look.

    **Raises:** `InputError` where the record is damaged or cannot be written, where nothing could be timed, and
    where nothing meets `max_error`.
    """
    run = _Run(space, workload, Path(record_path), budget, objective, max_error, progress, clock)
    hopeful, not_measured = _hopeful(space, run, keep)

    design = initial_design(hopeful, run.counts, seed)
    defaults, spread = design[: len(hopeful.techniques)], design[len(hopeful.techniques) :]
    # Thrifty ones first: what is there to beat is then known when the slow ones are measured.
    in_budget = all(run.measure(candidate) for candidate in sorted(defaults, key=run.main_work))
    explored, not_explored = _explored(hopeful, run)

    share = 1 - _ACCURACY_SHARE
    in_budget = in_budget and all(run.measure(c, share) for c in spread if c.technique in explored.techniques)
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
        default=run.timed(configuration(best.technique)),
        fastest_default=_measurement(run, run.fastest(defaults)),
        models=models,
        predictions=_predictions(hopeful, run, models, objective),
        stop_reason=stop_reason,
        pareto=pareto_front(run.measured.values(), objective),
        not_measured=not_measured,
        not_explored=not_explored,
    )


class _Run:
    """What was measured so far, and what that cost. Measures nothing twice."""

    def __init__(
        self,
        space: Space,
        workload: Workload,
        record_path: Path,
        budget: Budget,
        objective: Objective,
        max_error: float | None,
        progress: Callable[[Progress], None] | None,
        clock: Callable[[], float],
    ):
        self._space = space
        self._workload = workload
        self._record_path = record_path
        self._budget = budget
        self.objective: Objective = objective
        self._max_error = max_error
        self._progress = progress
        self._clock = clock
        self._counts: dict[Configuration, Counts] = {}
        self._models: dict[str, tuple[int, CostModel | None]] = {}
        self.measured: dict[Configuration, Measurement] = {}
        self._seconds = 0.0
        for measurement in read_measurements(record_path) if record_path.exists() else ():
            self._take_over(measurement)

    def _take_over(self, measurement: Measurement) -> None:
        workload = self._workload
        ours = (workload.scene_key, workload.device, tuple(workload.frames))
        if (measurement.scene_key, measurement.device, measurement.frames) != ours:
            return
        try:
            candidate = configuration(measurement.technique, measurement.params)
        except InputError:  # of a version with other techniques or parameters
            return
        self.measured.setdefault(candidate, measurement)
        repeats_ms = (ms for frames in measurement.stages_ms.values() for repeats in frames for ms in repeats)
        self._seconds += sum(s for s in (measurement.compile_s, *(ms / 1e3 for ms in repeats_ms)) if math.isfinite(s))

    @property
    def spent(self) -> float:
        """Share of the budget; 1 and more: used up."""
        if self._budget.measurements is not None:
            return len(self.measured) / self._budget.measurements
        return self._seconds / (self._budget.seconds or math.inf)

    def counts(self, candidate: Configuration) -> Counts:
        """Counts of each frame; what cannot be counted has none, and is a line of the record at once."""
        if candidate not in self._counts:
            self._counts[candidate] = self._workload.counts(candidate)
            if not self._counts[candidate] and candidate not in self.measured:
                self._record(candidate, None)
        return self._counts[candidate]

    def main_work(self, candidate: Configuration) -> int:
        return sum(map(main_work, self.counts(candidate)))

    def measure(self, candidate: Configuration, share: float = 1.0) -> bool:
        """Measure and record it, unless that was done; False where the budget's `share` was used up before."""
        if candidate in self.measured:
            return True
        if self.measured and self.spent >= share:
            return False
        fastest = self.fastest(filter(self._is_allowed, self.measured))
        best_ms = None if fastest is None else time_ms(self.measured[fastest], self.objective)
        if self._progress is not None:
            self._progress(Progress(candidate, len(self.measured), self.spent, best_ms))
        self._record(candidate, best_ms)
        return True

    def _record(self, candidate: Configuration, best_ms: float | None) -> None:
        started = self._clock()
        measurement = self._workload.measure(candidate, best_ms)
        self._seconds += self._clock() - started
        append_measurement(self._record_path, measurement)
        self.measured[candidate] = measurement

    def _is_allowed(self, candidate: Configuration) -> bool:
        """May it be recommended? What may not, as a default that the space leaves out, is not there to be beaten."""
        if self._max_error is None:
            return candidate in self._space and candidate.is_exact
        error = self.measured[candidate].error
        known = candidate in self._space or candidate.exact() in self._space
        return known and error is not None and error <= self._max_error

    def timed(self, candidate: Configuration) -> Measurement | None:
        measurement = self.measured.get(candidate)
        return measurement if measurement is not None and is_timed(measurement) else None

    def fastest(self, candidates: Iterable[Configuration]) -> Configuration | None:
        times = {c: time_ms(m, self.objective) for c in candidates if (m := self.timed(c)) is not None}
        return min(times, key=times.__getitem__, default=None)

    def fruitless(self, space: Space, design: Collection[Configuration]) -> int:
        """How many choices of the search were measured since the fastest configuration was. By the record's order, so
        that a run that goes on stops where one run would have."""
        fastest = self.fastest(c for c in self.measured if c in space and c.is_exact)
        since = list(self.measured)
        since = since[since.index(fastest) + 1 :] if fastest is not None else since
        return sum(c in space and c.is_exact and c not in design for c in since)

    def best(self, space: Space, max_error: float | None) -> Configuration:
        """The fastest that may be recommended."""
        timed = {c: m for c in self.measured if (c in space or c.exact() in space) and (m := self.timed(c)) is not None}
        if not timed:
            outcomes = ", ".join(sorted({measurement.outcome for measurement in self.measured.values()}))
            message = next((f": {m.message}" for m in self.measured.values() if m.message), "")
            raise InputError(
                f"none of {len(self.measured)} configurations gave a time that counts ({outcomes}{message}); "
                "try a smaller size, a larger budget, other techniques or another space."
            )
        if max_error is None:
            found = self.fastest(c for c in timed if c.is_exact)
            if found is None:
                raise InputError("max-error is missing and no exact setting could be timed; say what error is allowed.")
            return found
        errors = {c: m.error for c, m in timed.items() if m.error is not None}
        found = self.fastest(c for c, error in errors.items() if error <= max_error)
        if found is None:
            raise InputError(
                f"max-error {max_error:g}: nothing measured is that accurate; the smallest error is "
                f"{min(errors.values(), default=math.nan):.3g}, allow at least that."
            )
        return found

    def fitted(self, space: Space) -> list[Measurement]:
        """What models are fitted to: not the accuracy settings, which change the cost of an operation."""
        return [m for c, m in self.measured.items() if c in space or c == configuration(c.technique)]

    def available(self, technique: str) -> frozenset[str]:
        """Names of the counts of a technique that are known before measuring."""
        frames = [frame for c, counts in self._counts.items() if c.technique == technique for frame in counts]
        return frozenset.intersection(*(frozenset(frame) for frame in frames)) if frames else frozenset()

    def frame_models(self, space: Space) -> dict[str, CostModel]:
        """Of the fused frame, by technique; fitted again only where something was measured since."""
        models = {}
        for technique in space.techniques:
            own = [m for m in self.fitted(space) if m.technique == technique]
            n_before, model = self._models.get(technique, (-1, None))
            if n_before != len(own):
                model = fit_stage(own, technique, "frame", self.available(technique))
                self._models[technique] = len(own), model
            if model is not None:
                models[technique] = model
        return models


def _hopeful(space: Space, run: _Run, keep: Collection[str]) -> tuple[Space, dict[str, str]]:
    """The techniques that are measured at all, and for the others, why not."""
    reachable = {candidate.technique for candidate in space.configurations()}
    unreachable = [name for name in space.techniques if name not in reachable]
    excluded = dict.fromkeys(unreachable, "the constraints leave no configuration of it")
    space = space.limited_to(reachable)
    defaults = {name: configuration(name) for name in space.techniques}
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


def _explored(space: Space, run: _Run) -> tuple[Space, dict[str, str]]:
    """The techniques whose parameters are searched, and for the others, why not."""
    times = {
        name: time_ms(measurement, run.objective)
        for name in space.techniques
        if (measurement := run.timed(configuration(name))) is not None
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


def _measurement(run: _Run, candidate: Configuration | None) -> Measurement | None:
    return None if candidate is None else run.measured[candidate]


def _predictions(
    space: Space, run: _Run, models: dict[str, dict[str, CostModel]], objective: Objective
) -> tuple[Prediction, ...]:
    predictions = []
    for technique in space.techniques:
        model = models.get(technique, {}).get("frame")
        if model is None or not math.isfinite(model.loo_error):
            continue
        candidates = [c for c in space.configurations() if c.technique == technique and run.counts(c)]
        predicted = predict_ms(model, [run.counts(c) for c in candidates], objective)
        for candidate, ms in zip(candidates, map(float, predicted), strict=True):
            measurement = run.timed(candidate)
            measured_ms = None if measurement is None else time_ms(measurement, objective)
            predictions.append(Prediction(candidate, ms, ms / model.factor, ms * model.factor, measured_ms))
    return tuple(predictions)
