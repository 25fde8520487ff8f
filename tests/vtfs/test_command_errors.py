"""What is wrong with files and options, in one line."""

import json
from pathlib import Path

import pytest

from tests.command_line import CAMERA, SMALL, STREET, is_refused, vtfs, write
from vtfs.gallery import build_scene
from vtfs.scene import save_scene

pytestmark = pytest.mark.usefixtures("own_folder")


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


@pytest.mark.parametrize("folder", ["none", "empty", "file"])
def test_a_report_of_what_is_no_run(folder):
    write("file", "")
    Path("empty").mkdir()
    ran = vtfs("report", folder)
    is_refused(ran, f"vtfs: {folder}/result.json: missing" if folder == "empty" else f"vtfs: {folder}: no such folder")
    assert "damaged" not in ran.err
