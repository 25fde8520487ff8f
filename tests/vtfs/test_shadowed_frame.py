"""Shadowed images: each light that casts, directional ones too, on solid samples and transparent layers."""

from dataclasses import fields, replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests import oracles
from tests.strategies import a_camera, layered_samples, nearby_lights, surface_samples
from tests.vtfs.test_frame import Compiles
from vtfs.configurations import configuration
from vtfs.directional_lights import NO_DIRECTIONAL, DirectionalLights
from vtfs.frame import cast_counted, cast_program, image_on_host, render, run_stages
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_plan import Plan
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.light_shadows import CastMask, shadow_bits
from vtfs.lights import Lights, point_lights
from vtfs.parameters import TECHNIQUES
from vtfs.reference import ViewShadows, forward_reference, largest_relative_difference
from vtfs.shadow_capacities import fitted_to_all
from vtfs.shadow_casters import Casters
from vtfs.shadow_inputs import FrameShadows, brightest_lights, receiving
from vtfs.shadow_maps import shadow_maps
from vtfs.shadow_programs import shadow_plan
from vtfs.shadow_scene import ShadowScene
from vtfs.technique_names import SHADOW_REFERENCES
from vtfs.view_samples import ViewSamples

SUNS = DirectionalLights(np.array([[0.3, 1.0, 0.4], [-2.0, 0.5, 0.0]]), np.array([[1.0, 0.9, 0.7], [0.2, 0.3, 0.6]]))
NOTHING = Casters(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
CAST = configuration("cluster_hierarchy", {"branching": 8})
"""Of the walks only one, and only from points: each compiles for seconds. `test_shadow_mask` has the others."""


def between(samples: ViewSamples, lights: Lights, seed: int, n: int = 200) -> Casters:
    """Triangles on the way from visible samples to lights that reach them."""
    rng = np.random.default_rng(seed)
    at = samples.world_positions_m()
    reached = np.linalg.norm(at[:, None] - lights.position_m, axis=-1) < lights.range_m
    sample, light = np.argwhere(reached)[rng.integers(0, reached.sum(), n)].T
    way = lights.position_m[light] - at[sample]
    middle = at[sample] + rng.uniform(0.2, 0.8, (n, 1)) * way
    size = 0.4 * np.linalg.norm(way, axis=1)[:, None, None]
    corners = middle[:, None] + size * rng.normal(size=(n, 3, 3))
    return Casters(corners.reshape(-1, 3), np.arange(3 * n).reshape(n, 3))


def a_frame(seed: int, suns: DirectionalLights = SUNS, n_lights: int = 3) -> FrameInputs:
    samples = layered_samples(a_camera(), seed)
    lights = nearby_lights(samples, 37, seed)
    return FrameInputs(samples, lights, shadow_scene=ShadowScene(between(samples, lights, seed), suns, n_lights))


def reference_of(inputs: FrameInputs, lights, technique: str = "brute_force") -> np.ndarray:
    shadows = inputs.shadows
    masks = [
        [shadows.reference(view, k, technique, "cast") for k in range(len(shadows.lights))] for view in shadows.views
    ]
    own = [ViewShadows(shadows.slot, np.array(of_view), shadows.scene.suns) for of_view in masks]
    return forward_reference(inputs.samples, lights, own)


def slow_image(inputs: FrameInputs, lights: Lights) -> np.ndarray:
    """By the oracle, which knows no shadows and no directional lights: these are points 1e7 m away, right to 1e-5, and
    each light is listed only where brute force leaves a sample lit. Layers pixel by pixel."""
    shadows, suns = inputs.shadows, inputs.shadows.scene.suns
    far_m, eye_m = 1e7, np.array(inputs.camera.eye_m)
    far = point_lights(eye_m + far_m * suns.toward, np.full(suns.n_lights, 1e6 * far_m), far_m**2 * suns.colour)
    everything = Lights(*(np.concatenate([getattr(each, f.name) for each in (lights, far)]) for f in fields(lights)))
    of_slot = [*range(lights.n_lights, everything.n_lights), *np.argsort(np.where(shadows.slot < 0, 99, shadows.slot))]
    images = []
    for view in shadows.views:
        listed = np.ones((*view.valid.shape, everything.n_lights), bool)
        for k in range(len(shadows.lights)):
            listed[..., of_slot[k]] = ~shadows.reference(view, k, "brute_force", "cast")
        images.append(oracles.image(view, everything, listed=listed))
    total, *colours = images
    for y, x in np.ndindex(total.shape[:2]):
        for layer, colour in reversed(list(zip(inputs.samples.layers.transparent, colours, strict=True))):
            opacity = float(layer.opacity[y, x])
            total[y, x] = opacity * colour[y, x] + (1 - opacity) * total[y, x]
    return total


def test_a_shadowed_image_is_the_sum_of_what_each_light_reaches():
    inputs = a_frame(3)
    lights = nearby_lights(inputs.samples, 37, 3)
    expected = slow_image(inputs, lights)
    image = render(configuration("brute_force"), inputs)
    assert largest_relative_difference(image, expected, inputs.seen()) < 1e-4  # as of any image
    reference = reference_of(inputs, lights)
    assert largest_relative_difference(reference, expected, inputs.seen()) < 2e-5  # the far points
    lit = FrameInputs(inputs.samples, lights, shadow_scene=ShadowScene(NOTHING, SUNS, 3))
    unshadowed = render(configuration("brute_force"), lit)
    assert largest_relative_difference(unshadowed, expected, inputs.seen()) > 0.1


def test_a_light_that_is_too_far_to_cast_is_refused_where_it_lights():
    samples, lights = layered_samples(a_camera(), 3), nearby_lights(layered_samples(a_camera(), 3), 5, 3)
    scene = ShadowScene(between(samples, lights, 3), NO_DIRECTIONAL, 1)
    far = np.array([[0.0, 1e30, 0.0]])
    with pytest.raises(InputError, match=r"`position_m` = \(0, 1e\+30, 0\): is 1e\+30 m from .*directional light"):
        FrameShadows(scene, samples, point_lights(far, np.array([1e31]), np.full((1, 3), 1e60)))
    # One that lights nothing casts on nothing, wherever it is.
    assert len(FrameShadows(scene, samples, point_lights(far, np.ones(1), np.ones((1, 3)))).lights) == 1


def test_a_technique_makes_the_image_that_the_references_make():
    inputs = a_frame(4, NO_DIRECTIONAL)
    image, expected = (render(c, inputs).astype(np.float64) for c in (CAST, configuration("brute_force")))
    maps = shadow_maps(CAST, inputs)
    assert maps is not None
    assert 0.05 < maps.share_stopped < 0.95
    # Pixels in which rounding decides one of three masks: a few of 561.
    off = np.abs(image - expected).max(axis=-1) > 1e-4 * expected.mean()
    assert off.sum() <= 0.01 * off.size
    stages, _ = run_stages(CAST, inputs)
    by_stages = image_on_host(stages["shade_transparent"], inputs).astype(np.float64)
    assert largest_relative_difference(image, by_stages, inputs.seen()) < 1e-6


def test_the_walk_that_is_timed_is_the_program_that_was_counted():
    inputs = a_frame(4, NO_DIRECTIONAL)
    counted = cast_counted(CAST, inputs)
    tasks = inputs.shadows.tasks(CAST)
    with Compiles() as compiled:
        masks = cast_program(CAST.technique, Plan(shadow=counted.opaque[0].plan))(tasks)
    assert compiled.n == 0
    # Without loops, as a GPU runs it, it is one program of its own.
    plan, _ = fitted_to_all(CAST.technique, shadow_plan(CAST), list(map(receiving, tasks)), unrolled=True)
    assert plan.level_groups
    at_once = cast_program(CAST.technique, Plan(shadow=plan))(tasks)
    for mask, fused, own in zip(masks, at_once, counted.opaque, strict=True):
        shadowed = [from_runs(np.asarray(each.shadowed), inputs.viewport) for each in (mask, fused)]
        assert (shadowed[0] == own.shadowed).all() and (shadowed[1] == own.shadowed).all()
        assert not mask.overflowed and not fused.overflowed
    assert any(own.shadowed.any() for own in counted.opaque)


def test_counts_are_of_all_lights_and_views():
    inputs = a_frame(4, NO_DIRECTIONAL)
    counts = count(CAST, inputs)[0].of(CAST)
    lists = configuration("clustered_deferred")
    alone = count(lists, inputs)[0].of(lists)
    assert counts["shadow_lights"] == 3 and counts["casters"] <= inputs.shadows.scene.casters.n_triangles
    assert counts["lighting_computations"] == alone["lighting_computations"]
    rays = configuration("shadow_rays")
    with_suns = count(rays, a_frame(4))[0].of(rays)
    assert with_suns["lighting_computations"] == alone["lighting_computations"] + 2 * alone["samples"]
    assert counts["test_and_set"] == counts["node_tests"] + counts["sample_tests"] > 0
    assert counts["tests_of_largest"] <= counts["test_and_set"]
    shadows = inputs.shadows
    lit = sum(int(shadows.lit_by(view, k).sum()) for view in shadows.views for k in range(3))
    assert abs(counts["shadow_samples"] - lit) <= 5  # float32 decides where a surface turns away
    assert counts["memory"] > alone["memory"]


def test_bits_of_a_layer_lie_at_its_own_runs():
    inputs = a_frame(5, NO_DIRECTIONAL, 2)
    layers, n_visible = inputs.layers, inputs.positions(False).n_visible_runs
    n_views = len(inputs.shadows.views)
    rng = np.random.default_rng(0)
    masks = rng.random((n_views, 2, n_visible, 32)) < 0.5
    found = shadow_bits(
        [CastMask(jnp.asarray(m), jnp.bool_(False)) for m in masks.reshape(-1, n_visible, 32)],
        inputs.shadows.slots,
        layers,
    )
    words = np.asarray(found.shadowed)
    assert (words[:n_visible] == masks[0, 0] + 2 * masks[0, 1]).all()
    run = np.asarray(layers.run)
    for layer in range(n_views - 1):
        there = np.flatnonzero(run[layer] >= 0)
        own = words[n_visible + run[layer, there]]
        assert len(there) and (own == masks[layer + 1, 0, there] + 2 * masks[layer + 1, 1, there]).all()


def test_the_lights_that_cast_are_those_that_light_the_view_most():
    samples = surface_samples(a_camera(), 1)
    lights = nearby_lights(samples, 37, 1, spots=True)
    white = []
    for i in range(lights.n_lights):
        listed = np.zeros((*samples.valid.shape, lights.n_lights), bool)
        black = oracles.image(samples, lights, listed=listed)
        listed[..., i] = True
        white.append(float((oracles.image(samples, lights, listed=listed) - black)[samples.valid].sum()))
    order = brightest_lights(samples, lights, 37)
    # Irradiance is not what a material reflects of it: the ranks agree, not the order.
    assert {int(i) for i in order[:8]} <= {int(i) for i in np.argsort(white)[::-1][:16]}
    assert set(order) == {i for i, light in enumerate(white) if light > 0}


@pytest.mark.parametrize("technique", ["cluster_hierarchy", "z_pass", "brute_force"])
def test_a_frame_that_no_light_lights_is_dark_not_an_error(technique):
    samples = surface_samples(a_camera(), 1)
    lights = nearby_lights(samples, 3, 1)
    casters = between(samples, lights, 0)
    config = configuration(technique)
    short = replace(lights, range_m=np.full(3, 1e-6))
    blind = replace(samples, valid=np.zeros_like(samples.valid))
    for seen, own in ((samples, short), (blind, lights)):
        inputs = FrameInputs(seen, own, shadow_scene=ShadowScene(casters, NO_DIRECTIONAL, 2))
        assert len(inputs.shadows.lights) == 1
        emitted = render(configuration("forward"), inputs)  # all there is: the samples' own light
        assert largest_relative_difference(render(config, inputs), emitted, inputs.seen()) < 1e-6
        counts = count(config, inputs)[0].of(config)
        assert counts["shadow_lights"] == 1 and counts.get("test_and_set", 0) == 0
        maps = shadow_maps(config, inputs)
        assert maps is not None and maps.share_stopped == 0


def test_where_all_is_transparent_the_lights_of_the_nearest_layer_cast():
    samples = layered_samples(a_camera(), 5)
    lights = nearby_lights(samples, 37, 5)
    nearest = samples.layers.transparent[0].samples
    only_layers = replace(samples, valid=np.zeros_like(samples.valid))
    expected = brightest_lights(nearest, lights, 4)
    assert len(expected) == 4 and list(brightest_lights(only_layers, lights, 4)) == list(expected)


def test_without_geometry_or_lights_shadows_are_refused():
    samples = surface_samples(a_camera(), 1)
    lights = nearby_lights(samples, 3, 1)
    with pytest.raises(InputError, match="need the triangles of a scene"):
        render(configuration("ptsv"), FrameInputs(samples, lights))
    casters = between(samples, lights, 0)
    with pytest.raises(InputError, match="--shadow-lights 31: with 2 directional lights must be from 0 to 30"):
        ShadowScene(casters, SUNS, 31)
    crowd = DirectionalLights(np.ones((40, 3)), np.ones((40, 3)))
    with pytest.raises(InputError, match=r"the scene has 40 directional lights, which all cast: .* at most 32"):
        ShadowScene(casters, crowd, 1)
    with pytest.raises(InputError, match="no light casts shadows; give --shadow-lights 1 or more"):
        FrameShadows(ShadowScene(casters, NO_DIRECTIONAL, 0), samples, lights)
    with pytest.raises(InputError, match="directional light 1 `toward`"):
        DirectionalLights(np.array([[1.0, 0, 0], [0, 0, 0]]), np.ones((2, 3)))


def test_every_shadow_technique_has_the_stages_of_its_frame():
    for name in ("z_pass", "z_fail", "ptsv", "cluster_hierarchy"):
        assert {"tile_px", "branching", "front_faces"} <= set(TECHNIQUES[name])
    assert set(SHADOW_REFERENCES) < set(TECHNIQUES)
