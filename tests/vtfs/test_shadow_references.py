"""Why a mask may differ from brute force, and why not."""

from __future__ import annotations

import numpy as np

from tests.strategies import SMALL, a_camera, surface_samples
from tests.vtfs.shadow_cases import gallery_case, light_of, soup
from vtfs.shadow_casters import Casters, ShadowLight
from vtfs.shadow_mask import default_bias_m, facing_samples
from vtfs.shadow_references import brute_force, classify, facing_light, is_excused, view_points_m


def test_a_mask_that_is_wrong_everywhere_is_excused_nowhere():
    """Every sample of a scene lies on the plane of a caster, which must not excuse it."""
    samples, casters, light = gallery_case(4_000, 128)
    points = view_points_m(samples, facing_samples(samples, light))[::40]
    eye, bias_m = np.array(samples.camera.eye_m), default_bias_m(casters)
    found = classify(points, np.ones(len(points), bool), casters, light, bias_m, eye)
    assert found.near_plane == 0
    assert found.errors > 0.98 * len(points)


def test_a_light_far_away_excuses_no_more_than_one_that_is_near():
    """From 1e6 extents away a scene is 1e-6 rad wide: were bands angles alone, every answer would be excused."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    casters = Casters(corners, np.array([[0, 1, 2]]))
    light = ShadowLight((0.0, 0.0, 1e6 * casters.extent_m))
    points, own = np.array([[0.0, -0.2, -1.0], [0.0, -0.999999, -1.0]]), np.full(2, -1)
    found = classify(points, np.ones(2, bool), casters, light, bias_m=1e-4)
    assert (found.near_edge, found.errors) == (1, 1)
    by_edge, by_plane = is_excused(points, np.zeros(2, bool), casters, light, 1e-4, own)  # both lie in shadow
    assert by_edge.tolist() == [False, True] and not by_plane.any()


def test_mismatches_are_told_apart():
    """A triangle one metre before the light: one point behind its middle, one on its edge, one on its plane."""
    casters = Casters(np.array([[-1.0, -1, -1], [1, -1, -1], [0, 1, -1]]), np.array([[0, 1, 2]]))
    light = ShadowLight((0.0, 0.0, 0.0))
    points = np.array([[0.0, -0.2, -5.0], [2e-6, -2, -2], [0.0, -0.2, -1.0001], [30.0, 0, -1]])
    found = classify(points, np.ones(4, bool), casters, light, bias_m=1e-4)
    assert (found.near_edge, found.near_plane, found.errors) == (1, 1, 2)
    assert found.error_points.tolist() == [0, 3] and found.total == 4
    # On the triangle itself: its own plane excuses nothing.
    assert classify(np.array([[0.0, -0.2, -1.0]]), np.ones(1, bool), casters, light, bias_m=1e-4).errors == 1
    assert classify(points, np.zeros(4, bool), casters, light, 1e-4).total == 0
    assert facing_light(casters, light).tolist() == [True]


def test_the_reference_knows_no_length():
    """A directional light shadows a scene of any size."""
    camera = a_camera(SMALL)
    samples, casters = surface_samples(camera, 2), soup(camera, np.random.default_rng(2), largest=1.0)
    light, eye = light_of(camera, "directional", np.random.default_rng(3)), np.array(camera.eye_m)
    points = view_points_m(samples, samples.valid)
    found = brute_force(points, casters, light, 1e-4, eye)
    assert 20 < found.sum() < len(found)
    large = Casters((casters.vertices_m - eye) * 2.0**50, casters.triangles)
    assert (brute_force(points * 2.0**50, large, light, 1e-4 * 2.0**50) == found).all()
