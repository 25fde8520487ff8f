"""Every shadow technique against brute force; what is counted, held in memory, and run again where it does not fit."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.strategies import SMALL, a_camera, seeds, surface_samples, through
from tests.vtfs.shadow_cases import (
    CLUSTERS,
    N_TRIANGLES,
    N_VERTICES,
    TILES,
    assert_equal_outside_the_bands,
    balls,
    cast,
    gallery_case,
    light_of,
    soup,
)
from vtfs.camera import Lens
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.shadow_capacities import fitted
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight
from vtfs.shadow_mask import ShadowPlan, casters_on_device, default_bias_m, facing_samples, shadow_frame, uncounted
from vtfs.shadow_programs import run_program, shadow_program
from vtfs.shadow_references import ShadowRays, brute_force, classify, kept_casters, view_points_m
from vtfs.shadow_techniques import cast_shadows, shadow_grid

some = settings(max_examples=5, deadline=None)
LIGHTS = ("at the eye", "near", "inside", "far")


@pytest.mark.parametrize(("technique", "plan"), [("cluster_hierarchy", CLUSTERS), ("ptsv", TILES)])
@given(seed=seeds, kind=st.sampled_from(LIGHTS), front_faces=st.sampled_from(["cast", "culled"]))
@some
def test_a_triangle_soup_shadows_what_brute_force_says(technique, plan, seed, kind, front_faces):
    rng = np.random.default_rng(seed)
    # Kilometres from the origin, as large worlds are.
    camera = a_camera(SMALL, eye_m=((1.0, 2.0, 3.0), (1e6, -3e5, 1e6))[seed % 2])
    samples, casters, light = surface_samples(camera, seed), soup(camera, rng), light_of(camera, kind, rng)
    bias_m = default_bias_m(casters)
    found = cast(technique, plan, samples, casters, light, bias_m, front_faces)
    kept = kept_casters(casters, light, front_faces)
    # Nothing lies on a caster, so the bands hold next to nothing: 5 of 561 samples by chance.
    assert_equal_outside_the_bands(found.shadowed, samples, kept, light, bias_m, 0.01)
    shuffled = Casters(casters.vertices_m, rng.permutation(casters.triangles))
    assert (cast(technique, plan, samples, shuffled, light, bias_m, front_faces).shadowed == found.shadowed).all()


@pytest.mark.parametrize(("technique", "plan"), [("cluster_hierarchy", CLUSTERS), ("ptsv", TILES)])
def test_a_directional_light_shadows_what_brute_force_says(technique, plan):
    camera = a_camera(SMALL, eye_m=(1e6, -3e5, 1e6))
    for seed in range(4):
        rng = np.random.default_rng(seed)
        samples, casters, light = surface_samples(camera, seed), soup(camera, rng), light_of(camera, "directional", rng)
        bias_m = default_bias_m(casters)
        front_faces: FrontFaces = "culled" if seed % 2 else "cast"
        found = cast(technique, plan, samples, casters, light, bias_m, front_faces)
        kept = kept_casters(casters, light, front_faces)
        assert_equal_outside_the_bands(found.shadowed, samples, kept, light, bias_m, 0.01)
        assert found.counts["casters"] == kept.n_triangles  # none is seen edge-on


@pytest.mark.parametrize("kinds", [("inside", "far", "near"), ("directional",)], ids=["point", "directional"])
@pytest.mark.parametrize("technique", ["z_pass", "z_fail"])
def test_stencils_shadow_what_brute_force_says(technique, kinds):
    n_shadowed = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        camera = a_camera(SMALL, eye_m=((1.0, 2.0, 3.0), (1e6, -3e5, 1e6))[seed % 2])
        samples, casters = surface_samples(camera, seed), balls(camera, rng)
        light = light_of(camera, kinds[seed % len(kinds)], rng)
        bias_m = default_bias_m(casters)
        receives = samples.valid.copy()
        if technique == "z_pass":  # it has no caps: only what the eye sees is right
            eye = ShadowLight(camera.eye_m)
            points = view_points_m(samples, samples.valid)
            receives[samples.valid] = ~brute_force(points, casters, eye, 0.0, np.array(camera.eye_m))
        front_faces: FrontFaces = "culled" if seed > 4 else "cast"
        found = cast(technique, CLUSTERS, samples, casters, light, bias_m, front_faces, receives)
        kept = kept_casters(casters, light, front_faces)
        assert_equal_outside_the_bands(found.shadowed, samples, kept, light, bias_m, 0.02, receives)
        n_shadowed += found.shadowed.sum()
        assert found.counts["test_and_set"] >= found.shadowed.sum()
    assert n_shadowed > 100


def bad_triangles(kind: str, light_m: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Corners `[n, 3, 3]` of triangles before a light that no rasteriser likes."""
    a, b = rng.normal(size=(2, n, 3)) * 5
    t, u = rng.uniform(-2, 2, (2, n, 1))
    if kind == "edge-on":  # the light lies in the plane, up to rounding
        corners = np.stack([a, b, t * a + u * b], axis=1)
    elif kind == "zero area":
        corners = np.stack([a, b, a + t * (b - a)], axis=1)
    elif kind == "repeated":
        corners = np.stack([a, b, np.where(t > 0, a, b)], axis=1)
    elif kind == "light at a vertex":
        corners = np.stack([a, b, np.zeros((n, 3))], axis=1)
    else:
        corners = np.stack([a, b, rng.normal(size=(n, 3)) * 5], axis=1)
        scale = {"tiny": 1e-30, "huge": 1e30}[kind]
        corners = corners * scale + np.where(rng.random((n, 1, 1)) < 0.5, a[:, None], 0)
    return corners + light_m


@pytest.mark.parametrize(
    ("technique", "plan"), [("cluster_hierarchy", CLUSTERS), ("ptsv", TILES), ("z_pass", CLUSTERS)]
)
def test_a_parallel_view_has_the_shadows_that_brute_force_says(technique, plan):
    n_shadowed = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        camera = a_camera(SMALL)
        samples, casters = through(surface_samples(camera, seed), Lens(orthographic_height_m=8.0)), balls(camera, rng)
        light, bias_m = light_of(camera, "inside", rng), default_bias_m(casters)
        found = cast(technique, plan, samples, casters, light, bias_m)
        assert_equal_outside_the_bands(found.shadowed, samples, casters, light, bias_m, 0.02)
        n_shadowed += found.shadowed.sum()
    assert n_shadowed > 100


def test_ten_thousand_bad_triangles_shadow_nothing_that_brute_force_leaves_lit():
    camera = a_camera(SMALL)
    samples = surface_samples(camera, 0)
    points, eye = view_points_m(samples, samples.valid), np.array(camera.eye_m)
    kinds = ("edge-on", "zero area", "repeated", "light at a vertex", "tiny", "huge")
    order = np.arange(N_VERTICES, dtype=np.int32).reshape(-1, 3)
    bias_m = 3e-4  # of the samples' extent: the casters' own is without meaning here
    n_done = 0
    for seed in range(9):
        for kind in kinds:
            rng = np.random.default_rng(seed)
            light = light_of(camera, LIGHTS[seed % 3], rng)
            corners = bad_triangles(kind, np.array(light.position_m), N_TRIANGLES, rng)
            casters = Casters(corners.reshape(-1, 3), order)
            mask = cast("cluster_hierarchy", CLUSTERS, samples, casters, light, bias_m).shadowed
            reference = brute_force(points, casters, light, bias_m, eye)
            found = classify(points, mask[samples.valid] & ~reference, casters, light, bias_m, eye)
            assert found.errors == 0, (kind, seed)
            n_done += N_TRIANGLES
    assert n_done >= 10_000


def test_a_built_in_scene_in_16k_samples():
    samples, casters, light = gallery_case(4_000, 128)
    receives = facing_samples(samples, light)
    found = cast_shadows("cluster_hierarchy", ShadowPlan(8, 8), samples, casters, light, receives=receives)
    bias_m = default_bias_m(casters)
    reference = assert_equal_outside_the_bands(found.shadowed, samples, casters, light, bias_m, 1e-3, receives)
    assert 0.02 < reference.mean() < 0.98
    # Embree is float32, and leaks at edges: it agrees but for a few samples.
    rays = ShadowRays(casters).shadowed(view_points_m(samples, receives), light, bias_m, np.array(samples.camera.eye_m))
    assert (rays != reference).sum() <= 1e-3 * len(rays)


@pytest.mark.parametrize(
    ("technique", "plan", "planes", "nodes"),
    [
        # 16 float64 and 28 float32 a triangle and one that is none; 5 x 3 tiles have 32 places, all below the root.
        ("ptsv", TILES, 240 * (N_TRIANGLES + 1), [1]),
        # Relative to the light 6 float32 fewer; 4,096 keys have 512 nodes above, 64, 8 and the root: at most 64 each.
        ("cluster_hierarchy", replace(CLUSTERS, cells=2**12, nodes=64), 216 * (N_TRIANGLES + 1), [64, 64, 8, 1]),
    ],
)
def test_bytes_held_are_those_of_the_arrays(technique, plan, planes, nodes):
    samples, light = surface_samples(a_camera(SMALL), 0), ShadowLight((1.0, 2.0, 3.0))
    casters = soup(a_camera(SMALL), np.random.default_rng(0))
    counts = cast(technique, plan, samples, casters, light, 1e-4).counts
    # Besides the planes whether each triangle has any, how large it is, where the light is, and the bias.
    assert counts["memory_planes"] == planes + N_TRIANGLES * (1 + 8) + 3 * 8 + 8
    # Boxes of 24 bytes for each child; how many there are, of each node and level; of each item its tile, how many
    # samples that has, and the bits of 64.
    n_items = 32 if technique == "ptsv" else plan.clusters
    boxes = sum(nodes) * (24 * plan.branching + 4) + 4 * len(nodes)
    # Of a compact tree, where each child is, and each node below the root.
    links = 4 * (sum(nodes) * plan.branching + sum(nodes) - 1 + n_items) if plan.nodes else 0
    assert counts["memory_tree"] == boxes + links + n_items * (4 + 4 + 8)
    # 15 tiles of 64 samples: a position, an item and a flag each; and the bits of the items.
    assert counts["memory_samples"] == 15 * 64 * (12 + 4 + 1) + n_items * 8


@pytest.mark.parametrize(
    ("technique", "plan"), [("cluster_hierarchy", CLUSTERS), ("ptsv", TILES), ("z_fail", CLUSTERS)]
)
def test_a_walk_that_is_not_counted_is_the_same_walk(technique, plan):
    camera, rng = a_camera(SMALL), np.random.default_rng(6)
    samples = surface_samples(camera, 6)
    casters = balls(camera, rng) if technique == "z_fail" else soup(camera, rng)
    light, bias_m = light_of(camera, "inside", rng), default_bias_m(casters)
    frame = shadow_frame(samples, casters_on_device(casters), light, shadow_grid(samples, plan.tile_px), bias_m)
    counted, alone = run_program(technique, plan, frame), run_program(technique, plan, uncounted(frame))
    assert np.array_equal(counted.shadowed, alone.shadowed) and np.asarray(counted.shadowed).any()
    assert not counted.overflowed and not alone.overflowed
    # What the capacities must hold is known all the same.
    assert np.array_equal(counted.counts.groups, alone.counts.groups) and np.asarray(alone.counts.groups).any()
    assert int(counted.counts.sample_tests) > 0 and np.asarray(counted.tests).any()
    for name in ("node_tests", "refined", "sample_tests", "sample_tests_in_cluster", "tests_of_triangle"):
        assert np.asarray(getattr(counted.counts, name)).any() and not np.asarray(getattr(alone.counts, name)).any()
    assert not np.asarray(alone.tests).any()
    small = replace(plan, leaf_groups=4)
    assert run_program(technique, small, uncounted(frame)).overflowed


def test_what_does_not_fit_is_refused_and_run_again_not_cut():
    camera = a_camera(SMALL)
    rng = np.random.default_rng(3)
    samples, casters = surface_samples(camera, 3), soup(camera, rng)
    light, bias_m = light_of(camera, "inside", rng), default_bias_m(casters)
    whole = cast("cluster_hierarchy", CLUSTERS, samples, casters, light, bias_m)
    small = replace(CLUSTERS, branching=4, leaf_groups=4)
    with pytest.raises(InputError, match="no longer fits"):
        cast("cluster_hierarchy", small, samples, casters, light, bias_m)
    frame = shadow_frame(samples, casters_on_device(casters), light, shadow_grid(samples, 8), bias_m)
    plan = fitted("cluster_hierarchy", small, frame, unrolled=True)
    assert plan.leaf_groups > 4
    # No more clusters and nodes than there are, and the levels of as many keys as the grid has.
    assert plan.clusters == plan.nodes == 64 < CLUSTERS.clusters and plan.cells == 4 ** len(plan.level_groups) * 4
    # The program that is timed, as a GPU runs it: another branching, no loops, and the same mask.
    with jax.enable_x64(True):
        shadowed, overflowed = shadow_program("cluster_hierarchy", plan)(frame)
    assert not bool(overflowed)
    assert (from_runs(np.asarray(shadowed), camera.viewport) == whole.shadowed).all() and whole.shadowed.any()
