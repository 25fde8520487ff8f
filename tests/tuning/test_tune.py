"""The main job from the command line: scenes, techniques, objectives, errors; on scenes that take a second."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import SMALL, is_refused, small_setup, vtfs
from tests.tuning.tune_runs import configurations_of, is_complete, result_of, tune
from tuning.record import read_measurements
from vtfs.camera import save_cameras
from vtfs.gallery import build_scene
from vtfs.gbuffer_files import save_gbuffer
from vtfs.input_error import InputError
from vtfs.lights import save_lights
from vtfs.scene import save_scene

pytestmark = pytest.mark.usefixtures("quick_tune")
TECHNIQUES = {"forward", "tiled_deferred", "volume_tiled_bvh"}


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
