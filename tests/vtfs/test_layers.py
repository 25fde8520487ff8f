"""Transparent layers and overdraw of a view, against rays tested with every triangle in float64."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.vtfs.test_view_samples import BLEND, FRONT, HALF, SOLID, own_cache, square, stacked
from vtfs.camera import Camera, Viewport
from vtfs.layers import composite
from vtfs.scene import Material, Scene
from vtfs.view_samples import trace_view_samples

__all__ = ["own_cache"]  # a fixture that every test here uses


def depths(layers):
    return [-samples.position_m[2, 8, 2] for samples in layers]


def test_blended_surfaces_before_the_solid_one_are_layers_nearest_first():
    scene = stacked(square(4, BLEND), square(2, BLEND), square(5, SOLID), square(6, BLEND), square(3, HALF))
    layers = trace_view_samples(scene, FRONT).layers.transparent
    # The masked square hides the lower half from 3 m on.
    assert_allclose(depths(layer.samples for layer in layers), [2, 4])
    assert layers[0].samples.valid.all() and layers[1].samples.valid[:7].all() and not layers[1].samples.valid[9:].any()
    assert_array_equal(layers[0].opacity, np.full_like(layers[0].opacity, 0.5))
    assert (layers[1].opacity == np.where(layers[1].samples.valid, np.float32(0.5), 0)).all()


def test_blended_surfaces_are_seen_against_the_sky_and_clipped_at_near_and_far():
    scene = stacked(square(2, BLEND), square(0.05, BLEND), square(7, BLEND))
    samples = trace_view_samples(scene, replace(FRONT, far_m=6.0))
    assert not samples.valid.any()
    assert_allclose(depths(layer.samples for layer in samples.layers.transparent), [2])


def test_the_opacity_of_a_layer_is_read_from_its_image():
    image = np.array([[0.2, 0.6]], np.float32)
    pane = Material("pane", opacity=0.5, alpha_mode="blend", alpha_image=image)
    corners = np.array([(-4.0, -4, -2), (4, -4, -2), (4, 4, -2), (-4, 4, -2)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    scene = Scene("pane", corners, np.array([[0, 1, 2], [0, 2, 3]]), uv, np.zeros(2, np.int32), (pane,))
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 90.0, 0.1, 20.0, Viewport(8, 4))
    (layer,) = trace_view_samples(scene, camera).layers.transparent
    u = 0.5 + camera.pixel_slopes()[0] * 2 / 8
    # Texel centres lie at u = 1/4 and 3/4; between them the image is linear, beyond them it repeats.
    expected = 0.5 * np.interp(u, [-0.25, 0.25, 0.75, 1.25], [0.6, 0.2, 0.6, 0.2])
    assert_allclose(layer.opacity, np.broadcast_to(expected, (4, 8)), rtol=1e-6)  # stored in float32


def test_a_scene_without_blended_surfaces_has_no_layers():
    assert trace_view_samples(stacked(square(5, SOLID)), FRONT).layers.transparent == ()


def test_blended_surfaces_outside_the_view_make_no_layer():
    behind = replace(FRONT, target_m=(0.0, 0.0, 1.0))
    samples = trace_view_samples(stacked(square(2, BLEND)), behind)
    assert samples.layers.transparent == () and samples.layers.hidden == ()


def test_hidden_fragments_are_those_that_pass_when_they_are_submitted():
    """5 m passes, 6 m fails, 4 m passes, 3 m passes and is seen, 3.5 m fails."""
    scene = stacked(*(square(depth_m, SOLID) for depth_m in (5, 6, 4, 3, 3.5)))
    samples = trace_view_samples(scene, FRONT)
    assert_allclose(-samples.position_m[..., 2], 3)
    assert_allclose(depths(samples.layers.hidden), [5, 4])
    front_to_back = stacked(*(square(depth_m, SOLID) for depth_m in (3, 4, 5)))
    assert trace_view_samples(front_to_back, FRONT).layers.hidden == ()


@pytest.mark.parametrize("seed", [0, 1])
def test_layers_of_a_soup_are_those_of_float64_rays(seed):
    rng = np.random.default_rng(seed)
    n = 60
    centre = rng.uniform((-2, -2, -9), (2, 2, -1), (n, 1, 3))
    vertices = (centre + rng.normal(scale=1.0, size=(n, 3, 3))).reshape(-1, 3)
    materials = (SOLID, BLEND, Material("glass", opacity=0.25, alpha_mode="blend"))
    index = rng.integers(0, 3, n).astype(np.int32)
    scene = Scene("soup", vertices, np.arange(3 * n, dtype=np.int32).reshape(n, 3), None, index, materials)
    camera = Camera((0.0, 0.0, 0.5), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 70.0, 0.1, 20.0, Viewport(24, 16))
    samples = trace_view_samples(scene, camera)
    transparent, hidden = samples.layers.transparent, samples.layers.hidden
    for row, column in np.ndindex(16, 24):
        hits = ray_hits(scene, camera, row, column)
        if hits is None:  # within rounding of an edge: Embree may see it the other way
            continue
        solid = [(k, t) for k, t in hits if index[k] == 0]
        until = min((t for _, t in solid), default=math.inf)
        expected = [k for k, t in sorted(hits, key=lambda hit: hit[1]) if index[k] > 0 and t < until]
        found = [int(layer.samples.triangle[row, column]) for layer in transparent]
        assert [k for k in found if k >= 0] == expected
        passing: list[int] = []
        nearest = math.inf
        for k, t in sorted(solid):
            if t < nearest:
                passing, nearest = [*passing, k], t
        in_vain = [int(layer.triangle[row, column]) for layer in hidden]
        assert [k for k in in_vain if k >= 0] == passing[:-1]
        for layer in transparent:
            k = int(layer.samples.triangle[row, column])
            assert layer.opacity[row, column] == (np.float32(materials[index[k]].opacity) if k >= 0 else 0)


def ray_hits(scene, camera, row, column):
    """Triangle and depth of all hits of a pixel's ray; None where one is too close to an edge to be sure."""
    direction = camera.primary_rays()[1][row, column]
    hits = []
    for k, corners in enumerate(scene.vertices_m[scene.triangles]):
        e1, e2 = corners[1] - corners[0], corners[2] - corners[0]
        p = np.cross(direction, e2)
        determinant = e1 @ p
        to_eye = np.array(camera.eye_m) - corners[0]
        q = np.cross(to_eye, e1)
        u, v, t = (to_eye @ p) / determinant, (direction @ q) / determinant, (e2 @ q) / determinant
        margin = min(u, v, 1 - u - v)
        if abs(margin) < 1e-4 and t > 0:
            return None
        if margin > 0 and camera.near_m < t <= camera.far_m:
            hits.append((k, t))
    return hits


def test_layers_are_blended_farthest_first():
    solid = np.full((1, 1, 3), 8.0)
    near, far = np.full((1, 1, 3), 1.0), np.full((1, 1, 3), 4.0)
    image = composite(solid, ((near, np.array([[0.5]])), (far, np.array([[0.25]]))))
    assert_allclose(image, 0.5 * 1 + 0.5 * (0.25 * 4 + 0.75 * 8))
