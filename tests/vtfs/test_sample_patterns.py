"""Several samples a pixel: where they lie, what they see, and what they are together."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.vtfs.test_view_samples import own_cache
from vtfs.camera import CENTRED, Lens, Viewport
from vtfs.gallery import build_scene
from vtfs.input_error import InputError
from vtfs.sample_patterns import (
    PATTERNS,
    extrapolated_sub_samples,
    pattern,
    resolved,
    shifted_camera,
    traced_sub_samples,
)
from vtfs.tracer import Tracer
from vtfs.view_samples import trace_view_samples

__all__ = ["own_cache"]  # a fixture that every test here uses


@pytest.mark.parametrize("n", PATTERNS)
def test_a_pattern_samples_each_row_and_column_of_its_pixel_once(n):
    offsets = np.array(pattern(n))
    assert offsets.shape == (n, 2) and (np.abs(offsets) <= 8).all()
    assert np.abs(offsets.mean(axis=0)).max() <= 0.5  # sixteenths: no pattern moves the image
    for axis in range(2):
        assert len(np.unique(offsets[:, axis])) == n  # as n rooks: near-vertical and near-horizontal edges get n steps


def test_there_are_no_other_patterns():
    with pytest.raises(InputError, match="samples per pixel = 5: must be one of 1, 4, 8, 16"):
        pattern(5)


def small_view():
    scene = build_scene("conservatory", 2_000)
    camera = replace(scene.cameras.camera(12), viewport=Viewport(48, 32))  # type: ignore[union-attr]
    return scene, camera


def test_sub_samples_are_the_pixels_of_a_finer_image():
    """Those at odd eighths of a pixel are pixel centres of an image of eight times the size."""
    scene, camera = small_view()
    tracer = Tracer(scene)
    fine = trace_view_samples(scene, replace(camera, viewport=Viewport(48 * 8, 32 * 8)), tracer)
    for offset in ((1, -3), (5, 1), (-7, -1)):
        coarse = trace_view_samples(scene, shifted_camera(camera, offset), tracer)
        column, row = ((8 + step - 1) // 2 for step in offset)
        assert (
            coarse.triangle == fine.triangle[row::8, column::8]
        ).mean() > 0.995  # rays along an edge see either side
        same = coarse.valid & (coarse.triangle == fine.triangle[row::8, column::8])
        assert_allclose(coarse.position_m[same], fine.position_m[row::8, column::8][same], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("lens", [CENTRED, Lens(orthographic_height_m=6.0)], ids=["perspective", "parallel"])
def test_extrapolated_sub_samples_are_exact_where_the_pixel_sees_one_triangle(lens):
    scene, camera = small_view()
    camera = replace(camera, lens=lens)
    centre = trace_view_samples(scene, camera)
    views = traced_sub_samples(scene, camera, 4), extrapolated_sub_samples(centre, 4)
    for traced, extrapolated in zip(*views, strict=True):
        assert traced.camera == extrapolated.camera
        same = traced.valid & centre.valid & (traced.triangle == centre.triangle)
        assert same.sum() > 100 and (traced.triangle != centre.triangle).any()
        # Triangles seen edge-on lose digits: float32 of a position over the cosine of the angle.
        way = centre.position_m[same] * (0, 0, 1) if camera.is_orthographic else centre.position_m[same]
        cosine = np.abs((centre.normal[same] * way).sum(axis=-1)) / np.linalg.norm(way, axis=-1)
        error_m = np.linalg.norm(traced.position_m - extrapolated.position_m, axis=-1)[same]
        depth_m = -traced.position_m[..., 2][same]
        assert (error_m <= 1e-6 * (depth_m + 1) / cosine).all()
        # Each lies on the ray of its own sub-sample.
        x, y = traced.camera.pixel_slopes()
        row, column = np.nonzero(centre.valid)
        position = extrapolated.position_m[row, column]
        width = camera.width_at(-position[:, 2:])
        assert_allclose(position[:, :2] / width, np.stack([x[column], y[row]], axis=-1), 1e-6, 1e-6)
    assert (extrapolated.position_m[~centre.valid] == 0).all()


def test_pixels_are_the_mean_of_their_valid_sub_samples():
    scene, camera = small_view()
    views = traced_sub_samples(scene, camera, 4)
    rng = np.random.default_rng(0)
    for shape in ((32, 48), (32, 48, 3)):
        values = [rng.random(shape) for _ in views]
        found = resolved(values, views)
        for row, column in ((0, 0), (16, 24), (31, 47)):
            kept = [value[row, column] for value, view in zip(values, views, strict=True) if view.valid[row, column]]
            assert_allclose(found[row, column], np.mean(kept, axis=0) if kept else 0.0)
    n_valid = np.sum([view.valid for view in views], axis=0)
    assert ((n_valid > 0) & (n_valid < 4)).any()  # pixels half against the sky
    assert (resolved([np.ones((32, 48))] * 4, views)[n_valid > 0] == 1).all()
