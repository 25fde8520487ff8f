"""However lists are made, they are the same, and so are the counts: those of the technique as published."""

import numpy as np
import pytest

from tests.strategies import a_camera, adversarial_lights, surface_samples
from tests.vtfs.test_light_assignment import listed_lights
from tests.vtfs.test_light_culling import as_spots
from vtfs import light_stages
from vtfs.configurations import ConflictError, configuration
from vtfs.frame import stage_program
from vtfs.frame_counts import FrameCounts, count
from vtfs.frame_inputs import FrameInputs
from vtfs.techniques import REGISTRY

CASES = {
    "tiles": ("tiled_deferred", {}, False),
    "spots, exact, cones of normals": (
        "volume_tiled_bvh",
        {"branching": 8, "cull": "frustum", "bounds": "explicit", "normal_bins": 2, "normal_cones": "explicit"},
        True,
    ),
}
OF_THIS_PROGRAM = {"memory"}


def a_frame(spots):
    samples = surface_samples(a_camera(), 3)
    lights = adversarial_lights(samples, 37, ("anywhere", "behind"), 3)
    return FrameInputs(samples, as_spots(samples, lights, 3) if spots else lights)


@pytest.fixture
def few_is_none(monkeypatch):
    """`auto` refines lists from the first light on."""
    monkeypatch.setitem(light_stages._FEW_LIGHTS, "cpu", 0)


@pytest.mark.parametrize("case", CASES)
def test_lists_and_counts_are_those_of_the_published_assigner(case):
    technique, params, spots = CASES[case]
    inputs = a_frame(spots)
    config = configuration(technique, {"batch": 1024, "assigner": "published", **params})
    expected, _ = listed_lights(config, inputs)
    assert 0 < expected.sum() < expected.size
    other = config.replaced(assigner="coarse_to_fine")
    assert np.array_equal(listed_lights(other, inputs)[0], expected)
    (counts, lengths), (published, its_lengths) = count(other, inputs), count(config, inputs)
    assert np.array_equal(lengths.of_cluster, its_lengths.of_cluster)
    for name in published.technique.keys() - OF_THIS_PROGRAM:
        assert counts.technique[name] == published.technique[name], name
    assert published.technique["leaf_tests"] > 0
    # Steps are of what runs: one step a level holds all words.
    assert counts.walked == "groups" and counts.at_batch(1024)["assign_steps"] == len(counts.walk_rows)
    assert FrameCounts.from_arrays(counts.as_arrays()).at_batch(32) == counts.at_batch(32)


def test_auto_goes_by_the_number_of_lights_and_never_builds_a_tree(few_is_none):
    technique = REGISTRY["volume_tiled_bvh"]
    plan = technique.plan(configuration("volume_tiled_bvh", {"assigner": "auto"}))
    assert technique.walked(plan, 1) == "groups" and technique.walked(plan, 0) == "all_pairs"
    assert [s.name for s in technique.stages_of(plan, True)] == [
        "clusters", "assign", "shade_opaque", "shade_transparent"
    ]  # fmt: skip
    assert technique.walked(technique.plan(configuration("volume_tiled_bvh")), 1) == "tree"


def test_both_ways_of_auto_make_the_same_lists(monkeypatch):
    inputs = a_frame(spots=False)
    config = configuration("tiled_deferred", {"batch": 1024})
    found = []
    for few, walked in ((100, "all_pairs"), (0, "groups")):
        monkeypatch.setitem(light_stages._FEW_LIGHTS, "cpu", few)
        # Programs are kept by their configuration: this one is made with another constant.
        stage_program.cache_clear()
        assert count(config, inputs)[0].walked == walked
        found.append(listed_lights(config, inputs)[0])
    stage_program.cache_clear()
    assert np.array_equal(*found)


@pytest.mark.parametrize("loose", [{"cull": "planes"}, {"cull": "screen_rect"}, {"leaf_test": "box"}], ids=str)
def test_tests_that_accept_what_misses_the_box_are_made_as_published(loose):
    technique = REGISTRY["volume_tiled_bvh"]
    plan = technique.plan(configuration("volume_tiled_bvh", {"assigner": "auto", **loose}))
    assert technique.walked(plan, 10**6) == "tree"
    name, value = next(iter(loose.items()))
    with pytest.raises(ConflictError, match=rf"`assigner` = 'coarse_to_fine' with {name}={value}: .*cull=box"):
        configuration("volume_tiled_bvh", {"assigner": "coarse_to_fine", **loose})
