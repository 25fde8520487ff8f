"""Lights that move while their tree keeps its order: lists stay right, and only the walk gets longer."""

from dataclasses import replace

import numpy as np
import pytest

from tests.strategies import a_camera, nearby_lights, surface_samples
from tests.vtfs.test_light_assignment import listed_lights
from vtfs.configurations import configuration
from vtfs.frame import run_stages
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.light_lists import view_lights
from vtfs.techniques import REGISTRY

SAMPLES = surface_samples(a_camera(), 11)
TREE = {"branching": 8, "batch": 1024, "assigner": "published"}
START = nearby_lights(SAMPLES, 200, 11)
VELOCITY_M = np.random.default_rng(11).normal(size=(200, 3)) * 0.8


def at(frame):
    return replace(START, position_m=START.position_m + frame * VELOCITY_M)


def inputs_of(frame):
    return FrameInputs(SAMPLES, at(frame), frame=frame, earlier_lights=lambda i: view_lights(at(i), SAMPLES.camera))


def config(resort_every):
    return configuration("volume_tiled_bvh", {**TREE, "resort_every": resort_every})


def tree_tests(frame, resort_every):
    return count(config(resort_every), inputs_of(frame))[0].technique["tree_tests"]


@pytest.mark.parametrize("frame", [4, 7])
def test_lists_are_the_same_whatever_the_order(frame):
    listed, cluster = listed_lights(config(1), inputs_of(frame))
    kept, same_cluster = listed_lights(config(4), inputs_of(frame))
    assert (kept == listed).all() and (cluster == same_cluster).all() and listed.any()


def test_the_order_is_that_of_the_frame_that_was_sorted_last():
    for frame, last in ((3, 0), (4, 4), (7, 4)):
        order = run_stages(config(4), inputs_of(frame), until="sort")[0]["sort"]
        expected = run_stages(config(1), inputs_of(last), until="sort")[0]["sort"]
        assert (np.asarray(order) == np.asarray(expected)).all()


def test_an_old_order_costs_tests_and_a_new_one_none():
    assert tree_tests(4, 4) == tree_tests(4, 1)
    assert tree_tests(7, 8) > tree_tests(7, 4) > tree_tests(7, 1)  # seven frames old, three, and none


def test_one_stage_sorts_or_not_in_place_of_three():
    technique = REGISTRY["clustered_forward"]
    names = [
        s.name
        for s in technique.stages_of(
            technique.plan(configuration("clustered_forward", {"assigner": "published"})), True
        )
    ]
    kept = [
        s.name
        for s in technique.stages_of(technique.plan(configuration("clustered_forward", {"resort_every": 2})), True)
    ]
    assert [name for name in names if name not in ("reduce", "morton")] == kept and len(names) == len(kept) + 2
