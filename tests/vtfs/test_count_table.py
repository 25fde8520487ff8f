"""Counts of many configurations are those of each by itself, and those of a float64 count from the definitions."""

import csv
import io

import pytest

from tests.command_line import vtfs
from tests.slow_counts import slow_counts
from vtfs import frame
from vtfs.camera import Viewport
from vtfs.configurations import configuration
from vtfs.count_table import count_frames, counts_csv, print_counts
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.scene_setup import SceneOptions, set_up

CONFIGURATIONS = (
    configuration("tiled_deferred", {"tile_px": 8}),
    configuration("tiled_deferred", {"tile_px": 8, "batch": 64}),
    configuration("forward"),
    configuration("tiled_deferred", {"tile_px": 8, "gbuffer": "float16"}),
)


@pytest.fixture(scope="module")
def setup():
    return set_up(SceneOptions("street", viewport=Viewport(64, 36), n_triangles=1000, lights="20"))


@pytest.fixture(scope="module")
def rows(setup):
    progress = []
    rows = count_frames(setup, CONFIGURATIONS, (5, 0), lambda *step: progress.append(step))
    assert progress == [(done, 8) for done in range(1, 9)]
    return rows


def test_rows_are_those_of_counting_one_by_one(setup, rows):
    assert [(row.frame, row.configuration) for row in rows] == [(f, c) for f in (5, 0) for c in CONFIGURATIONS]
    for row in rows:
        expected, _ = count(row.configuration, FrameInputs(setup.samples(row.frame), setup.lights))
        expected = expected.at_batch(int(row.configuration["batch"]))
        if row.configuration["batch"]:  # of the capacities at batch 0, some of which are rounded up to whole chunks
            assert row.counts["memory"] == pytest.approx(expected["memory"], rel=0.02)
            expected["memory"] = row.counts["memory"]
        assert row.counts == expected


def test_a_batch_changes_the_steps_and_nothing_else(rows):
    at_once, in_chunks = rows[0].counts, rows[1].counts
    assert {name for name in at_once if at_once[name] != in_chunks[name]} <= {
        "shading_lanes",
        "shading_steps",
        "assign_steps",
    }
    assert at_once["shading_steps"] != in_chunks["shading_steps"]


def test_a_csv_holds_every_configuration_and_count(rows):
    read = list(csv.DictReader(io.StringIO(counts_csv(rows))))
    assert len(read) == len(rows)
    for line, row in zip(read, rows, strict=True):
        assert None not in line and line["technique"] == row.configuration.technique and int(line["frame"]) == row.frame
        assert {name: line[name] for name in row.configuration.params} == {
            k: str(v) for k, v in row.configuration.params.items()
        }
        assert {name: int(line[name]) for name in row.counts} == row.counts
        others = line.keys() - {"technique", "frame"} - row.configuration.params.keys() - row.counts.keys()
        assert all(line[name] == "" for name in others)  # what forward does not have


def test_a_csv_of_nothing_is_a_header():
    assert counts_csv([]) == "technique,frame\n"


def test_a_table_has_a_line_a_row(rows, capsys):
    print_counts(rows)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(rows)
    assert f"{rows[0].counts['lighting_computations']:,}" in lines[1]


NAMES = ("samples", "cells_total", "clusters_occupied", "light_cluster_pairs", "longest_list", "lighting_computations")


@pytest.mark.parametrize(
    ("technique", "tile_px", "depth_slices"),
    [
        ("tiled_deferred", 32, None),
        ("tiled_deferred", 7, None),
        ("volume_tiled_bvh", 16, 0),
        ("volume_tiled_bvh", 5, 24),
    ],
)
def test_the_command_counts_what_the_definitions_say(technique, tile_px, depth_slices):
    """To 0.1 %: float32 decides a light that ends at a cell's face otherwise, and cells are grown by
    1e-5 of their depth and some hundredths of a pixel."""
    scene = ("grove", "--triangles", "3000", "--size", "320x180", "--lights", "100")
    settings = ("--set", f"tile_px={tile_px}") + (
        ("--set", f"depth_slices={depth_slices}") if depth_slices is not None else ()
    )
    ran = vtfs("count", *scene, "--technique", technique, *settings, "--frame", "0", "--frame", "33", "--json", "-")
    setup = set_up(SceneOptions("grove", viewport=Viewport(320, 180), n_triangles=3000, lights="100"))
    for record in ran.json["frames"]:
        samples = setup.samples(record["frame"])
        expected = slow_counts(
            samples.camera, samples.position_m, samples.valid, setup.lights.position_m, setup.lights.range_m,
            tile_px, depth_slices,
        )  # fmt: skip
        assert expected["samples"] > 1000 and expected["lighting_computations"] > 1000
        assert {name: record[name] for name in NAMES} == pytest.approx(expected, rel=1e-3)


def test_configurations_that_share_a_grid_share_its_clusters_and_lights_their_tree(setup, monkeypatch):
    ran = []
    program = frame.stage_program
    monkeypatch.setattr(frame, "stage_program", lambda stage, plan: ran.append(stage.name) or program(stage, plan))
    by_tree = [
        configuration(technique, {"tile_px": tile_px, "branching": branching, "batch": 1024})
        for technique in ("volume_tiled_bvh", "clustered_forward")
        for branching in (8, 32)
        for tile_px in (8, 16)
    ]
    shared = count_frames(setup, by_tree, (5,), lambda *_: None)
    assert {name: ran.count(name) for name in ran} == {
        "clusters": 2, "reduce": 1, "morton": 1, "sort": 1, "build_tree": 2, "assign": 4
    }  # fmt: skip
    for row in shared[2:4]:
        expected, _ = count(row.configuration.replaced(batch=0), setup.inputs(5))
        assert row.counts == expected.at_batch(1024)
