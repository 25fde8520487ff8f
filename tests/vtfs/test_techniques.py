"""All techniques make the image that one float64 loop over all lights makes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import (
    SMALL,
    WIDE,
    a_camera,
    layered_samples,
    nearby_lights,
    no_lights,
    seeds,
    surface_samples,
    through,
)
from vtfs.camera import Lens
from vtfs.configurations import configuration
from vtfs.frame import image_on_host, render, run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.parameters import TECHNIQUES
from vtfs.reference import forward_reference, largest_relative_difference
from vtfs.technique_names import SHADOW_REFERENCES
from vtfs.techniques import REGISTRY

few = settings(max_examples=5, deadline=None)
DISTINCT = tuple(
    {
        replace(technique, name="", reads_gbuffer="never"): name
        for name, technique in REGISTRY.items()
        if not technique.casts_shadows
    }.values()
)
"""One technique of each kind of frame: those that differ only in what is rasterised run the same programs. Shadowed
frames have tests of their own."""

BATCH = 1024  # a walk with small chunks takes little time on a small image


def a_config(technique, **params):
    narrow = {"branching": 8} if "branching" in TECHNIQUES[technique] else {}
    return configuration(technique, {"batch": BATCH, **narrow, **params})


def check(config, samples, lights, *, light_cutoff=0.0):
    inputs = FrameInputs(samples, lights)
    image, seen = render(config, inputs), inputs.seen()
    expected = oracles.layered_image(samples, lights, float(np.float32(light_cutoff)))
    # Rounding decides whether a light counts where its window is the cut-off.
    unsure = oracles.near_cutoff(samples, lights, light_cutoff, 1e-5)
    for layer in samples.layers.transparent:
        unsure |= oracles.near_cutoff(layer.samples, lights, light_cutoff, 1e-5)
    sure = seen & ~unsure
    assert sure.sum() > 0.4 * seen.sum()
    assert largest_relative_difference(image, expected, sure) < 1e-4
    assert image.dtype == np.float32 and (image[~seen] == 0).all()
    return image


@pytest.mark.parametrize(
    ("technique", "viewport", "n_lights", "spots"),
    [*((technique, SMALL, 37, False) for technique in DISTINCT), ("volume_tiled_bvh", WIDE, 200, True)],
    ids=[*DISTINCT, "spots"],
)
@given(seed=seeds, light_cutoff=st.sampled_from([0.0, 0.01, 0.3, 0.9]))
@few
def test_images_are_those_of_the_float64_loop(technique, viewport, n_lights, spots, seed, light_cutoff):
    samples = surface_samples(a_camera(viewport), seed)
    lights = nearby_lights(samples, n_lights, seed, spots)
    check(a_config(technique, light_cutoff=light_cutoff), samples, lights, light_cutoff=light_cutoff)


@pytest.mark.parametrize("technique", DISTINCT)
@given(seed=seeds)
@few
def test_transparent_layers_are_blended_as_pixel_by_pixel(technique, seed):
    samples = layered_samples(a_camera(), seed)
    lights = nearby_lights(samples, 37, seed)
    check(a_config(technique), samples, lights)


@given(
    tile_px=st.integers(2, 256),
    depth_slices=st.sampled_from([0, 1, 24, 1024]),
    bounds=st.sampled_from(["implicit", "explicit"]),
    seed=seeds,
)
@settings(max_examples=8, deadline=None)
def test_no_parameter_of_the_grid_changes_the_image(tile_px, depth_slices, bounds, seed):
    samples = surface_samples(a_camera(), seed)
    lights = nearby_lights(samples, 37, seed)
    check(a_config("tiled_deferred", tile_px=tile_px), samples, lights)
    check(a_config("volume_tiled_bvh", tile_px=tile_px, depth_slices=depth_slices, bounds=bounds), samples, lights)


@pytest.mark.parametrize(("technique", "precision"), [("forward", "float16"), ("tiled_deferred", "bfloat16")])
def test_narrow_channels_are_rounded_once_and_computed_with_in_float32(technique, precision):
    samples = surface_samples(a_camera(), 2)
    lights = nearby_lights(samples, 37, 2)
    image = render(a_config(technique, gbuffer=precision), FrameInputs(samples, lights))
    channels = ("normal", "base_colour", "specular", "shininess", "emissive")
    dtype = jnp.dtype(precision)
    rounded = replace(samples, **{name: getattr(samples, name).astype(dtype).astype(np.float32) for name in channels})
    assert largest_relative_difference(image, oracles.image(rounded, lights), samples.valid) < 1e-4
    assert largest_relative_difference(image, oracles.image(samples, lights), samples.valid) > 1e-4


@pytest.mark.parametrize(("technique", "batch"), [("forward", 32), ("tiled_deferred", 0), ("volume_tiled_bvh", 2**15)])
def test_a_batch_changes_the_image_by_no_more_than_the_order_of_adding(technique, batch):
    """A sample's lights are added one by one in the order of its list, whatever the chunk: the images agree to the
    float32 rounding of one sum (the compiler may fuse differently in each program), 1e-6, not just to 1e-4."""
    samples = surface_samples(a_camera(), 3)
    inputs = FrameInputs(samples, nearby_lights(samples, 37, 3))
    expected = render(a_config(technique), inputs)
    image = render(a_config(technique, batch=batch), inputs)
    assert largest_relative_difference(image, expected.astype(np.float64), samples.valid) < 1e-6


@pytest.mark.parametrize("technique", DISTINCT)
def test_stages_by_themselves_make_the_image_of_the_frame(technique):
    samples = layered_samples(a_camera(), 4)
    inputs = FrameInputs(samples, nearby_lights(samples, 37, 4))
    env, _ = run_stages(a_config(technique), inputs)
    by_stages = image_on_host(env["shade_transparent"], inputs).astype(np.float64)
    assert largest_relative_difference(render(a_config(technique), inputs), by_stages, samples.valid) < 1e-6


@pytest.mark.parametrize("technique", ["deferred", "volume_tiled_bvh"])
def test_a_parallel_view_is_shaded_with_its_eye_at_infinity(technique):
    samples = through(surface_samples(a_camera(), 7), Lens(orthographic_height_m=7.5))
    lights = nearby_lights(samples, 37, 7)
    image = check(a_config(technique), samples, lights)
    assert largest_relative_difference(image, forward_reference(samples, lights), samples.valid) < 1e-4


@pytest.mark.parametrize("technique", ["forward", "volume_tiled_bvh"])
def test_without_lights_or_samples_there_is_what_emits_or_nothing(technique):
    samples = surface_samples(a_camera(), 5)
    image = check(a_config(technique), samples, no_lights())
    assert (image == np.where(samples.valid[..., None], samples.emissive, 0)).all()
    nothing = replace(samples, valid=np.zeros_like(samples.valid))
    assert (render(a_config(technique), FrameInputs(nothing, nearby_lights(samples, 37, 5))) == 0).all()


@pytest.mark.parametrize("technique", DISTINCT)
def test_odd_lights_make_no_image_that_is_not_a_number(technique):
    samples = surface_samples(a_camera(), 6)
    lights = nearby_lights(samples, 37, 6)
    on_samples = oracles.in_world_space(samples.camera, samples.position_m[samples.valid][:37].astype(np.float64))
    lights.position_m[:20] = on_samples[:20]  # lights in a surface
    lights.range_m[10:25] = 0.0
    lights.range_m[25:28] = 1e-20
    lights.position_m[28] = samples.camera.eye_m
    lights.range_m[29] = 1e15
    image = render(a_config(technique), FrameInputs(samples, lights))
    assert np.isfinite(image).all()
    # Next to a light float32 positions are off by more than the distance: all other pixels agree.
    position_m = samples.position_m.astype(np.float64)
    gap = np.linalg.norm(position_m[:, :, None] - oracles.in_view_space(samples.camera, lights.position_m), axis=-1)
    far = samples.valid & (np.where(lights.range_m > 0, gap, np.inf).min(axis=-1) > 0.05)
    assert largest_relative_difference(image, forward_reference(samples, lights), far) < 1e-4


def test_the_registry_and_the_parameters_name_the_same_techniques():
    assert tuple(REGISTRY) == tuple(TECHNIQUES)
    for name, technique in REGISTRY.items():
        assert technique.name == name and technique.stages[-1].name == "shade_transparent"
        known = {"positions", "gbuffer", "layers", "grid", "normals", "lights", "light_cutoff"}
        known |= {"approximate", "cluster_light", "listed", "old_order", "frame", "resort_every"}
        if technique.casts_shadows:
            known |= {"shadow_slots", "shadow_masks" if name in SHADOW_REFERENCES else "shadow_tasks"}
        for stage in technique.stages:
            assert set(stage.needs) <= known
            known.add(stage.name)
            known |= {"shadow_masks"} if stage.name == "shadow_merge" else set()
