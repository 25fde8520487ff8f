"""One run of the search: what was measured so far, what that cost, and what is the fastest of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from tuning.budget import Budget
from tuning.choose import Counts, Objective, is_timed, time_ms
from tuning.cost_model import CostModel
from tuning.features import main_work
from tuning.measurement import Measurement
from tuning.record import append_measurement, read_measurements
from tuning.space import Space
from tuning.stage_models import fit_stage
from vtfs.configurations import Configuration, configuration
from vtfs.input_error import InputError


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
class Progress:
    """Where a search is, before it measures `configuration`.

    - `spent`: share of the budget, from 0.
    """

    configuration: Configuration
    n_measured: int
    spent: float
    best_ms: float | None


class SearchRun:
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
        self._seconds += _repeats_s(measurement)

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

    def has_counted(self, candidate: Configuration) -> bool:
        return candidate in self._counts

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
        # Without compiling, so that a cold cache does not end the search early. Two programs may compile at once.
        elapsed_s = self._clock() - started
        self._seconds += max(elapsed_s - measurement.compile_s, _repeats_s(measurement))
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
        return [m for c, m in self.measured.items() if c in space or c == space.default(c.technique)]

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


def _repeats_s(measurement: Measurement) -> float:
    times_ms = (ms for frames in measurement.stages_ms.values() for repeats in frames for ms in repeats)
    return sum(ms for ms in times_ms if math.isfinite(ms)) / 1e3
