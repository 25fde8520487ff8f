"""Casters, lights and plans of which a shadow program is compiled once, and masks against brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from vtfs.camera import Camera, Viewport
from vtfs.gallery import build_scene
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight, opaque_casters
from vtfs.shadow_mask import ShadowPlan, casters_on_device, shadow_frame
from vtfs.shadow_programs import run_program
from vtfs.shadow_references import brute_force, classify, view_points_m
from vtfs.shadow_techniques import on_host, shadow_grid
from vtfs.view_samples import ViewSamples, trace_view_samples

N_TRIANGLES, N_VERTICES = 200, 600
CLUSTERS = ShadowPlan(8, 8, clusters=2**10, groups=2**10, leaf_groups=2**13)
TILES = replace(CLUSTERS, branching=32, extra="silhouette")


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


def gallery_case(n_triangles: int, size_px: int):
    scene = build_scene("atrium", n_triangles)
    camera = replace(scene.cameras.camera(0), viewport=Viewport(size_px, size_px))  # type: ignore[union-attr]
    low, high = scene.bounds_m
    light = ShadowLight(tuple(low + (high - low) * np.array([0.4, 0.7, 0.45])))
    return trace_view_samples(scene, camera), opaque_casters(scene), light


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
