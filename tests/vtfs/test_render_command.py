"""`vtfs render`: pictures of every technique, also where nothing is seen."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command_line import CAMERA, SMALL, is_refused, vtfs, write
from vtfs.technique_names import TUNED_TECHNIQUES

pytestmark = pytest.mark.usefixtures("own_folder")


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


def test_pictures_of_one_frame_are_not_drawn_where_the_next_is_none():
    is_refused(vtfs("render", *SMALL, "--frame", "0", "--frame", "60"), "frame 60", "0 to 59")
