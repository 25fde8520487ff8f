"""What a configuration's masks are compared with, and what is wrong, excused, or not looked at."""

import numpy as np
import pytest

from tests.strategies import nearby_lights
from tests.vtfs.test_shadowed_frame import a_frame, slow_image
from tuning.shadow_check import ShadowChecker
from vtfs.configurations import configuration
from vtfs.reference import largest_relative_difference

PTSV = configuration("ptsv")


@pytest.fixture(scope="module")
def inputs():
    return a_frame(3)


@pytest.fixture(scope="module")
def masks(inputs):
    shadows = inputs.shadows
    return [
        shadows.reference(view, k, "brute_force", "cast") for view in shadows.views for k in range(len(shadows.lights))
    ]


@pytest.fixture
def checker(inputs):
    lights = nearby_lights(inputs.samples, 37, 3)
    return ShadowChecker(inputs.shadows, inputs.samples, lights, ("test_shadow_check", "3"))


def test_right_masks_are_right_and_their_image_is_the_oracles(inputs, masks, checker):
    found = checker.check(PTSV, masks)
    assert found.wrong == ""
    expected = slow_image(inputs, nearby_lights(inputs.samples, 37, 3))
    assert largest_relative_difference(found.image, expected, inputs.seen()) < 2e-5  # the oracle's far points


@pytest.mark.parametrize("wrongly_lit", [True, False])
def test_one_wrong_sample_of_one_layer_is_found(inputs, masks, checker, wrongly_lit):
    k = len(inputs.shadows.lights) + 2  # of the first layer
    view = inputs.shadows.views[1]
    tested = inputs.shadows.lit_by(view, 2) & (masks[k] == wrongly_lit)
    wrong = [mask.copy() for mask in masks]
    wrong[k][tuple(np.argwhere(tested)[len(np.argwhere(tested)) // 2])] ^= True
    assert checker.check(PTSV, wrong).wrong.startswith("shadows: 1 of ")


def test_what_the_light_does_not_light_is_not_looked_at(inputs, masks, checker):
    shadows = inputs.shadows
    n_slots = len(shadows.lights)
    others = [m | ~shadows.lit_by(shadows.views[i // n_slots], i % n_slots) for i, m in enumerate(masks)]
    assert checker.check(PTSV, others).wrong == ""


def test_where_embree_is_wrong_brute_force_decides(inputs, masks, checker):
    """Embree's masks replaced by others that lack a third of the shadows: the image still is that of brute force."""
    reference = checker.masks("cast")
    rng = np.random.default_rng(0)
    checker._masks["cast"] = reference & (rng.random(reference.shape) < 0.67)
    found = checker.check(PTSV, masks)
    assert found.wrong == ""
    expected = slow_image(inputs, nearby_lights(inputs.samples, 37, 3))
    assert largest_relative_difference(found.image, expected, inputs.seen()) < 2e-5


def test_culled_front_faces_are_checked_with_the_same_casters(inputs, masks, checker):
    shadows = inputs.shadows
    culled = [
        shadows.reference(view, k, "brute_force", "culled")
        for view in shadows.views
        for k in range(len(shadows.lights))
    ]
    config = PTSV.replaced(front_faces="culled")
    assert checker.check(config, culled).wrong == "" and checker.check(PTSV, culled).wrong != ""
    assert checker.check(config, masks).wrong != ""
    # Its error is that against all casters.
    assert (checker.check(config, culled).image == checker.image()).all()
