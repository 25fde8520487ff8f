"""Every shadow technique against brute force; one mask, whatever the variant; and what is counted."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.strategies import SMALL, a_camera, samples_at, seeds, surface_samples, through
from vtfs.camera import Camera, Lens, Viewport, load_cameras
from vtfs.gallery import build_scene
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.scene import load_scene
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight, opaque_casters, welded
from vtfs.shadow_mask import (
    ShadowPlan,
    casters_on_device,
    default_bias_m,
    edge_list,
    facing_samples,
    shadow_frame,
    uncounted,
)
from vtfs.shadow_references import (
    ShadowRays,
    brute_force,
    classify,
    facing_light,
    is_excused,
    kept_casters,
    view_points_m,
)
from vtfs.shadow_techniques import cast_by_bias, cast_shadows, fitted, on_host, run_program, shadow_grid, shadow_program
from vtfs.shadow_volumes.full_tree import n_cells, require_room
from vtfs.shadow_volumes.volumes import volumes
from vtfs.shadow_volumes.walk import restart_level
from vtfs.view_samples import ViewSamples, trace_view_samples

some = settings(max_examples=5, deadline=None)
N_TRIANGLES, N_VERTICES = 200, 600
CLUSTERS = ShadowPlan(8, 8, clusters=2**10, groups=2**10, leaf_groups=2**13)
TILES = replace(CLUSTERS, branching=32, extra="silhouette")
LIGHTS = ("at the eye", "near", "inside", "far")


def light_of(camera: Camera, kind: str, rng: np.random.Generator) -> ShadowLight:
    way = rng.normal(size=3)
    if kind == "directional":
        return ShadowLight(tuple(way * 10 ** rng.uniform(-5, 5)), directional=True)
    distance = {"at the eye": 0.0, "near": 1e-3, "inside": 3.0, "far": 1e4}[kind]
    return ShadowLight(tuple(np.array(camera.eye_m) + way * distance))


def soup(camera: Camera, rng: np.random.Generator, largest: float = 0.4) -> Casters:
    """Pairs of triangles that share an edge, of all sizes, around the camera: a fifth or so of the view in shadow."""
    n_pairs = N_TRIANGLES // 2
    size = 10 ** rng.uniform(-1.5, largest, (n_pairs, 1, 1))
    corners = rng.normal(size=(n_pairs, 1, 3)) * 8 + rng.normal(size=(n_pairs, 4, 3)) * size
    vertices = np.zeros((N_VERTICES, 3))
    vertices[: 4 * n_pairs] = corners.reshape(-1, 3)
    first = 4 * np.arange(n_pairs)[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([2, 1, 3])])
    return Casters(vertices + camera.eye_m, rng.permutation(triangles))


def cast(
    technique: str,
    plan: ShadowPlan,
    samples: ViewSamples,
    casters: Casters,
    light: ShadowLight,
    bias_m: float,
    front_faces: FrontFaces = "cast",
    receives: np.ndarray | None = None,
):
    """Without a sizing run: the capacities of these tests hold everything, or the mask is refused."""
    grid = shadow_grid(samples, plan.tile_px)
    frame = shadow_frame(samples, casters_on_device(casters), light, grid, bias_m, receives, front_faces)
    return on_host(run_program(technique, plan, frame), plan, frame)


def assert_equal_outside_the_bands(mask, samples, casters, light, bias_m, most_in_bands, receives=None):
    """Against brute force; with a receiver mask the others must be lit."""
    receives = samples.valid if receives is None else receives
    points = view_points_m(samples, receives)
    eye = np.array(samples.camera.eye_m)
    reference = brute_force(points, casters, light, bias_m, eye)
    found = classify(points, mask[receives] != reference, casters, light, bias_m, eye)
    assert found.errors == 0
    assert found.total <= most_in_bands * len(points)
    assert not mask[~receives].any()
    return reference


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


def balls(camera: Camera, rng: np.random.Generator) -> Casters:
    """Two closed balls and twenty loose triangles: always the same edges, as each number of them compiles."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    parts, triangles, n = [], [], 0
    for _ in range(2):
        parts.append(np.array(ball.vertices) * 10 ** rng.uniform(-0.5, 0.5) + rng.normal(size=3) * 6)
        triangles.append(np.array(ball.faces) + n)
        n += len(ball.vertices)
    loose = rng.normal(size=(20, 1, 3)) * 6 + rng.normal(size=(20, 3, 3)) * 2
    parts.append(loose.reshape(-1, 3))
    triangles.append(n + np.arange(60).reshape(20, 3))
    return Casters(np.concatenate(parts) + camera.eye_m, np.concatenate(triangles))


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


def test_each_edge_is_listed_once_with_its_two_triangles():
    #  0-1-2 and 0-2-3 share 0-2; 4 hangs on 0-2 too; 2, 2, 3 is no triangle
    triangles = np.array([[0, 1, 2], [0, 2, 3], [2, 0, 4], [2, 2, 3]], np.int32)
    edges = edge_list(triangles)
    assert edges.dtype == np.int32
    found = {tuple(edge) for edge in edges.tolist()}
    assert {(0, 1, 0, -1), (1, 2, 0, -1), (0, 3, 3, -1), (0, 4, 4, -1), (2, 4, 5, -1), (2, 3, 2, 6)} < found
    shared = sorted(edge for edge in found if edge[:2] == (0, 2))
    assert [edge[2:] for edge in shared] in ([(1, 2), (5, -1)], [(1, 2), (4, -1)])
    ball = trimesh.creation.icosphere(subdivisions=2)
    closed = edge_list(np.array(ball.faces, np.int32))
    assert len(closed) == len(ball.edges_unique) and (closed[:, 2:] >= 0).all()
    assert ((closed[:, 2] + closed[:, 3]) % 2 == 1).all()  # neighbours run along their edge in opposite directions
    # Where each triangle has vertices of its own, as at the seams of textures, the edges are the same.
    order = np.random.default_rng(0).permutation(ball.faces.size)
    split = np.empty((ball.faces.size, 3))
    split[order] = ball.vertices[ball.faces.ravel()]
    split[split == 0] = -0.0  # a place all the same
    split[: len(split) // 2] += 0.0
    alone = order.reshape(-1, 3)
    assert (edge_list(alone)[:, 3] < 0).all()
    joined = edge_list(welded(split, alone))
    assert len(joined) == len(closed) and (joined[:, 2:] >= 0).all()
    assert (split[welded(split, alone)] == ball.vertices[ball.faces]).all()


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


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_casters_that_are_not_finite_are_refused_by_name(value):
    corners = np.eye(3)
    corners[1, 2] = value
    with pytest.raises(InputError, match=r"casters `triangles`: triangle 0 .*NaN or infinite"):
        Casters(corners, np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Casters(np.eye(3), np.array([[0, 1, 3]])), "index 3 is out of range"),
        (lambda: ShadowLight((0.0, np.nan, 0.0)), "position_m"),
        (lambda: ShadowLight((0.0, 0.0, 0.0), directional=True), "needs a direction"),
    ],
)
def test_bad_input_is_refused_by_name(make, message):
    with pytest.raises(InputError, match=message):
        make()


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


def gallery_case(n_triangles: int, size_px: int):
    scene = build_scene("atrium", n_triangles)
    camera = replace(scene.cameras.camera(0), viewport=Viewport(size_px, size_px))  # type: ignore[union-attr]
    low, high = scene.bounds_m
    light = ShadowLight(tuple(low + (high - low) * np.array([0.4, 0.7, 0.45])))
    return trace_view_samples(scene, camera), opaque_casters(scene), light


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


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("receives", np.ones((3, 5), bool), r"`receives`: is bool of shape \(3, 5\); must be bool of shape \(17, 33\)"),
        ("receives", np.ones((17, 33)), "`receives`: is float64 of shape"),
        ("bias_m", float("nan"), "`bias_m` = nan: must be a finite number"),
        ("bias_m", -1e-3, "`bias_m` = -0.001: must be a finite number"),
        ("front_faces", "cull", "`front_faces='cull'`: must be one of cast, culled"),
        ("depth_slices", -1, "`depth_slices` = -1: must be a whole number from 0 to 8,192"),
        ("depth_slices", 2.5, "`depth_slices` = 2.5: must be"),
    ],
)
def test_what_shadows_are_cast_with_is_checked(argument, value, message):
    camera = a_camera(SMALL)
    samples, casters = surface_samples(camera, 0), soup(camera, np.random.default_rng(0))
    with pytest.raises(InputError, match=message):
        cast_shadows("ptsv", ShadowPlan(), samples, casters, ShadowLight((0.0, 9.0, 0.0)), **{argument: value})


@pytest.mark.parametrize("position", ["abc", None, (0.0, 1.0), (0.0, 1.0, np.nan), ((1.0,), 2.0, 3.0)])
def test_a_light_without_a_place_is_refused(position):
    with pytest.raises(InputError, match=r"`position_m` = .*: must be three finite numbers"):
        ShadowLight(position)


def test_a_light_is_refused_where_rounding_would_decide_more_than_the_bands_excuse():
    """A large triangle and one that is a little wider than the bands, which is left out where it is seen too narrow."""
    camera = a_camera(SMALL)
    samples = surface_samples(camera, 0)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0.1], [0.20004, 0.2, 0.1], [0.2, 0.20004, 0.1]])
    casters = Casters(corners, np.arange(6).reshape(2, 3))

    def n_cast(distance_m: float, casters: Casters, directional: bool = False) -> int:
        light = ShadowLight((0.1 * distance_m, 0.1 * distance_m, distance_m), directional)
        return cast_shadows("ptsv", TILES, samples, casters, light).counts["casters"]

    assert n_cast(1e5, casters) == 2
    assert n_cast(1e6, casters, directional=True) == 2
    far = ShadowLight((1e5, 1e5, 1e6))
    unchecked = cast_by_bias("ptsv", TILES, samples, casters, far, 0, "cast", None, default_bias_m(casters))
    assert unchecked.counts["casters"] == 1
    for distance_m in (2e5, 1e30, 1e300):
        with pytest.raises(
            InputError, match=r"must be within 100000 of their extents, .*; make it a directional light"
        ):
            n_cast(distance_m, casters)
    assert n_cast(1e30, Casters(np.zeros((0, 3)), np.zeros((0, 3), np.int32))) == 0
    with pytest.raises(InputError, match=r"`position_m`: a coordinate of 1e\+37 m is beyond 1e36"):
        n_cast(1e37, Casters(corners * 1e35, casters.triangles))  # boxes about it would overflow
