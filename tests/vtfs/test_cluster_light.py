# NumPy arrays stand for those of the device.
# pyright: reportArgumentType=false, reportCallIssue=false
"""Lights evaluated once a cluster: never one that varies more than allowed, and what they add is theirs."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings

from tests import oracles
from tests.strategies import a_camera, layered_samples, nearby_lights, seeds, surface_samples
from vtfs.bounds import Aabb
from vtfs.cluster_light import lit_range
from vtfs.configurations import configuration
from vtfs.frame import render, run_stages
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.light_lists import view_lights
from vtfs.normal_cones import NormalCones
from vtfs.reference import largest_relative_difference
from vtfs.techniques import REGISTRY

N_LIGHTS, N_POINTS = 200, 64
range_jit = jax.jit(lit_range)


def flat_samples(seed, make=surface_samples):
    """Normals that are nearly one: as on walls and floors, the light varies with the place alone."""
    samples = make(a_camera(), seed)
    rng = np.random.default_rng(seed)
    normal = np.array([0.2, 0.5, 0.8]) + 0.02 * rng.normal(size=(*samples.valid.shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return replace(samples, normal=normal.astype(np.float32))


def lit(position_m, normal, lights, view_m, rotation, light_cutoff=0.0):
    """`window * cone * n.l / max(d**2, 1e-4)` in float64: points `[P, 3]` against lights, `[P, N]`."""
    to = view_m[None] - position_m[:, None]
    distance = np.linalg.norm(to, axis=-1)
    n_dot_l = np.maximum((to * normal[:, None]).sum(-1) / np.maximum(distance, 1e-300), 0)
    window = np.maximum(0, 1 - (distance / np.maximum(lights.range_m, 1e-300)) ** 4) ** 2
    cos = -(to / np.maximum(distance, 1e-300)[..., None] * (lights.direction @ rotation.T)).sum(-1)
    cone = np.clip((cos - lights.cos_outer) / (lights.cos_inner - lights.cos_outer), 0, 1)
    return np.where(window > light_cutoff, window, 0) * cone * n_dot_l / np.maximum(distance**2, 1e-4)


@pytest.mark.parametrize("spots", [False, True], ids=["points", "spots"])
@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_no_place_in_a_cluster_is_lit_more_or_less_than_the_range_says(spots, seed):
    rng = np.random.default_rng(seed)
    samples = surface_samples(a_camera(), seed)
    lights = nearby_lights(samples, N_LIGHTS, seed, spots)
    rotation = samples.camera.view_from_world[:3, :3]
    view_m = oracles.in_view_space(samples.camera, lights.position_m)
    # Some boxes hold the light.
    middle_m = view_m + rng.normal(size=(N_LIGHTS, 3)) * 10 ** rng.uniform(-2, 0.5, (N_LIGHTS, 1))
    half_m = 10 ** rng.uniform(-3, 0, (N_LIGHTS, 3))
    axis = rng.normal(size=(N_LIGHTS, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    cos = np.where(rng.random(N_LIGHTS) < 0.3, 1.0, rng.uniform(-1, 1, N_LIGHTS))
    box = Aabb(*(middle_m - half_m).T.astype(np.float32), *(middle_m + half_m).T.astype(np.float32))
    cones = NormalCones(*axis.T.astype(np.float32), cos.astype(np.float32))
    rows = view_lights(lights, samples.camera).row
    low, high = (np.asarray(v) for v in range_jit(box, cones, rows, np.float32(0.05)))
    for n in range(N_LIGHTS):
        place_m = middle_m[n] + half_m[n] * rng.choice([-1, 1, 0.3], (N_POINTS, 3))
        turned = axis[n] + rng.normal(size=(N_POINTS, 3)) * np.sqrt(max(1 - cos[n], 0))
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        normal = np.where((turned @ axis[n] >= cos[n])[:, None], turned, axis[n])
        one = replace_one(lights, n)
        found = lit(place_m, normal, one, view_m[n : n + 1], rotation, 0.05)[:, 0]
        unsure = np.abs(np.maximum(0, 1 - (np.linalg.norm(place_m - view_m[n], axis=1) / one.range_m) ** 4) ** 2 - 0.05)
        found = found[unsure > 1e-4]  # rounding decides whether the window is above the cut-off
        slack = 1e-4 * high[n]  # float32 of positions a few metres from the eye, some millimetres from the light
        assert (found <= high[n] + slack).all() and (found >= low[n] - slack).all()


def replace_one(lights, n):
    return replace(lights, **{name: getattr(lights, name)[n : n + 1] for name in vars(lights) if name != "key"})


def approximated(technique, samples, lights, share):
    """Which lights are listed and kept, bool `[h, w, N]` of each pixel's cluster, and what the device has."""
    config = configuration(technique, {"approximate": share, "tile_px": 8, "batch": 1024})
    env, _ = run_stages(config, FrameInputs(samples, lights), until="approximate")
    clusters = env["clusters"]
    cluster = np.asarray(clusters.block_cluster)[np.asarray(clusters.block_of_sample)]
    cluster = oracles.as_image(cluster[: env["positions"].n_visible_runs], samples.camera.viewport)
    tables = []
    for lists in (env["listed"], env["assign"]):
        count_, index = np.asarray(lists.count), np.asarray(lists.index)
        assert (np.asarray(lists.offset) == np.cumsum(count_) - count_).all()
        table = np.zeros((len(count_), lights.n_lights), int)
        np.add.at(table, (np.repeat(np.arange(len(count_)), count_), index[: count_.sum()]), 1)
        assert table.max(initial=0) <= 1
        tables.append(table > 0)
    return config, env, cluster, *tables


@pytest.mark.parametrize("technique", ["tiled_deferred", "volume_tiled_bvh"])
@pytest.mark.parametrize("share", [0.003, 0.1])
def test_lights_taken_off_vary_by_no_more_than_allowed(technique, share):
    samples = flat_samples(3)
    lights = nearby_lights(samples, N_LIGHTS, 3)
    _, env, cluster, listed, kept = approximated(technique, samples, lights, share)
    taken = listed & ~kept
    assert not (kept & ~listed).any() and taken.sum() > 0.02 * listed.sum() and kept.any()
    box, cones = env["clusters"].box, env["clusters"].cones
    corners = np.array([np.asarray(c, np.float64) for c in jax.tree.leaves(box)])
    view_m = oracles.in_view_space(samples.camera, lights.position_m)
    rotation = samples.camera.view_from_world[:3, :3]
    irradiance, highlight = (
        np.stack([np.asarray(c, np.float64) for c in part], -1)
        for part in (env["cluster_light"].irradiance, env["cluster_light"].highlight)
    )
    for c in range(int(env["clusters"].n_clusters)):
        here = samples.valid & (cluster == c)
        centre_m = (corners[:3, c] + corners[3:, c])[None] / 2
        axis = np.array([[float(np.asarray(a)[c]) for a in (cones.x, cones.y, cones.z)]])
        at_centre = lit(centre_m, axis, lights, view_m, rotation)[0]
        assert np.allclose(irradiance[c], (taken[c] * at_centre) @ lights.colour, rtol=1e-4, atol=1e-6)
        to_light, to_eye = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (view_m - centre_m, -centre_m))
        half = to_light + to_eye
        n_dot_h = np.maximum((half @ axis[0]) / np.linalg.norm(half, axis=1), 0)
        gloss = taken[c] * at_centre * n_dot_h ** float(samples.shininess[here].mean())
        assert np.allclose(highlight[c], gloss @ lights.colour, rtol=1e-3, atol=1e-6)  # powers of up to 64
        brightness = lights.colour.sum(axis=1)
        most = share * (listed[c] * at_centre) @ brightness
        at_samples = lit(samples.position_m[here].astype(np.float64), samples.normal[here], lights, view_m, rotation)
        off = np.abs(at_samples - at_centre) * brightness
        assert (off[:, taken[c]] <= most * (1 + 1e-3) + 1e-6).all()


def test_an_image_is_that_of_the_lights_kept_and_of_what_clusters_reflect():
    samples = flat_samples(4)
    lights = nearby_lights(samples, N_LIGHTS, 4, spots=True)
    config, env, cluster, listed, kept = approximated("tiled_deferred", samples, lights, 0.1)
    irradiance, highlight = (
        np.stack([np.asarray(c, np.float64) for c in part], -1)[cluster]
        for part in (env["cluster_light"].irradiance, env["cluster_light"].highlight)
    )
    expected = oracles.image(samples, lights, listed=kept[cluster])
    once = samples.base_colour * irradiance + samples.specular[..., None] * highlight
    expected += np.where(samples.valid[..., None], once, 0)
    inputs = FrameInputs(samples, lights)
    assert highlight.max() > 0 and largest_relative_difference(render(config, inputs), expected, samples.valid) < 1e-4
    exact = oracles.image(samples, lights)
    assert 1e-5 < largest_relative_difference(expected, exact, samples.valid) < 1.0
    counts, without = (count(c, inputs)[0].technique for c in (config, config.exact()))
    of_pixel = kept[cluster].sum(-1)[samples.valid].sum()
    assert counts["lighting_computations"] == of_pixel
    assert counts["lighting_computations_saved"] == listed[cluster].sum(-1)[samples.valid].sum() - of_pixel
    assert counts["approximated_pairs"] == (listed & ~kept).sum() > 0 == without["approximated_pairs"]
    assert counts["light_cluster_pairs"] == listed.sum() and without["lighting_computations_saved"] == 0


def test_transparent_layers_get_the_light_of_their_clusters():
    samples = flat_samples(5, layered_samples)
    inputs = FrameInputs(samples, nearby_lights(samples, 37, 5))
    exact = render(configuration("volume_tiled_bvh", {"batch": 1024}), inputs).astype(np.float64)
    image = render(configuration("volume_tiled_bvh", {"batch": 1024, "approximate": 0.02}), inputs)
    # Random normals of the layers: what is off is small, where leaving the light out would not be.
    assert 0 < largest_relative_difference(image, exact, inputs.seen()) < 0.2


@pytest.mark.parametrize("technique", ["tiled_deferred", "volume_tiled_bvh"])
def test_without_approximation_the_frame_has_no_such_stage(technique):
    own = REGISTRY[technique]
    for share, has_stage in ((0.0, False), (0.5, True)):
        plan = own.plan(configuration(technique, {"approximate": share}))
        assert ("approximate" in [stage.name for stage in own.stages_of(plan, True)]) == has_stage
