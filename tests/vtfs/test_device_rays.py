"""The reference of every sample, on the device, against float64 brute force in NumPy, which asks another question."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.device_rays import BY_ITSELF, LIT, SHADOWED, answers
from tests.strategies import SMALL, a_camera, surface_samples
from tests.vtfs.shadow_cases import balls, light_of, soup
from vtfs.shadow_casters import Casters, ShadowLight
from vtfs.shadow_mask import default_bias_m
from vtfs.shadow_references import brute_force, facing_light, kept_casters, view_points_m


@pytest.mark.parametrize("kind", ["at the eye", "near", "inside", "far", "directional"])
@pytest.mark.parametrize("eye_m", [(1.0, 2.0, 3.0), (1e6, -3e5, 1e6)])
@pytest.mark.parametrize("made", [soup, balls])
def test_rays_on_the_device_say_what_planes_in_numpy_say(kind, eye_m, made):
    rng = np.random.default_rng(3)
    camera = a_camera(SMALL, eye_m=eye_m)
    samples, casters, light = surface_samples(camera, 3), made(camera, rng), light_of(camera, kind, rng)
    bias_m, eye = default_bias_m(casters), np.array(camera.eye_m)
    points = view_points_m(samples, samples.valid)
    nobody = np.full(len(points), -1)
    culled = ~facing_light(casters, light)
    for kept, casts in ((casters, None), (kept_casters(casters, light, "culled"), culled)):
        expected = brute_force(points, kept, light, bias_m, eye)
        found = answers(points, nobody, casters, light, bias_m, eye, casts)
        assert (found == np.where(expected, SHADOWED, LIT)).all()
    assert 0.02 < (found == SHADOWED).mean() < 0.98 or kind != "inside"


def test_the_triangle_that_a_sample_lies_on_does_not_shadow_it():
    """Two triangles, one before the other; samples behind both, told to lie on one of them, on neither, or lit."""
    corner = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    casters = Casters(np.concatenate([corner, corner + np.array([0, 0, 1])]), np.arange(6).reshape(2, 3))
    light = ShadowLight((0.0, 0.0, 5.0))
    points = np.array([[0.0, 0, -1], [0, 0, -1], [0, 0, 0.5], [0, 0, 0.5], [9, 0, -1]])
    own = np.array([-1, 0, 1, 0, -1])
    found = answers(points, own, casters, light, 1e-5, np.zeros(3))
    assert found.tolist() == [SHADOWED, SHADOWED, BY_ITSELF, SHADOWED, LIT]
    none = Casters(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert answers(points, own, none, light, 1e-5, np.zeros(3)).tolist() == [LIT] * 5


def test_samples_of_several_blocks_are_all_answered(monkeypatch):
    monkeypatch.setattr("benchmarks.device_rays.SAMPLES_AT_ONCE", 1_024)
    rng = np.random.default_rng(1)
    casters = Casters(rng.normal(size=(60, 3)), np.arange(60).reshape(20, 3))
    points, light = rng.normal(size=(2_500, 3)) * 3, ShadowLight((0.1, 0.2, 4.0))
    found = answers(points, np.full(2_500, -1), casters, light, 1e-5, np.zeros(3))
    assert ((found == SHADOWED) == brute_force(points, casters, light, 1e-5)).all()
