"""Deferred shading: which pixels a light's volume covers, against float64 rays and spheres."""

import numpy as np
import pytest
from hypothesis import given, settings

from tests import oracles
from tests.strategies import (
    LIGHT_KINDS,
    SMALL,
    a_camera,
    adversarial_lights,
    layered_samples,
    nearby_lights,
    random_samples,
    seeds,
    surface_samples,
    through,
)
from vtfs.camera import Lens
from vtfs.configurations import configuration
from vtfs.frame import run_stages
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.gbuffer import from_runs
from vtfs.light_volumes import lights_of_samples

BATCH = 1024


def covered(samples, lights, grow):
    """Does the ray through each pixel centre meet each sphere, grown by a share: bool `[h, w, N]`."""
    x, y = samples.camera.pixel_slopes()
    ray = np.stack([*np.meshgrid(x, y), -np.ones(samples.valid.shape)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    meets = np.zeros((*samples.valid.shape, lights.n_lights), bool)
    for n, centre in enumerate(oracles.in_view_space(samples.camera, lights.position_m)):
        # Rounding of a centre is a share of its distance to the eye.
        radius = lights.range_m[n] * (1 + grow) + grow * np.linalg.norm(centre)
        along = np.maximum(ray @ centre, 0)
        gap = np.linalg.norm(ray * along[..., None] - centre, axis=-1)
        meets[..., n] = (lights.range_m[n] > 0) & (gap <= radius)
    return meets


def inside(samples, lights, grow):
    position_m = samples.position_m.astype(np.float64)
    gap = np.linalg.norm(position_m[:, :, None] - oracles.in_view_space(samples.camera, lights.position_m), axis=-1)
    reach = lights.range_m * (1 + grow) + grow * np.linalg.norm(
        oracles.in_view_space(samples.camera, lights.position_m), axis=-1
    )
    return samples.valid[..., None] & (lights.range_m > 0) & (gap <= reach)


@pytest.mark.parametrize(("technique", "oracle"), [("deferred", covered), ("deferred_stencil", inside)])
@given(seed=seeds)
@settings(max_examples=8, deadline=None)
def test_a_light_shades_the_pixels_of_its_volume(technique, oracle, seed):
    samples = surface_samples(a_camera(), seed)
    lights = (nearby_lights if seed % 2 else lambda s, n, k: adversarial_lights(s, n, LIGHT_KINDS, k))(
        samples, 37, seed
    )
    config, inputs = configuration(technique, {"batch": BATCH}), FrameInputs(samples, lights)
    env, _ = run_stages(config, inputs, until="assign")
    n_runs = env["positions"].n_visible_runs
    found = from_runs(lights_of_samples(env["assign"], n_runs), SMALL)
    # Exact but for what float32 rounds: 1e-5 of the light's distance and size.
    at_least, at_most = oracle(samples, lights, -1e-5).sum(-1), oracle(samples, lights, 1e-5).sum(-1)
    if technique == "deferred":  # a sample inside the sphere counts also where the ray just misses it
        at_most = (oracle(samples, lights, 1e-5) | inside(samples, lights, 1e-5)).sum(-1)
    assert (at_least <= found).all() and (found <= at_most).all()
    counts, lengths = count(config, inputs)
    assert (lengths.of_sample == found).all()
    assert counts.technique["lighting_computations"] == found.sum()


def test_transparent_samples_take_every_light():
    samples = layered_samples(a_camera(), 3)
    lights = nearby_lights(samples, 37, 3)
    counts, lengths = count(configuration("deferred_stencil", {"batch": BATCH}), FrameInputs(samples, lights))
    n_transparent = sum(layer.samples.n_valid for layer in samples.layers.transparent)
    assert counts.technique["transparent_samples"] == n_transparent
    assert lengths.of_sample.sum() - lengths.of_visible.sum() == 37 * n_transparent
    expected = inside(samples, lights, 0.0).sum() + 37 * n_transparent
    assert counts.technique["lighting_computations"] == pytest.approx(expected, rel=1e-3)  # float32 at the spheres


@pytest.mark.parametrize("technique", ["forward", "tiled_forward"])
def test_overdraw_is_shaded_and_counted(technique):
    samples = layered_samples(a_camera(), 5)
    lights = nearby_lights(samples, 37, 5)
    inputs = FrameInputs(samples, lights)
    params = {"prepass": "off"} if technique == "forward" else {"tile_px": 16}
    counts, lengths = count(configuration(technique, {"batch": BATCH, **params}), inputs)
    n_hidden = sum(layer.n_valid for layer in samples.layers.hidden)
    n_transparent = sum(layer.samples.n_valid for layer in samples.layers.transparent)
    assert counts.technique["hidden_fragments"] == n_hidden > 0
    assert counts.technique["samples"] == samples.n_valid + n_hidden + n_transparent
    if technique == "forward":
        assert counts.technique["lighting_computations"] == 37 * counts.technique["samples"]
    assert counts.technique["lighting_computations"] == lengths.of_sample.sum() > lengths.of_visible.sum()


def test_a_gbuffer_is_read_per_light_or_per_sample():
    """36 or 68 bytes a pixel (Olsson and Assarsson 2011): written once, read again."""
    samples = surface_samples(a_camera(), 6)
    inputs = FrameInputs(samples, nearby_lights(samples, 37, 6))
    counts = {
        name: count(configuration(name, {"batch": BATCH}), inputs)[0].technique
        for name in ("deferred_stencil", "tiled_deferred", "tiled_forward_prez")
    }
    n_samples, pairs = samples.n_valid, counts["deferred_stencil"]["lighting_computations"]
    assert counts["deferred_stencil"]["bytes_gbuffer_32"] == 68 * (n_samples + pairs)
    assert counts["tiled_deferred"]["bytes_gbuffer_16"] == 36 * 2 * n_samples
    assert counts["tiled_forward_prez"]["bytes_gbuffer_32"] == 0


@pytest.mark.parametrize("lens", [Lens(), Lens(orthographic_height_m=7.5)], ids=["perspective", "parallel"])
@pytest.mark.parametrize("technique", ["deferred", "deferred_stencil"])
def test_a_light_that_just_reaches_a_sample_shades_it(technique, lens):
    """Lights that end less than a millionth of their range behind a sample."""
    config = configuration(technique, {"batch": BATCH})
    for seed in range(8):
        samples = through(random_samples(a_camera(near_m=0.1, far_m=1.0), seed), lens)
        lights = adversarial_lights(samples, 37, ("touching",), seed)
        env, _ = run_stages(config, FrameInputs(samples, lights), until="assign")
        n_runs, pixels = env["positions"].n_visible_runs, env["assign"]
        light, run, mask = (np.asarray(c)[: int(pixels.total)] for c in (pixels.light, pixels.run, pixels.mask))
        covered = np.zeros((n_runs, 32, 37), bool)
        covered[run, :, light] = (mask[:, None] >> np.arange(32, dtype=np.uint32)) & 1 == 1
        image = np.stack([from_runs(covered[..., n], SMALL) for n in range(37)], axis=-1)
        assert image[oracles.windows(samples, lights) > 0].all()
