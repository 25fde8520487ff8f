"""One scene as the search sees it: its counts are those of `vtfs.count`, and what has lost is not measured on."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tuning.timing
from tests.command_line import short_repeats
from tuning.budget import Budget
from tuning.choose import Objective, is_timed, time_ms
from tuning.compiles import Compiles
from tuning.space import Space, load_space
from tuning.sweep import search
from tuning.tune import choose_frames
from tuning.workload import LOST, ScenePath, SceneWorkload, busiest_frames, cached_counts
from vtfs.camera import Viewport
from vtfs.configurations import configuration
from vtfs.device import keep_compiled_programs
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.scene_setup import SceneOptions, set_up
from vtfs.technique_names import TUNED_TECHNIQUES

FRAMES = (0, 30, 45)


@pytest.fixture(scope="module")
def setup():
    """The scene, size and number of lights of all tests that run programs."""
    keep_compiled_programs()
    return set_up(SceneOptions("street", viewport=Viewport(64, 36), n_triangles=1000, lights="20"))


def a_workload(setup, objective: Objective = "max", frames=FRAMES) -> SceneWorkload:
    path = ScenePath(setup.key, frames, tuple(map(setup.samples, frames)), setup.lights, seed=0)
    return SceneWorkload(path, Compiles(), objective)


@pytest.fixture(scope="module")
def workload(setup):
    return a_workload(setup)


CONFIGURATIONS = [
    configuration("forward"),
    configuration("tiled_deferred", {"tile_px": 16, "batch": 64}),
    configuration("volume_tiled_bvh", {"depth_slices": 12, "light_cutoff": 0.1}),
    configuration("tiled_deferred", {"gbuffer": "float16"}),
]


@pytest.mark.parametrize("config", CONFIGURATIONS, ids=str)
def test_counts_are_those_of_counting(setup, workload, config):
    for i, frame in enumerate(FRAMES):
        expected, _ = count(config, FrameInputs(setup.samples(frame), setup.lights))
        expected = expected.at_batch(int(config["batch"]))
        counted = workload.counts_of_frame(config, i)
        if config["batch"]:  # of the capacities at batch 0, some of which are rounded up to whole chunks
            assert counted["memory"] == pytest.approx(expected["memory"], rel=0.02)
            counted, expected = counted | {"memory": 0}, expected | {"memory": 0}
        assert counted == expected
    assert workload.counts(config) == (workload.counts_of_frame(config, 0),)


def test_counts_are_read_again_not_made_again(setup):
    config = configuration("forward")

    def inputs():
        return FrameInputs(setup.samples(3), setup.lights)

    made = cached_counts(config, "a scene", 3, inputs)

    def fails():
        raise AssertionError("counted again")

    read = cached_counts(config, "a scene", 3, fails)
    assert read.technique == made.technique and read.at_batch(64) == made.at_batch(64) and read.sizes == made.sizes
    with pytest.raises(AssertionError, match="counted again"):
        cached_counts(config, "another scene", 3, fails)


# Which frames


@given(work=st.dictionaries(st.integers(0, 500), st.integers(0, 9), min_size=1, max_size=12))
def test_frames_are_those_with_the_most_the_median_and_the_least_work(work):
    frames = busiest_frames(work)
    amounts = [work[frame] for frame in frames]
    assert len(set(frames)) == len(frames) == min(3, len(work))
    assert amounts == sorted(amounts, reverse=True)
    assert amounts[0] == max(work.values()) and amounts[-1] == min(work.values())
    if len(frames) == 3:
        more, less = (sum(sign * w > sign * amounts[1] for w in work.values()) for sign in (1, -1))
        assert max(more, less) <= len(work) / 2


def test_a_path_of_one_frame_has_one():
    assert busiest_frames({7: 0}) == (7,)
    assert busiest_frames({7: 0, 8: 0}) in [(7, 8)]


def test_the_frames_of_a_scene_are_those_that_counting_says(setup):
    work = {}
    for frame in setup.counted_frames:
        counts, _ = count(configuration("tiled_deferred"), FrameInputs(setup.samples(frame), setup.lights))
        work[frame] = counts.technique["lighting_computations"]
    most, median, fewest = choose_frames(setup)
    assert work[most] == max(work.values()) and work[fewest] == min(work.values())
    assert sorted(work.values())[len(work) // 2] == work[median]


# Measuring


@pytest.mark.parametrize("technique", (*TUNED_TECHNIQUES, "deferred_stencil"))
def test_a_measurement_has_times_of_every_frame_and_stage(workload, technique):
    with short_repeats():
        m = workload.measure(configuration(technique), None)
    assert m.outcome == "timed" and m.message == "" and m.frames == FRAMES and m.device == workload.device
    assert m.error is not None and m.error_p999 is not None and 0 <= m.error < 1e-4
    assert len(m.counts) == len(FRAMES) and m.counts[0]["samples"] > 0
    assert all(len(repeats) >= 3 and min(repeats) > 0 for repeats in m.stages_ms["frame"])
    stages = set(m.stages_ms) - {"frame"}
    assert ("shade_opaque" in stages and "assign" in stages) == (technique != "forward")
    for stage in stages:
        assert len(m.stages_ms[stage][0]) >= 3 and m.stages_ms[stage][1:] == ((), ())


def test_stages_of_a_setting_that_changes_the_image_are_not_timed(workload):
    """No model of stages is fitted to them."""
    with short_repeats():
        m = workload.measure(configuration("tiled_deferred", {"light_cutoff": 0.1}), None)
    assert m.outcome == "timed" and set(m.stages_ms) == {"frame"} and all(m.stages_ms["frame"])


class FakeFrames:
    """Frames that take what `cost_ms(config, i)` says, on a clock of their own."""

    def __init__(self, monkeypatch, cost_ms):
        self.now_s = 0.0
        monkeypatch.setattr(tuning.timing, "time", SimpleNamespace(perf_counter=lambda: self.now_s))
        monkeypatch.setattr(tuning.timing, "MIN_S", 0.0)  # stages take no time on this clock

        def frame_run(_, config, i):
            def run():
                self.now_s += cost_ms(config, i) / 1e3

            return run

        monkeypatch.setattr(SceneWorkload, "_frame_run", frame_run)


def test_what_has_lost_on_the_first_frame_is_not_timed_on_the_others(setup, monkeypatch):
    FakeFrames(monkeypatch, lambda config, i: 10.0 - i)
    for best_ms, n_repeats in ((None, [6, 3, 3]), (9.8, [6, 3, 3]), (9.5, [3, 0, 0]), (6.2, [1, 0, 0])):
        m = a_workload(setup).measure(configuration("forward"), best_ms)
        assert [len(repeats) for repeats in m.stages_ms["frame"]] == n_repeats, best_ms
        assert is_timed(m) and time_ms(m, "max") == pytest.approx(10.0)


def test_a_later_frame_that_is_slower_decides(setup, monkeypatch):
    FakeFrames(monkeypatch, lambda config, i: (10.0, 30.0, 1.0)[i])
    m = a_workload(setup).measure(configuration("forward"), 20.0)
    assert [len(repeats) for repeats in m.stages_ms["frame"]] == [6, 3, 3]
    assert time_ms(m, "max") == pytest.approx(30.0)


def test_what_a_later_frame_compiles_is_not_held_against_it(setup, monkeypatch):
    compiled = set()

    def cost_ms(config, i):
        first = i > 0 and i not in compiled
        compiled.add(i)
        return 2000.0 if first else 10.0

    FakeFrames(monkeypatch, cost_ms)
    m = a_workload(setup).measure(configuration("forward"), 10.0)
    assert max(ms for repeats in m.stages_ms["frame"] for ms in repeats) == pytest.approx(10.0)


def test_for_the_mean_every_frame_counts(setup, monkeypatch):
    FakeFrames(monkeypatch, lambda config, i: 10.0 - i)
    m = a_workload(setup, "mean").measure(configuration("forward"), 1.0)
    assert [len(repeats) for repeats in m.stages_ms["frame"]] == [6, 6, 6]
    assert time_ms(m, "mean") == pytest.approx(9.0)


def test_what_has_lost_is_never_recommended(setup, monkeypatch, tmp_path):
    """Losers are timed on one frame only, where they may look good: here their others would be dear."""
    cost_ms = {"forward": 20.0, "tiled_deferred": 10.0, "volume_tiled_bvh": 30.0}
    FakeFrames(monkeypatch, lambda config, i: cost_ms[config.technique] + float(config.params.get("tile_px", 0)) / 100)
    path = tmp_path / "space.toml"
    path.write_text("[parameters]\ntile_px = [16, 32]\n")
    space: Space = load_space(path, TUNED_TECHNIQUES)
    found = search(space, a_workload(setup), tmp_path / "measurements.jsonl", Budget(measurements=4))
    assert (found.best.technique, found.best.params["tile_px"]) == ("tiled_deferred", 16)
    assert all(found.best.stages_ms["frame"])
    lost = [m for m in found.measurements if not all(m.stages_ms["frame"])]
    # Measured after `tiled_deferred`; `volume_tiled_bvh`, the thriftiest, came first and had nothing to lose to.
    assert {m.technique for m in lost} == {"forward"}
    for m in lost:
        assert len(m.stages_ms["frame"][0]) >= 1 and not any(m.stages_ms["frame"][1:])
        assert np.median(m.stages_ms["frame"][0]) > LOST * time_ms(found.best, "max")


def test_what_is_recommended_was_timed_on_every_frame(setup, monkeypatch, tmp_path):
    """The default is measured to compare with, and here is the fastest, but the space leaves it out: whatever it
    allows has lost against it on the first frame, and the slower second one is never seen."""
    FakeFrames(monkeypatch, lambda config, i: (10.0 if config["tile_px"] == 32 else 200.0) * (1 + i))
    path = tmp_path / "space.toml"
    path.write_text("constraints = ['tile_px < 20']\n[parameters]\ntile_px = [8, 16]\n")
    space = load_space(path, ("tiled_deferred",))
    found = search(space, a_workload(setup), tmp_path / "measurements.jsonl", Budget(measurements=4))
    assert found.best.params["tile_px"] != 32
    assert all(found.best.stages_ms["frame"]) and time_ms(found.best, "max") == pytest.approx(600.0)
