"""What a search finds and in how many measurements, where it stops, what it leaves out, what it tells."""

import dataclasses

import pytest

import tuning.sweep
from tests.tuning.synthetic_workload import (
    ASSIGNMENT_BOUND,
    LAUNCH_BOUND,
    SHADING_BOUND,
    SMALL,
    WHOLE,
    Synthetic,
    erratic,
    of,
)
from tuning.budget import Budget
from tuning.choose import choose_next, initial_design
from tuning.search_run import Progress
from tuning.space import Space
from tuning.sweep import PATIENCE, search
from vtfs.configurations import configuration


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
