"""Scenes that other people made: read from beside the checkout, with `-m shared`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.command_line import ROOT, short_repeats, vtfs
from tests.slow_counts import slow_counts
from vtfs.camera import Viewport
from vtfs.scene_setup import SceneOptions, set_up

pytestmark = pytest.mark.shared

SCENES = ROOT.parent / "shared" / "scenes"
SIZE = ("--size", "320x180")
LIGHTS = ("--lights", "200")


def files(name: str) -> tuple[str, ...]:
    return str(SCENES / f"{name}.glb"), "--cameras", str(SCENES / f"{name}.cameras.json")


@pytest.mark.parametrize("name", ["willow_garage_office", "japanese_bridge_garden"])
def test_counts_and_pictures(name, tmp_path):
    counted = vtfs(
        "count", *files(name), *SIZE, *LIGHTS, "--technique", "volume_tiled_bvh", "--frame", "0", "--json", "-"
    )
    assert counted.code == 0 and counted.err == ""
    (counts,) = counted.json["frames"]
    assert counts["samples"] > 0.3 * 320 * 180 and counts["lighting_computations"] > counts["samples"]
    drawn = vtfs("render", *files(name), *SIZE, *LIGHTS, "--out", tmp_path, "--json", "-")
    assert drawn.code == 0 and drawn.err == ""
    for kind in ("image", "heat_map"):
        with Image.open(drawn.json["pictures"][0][kind]) as picture:
            assert picture.size == (320, 180)
            colours = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
            assert len(colours) > 10  # something is to be seen


@pytest.mark.parametrize(
    ("technique", "tile_px", "depth_slices"), [("tiled_deferred", 32, None), ("volume_tiled_bvh", 32, 0)]
)
def test_counts_agree_with_the_definitions(technique, tile_px, depth_slices):
    """To 0.1 %, as the same test on a built-in scene."""
    frames = (0, 7, 19)
    numbers = [text for frame in frames for text in ("--frame", str(frame))]
    ran = vtfs("count", *files("zdm2"), *SIZE, *LIGHTS, "--technique", technique, *numbers, "--json", "-")
    scene, _, cameras = files("zdm2")
    setup = set_up(SceneOptions(scene, cameras=Path(cameras), viewport=Viewport(320, 180), lights="200"))
    assert [record["frame"] for record in ran.json["frames"]] == list(frames)
    for record in ran.json["frames"]:
        samples = setup.samples(record["frame"])
        expected = slow_counts(
            samples.camera, samples.position_m, samples.valid, setup.lights.position_m, setup.lights.range_m,
            tile_px, depth_slices,
        )  # fmt: skip
        assert {name: record[name] for name in expected} == pytest.approx(expected, rel=1e-3)


def test_the_main_job(tmp_path):
    with short_repeats():
        ran = vtfs("tune", *files("zdm2"), *SIZE, "--lights", "2000", "--budget", "2", "--out", tmp_path)
    assert ran.code == 0 and ran.err == ""
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["scene"]["triangles"] == 58_770 and result["scene"]["lights"] == 2000
    assert result["measured"] == 2 and result["best"]["technique"] != "forward"
    assert (tmp_path / "report.html").stat().st_size > 100_000


def test_shadows_are_checked_and_timed(tmp_path):
    """On 58,770 triangles: a mask with one wrong sample beyond the bands would be a failure, not a time."""
    space = tmp_path / "one.toml"
    space.write_text("[parameters]\nbranching = [32]\n")
    with short_repeats():
        ran = vtfs(
            "tune", *files("zdm2"), "--size", "160x90", *LIGHTS, "--shadow-lights", "2",
            "--techniques", "cluster_hierarchy", "--space", space, "--budget", "1", "--out", tmp_path / "out",
        )  # fmt: skip
    assert ran.code == 0 and ran.err == ""
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["kind"] == "shadows" and result["measured"] == 1 and result["failed"] == 0
    assert result["best"]["error"] < 1e-4
    counts = result["counts"]["cluster_hierarchy"]
    assert counts["shadow_lights"] == 2 and counts["casters"] > 20_000 and counts["test_and_set"] > counts["casters"]
