"""One mask, whatever the variant of the walk: full and compact trees, batches, passes; and plans that are refused."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.strategies import SMALL, a_camera, samples_at, surface_samples
from tests.vtfs.shadow_cases import (
    CLUSTERS,
    N_TRIANGLES,
    N_VERTICES,
    TILES,
    assert_equal_outside_the_bands,
    cast,
    light_of,
    soup,
)
from vtfs.camera import Camera, Viewport, load_cameras
from vtfs.input_error import InputError
from vtfs.scene import load_scene
from vtfs.shadow_casters import Casters, ShadowLight, opaque_casters
from vtfs.shadow_mask import ShadowPlan, casters_on_device, default_bias_m, facing_samples, shadow_frame
from vtfs.shadow_references import brute_force, classify, view_points_m
from vtfs.shadow_techniques import cast_shadows, shadow_grid
from vtfs.shadow_volumes.full_tree import n_cells, require_room
from vtfs.shadow_volumes.volumes import volumes
from vtfs.shadow_volumes.walk import restart_level
from vtfs.view_samples import trace_view_samples

TWICE = replace(CLUSTERS, passes=2, batch=64, pairs=2**12)
VARIANTS = {
    "full tree": ("cluster_hierarchy", replace(CLUSTERS, tree="full", cells=2**12)),
    "batches, full tree": ("cluster_hierarchy", replace(CLUSTERS, batch=64, tree="full", cells=2**12)),
    "two passes": ("cluster_hierarchy", replace(TWICE, level=3, feedback=False)),
    "ptsv, two passes": ("ptsv", replace(TWICE, level=1, branching=4, extra="silhouette")),
}


def test_variants_change_tests_and_not_the_mask():
    camera = a_camera(SMALL)
    rng = np.random.default_rng(6)
    samples, casters = surface_samples(camera, 6), soup(camera, rng, largest=1.0)
    light, bias_m = light_of(camera, "inside", rng), default_bias_m(casters)
    whole = cast("cluster_hierarchy", replace(CLUSTERS, cells=2**12), samples, casters, light, bias_m)
    assert_equal_outside_the_bands(whole.shadowed, samples, casters, light, bias_m, 0.01)
    found = {name: cast(*variant, samples, casters, light, bias_m) for name, variant in VARIANTS.items()}
    for name, other in {"whole": whole, **found}.items():
        assert (other.shadowed == whole.shadowed).all(), name
        counts, levels = other.counts, range(sum(key.startswith("refined_") for key in other.counts))
        assert counts["casters"] == whole.counts["casters"] <= N_TRIANGLES
        # A sample's list is tested against each sample of its cluster that no earlier batch shadows.
        assert other.tests.sum() == counts["test_and_set_in_cluster"] - counts["node_tests"]
        assert counts["sample_tests"] >= other.tests.sum()
        assert counts["node_tests"] == sum(counts[f"node_tests_{k}"] for k in levels)
        # No triangle is left out of the work of the largest 1,024, as there are only 200.
        assert counts["tests_of_largest"] == counts["node_tests"] + counts["sample_tests"]
        tested = [k for k in levels if counts[f"node_tests_{k}"]]
        ends = (counts[f"{kind}_{k}"] for kind in ("accepted", "refined", "dropped") for k in tested)
        assert counts["rejected_nodes"] == counts["node_tests"] - sum(ends) > 0
        assert counts["memory"] == sum(counts[f"memory_{part}"] for part in ("planes", "tree", "lists", "samples"))
        for k in levels:
            of_level = (counts[f"{kind}_{k}"] for kind in ("accepted", "refined", "dropped"))
            assert sum(of_level) <= counts[f"node_tests_{k}"] or counts[f"node_tests_{k}"] == 0
            if k:
                branching = VARIANTS[name][1].branching if name in VARIANTS else 8
                assert counts[f"node_tests_{k}"] <= branching * max(counts[f"refined_{k - 1}"], counts["casters"])
        assert counts["listed_pairs"] == counts[f"refined_{max(levels)}"]
    assert 0 < whole.shadowed.sum() < samples.n_valid
    # What feedback spares is counted: nodes, and samples that earlier batches shadow.
    full, spared, plain, twice = (other.counts for other in found.values())
    # A compact tree has the nodes of the full one that hold a cluster: all the same tests, on all levels.
    assert {k: full[k] for k in full if "memory" not in k} == {k: whole.counts[k] for k in full if "memory" not in k}
    assert plain["dropped_nodes"] == plain["dropped_samples"] == 0 < spared["dropped_samples"]
    assert min(spared["dropped_nodes"], whole.counts["dropped_nodes"], twice["dropped_nodes"]) > 0
    assert whole.counts["node_tests"] < plain["node_tests"]
    assert spared["sample_tests"] < whole.counts["sample_tests"] < plain["sample_tests"]


def roof(camera: Camera, depth_m: float) -> Casters:
    """One triangle across the whole view, at a depth; and as many without area as a soup has others."""
    corners = np.array([[-1e3, -1e3, -depth_m], [1e3, -1e3, -depth_m], [0, 2e3, -depth_m]])
    vertices = np.zeros((N_VERTICES, 3))
    vertices[:3] = corners @ camera.view_from_world[:3, :3]
    triangles = np.zeros((N_TRIANGLES, 3), np.int32)
    triangles[N_TRIANGLES // 2] = [0, 1, 2]
    return Casters(vertices + camera.eye_m, triangles)


def light_behind(camera: Camera, directional: bool = False) -> ShadowLight:
    """50 m behind the camera, on its axis."""
    way = np.array([0.0, 0.0, 50.0]) @ camera.view_from_world[:3, :3]
    return ShadowLight(tuple(way) if directional else tuple(way + camera.eye_m), directional)


@pytest.mark.parametrize("name", ["whole", "ptsv", *VARIANTS])
def test_what_lies_in_shadow_as_a_whole_is_accepted_at_the_top(name):
    camera = a_camera(SMALL)
    samples, casters = surface_samples(camera, 6), roof(camera, -20.0)  # between the light and the camera
    technique, plan = {"whole": ("cluster_hierarchy", CLUSTERS), "ptsv": ("ptsv", TILES), **VARIANTS}[name]
    found = cast(technique, plan, samples, casters, light_behind(camera), 1e-3)
    assert (found.shadowed == samples.valid).all()
    counts = found.counts
    top = next(k for k in range(9) if counts[f"node_tests_{k}"])
    assert counts["casters"] == 1 < counts[f"accepted_{top}"] == counts["node_tests"]
    assert counts["sample_tests"] == counts["extra_plane_tests"] == 0 == found.tests.sum()


@pytest.mark.parametrize(
    ("technique", "plan", "directional"),
    [("cluster_hierarchy", CLUSTERS, False), ("ptsv", TILES, False), ("cluster_hierarchy", CLUSTERS, True)],
)
def test_what_lies_less_than_the_bias_behind_a_triangle_is_lit(technique, plan, directional):
    camera, bias_m = a_camera(SMALL), 1e-2
    depth_m = np.full((SMALL.height_px, SMALL.width_px), 5.0)
    samples = samples_at(camera, depth_m, np.ones_like(depth_m, bool), np.random.default_rng(0))
    light = light_behind(camera, directional)
    for biases, is_shadowed in ((-3.0, False), (-0.3, False), (0.3, False), (1.5, True), (30.0, True)):
        found = cast(technique, plan, samples, roof(camera, 5.0 - biases * bias_m), light, bias_m)
        assert (found.shadowed == is_shadowed).all(), biases


def test_a_stencil_keeps_a_bias_that_float32_would_lose():
    """A fiftieth of what tells two float32 depths apart. Not by z-pass: no eye sees behind the roof."""
    camera, bias_m = a_camera(SMALL), 1e-8
    depth_m = np.full((SMALL.height_px, SMALL.width_px), 5.0)
    samples, light = (
        samples_at(camera, depth_m, np.ones_like(depth_m, bool), np.random.default_rng(0)),
        light_behind(camera),
    )
    for biases, is_shadowed in ((0.3, False), (1.5, True)):
        found = cast("z_fail", CLUSTERS, samples, roof(camera, 5.0 - biases * bias_m), light, bias_m)
        assert (found.shadowed == is_shadowed).all(), biases


@pytest.mark.parametrize("scale", [1e-22, 1e20])
def test_no_length_is_too_short_or_too_long_for_the_bias(scale):
    """Squares of these lengths vanish or overflow in float32."""
    camera, rng = a_camera(SMALL, eye_m=(0.0, 0.0, 0.0)), np.random.default_rng(2)
    samples, casters = surface_samples(camera, 2), soup(camera, rng, largest=1.0)
    light = light_of(camera, "inside", rng)
    scaled = replace(camera, near_m=camera.near_m * scale, far_m=camera.far_m * scale)
    position_m = (samples.position_m * np.float64(scale)).astype(np.float32)
    samples = replace(samples, camera=scaled, position_m=position_m)
    casters = Casters(casters.vertices_m * scale, casters.triangles)
    light, bias_m = ShadowLight(tuple(np.array(light.position_m) * scale)), default_bias_m(casters)
    found = cast("cluster_hierarchy", CLUSTERS, samples, casters, light, bias_m)
    reference = assert_equal_outside_the_bands(found.shadowed, samples, casters, light, bias_m, 0.01)
    assert 20 < reference.sum() < len(reference)
    # What lies less than the bias behind a triangle is lit.
    depth_m = np.full((SMALL.height_px, SMALL.width_px), (5 + 3e-6) * scale)
    wall, own = samples_at(scaled, depth_m, np.ones_like(depth_m, bool), rng), roof(scaled, 5.0)
    own = Casters(own.vertices_m * scale, own.triangles)
    behind = ShadowLight(tuple(np.array(light_behind(scaled).position_m) * scale))
    assert not cast("cluster_hierarchy", CLUSTERS, wall, own, behind, 1e-5 * scale).shadowed.any()


def test_what_blocks_most_of_the_light_is_known():
    """Each face of an octahedron about the light fills an eighth of all directions, whatever its size."""
    corners = np.concatenate([np.eye(3), -np.eye(3)]) * np.array([[1.0], [2], [3], [4], [5], [6]])
    faces = np.array([[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)])
    samples, light = surface_samples(a_camera(SMALL), 0), ShadowLight((1.0, 2.0, 3.0))
    casters = Casters(corners + light.position_m, faces)
    frame = shadow_frame(samples, casters_on_device(casters), light, shadow_grid(samples, 8), 1e-4)
    with jax.enable_x64(True):
        found = jax.jit(lambda frame: volumes(frame, CLUSTERS, about_light=True).solid_angle)(frame)
    np.testing.assert_allclose(found, np.pi / 2, rtol=1e-12)  # a few roundings of float64


def test_the_only_child_of_a_full_trees_root_need_not_be_its_first():
    camera = a_camera(SMALL, near_m=1e-7)  # all samples are in the deeper half of the slices
    rng = np.random.default_rng(6)
    samples, casters = surface_samples(camera, 6), soup(camera, rng, largest=1.0)
    light, bias_m = light_of(camera, "inside", rng), default_bias_m(casters)
    columns, rows = -(-SMALL.width_px // 8), -(-SMALL.height_px // 8)
    cells = n_cells(columns, rows, int(shadow_grid(samples, 8).depth_slices))
    found = cast("cluster_hierarchy", replace(CLUSTERS, tree="full", cells=cells), samples, casters, light, bias_m)
    assert found.counts["node_tests_0"] == 0  # the root has one child
    reference = assert_equal_outside_the_bands(found.shadowed, samples, casters, light, bias_m, 0.01)
    assert 0.02 < reference.mean() < 0.98


def test_the_full_tree_is_refused_where_it_is_too_large():
    assert n_cells(128, 100, 200) == 2**22
    require_room(2**22, 8)
    with pytest.raises(InputError, match=r"tree=full: .* 33,554,432 places.* MiB, more than 256; use tree=compact"):
        require_room(n_cells(240, 135, 512), 32)


def test_a_restart_level_that_is_not_there_is_refused_by_name():
    plan = ShadowPlan(branching=8, passes=2, level=4)
    assert restart_level(plan, 5) == 4 and restart_level(replace(plan, level=0), 5) == 2
    with pytest.raises(InputError, match=r"level=4: this tree has 4 levels .*use 1 to 3"):
        restart_level(plan, 4)
    with pytest.raises(InputError, match=r"passes=2: the tree has one level"):
        restart_level(plan, 1)


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("tile_px", 0, "a whole number from 1 to 256"),
        ("tile_px", 8.5, "a whole number from 1 to 256"),
        ("branching", 1, "a whole number from 2 on"),
        ("batch", -1, "a whole number from 0 on"),
        ("clusters", 2**25 + 1, "a whole number from 0 to 33554432"),
        ("passes", 3, "a whole number from 1 to 2"),
        ("level", -1, "a whole number from 0 to 24"),
        ("level", 2, "where the first of two passes ends, and this plan has one; give passes=2"),
        ("bounds", "packed", "one of explicit, implicit"),
        ("extra", "on", "one of off, vertex, silhouette"),
        ("feedback", "off", "one of False, True"),
        ("tree", "x", "one of compact, full"),
        ("stencil", "x", "one of unlimited, wrap, saturate"),
        ("precision", "float16", "one of float64, float32"),
        ("blending", "x", "one of opaque, grey, coloured, stochastic"),
    ],
)
def test_a_wrong_plan_is_refused_by_name(field, value, allowed):
    with pytest.raises(InputError, match=rf"`ShadowPlan\({field}={value!r}\)`: .*{allowed}"):
        ShadowPlan(**{field: value})


@functools.cache
def real_case(frame: int):
    """One view of a real scene at 256 squared, and what brute force says of one sample in each 2 by 2 pixels: a
    thousand million pairs."""
    scenes = Path(__file__).parents[3] / "shared" / "scenes"
    scene = load_scene(scenes / "zdm2.glb")
    camera = load_cameras(scenes / "zdm2.cameras.json").camera(frame)
    samples = trace_view_samples(scene, replace(camera, viewport=Viewport(256, 256)))
    low, high = scene.bounds_m
    light = ShadowLight(tuple(low + (high - low) * np.array([0.45, 0.8, 0.55])))
    casters, receives = opaque_casters(scene), facing_samples(samples, light)
    asked = np.zeros_like(receives)
    asked[::2, ::2] = receives[::2, ::2]
    points = view_points_m(samples, asked)
    reference = brute_force(points, casters, light, default_bias_m(casters), np.array(camera.eye_m))
    return samples, casters, light, receives, asked, points, reference


@pytest.mark.shared
@pytest.mark.parametrize("frame", [0, 9])
@pytest.mark.parametrize(
    ("technique", "plan"),
    [
        ("cluster_hierarchy", ShadowPlan(8, 8)),
        ("cluster_hierarchy", ShadowPlan(16, 4, bounds="implicit", extra="off", feedback=False)),
        ("cluster_hierarchy", ShadowPlan(4, 32, batch=2**14)),
        ("ptsv", ShadowPlan(8, 32, extra="silhouette")),
        ("ptsv", ShadowPlan(5, 16, extra="off", feedback=False)),
        ("cluster_hierarchy", ShadowPlan(8, 16, passes=2, tree="full", batch=2**14)),
        ("ptsv", ShadowPlan(8, 2, passes=2, level=5)),
    ],
    ids=str,
)
def test_every_variant_on_a_real_scene(technique, plan, frame):
    samples, casters, light, receives, asked, points, reference = real_case(frame)
    mask = cast_shadows(technique, plan, samples, casters, light, receives=receives).shadowed
    differs = mask[asked] != reference
    found = classify(points, differs, casters, light, default_bias_m(casters), np.array(samples.camera.eye_m))
    assert found.errors == 0 and found.total <= 1e-3 * len(points)
    assert not mask[~receives].any() and 0.02 < reference.mean() < 0.98
