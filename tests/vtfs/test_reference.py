"""The float64 reference and the error measures."""

import numpy as np
import pytest
from hypothesis import given, settings

from tests import oracles
from tests.strategies import (
    LIGHT_KINDS,
    WIDE,
    a_camera,
    adversarial_lights,
    nearby_lights,
    no_lights,
    random_samples,
    seeds,
    surface_samples,
)
from vtfs.camera import Viewport
from vtfs.reference import forward_reference, image_error, largest_relative_difference

few = settings(max_examples=8, deadline=None)


@pytest.mark.parametrize("spots", [False, True])
@given(seed=seeds)
@few
def test_the_reference_is_the_sum_over_all_lights(spots, seed):
    samples = surface_samples(a_camera(WIDE), seed)
    lights = nearby_lights(samples, 37, seed, spots)
    expected = oracles.image(samples, lights)
    slack = 1e-12 * np.maximum(expected, expected.mean())
    assert (np.abs(forward_reference(samples, lights) - expected) <= slack).all()


@given(seed=seeds)
@few
def test_the_reference_holds_for_odd_lights(seed):
    samples = random_samples(a_camera(), seed)
    lights = adversarial_lights(samples, 37, LIGHT_KINDS, seed)
    # Where a light all but ends, 1 - (d/range)^4 cancels: compared with the whole, not with itself.
    expected = oracles.image(samples, lights)
    assert np.abs(forward_reference(samples, lights) - expected).max() <= 1e-12 * expected.max()


def test_a_light_in_a_sample_is_not_a_number_nowhere():
    samples = surface_samples(a_camera(), 0)
    position_m = oracles.in_world_space(samples.camera, samples.position_m[samples.valid].astype(np.float64)[:5])
    lights = nearby_lights(samples, 5, 0)
    lights.position_m[:] = position_m
    assert np.isfinite(forward_reference(samples, lights)).all()


def test_without_lights_only_what_emits_shines():
    samples = surface_samples(a_camera(Viewport(33, 17)), 0)
    expected = np.where(samples.valid[..., None], samples.emissive, 0)
    assert (forward_reference(samples, no_lights()) == expected).all() and expected.any()


VALID = np.array([[True, True, False]])


def test_image_error_by_hand():
    reference = np.array([[[3.0, 3, 3], [4, 4, 4], [99, 99, 99]]])
    image = reference + np.array([[[0.0, 0, 0], [1, 1, 1], [55, 55, 55]]])
    rmse, percentile = image_error(image, reference, VALID)
    assert rmse == pytest.approx(np.sqrt(0.5) / np.sqrt(12.5))
    assert percentile == pytest.approx(1 / np.sqrt(12.5), rel=1e-2)
    assert image_error(reference, reference, VALID) == (0, 0)


def test_errors_of_black_and_of_nothing():
    black = np.zeros((1, 3, 3))
    assert image_error(black, black, VALID) == (0, 0) == image_error(black + 1, black, ~VALID & VALID)
    assert image_error(black + 1, black, VALID)[0] == 1
    assert largest_relative_difference(black, black, VALID) == 0
    assert largest_relative_difference(black + 1, black, np.zeros_like(VALID)) == 0


def test_the_largest_difference_is_relative_to_the_value_or_to_the_mean():
    reference = np.array([[[0.0, 0, 0], [2, 2, 2], [7, 7, 7]]])  # the mean of the valid ones is 1
    image = reference + np.array([[[0.25, 0, 0], [0.25, 0, 0], [9, 9, 9]]])
    assert largest_relative_difference(image, reference, VALID) == pytest.approx(0.25)
    image[0, 0] = 0
    assert largest_relative_difference(image, reference, VALID) == pytest.approx(0.125)
