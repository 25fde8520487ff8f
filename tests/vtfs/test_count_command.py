"""`vtfs count`: the counts of the API, of all frames, of spaces; scenes of one's own, and the smallest ones."""

import csv
import json
from pathlib import Path

import pytest

from tests.command_line import SMALL, STREET, small_setup, vtfs, write
from vtfs.camera import load_cameras, save_cameras
from vtfs.configurations import configuration
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.gallery import build_scene
from vtfs.parameters import TECHNIQUES
from vtfs.scene import save_scene
from vtfs.technique_names import SHADOW_NAMES

pytestmark = pytest.mark.usefixtures("own_folder")


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
