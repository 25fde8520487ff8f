"""Samples in runs of 32, and channels of less precision."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests import oracles
from tests.strategies import SMALL, WIDE, a_camera, gbuffer_of, positions_of, random_samples
from vtfs.camera import Viewport
from vtfs.gbuffer import from_runs, to_runs

VIEWPORTS = [SMALL, WIDE, Viewport(1, 1), Viewport(8, 4), Viewport(9, 5)]


@pytest.mark.parametrize("viewport", VIEWPORTS, ids=str)
def test_each_pixel_is_in_its_run_and_comes_back(viewport):
    image = np.arange(1, viewport.width_px * viewport.height_px + 1).reshape(viewport.height_px, viewport.width_px)
    runs = to_runs(image)
    for run, pixels in enumerate(oracles.run_pixels(viewport)):
        for lane, (y, x) in enumerate(pixels):
            inside = y < viewport.height_px and x < viewport.width_px
            assert runs[run, lane] == (image[y, x] if inside else 0)
    assert (from_runs(runs, viewport) == image).all()


def test_padding_is_invalid():
    samples = random_samples(a_camera(), 0, valid_share=1.0)
    assert int(positions_of(samples).valid.sum()) == SMALL.width_px * SMALL.height_px


@pytest.mark.parametrize("precision", ["float32", "float16", "bfloat16"])
def test_channels_have_their_precision_and_positions_keep_float32(precision):
    samples = random_samples(a_camera(), 0)
    samples.shininess[0, 0], samples.emissive[0, 0, 0] = 1e6, 3e38
    gbuffer = gbuffer_of(samples, precision)
    dtype = jnp.dtype(precision)
    for values, image in (
        (gbuffer.shininess, samples.shininess),
        (gbuffer.emissive[0], samples.emissive[..., 0]),
        (gbuffer.normal[2], samples.normal[..., 2]),
    ):
        limit = float(jnp.finfo(dtype).max)  # beyond it they saturate
        expected = np.clip(image, -limit, limit).astype(dtype)
        assert values.dtype == dtype and (oracles.as_image(np.asarray(values), SMALL) == expected).all()
        assert np.isfinite(np.asarray(values, np.float32)).all()
    z_m = np.asarray(gbuffer.positions.z_m)
    assert z_m.dtype == np.float32 and (oracles.as_image(z_m, SMALL) == samples.position_m[..., 2]).all()
