"""The scenes of the shadow benchmark: rolling ground with clumps of leaf triangles, of any triangle count."""

from __future__ import annotations

import math

import numpy as np

from vtfs.camera import Camera, CameraPath, Pose, Viewport
from vtfs.scene import Material, Scene
from vtfs.shadow_casters import ShadowLight

LIGHT = ShadowLight((10.0, 30.0, -20.0))


def clumps_scene(n_triangles: int, seed: int = 0) -> Scene:
    """Ground of 64 x 64 quads, and the rest small single triangles, normally distributed about 40 places above it."""
    rng = np.random.default_rng(seed)
    n = 64
    x, depth = np.meshgrid(np.linspace(-60, 60, n + 1), np.linspace(2, 120, n + 1), indexing="ij")
    height = -6 + np.sin(x / 6) + 0.8 * np.cos(depth / 5)
    ground = np.stack([x, height, -depth], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = np.concatenate(
        [
            np.stack([corner, corner + n + 1, corner + n + 2], axis=1),
            np.stack([corner, corner + n + 2, corner + 1], axis=1),
        ]
    )
    middles = np.stack([rng.uniform(-30, 30, 40), rng.uniform(-2, 4, 40), -rng.uniform(10, 80, 40)], axis=1)
    n_leaves = n_triangles - len(quads)
    first = middles[rng.integers(0, 40, n_leaves)] + rng.normal(0, 1.2, (n_leaves, 3))
    edges = rng.normal(0, 0.15, (2, n_leaves, 3))
    leaves = np.stack([first, first + edges[0], first + edges[1]], axis=1).reshape(-1, 3)
    triangles = np.concatenate([quads, len(ground) + np.arange(3 * n_leaves).reshape(-1, 3)])
    return Scene(
        f"clumps {n_triangles}", np.concatenate([ground, leaves]), triangles, None,
        np.zeros(len(triangles), np.int32), (Material("matt"),), clumps_path(),
    )  # fmt: skip


def clumps_path() -> CameraPath:
    return CameraPath(
        Viewport(1024, 1024), 60.0, 0.1, 400.0, (Pose((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),)
    )


def at_size(camera: Camera, size_px: int) -> Camera:
    """The same view, square."""
    return Camera(
        camera.eye_m, camera.target_m, camera.up, camera.fov_y_deg, camera.near_m,
        camera.far_m if math.isfinite(camera.far_m) else 1e4, Viewport(size_px, size_px),
    )  # fmt: skip
