import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import tuning.sweep
from tuning.budget import Budget
from tuning.choose import choose_next, initial_design
from tuning.measurement import Measurement, Outcome
from tuning.record import read_measurements
from tuning.search_run import Progress, Workload
from tuning.space import Space, default_space
from tuning.sweep import PATIENCE, search
from vtfs.configurations import Configuration, configuration
from vtfs.input_error import InputError

FRAMES = (40, 11, 3)
_WORK = (1.6, 1.0, 0.5)  # of the three frames


@cache
def synthetic_counts(technique: str, tile: int, slices: int, branching: int, batch: int) -> tuple[dict[str, int], ...]:
    """Counts of about the right size for 1,000 lights at 1280x720: smaller cells have fewer lights each."""
    frames = []
    for work in _WORK:
        samples = int(800_000 * (0.8 + 0.1 * work))
        tiles = math.ceil(1280 / tile) * math.ceil(720 / tile)
        if technique == "forward":
            tiles, slices, per_cell = 1, 1, 1000.0
        elif technique == "tiled_deferred":
            slices, per_cell = 1, 30 * work * (1 + 20 * tile / 1280)
        else:
            slices = slices or max(4, int(7.6 / math.log1p(1.2 * tile / 720)))
            per_cell = 10 * work * (1 + 8 * (tile / 1280 + 1 / slices)) ** 1.5
        occupied = tiles * min(slices, 1 + 0.06 * slices)
        computations = samples * per_cell
        chunks = math.ceil(samples / batch) if batch else 1
        tests = occupied * (2 * per_cell + branching * math.log(1000) / math.log(branching))
        counts = {
            "samples": samples,
            "lights": 1000,
            "cells_total": tiles * slices,
            "clusters_occupied": occupied,
            "light_cluster_pairs": occupied * per_cell,
            "lighting_computations": computations,
            "shading_lanes": computations * (1 + 0.3 * (32 / tile) ** 0.5),
            "shading_steps": chunks * per_cell * 2,
        }
        if technique == "volume_tiled_bvh":
            counts |= {"tree_tests": tests, "leaf_tests": occupied * per_cell, "assign_steps": chunks * 8}
        frames.append({name: int(count) for name, count in counts.items()})
    return tuple(frames)


SHADING_BOUND = {"shading_lanes": 4e-6, "samples": 1e-5, "shading_steps": 0.01}
ASSIGNMENT_BOUND = {"tree_tests": 2e-5, "clusters_occupied": 5e-4, "lighting_computations": 1e-6}
LAUNCH_BOUND = {"shading_steps": 0.2, "assign_steps": 0.5, "shading_lanes": 2e-6, "cells_total": 1e-5}


@dataclass
class Synthetic:
    """A workload whose times follow a law that the search does not know."""

    law: dict[str, float]
    noise: float = 0.02
    seed: int = 0
    fails: Callable[[Configuration], bool] = lambda _: False
    hidden: Callable[[Configuration], float] = lambda _: 1.0  # a factor on the time that no count shows
    scene_key: str = "synthetic"
    device: str = "no device"
    frames: tuple[int, ...] = FRAMES
    measured: list[Configuration] = field(default_factory=list)
    best_seen: list[float | None] = field(default_factory=list)
    counted: set[Configuration] = field(default_factory=set)
    dies_at: int | None = None

    def counts(self, configuration: Configuration, /) -> tuple[dict[str, int], ...]:
        self.counted.add(configuration)
        params = {"tile_px": 32, "depth_slices": 0, "branching": 32, **configuration.params}
        keys = ("tile_px", "depth_slices", "branching", "batch")
        return synthetic_counts(configuration.technique, *(int(params[name]) for name in keys))

    def true_ms(self, configuration: Configuration) -> list[float]:
        """Noiseless time of each frame."""
        faster = 0.8 if configuration["gbuffer"] != "float32" else 1.0
        faster *= 1 - 3 * float(configuration["light_cutoff"])
        faster *= 1 - 1.5 * float(configuration.params.get("approximate", 0))
        costs = [5 + sum(self.law[n] * c for n, c in f.items() if n in self.law) for f in self.counts(configuration)]
        return [ms * faster * self.hidden(configuration) for ms in costs]

    def measure(self, configuration: Configuration, best_ms: float | None, /) -> Measurement:
        if len(self.measured) == self.dies_at:
            raise KeyboardInterrupt
        self.measured.append(configuration)
        self.best_seen.append(best_ms)
        # The same every time: what a search does then depends on what it knows alone.
        rng = np.random.default_rng([self.seed, *str(configuration).encode()])
        repeats = [ms * np.exp(self.noise * rng.normal(size=5)) for ms in self.true_ms(configuration)]
        failed = self.fails(configuration)
        outcome: Outcome = "out_of_memory" if failed else "timed"
        approximate = 0.01 * (configuration["gbuffer"] != "float32") + float(configuration["light_cutoff"])
        approximate += float(configuration.params.get("approximate", 0))
        return Measurement(
            technique=configuration.technique,
            params=configuration.params,
            scene_key=self.scene_key,
            frames=self.frames,
            seed=0,
            outcome=outcome,
            compile_s=0.5,
            stages_ms={} if failed else {"frame": tuple(tuple(map(float, r)) for r in repeats)},
            counts=() if failed else self.counts(configuration),
            error=None if failed else 1e-7 + approximate,
            error_p999=None,
            device=self.device,
            versions={},
            load=0.0,
            message="9 GB needed" if failed else "",
        )

    def least_ms(self, space: Space) -> float:
        return min(max(self.true_ms(c)) for c in space.configurations())


WHOLE = default_space(["forward", "tiled_deferred", "volume_tiled_bvh"], n_samples=1280 * 720)
LARGE = Space(
    WHOLE.techniques,
    {
        "forward": {"batch": (0, 4096, 16384, 65536, 262144)},
        "tiled_deferred": {"tile_px": (8, 16, 32, 64, 128), "batch": (0, 4096, 16384, 65536, 262144)},
        "volume_tiled_bvh": {
            "tile_px": (8, 16, 32, 64, 128),
            "depth_slices": (0, 4, 8, 16, 32, 64, 128),
            "branching": (4, 8, 16, 32),
            "batch": (0, 4096, 16384, 65536, 262144),
        },
    },
)
SMALL = Space(
    ("tiled_deferred", "volume_tiled_bvh"),
    {
        "tiled_deferred": {"tile_px": (8, 16, 32, 64)},
        "volume_tiled_bvh": {"tile_px": (16, 32, 64), "depth_slices": (0, 16, 32)},
    },
)


def erratic(configuration: Configuration) -> float:
    """A factor from 0.6 to 1.7 on the time, without any pattern: a model is never sure."""
    rng = np.random.default_rng([*str(configuration.exact()).encode()])
    return float(np.exp(rng.uniform(-0.5, 0.5)))


def of(measurement: Measurement) -> Configuration:
    return configuration(measurement.technique, measurement.params)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("law", [SHADING_BOUND, ASSIGNMENT_BOUND, LAUNCH_BOUND], ids=["shading", "assign", "launch"])
def test_the_best_of_a_hundred_is_found_within_5_percent_in_few_measurements(tmp_path, law, seed):
    workload = Synthetic(law, seed=seed)
    result = search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(measurements=30), seed=seed)
    assert max(workload.true_ms(of(result.best))) <= 1.05 * workload.least_ms(WHOLE)
    assert len(workload.measured) == len(set(workload.measured)) <= 30
    assert result.best.technique == "volume_tiled_bvh"
    assert result.default is not None
    assert of(result.default) == configuration("volume_tiled_bvh")


@pytest.mark.parametrize("seed", range(3))
def test_what_no_count_shows_is_found_next_to_the_fastest(tmp_path, seed):
    # One batch size fits a cache: 40 % faster, though it has more loop iterations.
    workload = Synthetic(SHADING_BOUND, seed=seed, hidden=lambda c: 0.6 if c["batch"] == 16384 else 1.0)
    result = search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(measurements=40), seed=seed)
    assert max(workload.true_ms(of(result.best))) <= 1.1 * workload.least_ms(WHOLE)


def test_it_stops_where_nothing_is_left_to_gain(tmp_path):
    workload = Synthetic({}, noise=0.005)
    result = search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(measurements=100))
    assert "is within the noise" in result.stop_reason
    assert len(workload.measured) < 30
    # The truth is 5 ms, whatever is chosen. Four configurations can show a trend by chance (a model of them may have
    # a term), but none that promises anything, and a constant is already right within the noise.
    model = result.models["volume_tiled_bvh"]["frame"]
    assert model.loo_error <= model.constant_loo_error < 0.005
    predictions = [p for p in result.predictions if p.configuration.technique == "volume_tiled_bvh"]
    assert len(predictions) == sum(c.technique == "volume_tiled_bvh" for c in WHOLE.configurations())
    assert min(p.predicted_ms for p in predictions) > 0.99 * 5
    known = [p.predicted_ms for p in predictions if p.measured_ms is not None]
    assert known == pytest.approx([5.0] * len(known), rel=0.01)


def test_choices_that_gain_nothing_end_a_search_that_is_never_sure(tmp_path):
    # The default is the fastest by far; all others are erratic, so that the model expects a gain from each.
    workload = Synthetic({}, hidden=lambda c: 0.3 if c == configuration("tiled_deferred") else erratic(c))
    path = tmp_path / "measurements.jsonl"
    result = search(WHOLE, workload, path, Budget(measurements=60))
    assert result.stop_reason == f"the last {PATIENCE} choices gained nothing"
    assert of(result.best) == configuration("tiled_deferred")
    design = list(initial_design(WHOLE, workload.counts))
    chosen = [c for c in workload.measured if c not in design and c.is_exact]
    assert len(chosen) in (PATIENCE, PATIENCE + 1)  # the last choice may be of two
    again = Synthetic({}, hidden=workload.hidden)
    assert search(WHOLE, again, path, Budget(measurements=60)).stop_reason == result.stop_reason
    assert again.measured == []


def test_a_space_can_be_exhausted(tmp_path, monkeypatch):
    monkeypatch.setattr(tuning.sweep, "PATIENCE", 100)
    workload = Synthetic({}, hidden=erratic)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=100))
    assert set(SMALL.configurations()) <= set(workload.measured)
    assert result.stop_reason == "every configuration that can be predicted was measured"


def test_predictions_cover_the_space_and_hold_the_measured_times(tmp_path):
    workload = Synthetic(SHADING_BOUND)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=12))
    assert [p.configuration for p in result.predictions] == list(SMALL.configurations())
    for p in result.predictions:
        assert p.low_ms < p.predicted_ms < p.high_ms
        # Sixteen terms of 2 % noise fitted to ten configurations.
        assert p.predicted_ms == pytest.approx(max(workload.true_ms(p.configuration)), rel=0.15)
        assert (p.measured_ms is not None) == (p.configuration in workload.measured)
    assert any(p.measured_ms is None for p in result.predictions) or len(workload.measured) >= len(SMALL)
    assert set(result.models) == {"tiled_deferred", "volume_tiled_bvh"}


@pytest.mark.parametrize("technique", ["ptsv", "volume_tiled_bvh"])
def test_what_compiles_to_be_counted_is_not_counted_for_predictions_alone(tmp_path, technique):
    """A budget that ends before the search chooses: the rest of a shadow technique's space stays uncounted."""
    space = Space((technique,), {technique: {"tile_px": (4, 8, 16, 32), "branching": (2, 4, 8, 16, 32)}})
    workload = Synthetic(SHADING_BOUND)
    result = search(space, workload, tmp_path / "measurements.jsonl", Budget(measurements=3))
    predicted = [p.configuration for p in result.predictions]
    measured = [c for c in space.configurations() if c in workload.measured]
    assert 1 < len(measured) < len(space)
    assert predicted == (measured if technique == "ptsv" else list(space.configurations()))
    assert technique != "ptsv" or workload.counted == set(workload.measured)


def test_every_choice_is_made_from_all_that_is_known(tmp_path, monkeypatch):
    workload = Synthetic(SHADING_BOUND, hidden=erratic)
    known: list[tuple[int, int]] = []

    def choose(space, measured, counts_of, models, objective):
        n_measured = sum(c.technique == "volume_tiled_bvh" for c in measured)
        known.append((n_measured, models["volume_tiled_bvh"].n_configurations))
        return choose_next(space, measured, counts_of, models, objective)

    monkeypatch.setattr("tuning.sweep.choose_next", choose)
    search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(measurements=25))
    assert len(known) >= 4
    assert all(n_measured == n_fitted for n_measured, n_fitted in known)


@pytest.mark.parametrize("objective", ["max", "mean"])
def test_the_objective_decides_what_is_best(tmp_path, objective):
    workload = Synthetic(SHADING_BOUND, noise=0.0)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=40), objective)
    true = {c: workload.true_ms(c) for c in SMALL.configurations()}
    total = {c: max(ms) if objective == "max" else sum(ms) / 3 for c, ms in true.items()}
    assert total[of(result.best)] <= 1.01 * min(total.values())


# Kill and resume


N_SEARCHED = 16
N_DESIGN = 6  # two techniques' defaults, two more of each


def sought() -> Synthetic:
    """No model is ever sure of it: the budget is used up, and most of it on what models chose."""
    return Synthetic(LAUNCH_BOUND, hidden=erratic)


def searched(path: Path, workload: Workload):
    return search(WHOLE, workload, path, Budget(measurements=N_SEARCHED))


@pytest.mark.parametrize("torn", [b"", b'{"schema": 1, "technique": "tiled_def'])
def test_a_kill_after_any_line_neither_loses_nor_repeats_a_measurement(tmp_path, torn):
    whole = tmp_path / "whole.jsonl"
    complete = sought()
    expected = searched(whole, complete)
    lines = whole.read_bytes().splitlines(keepends=True)
    assert len(lines) == N_SEARCHED
    for n_kept in range(0, N_SEARCHED, 3):
        path = tmp_path / f"{n_kept}.jsonl"
        path.write_bytes(b"".join(lines[:n_kept]) + torn)
        workload = sought()
        result = searched(path, workload)
        assert path.read_bytes().splitlines(keepends=True)[:n_kept] == lines[:n_kept]
        kept = complete.measured[:n_kept]
        assert not set(kept) & set(workload.measured) and len(set(workload.measured)) == N_SEARCHED - n_kept
        # Later choices are made two at a time: a half one is made anew, knowing more.
        if n_kept <= N_DESIGN:
            assert workload.measured == complete.measured[n_kept:]
            assert path.read_bytes() == whole.read_bytes()
            assert result == expected


def test_a_kill_while_measuring_loses_that_measurement_alone(tmp_path):
    path = tmp_path / "measurements.jsonl"
    with pytest.raises(KeyboardInterrupt):
        searched(path, dataclasses.replace(sought(), dies_at=7))
    assert len(read_measurements(path)) == 7
    workload = sought()
    searched(path, workload)
    assert len(workload.measured) == N_SEARCHED - 7
    assert len(read_measurements(path)) == N_SEARCHED


def test_a_finished_search_is_only_evaluated_again(tmp_path):
    path = tmp_path / "measurements.jsonl"
    first = searched(path, sought())
    workload = sought()
    assert searched(path, workload) == first
    assert workload.measured == []


@pytest.mark.parametrize("other", [{"scene_key": "another"}, {"device": "another"}, {"frames": (1, 2, 3)}])
def test_measurements_of_something_else_are_kept_but_not_used(tmp_path, other):
    path = tmp_path / "measurements.jsonl"
    searched(path, dataclasses.replace(sought(), **other))
    workload = sought()
    result = searched(path, workload)
    assert len(workload.measured) == len(result.measurements) == N_SEARCHED
    assert len(read_measurements(path)) == 2 * N_SEARCHED


def test_a_damaged_record_is_refused_before_anything_is_measured(tmp_path):
    path = tmp_path / "measurements.jsonl"
    path.write_text("nonsense\n")
    workload = Synthetic(LAUNCH_BOUND)
    with pytest.raises(InputError, match="line 1"):
        searched(path, workload)
    assert workload.measured == []


# Failures


def test_failed_configurations_are_recorded_and_neither_fitted_nor_retried(tmp_path):
    path = tmp_path / "measurements.jsonl"
    workload = Synthetic(SHADING_BOUND, fails=lambda c: c.params.get("tile_px", 32) in (8, 16))
    result = search(WHOLE, workload, path, Budget(measurements=40))
    assert len(workload.measured) == len(set(workload.measured))
    outcomes = [m.outcome for m in read_measurements(path)]
    assert {"timed", "out_of_memory"} == set(outcomes)
    assert result.best.outcome == "timed"
    fitted = [of(m) for m in result.measurements if m.outcome == "timed" and of(m) in WHOLE]
    n_fitted = sum(candidate.technique == "volume_tiled_bvh" for candidate in fitted)
    assert result.models["volume_tiled_bvh"]["frame"].n == 3 * n_fitted
    possible = [c for c in WHOLE.configurations() if c.params.get("tile_px", 32) not in (8, 16)]
    assert max(workload.true_ms(of(result.best))) <= 1.05 * min(max(workload.true_ms(c)) for c in possible)


def test_a_default_that_fails_does_not_end_the_search(tmp_path):
    workload = Synthetic(SHADING_BOUND, fails=lambda c: c == configuration(c.technique))
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=12))
    assert result.default is None
    assert result.fastest_default is None
    assert result.best.outcome == "timed"


def test_where_everything_fails_one_line_says_so(tmp_path):
    path = tmp_path / "measurements.jsonl"
    workload = Synthetic({}, fails=lambda _: True)
    # The whole design is tried, and nothing after it: there is no time to go by.
    design = list(initial_design(SMALL, workload.counts))
    message = rf"none of {len(design)} configurations .*out_of_memory: 9 GB needed.*smaller size"
    with pytest.raises(InputError, match=message):
        search(SMALL, workload, path, Budget(measurements=len(design) + 2))
    assert set(workload.measured) == set(design)
    assert len(read_measurements(path)) == len(design)


def test_a_configuration_that_lost_on_the_first_frame_is_not_timed_on_the_others_and_still_counts(tmp_path):
    class Impatient(Synthetic):
        def measure(self, configuration, best_ms, /):
            whole = super().measure(configuration, best_ms)
            first_ms = whole.stages_ms["frame"][0]
            if best_ms is None or min(first_ms) <= 1.2 * best_ms:
                return whole
            return dataclasses.replace(whole, stages_ms={"frame": (first_ms, (), ())})

    path = tmp_path / "measurements.jsonl"
    workload = Impatient(SHADING_BOUND)
    result = search(WHOLE, workload, path, Budget(measurements=30))
    lost = [m for m in read_measurements(path) if not m.stages_ms["frame"][1]]
    assert lost
    assert max(workload.true_ms(of(result.best))) <= 1.05 * workload.least_ms(WHOLE)
    assert result.best not in lost
    # Their first frame is fitted, and is their measured time in the chart of predictions.
    fitted = [m for m in result.measurements if m.technique == "volume_tiled_bvh" and of(m) in WHOLE]
    n_rows = sum(len(repeats) > 0 for m in fitted for repeats in m.stages_ms["frame"])
    assert result.models["volume_tiled_bvh"]["frame"].n == n_rows
    told = {p.configuration: p.measured_ms for p in result.predictions}
    shown = [m for m in lost if of(m) in told]
    assert shown
    assert all(told[of(m)] == np.median(m.stages_ms["frame"][0]) for m in shown)


@pytest.mark.parametrize("broken_ms", [math.nan, math.inf])
def test_a_time_that_is_no_number_is_never_best(tmp_path, broken_ms):
    class Broken(Synthetic):
        def measure(self, configuration, best_ms, /):
            sound = super().measure(configuration, best_ms)
            if configuration["tile_px"] != 16:
                return sound
            return dataclasses.replace(sound, stages_ms={"frame": ((broken_ms,), (1e-9,), (1e-9,))})

    result = search(SMALL, Broken(SHADING_BOUND), tmp_path / "measurements.jsonl", Budget(measurements=20))
    assert result.best.params["tile_px"] != 16
    assert all(m.params["tile_px"] != 16 for m in result.pareto)


# Budget


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("40", Budget(measurements=40)),
        (" 1 ", Budget(measurements=1)),
        ("120s", Budget(seconds=120.0)),
        ("0.5 s", Budget(seconds=0.5)),
    ],
)
def test_a_budget_is_a_count_or_seconds(text, budget):
    assert Budget.parse(text) == budget


@pytest.mark.parametrize("text", ["", "0", "-3", "2.5", "s", "0s", "-1s", "nans", "infs", "2m", "ten", "9" * 5000])
def test_a_bad_budget_is_refused(text):
    with pytest.raises(InputError, match=r"budget .*: must be a number of measurements, as `40`, or of seconds"):
        Budget.parse(text)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
def test_a_count_is_never_exceeded_and_some_of_it_goes_to_accuracy(tmp_path, n):
    workload = Synthetic(LAUNCH_BOUND, hidden=erratic)
    result = search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(measurements=n))
    assert len(workload.measured) == n
    approximate = [c for c in workload.measured if not c.is_exact]
    assert len(approximate) >= n // 5
    assert len(result.pareto) >= 1 + (n >= 12)
    if n == 12:
        assert result.stop_reason == "the budget of 12 measurements was used"


def test_seconds_are_those_spent_measuring_and_the_last_measurement_is_completed(tmp_path):
    now = 0.0

    class Slow(Synthetic):
        def measure(self, configuration, best_ms, /):
            nonlocal now
            now += 10.5  # with half a second of compiling
            return super().measure(configuration, best_ms)

    workload = Slow(LAUNCH_BOUND)
    search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(seconds=95), clock=lambda: now)
    assert len(workload.measured) == 10  # the tenth starts at 90 s


def test_seconds_of_an_earlier_run_are_those_of_its_repeats(tmp_path):
    path = tmp_path / "measurements.jsonl"
    search(SMALL, Synthetic(LAUNCH_BOUND), path, Budget(measurements=4))
    spent_s = sum(sum(map(sum, m.stages_ms["frame"])) / 1e3 for m in read_measurements(path))
    again = Synthetic(LAUNCH_BOUND)
    search(SMALL, again, path, Budget(seconds=spent_s * 0.99), clock=lambda: 0.0)
    assert again.measured == []
    search(SMALL, again, path, Budget(seconds=spent_s * 1.3), clock=lambda: 0.0)
    assert again.measured  # the clock stands still: only the earlier run's seconds count


def test_progress_and_the_time_to_beat_are_told_before_each_measurement(tmp_path):
    seen: list[Progress] = []
    workload = Synthetic(LAUNCH_BOUND)
    search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=10), progress=seen.append)
    assert [p.configuration for p in seen] == workload.measured
    assert [p.n_measured for p in seen] == list(range(len(seen)))
    assert [p.spent for p in seen] == pytest.approx([k / 10 for k in range(len(seen))])
    assert [p.best_ms for p in seen] == workload.best_seen
    assert workload.best_seen[0] is None
    best = [ms for ms in workload.best_seen if ms is not None]
    assert best == sorted(best, reverse=True)


# What may be recommended


def test_without_a_permitted_error_only_exact_settings_are_best(tmp_path):
    workload = Synthetic(SHADING_BOUND)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=30))
    assert of(result.best).is_exact
    fastest, *_, most_exact = result.pareto
    assert most_exact == result.best
    assert min(fastest.stages_ms["frame"][0]) < min(result.best.stages_ms["frame"][0])


@pytest.mark.parametrize(("max_error", "expected"), [(0.2, 0.1), (0.05, 0.01), (1e-3, 0.0)])
def test_a_permitted_error_is_used_and_kept(tmp_path, max_error, expected):
    # A cut-off of 0.1 saves 30 %, half precision 20 % and a cut-off of 0.01 3 %; they are not combined.
    workload = Synthetic(SHADING_BOUND, noise=0.001)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=40), max_error=max_error)
    assert result.best.error == pytest.approx(expected, abs=0.0011)
    assert (result.best.params["gbuffer"] == "float32") == (expected != 0.01)
    assert result.best.params["light_cutoff"] == (0.1 if expected == 0.1 else 0.0)
    assert result.best.error is not None
    assert result.best.error <= max_error


def test_an_error_that_nothing_keeps_is_refused_with_the_smallest_there_is(tmp_path):
    with pytest.raises(InputError, match=r"max-error 1e-09: .*the smallest error is 1e-07"):
        search(SMALL, Synthetic({}), tmp_path / "measurements.jsonl", Budget(measurements=8), max_error=1e-9)


def test_a_default_outside_the_space_is_measured_and_not_recommended(tmp_path):
    space = Space(("tiled_deferred",), {"tiled_deferred": {"tile_px": (128, 256)}})
    workload = Synthetic(SHADING_BOUND)
    result = search(space, workload, tmp_path / "measurements.jsonl", Budget(measurements=8))
    assert workload.measured[0] == configuration("tiled_deferred")
    assert result.default is not None
    assert result.best.params["tile_px"] == 128


def test_a_space_without_exact_settings_needs_a_permitted_error(tmp_path):
    space = Space(("tiled_deferred",), {"tiled_deferred": {"gbuffer": ("float16",)}})
    path = tmp_path / "measurements.jsonl"
    with pytest.raises(InputError, match="max-error is missing"):
        search(space, Synthetic({}), path, Budget(measurements=8))
    result = search(space, Synthetic({}), path, Budget(measurements=8), max_error=0.05)
    assert result.best.params["gbuffer"] == "float16"


# Techniques that are left out


def test_a_hopeless_technique_is_not_measured_unless_it_is_asked_for(tmp_path):
    workload = Synthetic(SHADING_BOUND)
    result = search(WHOLE, workload, tmp_path / "a.jsonl", Budget(measurements=8))
    assert "forward" not in {c.technique for c in workload.measured}
    assert "times the lighting computations of volume_tiled_bvh's" in result.not_measured["forward"]
    assert {c for c in workload.counted if c.technique == "forward"} == {configuration("forward")}

    asked = Synthetic(SHADING_BOUND)
    result = search(WHOLE, asked, tmp_path / "b.jsonl", Budget(measurements=8), keep={"forward"})
    assert asked.measured.count(configuration("forward")) == 1
    assert result.not_measured == {}


def test_a_technique_that_is_much_slower_is_measured_at_its_default_only(tmp_path):
    workload = Synthetic(SHADING_BOUND)
    result = search(WHOLE, workload, tmp_path / "a.jsonl", Budget(measurements=30), keep={"forward"})
    assert [c for c in workload.measured if c.technique == "forward"] == [configuration("forward")]
    assert "times as long as the fastest default" in result.not_explored["forward"]


def test_a_technique_that_the_constraints_leave_nothing_of_is_not_measured(tmp_path):
    space = Space(SMALL.techniques, SMALL.values, ("depth_slices > 0", "tile_px > 40 or depth_slices > 0"))
    space = dataclasses.replace(space, constraints=(*space.constraints, "tile_px == 16", "branching == 32"))
    only = dataclasses.replace(space, values={**space.values, "tiled_deferred": {"tile_px": (8,)}})
    workload = Synthetic(SHADING_BOUND)
    result = search(only, workload, tmp_path / "measurements.jsonl", Budget(measurements=8))
    assert {c.technique for c in workload.measured} == {"volume_tiled_bvh"}
    assert "constraints leave no configuration" in result.not_measured["tiled_deferred"]
