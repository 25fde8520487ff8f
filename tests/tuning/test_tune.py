"""The main job from the command line: files, budgets, resuming, failures; on scenes that take a second."""

import json
import os
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest

import tuning.workload
from tests.command_line import SMALL, finished, full_disk, is_refused, short_repeats, started, vtfs
from tuning.record import read_measurements
from vtfs.camera import Viewport, save_cameras
from vtfs.frame import frame_program
from vtfs.frame_sizes import CapacityError
from vtfs.gallery import build_scene
from vtfs.gbuffer_files import save_gbuffer
from vtfs.input_error import InputError
from vtfs.lights import save_lights
from vtfs.scene import save_scene
from vtfs.scene_setup import SceneOptions, set_up

TECHNIQUES = {"forward", "tiled_deferred", "volume_tiled_bvh"}
SPACE = "[parameters]\ntile_px = [16, 32]\n"


@pytest.fixture(autouse=True)
def _quick(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("space.toml").write_text(SPACE)
    Path("forward.toml").write_text("[parameters]\nbatch = [0]\n")
    with short_repeats():
        yield


def small_setup():
    return set_up(SceneOptions("street", viewport=Viewport(64, 36), n_triangles=1000, lights="20"))


def tune(*arguments, scene=SMALL, out="out", space="space.toml"):
    return vtfs("tune", *scene, "--space", space, "--out", out, *arguments)


def result_of(ran, out="out"):
    assert ran.code == 0 and ran.err == "", ran
    return json.loads(Path(out, "result.json").read_text())


def lines_of(out="out"):
    return Path(out, "measurements.jsonl").read_bytes().splitlines(keepends=True)


def configurations_of(out="out"):
    return [(m.technique, tuple(m.params.items())) for m in read_measurements(Path(out, "measurements.jsonl"))]


def is_complete(result, out="out"):
    """Every key that programs rely on, every file, and a recommendation that was measured."""
    keys = "schema scene device versions seed space_size measured compiled_programs compile_s wall_s "
    keys += "default best pareto cost_models"
    assert set(keys.split()) <= set(result)
    assert {"name", "triangles", "lights", "frames"} <= set(result["scene"])
    assert {"technique", "params", "time_ms"} <= set(result["default"])
    assert {"technique", "params", "time_ms", "time_ms_interval"} <= set(result["best"])
    assert result["pareto"] and all(
        {"technique", "params", "time_ms", "error"} <= set(point) for point in result["pareto"]
    )
    model_keys = {"technique", "stage", "terms", "dropped", "coefficients", "loo_error"}
    assert all(model_keys <= set(model) for model in result["cost_models"])
    assert {"within", "crossovers", "matters", "best", "influential"} == set(result["answers"])
    assert all(isinstance(line, str) for line in result["answer_lines"])
    best = result["best"]
    low, high = best["time_ms_interval"]
    assert 0 < low <= best["time_ms"] <= high
    measured = read_measurements(Path(out, "measurements.jsonl"))
    own = [m for m in measured if (m.technique, m.params) == (best["technique"], best["params"])]
    assert len(own) == 1 and own[0].outcome == "timed"
    assert result["measured"] + result["failed"] == len(measured) == len(set(configurations_of(out)))
    for picture in result["pictures"]:
        assert Path(out, "pictures", picture["file"]).stat().st_size > 100
    assert "<html" in Path(out, "report.html").read_text()[:1000].lower()
    leftovers = [file for file in Path(out).rglob("*") if file.name.startswith(".")]
    assert leftovers == []


# The whole job


def test_a_built_in_scene_with_the_default_space():
    ran = vtfs("tune", *SMALL, "--budget", "3", "--out", "new/out")
    result = result_of(ran, "new/out")
    is_complete(result, "new/out")
    assert result["scene"]["name"] == "street" and result["scene"]["lights"] == 20 and result["scene"]["frames"] == 60
    assert result["measured"] + result["failed"] == 3 < result["space_size"] and result["seed"] == 0
    assert {m.technique for m in read_measurements("new/out/measurements.jsonl")} == TECHNIQUES
    assert "new/out/report.html" in ran.out and result["best"]["technique"] in ran.out.splitlines()[0]
    assert "for this JAX implementation on this device" in ran.out


def test_no_more_is_measured_than_the_space_is_said_to_have():
    result = result_of(tune("--techniques", "tiled_deferred", "--budget", "20"))
    assert 2 < result["measured"] <= result["space_size"]  # two in the space, and what changes the image


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_files_of_ones_own(suffix):
    scene = build_scene("street", 1000)
    assert scene.cameras is not None
    save_scene(scene, Path("Straße.x").with_suffix(suffix))
    save_cameras("cameras.json", scene.cameras)
    save_lights("lights.csv", small_setup().lights)
    files = (f"Straße{suffix}", "--cameras", "cameras.json", "--lights", "lights.csv", "--size", "64x36")
    result = result_of(tune("--budget", "3", scene=files))
    is_complete(result)
    assert result["scene"]["triangles"] == scene.n_triangles and result["scene"]["lights"] == 20


@pytest.mark.parametrize("n_frames", [1, 3])
def test_view_samples_of_ones_own_renderer(n_frames):
    setup = small_setup()
    save_cameras("cameras.json", setup.cameras)
    Path("frames").mkdir()
    for frame in range(n_frames):
        save_gbuffer(f"frames/{frame:04d}.npz", setup.samples(frame))
    scene = "frames" if n_frames > 1 else "frames/0000.npz"
    result = result_of(tune("--budget", "3", scene=(scene, "--cameras", "cameras.json", "--lights", "20")))
    is_complete(result)
    assert result["scene"]["frames"] == n_frames and result["scene"]["triangles"] == 0
    assert set(result["scene"]["measured_frames"]) <= set(range(n_frames))


@pytest.mark.parametrize("space", [None, "two.toml"])
def test_shadows_that_cannot_be_compared_are_refused_before_anything_is_counted(space, monkeypatch):
    monkeypatch.setattr("tuning.tune.choose_frames", None)
    Path("two.toml").write_text("[parameters]\nblending = ['grey', 'coloured']\n")
    scene = ("conservatory", "--triangles", "1000", "--size", "64x36", "--lights", "20")
    own = ("--techniques", "z_pass") if space is None else ("--techniques", "ptsv", "--space", space)
    is_refused(vtfs("tune", *scene, *own, "--out", "out"), "z_pass" if space is None else "`blending` = grey, coloured")


def test_groups_stand_in_lists_with_single_techniques(monkeypatch):
    scene = ("conservatory", "--triangles", "1000", "--size", "64x36", "--lights", "20", "--out", "out")
    is_refused(vtfs("tune", *scene, "--techniques", "shadows,tiled_deferred"), "one casts shadows, the other does not")
    is_refused(vtfs("tune", *scene, "--techniques", "all,brute_force"), "brute_force", "is not timed")
    asked = []

    def only_asked(setup, options, *_):
        asked.append(options)
        raise InputError("enough")

    monkeypatch.setattr("tuning.tune.tune", only_asked)
    for named in ("shadows", "ptsv,shadows,z_fail", "ptsv"):
        is_refused(vtfs("tune", *scene, "--techniques", named), "enough")
    group, mixed, single = [(options.techniques, options.keep) for options in asked]
    assert group == (("z_pass", "z_fail", "ptsv", "cluster_hierarchy"), ())
    assert mixed == (("ptsv", "z_pass", "z_fail", "cluster_hierarchy"), ("ptsv", "z_fail"))
    assert single == (("ptsv",), ("ptsv",))


def test_shadow_techniques_are_tuned_as_others_and_not_among_them():
    Path("one.toml").write_text("[parameters]\nbranching = [32]\n")
    ran = tune("--techniques", "cluster_hierarchy", "--shadow-lights", "2", "--budget", "2", space="one.toml")
    result = result_of(ran)
    is_complete(result)
    assert result["kind"] == "shadows" and result["scene"]["shadow_lights"] == 2
    exact, other = read_measurements(Path("out/measurements.jsonl"))
    assert exact.error is not None and exact.error < 1e-5 and other.params["front_faces"] == "culled"
    casting = {"shadow_planes", "shadow_build", "shadow_traverse", "shadow_merge", "shadow_bits"}
    assert casting | {"assign", "shade_opaque", "frame"} <= set(exact.stages_ms)
    assert exact.counts[0]["test_and_set"] > 0 and exact.counts[0]["shadow_lights"] == 2
    assert {picture["kind"] for picture in result["pictures"]} == {"frame", "shadows", "heat_map"}
    page = Path("out/report.html").read_text()
    assert "2 of them with shadows" in page and "compared with one another only" in page
    is_refused(tune("--techniques", "ptsv,forward", out="b"), "ptsv,forward: one casts shadows, the other does not")
    is_refused(tune("--techniques", "shadow_rays", out="c"), "shadow_rays: is what others are checked against")


def test_json_on_stdout_is_all_that_is_printed():
    ran = tune("--budget", "2", "--json", "-")
    assert ran.code == 0 and ran.err == ""
    assert ran.json == json.loads(Path("out/result.json").read_text())


def test_a_named_technique_is_the_only_one_measured():
    result = result_of(tune("--techniques", "forward", "--budget", "4", space="forward.toml"))
    assert result["best"]["technique"] == "forward"
    assert {technique for technique, _ in configurations_of()} == {"forward"}


def test_the_mean_of_the_frames_is_an_objective():
    result = result_of(tune("--objective", "mean", "--budget", "3"))
    for m in read_measurements("out/measurements.jsonl"):
        assert all(m.stages_ms["frame"])  # no frame is left out: each counts
        if (m.technique, m.params) == (result["best"]["technique"], result["best"]["params"]):
            assert result["best"]["time_ms"] == pytest.approx(
                np.mean([np.median(frame) for frame in m.stages_ms["frame"]])
            )


@pytest.mark.parametrize("max_error", ["0.5", "1e-5"])
def test_a_larger_error_allows_what_changes_the_image(max_error):
    result = result_of(
        tune("--techniques", "forward", "--budget", "20", "--max-error", max_error, space="forward.toml")
    )
    allowed = [
        m for m in read_measurements("out/measurements.jsonl") if m.error is not None and m.error <= float(max_error)
    ]
    fastest = min(allowed, key=lambda m: max(np.median(frame) for frame in m.stages_ms["frame"] if frame))
    assert (result["best"]["technique"], result["best"]["params"]) == (fastest.technique, fastest.params)
    assert any(m.params["gbuffer"] != "float32" for m in allowed) == (max_error == "0.5")


def test_no_error_that_small_is_refused():
    is_refused(tune("--budget", "2", "--max-error", "1e-12"), "max-error", "the smallest error is")


def test_constraints_leave_out_configurations():
    Path("own.toml").write_text("constraints = ['tile_px < 20']\n[parameters]\ntile_px = [8, 16, 24]\n")
    result_of(tune("--techniques", "tiled_deferred", "--budget", "3", space="own.toml"))
    tiles = [dict(params)["tile_px"] for _, params in configurations_of()]
    assert set(tiles) <= {8, 16, 32}  # 32 is the default, measured to compare with


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--budget", "0"), ("budget", "'0'", "120s")),
        (("--budget", ""), ("budget",)),
        (("--budget", "-3s"), ("'-3s'",)),
        (("--budget", "nans"), ("'nans'",)),
        (("--objective", "x"), ("--objective x", "max or mean")),
        (("--max-error", "-1"), ("--max-error", "-1", "0 or more")),
        (("--max-error", "nan"), ("--max-error nan",)),
        (("--techniques", "foo"), ("`foo`", "forward")),
        (("--techniques", ","), ("technique", "forward")),
        (("--seed", "-1"), ("--seed", "0")),
    ],
    ids=lambda value: " ".join(value)[:30],
)
def test_an_option_that_is_wrong_costs_nothing(arguments, words):
    is_refused(tune(*arguments), *words)
    assert not Path("out").exists()


# Going on


def test_a_folder_with_measurements_is_not_written_over():
    result_of(tune("--budget", "2"))
    before = lines_of()
    is_refused(tune("--budget", "2"), "out", "--resume")
    assert lines_of() == before


def test_going_on_twice_measures_nothing_new():
    first = result_of(tune("--budget", "4"))
    before = lines_of()
    for _ in range(2):
        again = result_of(tune("--budget", "4", "--resume"))
        assert lines_of() == before
        assert again["best"]["params"] == first["best"]["params"] and again["measured"] == first["measured"]
    more = result_of(tune("--budget", "5", "--resume"))
    assert lines_of()[:-1] == before and more["measured"] == 5


def test_a_run_that_was_cut_anywhere_goes_on():
    """What a kill leaves is the file up to some byte: any of a line's start, middle, last byte, missing line end."""
    result_of(tune("--budget", "4"))
    whole = b"".join(lines_of())
    ends = np.cumsum([len(line) for line in lines_of()])
    for k, length in enumerate(
        [0, 10, ends[0] - 1, ends[0], ends[1] - 2, ends[1] + 1, (ends[1] + ends[2]) // 2, ends[3] - 1]
    ):
        out = f"cut{k}"
        Path(out).mkdir()
        Path(out, "measurements.jsonl").write_bytes(whole[:length])
        complete = [line.strip() for line, end in zip(lines_of(), ends, strict=True) if end - 1 <= length]
        result_of(tune("--budget", "4", "--resume", out=out), out)
        assert [line.strip() for line in lines_of(out)[: len(complete)]] == complete
        assert len(lines_of(out)) == len(set(configurations_of(out))) == 4


def test_a_run_that_was_killed_goes_on(tmp_path):
    arguments = ("tune", *SMALL, "--space", "space.toml", "--budget", "6", "--out", "out")
    run = started(*arguments, folder=tmp_path)
    deadline = time.monotonic() + 100
    while not (Path("out/measurements.jsonl").exists() and len(lines_of()) >= 2):
        assert run.poll() is None and time.monotonic() < deadline, run.communicate()
        time.sleep(0.005)
    os.kill(run.pid, signal.SIGKILL)
    run.communicate()
    kept = [line for line in lines_of() if line.endswith(b"\n")]
    assert 2 <= len(kept) < 6 and not Path("out/result.json").exists()
    ran = finished(started(*arguments, "--resume", folder=tmp_path))
    result = result_of(ran)
    is_complete(result)
    assert lines_of()[: len(kept)] == kept
    assert len(lines_of()) == len(set(configurations_of())) == 6


def test_another_scene_in_the_same_folder_is_a_run_of_its_own():
    result_of(tune("--budget", "2"))
    grove = ("grove", "--triangles", "1000", "--size", "64x36", "--lights", "20")
    result = result_of(tune("--budget", "2", "--resume", scene=grove))
    assert result["scene"]["name"] == "grove" and result["measured"] + result["failed"] == 2
    assert len(lines_of()) == 4


def test_a_damaged_record_is_refused():
    Path("out").mkdir()
    Path("out/measurements.jsonl").write_text('{"schema": 1}\n{"schema": 1}\n')
    is_refused(tune("--resume"), "measurements.jsonl", "line 1")


# Failures are results


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


# A full disk


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
