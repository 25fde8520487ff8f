"""The built-in stage of the stress ladders: a room with a few things in it, a camera, a light, and what they see.

Everything is float64, and small enough that every pixel is tested against every triangle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh

from vtfs.camera import Camera, Viewport
from vtfs.shadow_casters import BIAS, Casters, ShadowLight
from vtfs.shapes import box, flat
from vtfs.view_samples import ViewSamples

VIEWPORT = Viewport(64, 64)

_SEEN_AT_ONCE = 2**20  # pairs of a ray and a triangle: 8 MB an array


@dataclass(frozen=True)
class ShadowCase:
    """One view, its casters and one light: what a shadow method answers.

    - `bias_m`: by which samples move toward the light, also for the reference.
    - `tested`: bool `[h, w]`; `own_triangle`: the caster on which each sample lies, -1 for none.
    """

    samples: ViewSamples
    casters: Casters
    light: ShadowLight
    bias_m: float
    tested: np.ndarray
    own_triangle: np.ndarray


@dataclass(frozen=True)
class Stage:
    """A view of some triangles.

    - `extent_m`: what biases and distances are shares of; more triangles do not change it.
    - `tested_px`: the rows and columns of pixels that are tested.
    """

    camera: Camera
    casters: Casters
    light: ShadowLight
    extent_m: float
    tested_px: tuple[slice, slice] = (slice(None), slice(None))

    def case(self) -> ShadowCase:
        samples = seen(self.camera, self.casters)
        tested = np.zeros(samples.valid.shape, bool)
        tested[self.tested_px] = True
        return ShadowCase(samples, self.casters, self.light, BIAS * self.extent_m, tested, samples.triangle)

    def with_triangles(self, corners_m: np.ndarray) -> Stage:
        """With loose triangles `[n, 3, 3]` besides."""
        return self.with_mesh(corners_m.reshape(-1, 3), np.arange(3 * len(corners_m)).reshape(-1, 3))

    def with_mesh(self, vertices_m: np.ndarray, triangles: np.ndarray) -> Stage:
        return replace(self, casters=joined(self.casters, vertices_m, triangles))

    def lit_from(self, position_m: np.ndarray) -> Stage:
        return replace(self, light=point_light(position_m))

    def moved(self, scale: float, offset_m: np.ndarray) -> Stage:
        """Scaled about the origin, then moved; the image stays the same."""

        def at(point: tuple[float, float, float]) -> tuple[float, float, float]:
            x, y, z = (float(c) for c in np.asarray(point) * scale + offset_m)
            return x, y, z

        camera = replace(
            self.camera,
            eye_m=at(self.camera.eye_m),
            target_m=at(self.camera.target_m),
            near_m=self.camera.near_m * scale,
            far_m=self.camera.far_m * scale,
        )
        casters = Casters(self.casters.vertices_m * scale + offset_m, self.casters.triangles)
        return replace(
            self,
            camera=camera,
            casters=casters,
            light=ShadowLight(at(self.light.position_m)),
            extent_m=self.extent_m * scale,
        )


def joined(casters: Casters, vertices_m: np.ndarray, triangles: np.ndarray) -> Casters:
    return Casters(
        np.concatenate([casters.vertices_m, vertices_m]),
        np.concatenate([casters.triangles, triangles + len(casters.vertices_m)]),
    )


def point_light(position_m: np.ndarray) -> ShadowLight:
    x, y, z = (float(c) for c in position_m)
    return ShadowLight((x, y, z))


def default_stage(seed: int) -> Stage:
    """A floor, a wall, three boxes, a ball and forty leaves in the air: 204 triangles, a sixth of what is seen in
    shadow."""
    rng = np.random.default_rng(seed)
    parts = [
        flat((-6, 0, 6), (12, 0, 0), (0, 0, -12), 4, 4).build(),
        flat((-6, 0, -6), (12, 0, 0), (0, 6, 0), 4, 2).build(),
        box((-3.2, 0, -2), (-2, 1.7, -0.8)).build(),
        box((1.5, 0, -3.5), (3, 2.5, -2.4)).build(),
        box((-1, 0, 1), (0.1, 0.8, 2.1)).build(),
    ]
    casters = Casters(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    for vertices, triangles, _ in parts:
        casters = joined(casters, vertices, triangles)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.8)  # closed: neighbours share vertices
    casters = joined(casters, np.array(ball.vertices) + np.array([2.4, 1.9, 0.6]), np.array(ball.faces))
    middle = rng.uniform([-4, 1.2, -5], [4, 4, 2.5], (40, 3))
    leaves = middle[:, None] + rng.normal(size=(40, 3, 3)) * 0.55
    casters = joined(casters, leaves.reshape(-1, 3), np.arange(120).reshape(40, 3))
    camera = Camera((0.2, 3.1, 9.7), (0.0, 1.1, 0.0), (0.0, 1.0, 0.0), 50.0, 0.1, 100.0, VIEWPORT)
    return Stage(camera, casters, ShadowLight((4.2, 5.6, 4.6)), casters.extent_m)


def seen(camera: Camera, casters: Casters) -> ViewSamples:
    """What each pixel sees of the casters between near and far: float64 rays against every triangle."""
    matrix = camera.view_from_world
    x, y = camera.pixel_slopes()
    way = np.stack([np.tile(x, len(y)), np.repeat(y, len(x)), -np.ones(len(x) * len(y))], axis=1)
    # Relative to the eye, then turned: an offset loses nothing.
    vertices = (casters.vertices_m - np.asarray(camera.eye_m)) @ matrix[:3, :3].T
    a, b, c = (vertices[casters.triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    height = (face * a).sum(axis=1)
    sides = [np.cross(first, second) * np.sign(height)[:, None] for first, second in ((a, b), (b, c), (c, a))]
    depth_m, triangle = np.full(len(way), np.inf), np.full(len(way), -1, np.int32)
    n_rays = max(1, _SEEN_AT_ONCE // max(1, len(a)))
    for first in range(0, len(way), n_rays):
        some = way[first : first + n_rays]
        inside = height != 0
        for normal in sides:
            inside = inside & (some @ normal.T >= 0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            depth = height / (some @ face.T)
        depth = np.where(inside & (depth >= camera.near_m) & (depth <= camera.far_m), depth, np.inf)
        nearest = depth.argmin(axis=1)
        depth_m[first : first + n_rays] = depth[np.arange(len(some)), nearest]
        triangle[first : first + n_rays] = nearest
    valid = np.isfinite(depth_m)
    position = np.where(valid[:, None], way * np.where(valid, depth_m, 0)[:, None], 0)
    normal = face[triangle] / np.maximum(np.linalg.norm(face[triangle], axis=1, keepdims=True), 1e-300)
    normal *= -np.sign((normal * way).sum(axis=1, keepdims=True))
    return _samples(camera, position, np.where(valid[:, None], normal, 0), np.where(valid, triangle, -1), valid)


def _samples(
    camera: Camera, position: np.ndarray, normal: np.ndarray, triangle: np.ndarray, valid: np.ndarray
) -> ViewSamples:
    """Rows of pixels as view samples, all of one grey."""
    shape = (camera.viewport.height_px, camera.viewport.width_px)
    grey = np.full((*shape, 3), 0.5, np.float32)
    flat_channel = np.zeros(shape, np.float32)
    return ViewSamples(
        camera,
        position.reshape(*shape, 3).astype(np.float32),
        normal.reshape(*shape, 3).astype(np.float32),
        grey,
        flat_channel,
        flat_channel + 1,
        np.zeros((*shape, 3), np.float32),
        triangle.reshape(shape).astype(np.int32),
        valid.reshape(shape),
    )
