"""Failures are results: what runs out of memory or time, is wrong, or cannot be counted or written."""

import json
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import tuning.workload
from tests.command_line import full_disk, is_refused
from tests.tuning.tune_runs import configurations_of, is_complete, lines_of, result_of, tune
from tuning.record import read_measurements
from vtfs.frame import frame_program
from vtfs.frame_sizes import CapacityError

pytestmark = pytest.mark.usefixtures("quick_tune")


def broken_frames(monkeypatch, technique, break_):
    """Frames of a technique are what `break_` makes of their program's `(image, overflowed)`."""

    def program(name, plan, has_transparent):
        run = frame_program(name, plan, has_transparent)
        return (lambda env: break_(run(env))) if name == technique else run

    monkeypatch.setattr(tuning.workload, "frame_program", program)


def raising(error):
    def break_(_):
        raise error

    return break_


FAILURES = {
    "device memory": (
        raising(jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 byte.\nmore")),
        "out_of_memory",
    ),
    "device error": (raising(jax.errors.JaxRuntimeError("INTERNAL: broken")), "failed"),
    "empty message": (raising(jax.errors.JaxRuntimeError("")), "failed"),
    "host memory": (raising(MemoryError()), "out_of_memory"),
    "capacity": (raising(CapacityError("pairs: 9 needed, at most 8 fit.")), "overflow"),
    "overflow": (lambda made: (made[0], True), "overflow"),
    "wrong image": (lambda made: (tuple(1.01 * channel for channel in made[0]), made[1]), "failed"),
    "not a number": (lambda made: (tuple(np.nan * channel for channel in made[0]), made[1]), "failed"),
}


@pytest.mark.parametrize("failure", FAILURES)
def test_a_configuration_that_fails_is_a_line_and_the_search_goes_on(failure, monkeypatch):
    break_, outcome = FAILURES[failure]
    broken_frames(monkeypatch, "tiled_deferred", break_)
    result = result_of(tune("--budget", "4"))
    is_complete(result)
    by_outcome = {m.technique: m for m in read_measurements("out/measurements.jsonl")}
    assert by_outcome["tiled_deferred"].outcome == outcome and by_outcome["tiled_deferred"].message
    assert "\n" not in by_outcome["tiled_deferred"].message
    assert by_outcome["forward"].outcome == by_outcome["volume_tiled_bvh"].outcome == "timed"
    assert result["best"]["technique"] != "tiled_deferred" and result["failed"] >= 1


def test_a_frame_that_takes_too_long_is_a_line(monkeypatch):
    def slow(made):
        time.sleep(0.5)
        return made

    broken_frames(monkeypatch, "tiled_deferred", slow)
    monkeypatch.setattr(tuning.workload, "TIMEOUT_S", 0.4)
    result = result_of(tune("--budget", "3"))
    (late,) = [m for m in read_measurements("out/measurements.jsonl") if m.technique == "tiled_deferred"]
    assert late.outcome == "timeout" and late.stages_ms == {} and result["failed"] == 1


def test_a_stage_that_fails_by_itself_is_a_line(monkeypatch):
    monkeypatch.setattr(tuning.workload, "run_stages", lambda *_: raising(MemoryError())(None))
    result = result_of(tune("--budget", "3"))
    assert {m.outcome for m in read_measurements("out/measurements.jsonl") if m.technique != "forward"} == {
        "out_of_memory"
    }
    assert result["best"]["technique"] == "forward" and result["failed"] == 2


def test_where_all_fail_that_is_said_in_one_line(monkeypatch):
    broken_frames(monkeypatch, "forward", raising(MemoryError()))
    is_refused(
        tune("--budget", "2", "--techniques", "forward", space="forward.toml"),
        "configurations",
        "out_of_memory",
        "smaller size",
    )
    assert len(lines_of()) == 1


def test_a_half_precision_image_may_be_infinite(monkeypatch):
    """Of a setting that changes the image the error is recorded, however bad it is; none is infinite in JSON."""
    run_frame = tuning.workload.SceneWorkload._run_frame

    def overflowing(self, config, i):
        image, overflowed = run_frame(self, config, i)
        return (tuple(np.inf * channel for channel in image) if config["gbuffer"] == "float16" else image), overflowed

    monkeypatch.setattr(tuning.workload.SceneWorkload, "_run_frame", overflowing)
    result = result_of(tune("--techniques", "forward", "--budget", "20", space="forward.toml"))
    is_complete(result)
    assert all(point["params"]["gbuffer"] != "float16" for point in result["pareto"])


@pytest.mark.parametrize(
    "error",
    [
        CapacityError("pairs: 9 needed, at most 8 fit."),
        MemoryError(),
        jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: x"),
    ],
    ids=["capacity", "host memory", "device memory"],
)
def test_what_cannot_even_be_counted_is_a_line_too(error, monkeypatch):
    count = tuning.workload.count

    def counting(config, *arguments):
        if config.technique == "volume_tiled_bvh" and config["tile_px"] == 16:
            raise error
        return count(config, *arguments)

    monkeypatch.setattr(tuning.workload, "count", counting)
    monkeypatch.setattr(tuning.workload, "cached", lambda kind, parts, make: make())
    result = result_of(tune("--techniques", "volume_tiled_bvh", "--budget", "4"))
    is_complete(result)
    uncounted = [
        m
        for m in read_measurements(Path("out/measurements.jsonl"))
        if m.technique == "volume_tiled_bvh" and m.params["tile_px"] == 16
    ]
    assert uncounted and all(m.outcome in ("overflow", "out_of_memory") for m in uncounted)


@pytest.mark.parametrize("nth", [1, 2, 3, 4, 6, 8])
def test_a_full_disk_leaves_what_was_measured_and_nothing_half_written(nth):
    with full_disk("out", nth):
        ran = tune("--budget", "3")
    assert ran.code == 2 and ran.err.count("\n") == 1 and "No space left on device" in ran.err
    kept = min(max(nth - 2, 0), 3)  # the first is the probe of the folder
    assert not Path("out/report.html").exists() and list(Path("out").rglob(".*")) == []
    if nth > 1:
        assert len(configurations_of()) == kept
    assert not Path("out/result.json").exists() or json.loads(Path("out/result.json").read_text())
    result_of(tune("--budget", "3", "--resume"))
    assert len(lines_of()) == 3 == len(set(configurations_of()))
