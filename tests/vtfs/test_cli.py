"""The command line as a new user meets it: help, counts, pictures, and one line for whatever is wrong."""

import csv
import importlib.metadata
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command_line import ROOT, SMALL, STREET, Ran, finished, full_disk, is_refused, started, vtfs
from vtfs.camera import Viewport, load_cameras, save_cameras
from vtfs.configurations import configuration
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.gallery import GALLERY, build_scene
from vtfs.parameters import PARAMETERS, TECHNIQUES
from vtfs.scene import save_scene
from vtfs.scene_setup import SceneOptions, set_up
from vtfs.technique_names import SHADOW_NAMES, TECHNIQUE_GROUPS, TUNED_TECHNIQUES

COMMANDS = ("tune", "count", "render", "stability", "report", "scenes", "techniques", "doctor")
CAMERA = {
    "width": 64,
    "height": 36,
    "fov_y_deg": 60,
    "near": 0.1,
    "far": 100,
    "frames": [{"eye": [0, 1, 0], "target": [1, 1, 0], "up": [0, 1, 0]}],
}


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def small_setup(n_lights="20"):
    return set_up(SceneOptions("street", viewport=Viewport(64, 36), n_triangles=1000, lights=n_lights))


# Help and what there is


def test_help_needs_nothing_heavy():
    """Importing jax alone takes 0.8 s, and help must answer in one."""
    heavy = ("jax", "numpy", "scipy", "trimesh", "plotly", "jinja2", "equinox", "PIL")
    program = f"""
import sys
from vtfs.cli import main
sys.argv = ["vtfs", "--help"]
try:
    main()
except SystemExit as left:
    assert left.code == 0, left.code
print("loaded:", *[name for name in {heavy} if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.splitlines()[-1] == "loaded:", run.stdout[-300:] + run.stderr
    assert all(command in run.stdout for command in COMMANDS) and run.stderr == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command):
    ran = vtfs(command, "--help")
    assert ran.code == 0 and f"vtfs {command}" in ran.out and ran.err == ""


def test_without_a_command_there_is_help():
    assert vtfs() == vtfs("--help") == vtfs("-h")
    assert vtfs().code == 0


def test_the_version_is_the_packages():
    assert vtfs("--version").out == f"vtfs {importlib.metadata.version('vtfs')}\n"


def test_scenes_and_techniques_list_everything_there_is():
    scenes, techniques = vtfs("scenes"), vtfs("techniques")
    assert scenes.code == techniques.code == 0 and scenes.err == techniques.err == ""
    assert all(name in scenes.out for name in GALLERY)
    assert all(name in techniques.out for name in (*TECHNIQUES, *TECHNIQUE_GROUPS, *PARAMETERS))


def test_doctor_names_the_device_the_versions_and_the_cache():
    ran = vtfs("doctor")
    assert ran.code == 0 and ran.err == ""
    for word in ("device", "jax", "numpy", "embree    found", os.environ["VTFS_CACHE_DIR"]):
        assert word in ran.out


# count


def test_counts_as_json_are_those_of_the_api():
    ran = vtfs(
        "count",
        *SMALL,
        "--technique",
        "volume_tiled_bvh",
        "--set",
        "tile_px=16",
        "--frame",
        "0",
        "--frame",
        "7",
        "--json",
        "-",
    )
    assert ran.code == 0 and ran.err == ""
    assert set(ran.json) == {"technique", "params", "scene", "frames"}
    config, setup = configuration("volume_tiled_bvh", {"tile_px": 16}), small_setup()
    assert ran.json["technique"] == "volume_tiled_bvh" and ran.json["params"] == config.params
    assert ran.json["scene"] | {"name": "street", "lights": 20, "triangles": setup.n_triangles} == ran.json["scene"]
    assert [record["frame"] for record in ran.json["frames"]] == [0, 7]
    for record in ran.json["frames"]:
        counts, _ = count(config, FrameInputs(setup.samples(record["frame"]), setup.lights))
        assert record == {"frame": record["frame"], **counts.at_batch(0)}


def test_all_frames_are_counted_unless_some_are_named():
    ran = vtfs("count", *SMALL, "--technique", "forward", "--json", "counts.json")
    assert ran.code == 0 and len(ran.out.splitlines()) == 61  # a heading, and one line a frame
    written = json.loads(Path("counts.json").read_text())
    assert [record["frame"] for record in written["frames"]] == list(range(60))


def test_a_frame_named_twice_is_counted_once():
    frames = vtfs("count", *SMALL, "--frame", "3", "--frame", "3", "--json", "-").json["frames"]
    assert [record["frame"] for record in frames] == [3]


def test_a_space_of_counts_is_a_csv_that_holds_single_counts():
    write("space.toml", "constraints = ['tile_px != 24']\n[parameters]\ntile_px = [8, 24, 32]\nbatch = [0, 64]\n")
    ran = vtfs("count", *SMALL, "--space", "space.toml", "--frame", "0", "--frame", "30", "--out", "a b/counts.csv")
    assert ran.code == 0 and ran.err == ""
    with Path("a b/counts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["frame"]), int(row["tile_px"]), int(row["batch"])) for row in rows] == [
        (frame, tile, batch) for frame in (0, 30) for tile in (8, 32) for batch in (0, 64)
    ]
    for row in rows[1::3]:
        single = vtfs(
            "count",
            *SMALL,
            "--frame",
            row["frame"],
            "--set",
            f"tile_px={row['tile_px']}",
            "--set",
            f"batch={row['batch']}",
            "--json",
            "-",
        ).json
        assert {name: int(row[name]) for name in single["frames"][0]} == single["frames"][0]


def test_a_space_without_a_file_prints_a_record_a_configuration():
    write("space.toml", "[parameters]\ntile_px = [8, 32]\n")
    ran = vtfs("count", *SMALL, "--space", "space.toml", "--frame", "0", "--json", "-")
    assert [record["params"]["tile_px"] for record in ran.json] == [8, 32]


def test_a_space_is_counted_for_groups_and_single_techniques_each_once_in_their_order():
    write("space.toml", "[parameters]\nlight_cutoff = [0.5]\n")
    named = "volume_tiled_bvh, all,forward,volume_tiled_bvh"
    ran = vtfs("count", *SMALL, "--technique", named, "--space", "space.toml", "--frame", "0", "--json", "-")
    others = [name for name in TECHNIQUES if name not in SHADOW_NAMES and name != "volume_tiled_bvh"]
    assert [record["technique"] for record in ran.json] == ["volume_tiled_bvh", *others]


# render


@pytest.mark.parametrize("technique", TUNED_TECHNIQUES)
def test_render_writes_an_image_and_a_heat_map(technique):
    ran = vtfs("render", *SMALL, "--technique", technique, "--out", "new/pictures ü", "--frame", "5", "--json", "-")
    assert ran.code == 0 and ran.err == ""
    (written,) = ran.json["pictures"]
    assert written["frame"] == 5 and 0 < written["mean"] <= written["largest"] <= 20
    for kind in ("image", "heat_map"):
        with Image.open(written[kind]) as picture:
            assert picture.size == (64, 36)
            assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > (
                50 if kind == "image" else 0
            )


@pytest.mark.parametrize("technique", [*TUNED_TECHNIQUES, "shadow_rays"])
def test_a_camera_that_sees_nothing(technique):
    away = CAMERA | {"frames": [{"eye": [1e3, 1, 0], "target": [2e3, 1, 0], "up": [0, 1, 0]}]}
    write("away.json", json.dumps(away))
    arguments = ("street", "--triangles", "1000", "--lights", "20", "--cameras", "away.json", "--technique", technique)
    ran = vtfs("render", *arguments)
    assert ran.code == 0 and ran.err == "" and "at most 0" in ran.out and "nan" not in ran.out
    counts = vtfs("count", *arguments, "--json", "-").json["frames"]
    assert len(counts) == 1 and counts[0]["samples"] == counts[0]["lighting_computations"] == 0


def test_a_heat_map_of_no_tests_replaces_that_of_an_earlier_run():
    away = CAMERA | {"frames": [{"eye": [1e3, 1, 0], "target": [2e3, 1, 0], "up": [0, 1, 0]}]}
    write("away.json", json.dumps(away))
    arguments = ("render", "street", "--triangles", "1000", "--lights", "20", "--cameras", "away.json", "--json", "-")
    out = Path("out")
    out.mkdir()
    for technique, has_tests in (("z_fail", True), ("shadow_rays", False)):
        file = out / f"shadow_tests_{technique}_0000.png"
        file.write_bytes(b"of an earlier run")
        (written,) = vtfs(*arguments, "--technique", technique, "--out", out).json["pictures"]
        assert ("shadow_tests" in written) == has_tests
        if has_tests:
            with Image.open(file) as picture:
                assert not np.asarray(picture).any()
    ran = vtfs("render", *SMALL, "--technique", "z_fail", "--out", out)
    assert "(volume polygons that each pixel's tile or cluster is tested against: " in ran.out
    is_refused(vtfs("render", *SMALL, "--technique", "shadows"), "`shadows`", "is a group", "cluster_hierarchy")


def test_one_pixel_and_one_light():
    ran = vtfs(
        "render",
        "street",
        "--triangles",
        "1000",
        "--size",
        "1x1",
        "--lights",
        "1",
        "--technique",
        "forward",
        "--json",
        "-",
    )
    assert ran.code == 0 and ran.err == ""
    with Image.open(ran.json["pictures"][0]["image"]) as picture:
        assert picture.size == (1, 1)


def test_no_light_at_all():
    counts = vtfs("count", *STREET, "--lights", "0", "--frame", "0", "--json", "-").json["frames"][0]
    assert counts["samples"] > 0 and counts["lights"] == counts["lighting_computations"] == 0


def test_a_tile_larger_than_the_image_is_one_tile():
    ran = vtfs("count", *SMALL, "--set", "tile_px=256", "--frame", "0", "--json", "-")
    counts = ran.json["frames"][0]
    assert counts["cells_total"] == counts["clusters_occupied"] == 1
    assert counts["lighting_computations"] == counts["samples"] * counts["light_cluster_pairs"]


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_a_scene_of_ones_own_with_a_name_of_ones_own(suffix, tmp_path):
    scene = build_scene("street", 1000)
    assert scene.cameras is not None
    path = tmp_path / "meine Szenen" / f"Straße é {suffix}"
    path.parent.mkdir()
    save_scene(scene, path)
    save_cameras("cameras.json", scene.cameras)
    assert load_cameras("cameras.json").key == scene.cameras.key
    ran = vtfs(
        "count", path, "--cameras", "cameras.json", "--lights", "20", "--size", "64x36", "--frame", "0", "--json", "-"
    )
    assert ran.code == 0 and ran.json["scene"]["triangles"] == scene.n_triangles
    # The same surfaces at the same pixels, but for coordinates in float32 and lights scattered in their box.
    expected = small_setup().samples(0).n_valid
    assert ran.json["frames"][0]["samples"] == pytest.approx(expected, rel=0.01)


# A pipe


def test_in_a_pipe_only_the_result_is_printed():
    ran = finished(started("count", *SMALL, "--frame", "0", "--json", "-", folder=ROOT))
    assert ran.code == 0 and ran.err == ""
    assert ran.json["technique"] == "tiled_deferred"


def test_a_pipe_that_nobody_reads_ends_quietly():
    run = started("count", *SMALL, "--json", "-", folder=ROOT)
    assert run.stdout is not None
    run.stdout.close()
    assert run.stderr is not None
    err = run.stderr.read()
    run.stderr.close()
    assert run.wait(60) in (0, 1) and "Traceback" not in err


def test_an_interrupt_says_so_in_one_line(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("vtfs.scene_setup.set_up", interrupted)
    assert vtfs("count", *SMALL) == Ran(130, "", "vtfs: interrupted.\n")
    ran = vtfs("tune", *SMALL)
    assert ran.code == 130 and "--resume" in ran.err and ran.err.count("\n") == 1


def test_a_defect_of_ours_keeps_its_traceback(monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("ours")

    monkeypatch.setattr("vtfs.scene_setup.set_up", broken)
    with pytest.raises(ZeroDivisionError, match="ours"):
        vtfs("count", *SMALL)


# What is wrong, in one line


def write(name, content):
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())


def cut_glb() -> bytes:
    whole = Path("whole.glb")
    save_scene(build_scene("street", 1000), whole)
    return whole.read_bytes()[:-100]


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.glb", None, ("none.glb", "no such file")),
        ("nosuch", None, ("nosuch", "atrium, street, grove, conservatory")),
        ("a.blend", "", ("a.blend", "`.blend`", ".glb")),
        ("cut.glb", cut_glb, ("cut.glb", "truncated")),
        ("nan.obj", OBJ.replace("v 0 1 0", "v 0 nan 0"), ("nan.obj", "NaN")),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", ("points.obj", "triangle")),
        ("empty.npz", b"", ("empty.npz", "--cameras")),
    ],
)
def test_a_scene_that_cannot_be_read(name, content, words):
    if content is not None:
        write(name, content() if callable(content) else content)
    for command in ("count", "render", "tune"):
        is_refused(vtfs(command, name, "--lights", "1", "--size", "64x36"), *words)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames": [{"eye": [0, 1, 0], "target": [0, 1, 0], "up": [0, 1, 0]}]}, ("frame 0", "target", "eye")),
        ({"frames": [{"eye": [0, 1, 0], "target": [0, 2, 0], "up": [0, 1, 0]}]}, ("frame 0", "up")),
        ({"frames": [{"eye": [0, 1], "target": [0, 2, 0], "up": [0, 1, 0]}]}, ("eye",)),
        ({"frames": []}, ("frames", "empty")),
        ({"near": 5, "far": 5}, ("far", "near = 5")),
        ({"near": 0}, ("near",)),
        ({"fov_y_deg": 0}, ("fov_y_deg", "180")),
        ({"fov_y_deg": 180}, ("fov_y_deg", "180")),
        ({"width": 0}, ("width", "at least 1")),
        ({"height": "36"}, ("height", "'36'", "number")),
    ],
)
def test_a_degenerate_camera(changes, words):
    write("cameras.json", json.dumps(CAMERA | changes))
    is_refused(vtfs("count", "street", "--triangles", "1000", "--cameras", "cameras.json"), "cameras.json", *words)


@pytest.mark.parametrize("content", ["", "{", "[]", b"\xff\xfe", None], ids=repr)
def test_a_camera_file_that_is_none(content):
    if content is not None:
        write("cameras.json", content)
    is_refused(vtfs("count", "street", "--cameras", "cameras.json"), "cameras.json")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("x,y,z,range,r,g\n1,2,3,4,5,6\n", ("`b`", "missing", "x,y,z,range,r,g,b")),
        ("x,y,z,range,r,g,b\n1,2,3,4,5,6,7\n1,2,3,far,5,6,7\n", ("line 3", "`range`", "'far'", "number")),
        ("x,y,z,range,r,g,b\n1,2,3,-4,5,6,7\n", ("line 2", "`range`", "-4", "0 or more")),
        ("x,y,z,range,r,g,b\n1,2,3,4,5,6\n", ("line 2",)),
        ("x,y,z,range,r,g,b\n1,2,3,inf,5,6,7\n", ("line 2", "`range`")),
        ("", ("line 1", "missing")),
        (bytes(range(256)), ("UTF-8",)),
        (None, ("no such file",)),
    ],
)
def test_a_light_file_that_is_wrong(content, words):
    if content is not None:
        write("lights.csv", content)
    is_refused(vtfs("count", *STREET, "--lights", "lights.csv"), "lights.csv", *words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--lights", "-5"), ("-5", "0")),
        (("--lights", "9" * 20), ("9" * 20, "10,000,000")),
        (("--lights", "1e3"), ("1e3", "number of lights")),
        (("--technique", "foo"), ("`foo`", "tiled_deferred")),
        (("--set", "foo=1"), ("`foo`", "tile_px")),
        (("--set", "tile_px=0"), ("`tile_px`", "'0'", "2 to 256")),
        (("--set", "tile_px=257"), ("'257'",)),
        (("--set", "tile_px=8.5"), ("'8.5'", "whole")),
        (("--set", "tile_px=nan"), ("'nan'",)),
        (("--technique", "volume_tiled_bvh", "--set", "branching=3"), ("`branching`", "'3'", "2, 4, 8")),
        (("--set", "branching=2"), ("`branching`", "`tiled_deferred`")),
        (("--set", "tile_px"), ("tile_px", "NAME=VALUE")),
        (("--set", "=8"), ("=8", "NAME=VALUE")),
        (("--set", "light_cutoff=nan"), ("light_cutoff", "0 to 0.99")),
        (("--set", "batch=33"), ("batch",)),
        (("--size", "12"), ("12", "1280x720")),
        (("--size", "axb"), ("axb", "1280x720")),
        (("--size", "0x5"), ("width", "at least 1")),
        (("--size", "5x99999999"), ("height", "at most")),
        (("--frame", "9999"), ("9999", "0 to 59")),
        (("--frame", "-1"), ("-1", "0 to 59")),
        (("--seed", "-1"), ("--seed", "equal to 0")),
        (("--density", "x"), ("--density x", "constant")),
        (("--lights-per-sample", "0"), ("--lights-per-sample", "equal to 1")),
        (("--triangles", "5"), ("5", "1000")),
        (("--space", "none.toml"), ("none.toml",)),
        (("--space", "space.toml", "--set", "tile_px=8"), ("--set tile_px=8", "without --space")),
        (("--technique", "shadows"), ("`shadows`", "is a group", "z_pass, z_fail, ptsv, cluster_hierarchy")),
        (("--technique", "all", "--frame", "0"), ("`all`", "is a group", "forward, deferred")),
        (("--technique", "shadows,magic", "--space", "space.toml"), ("`magic`", "unknown")),
        (("--technique", ",", "--space", "space.toml"), ("technique ``", "unknown")),
        (("--technique", "ptsv", "--set", "level=2"), ("`level` = 2", "passes=1", "give passes=2")),
        (("--out", "x.csv"), ("--out", "--space")),
        (("--json", "file/x.json"), ("--json file/x.json", "cannot be written")),
        (("--json", "."), ("--json .", "is a folder")),
        (("--space", "space.toml", "--out", "."), ("--out .", "is a folder")),
        (("--frame", "0", "--frame", "60"), ("frame 60", "0 to 59")),
    ],
    ids=lambda value: " ".join(value)[:40],
)
def test_an_option_that_is_wrong(arguments, words):
    write("file", "")
    ran = vtfs("count", *SMALL, *arguments)
    is_refused(ran, *words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[parameters\n", ("TOML",)),
        ("[parameters]\nfoo = [1]\n", ("foo", "tile_px")),
        ("[parameters]\ntile_px = [0]\n", ("tile_px", "0", "2 to 256")),
        ("[parameters]\ntile_px = 8\n", ("tile_px",)),
        ("constraints = ['tile_px >']\n[parameters]\ntile_px = [8]\n", ("constraints[0]",)),
        ("constraints = ['open(\"x\")']\n[parameters]\ntile_px = [8]\n", ("constraints[0]",)),
        ("constraints = ['tile_px > 100']\n[parameters]\ntile_px = [8]\n", ("constraints", "no combination")),
    ],
)
def test_a_space_that_is_wrong(content, words):
    write("space.toml", content)
    is_refused(vtfs("count", *SMALL, "--space", "space.toml"), "space.toml", *words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--nope",), ("--nope", "--help")),
        (("count", "--nope"), ("--nope", "vtfs count --help")),
        (("nosuch",), ("nosuch",)),
        (("tuna",), ("tuna", "Did you mean 'tune'? See vtfs --help.")),
        (("count", "--lights"), ("--lights", "argument")),
        (("count", "--frame", "abc"), ("--frame", "integer")),
        (("count", "--seed", "1.5"), ("--seed", "integer")),
        (("tune", "--max-error", "x"), ("--max-error", "number")),
        (("report",), ("DIR",)),
        (("scenes", "extra"), ("extra",)),
        (("count", "street", "grove"), ("grove",)),
    ],
    ids=lambda value: " ".join(value)[:30],
)
def test_usage_errors_are_one_line_too(arguments, words):
    is_refused(vtfs(*arguments), *words)


@pytest.mark.parametrize("folder", ["file", "file/below"])
@pytest.mark.parametrize("command", ["tune", "render"])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_done(command, folder, monkeypatch):
    write("file", "")
    monkeypatch.setattr("vtfs.scene_setup.set_up", None)
    is_refused(vtfs(command, *SMALL, "--out", folder), f"--out {folder}", "no folder")


@pytest.mark.parametrize("folder", ["none", "empty", "file"])
def test_a_report_of_what_is_no_run(folder):
    write("file", "")
    Path("empty").mkdir()
    ran = vtfs("report", folder)
    is_refused(ran, f"vtfs: {folder}/result.json: missing" if folder == "empty" else f"vtfs: {folder}: no such folder")
    assert "damaged" not in ran.err


@pytest.mark.parametrize("arguments", [("count", "--json", "."), ("predict", "model.json", "rows.csv", "--out", ".")])
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_done(arguments, monkeypatch):
    monkeypatch.setattr("vtfs.scene_setup.set_up", None)
    is_refused(vtfs(*arguments), f"{arguments[-2]} .", "is a folder")


def test_pictures_of_one_frame_are_not_drawn_where_the_next_is_none():
    is_refused(vtfs("render", *SMALL, "--frame", "0", "--frame", "60"), "frame 60", "0 to 59")


def test_a_bad_scene_leaves_nothing_behind():
    is_refused(vtfs("count", "none.glb", "--json", "x.json"))
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [("render", *SMALL, "--out", "out"), ("count", *SMALL, "--frame", "0", "--json", "out/counts.json")],
    ids=["render", "count"],
)
def test_a_full_disk_leaves_nothing_half_written(arguments):
    with full_disk("out", 2 if arguments[0] == "render" else 1):
        ran = vtfs(*arguments)
    assert ran.code == 2 and ran.err.count("\n") == 1 and "No space left on device" in ran.err
    assert not Path("out").exists() or list(Path("out").iterdir()) == []
