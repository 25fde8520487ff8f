"""View samples: what each pixel sees, from our own primary rays or from the user's renderer.

Primary rays go through pixel centres. Embree finds the triangle in float32; the position is then computed again in
float64 where the ray meets the plane of that triangle. Only triangle indices are cached on disk.
"""

from __future__ import annotations

import hashlib
import io
import logging
import os
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from vtfs.cache import cache_dir
from vtfs.camera import Camera
from vtfs.files import write_atomically
from vtfs.input_error import InputError
from vtfs.scene import Material, Scene

log = logging.getLogger("vtfs.view_samples")

_VERSION = 1  # of the rule by which a pixel gets its triangle; part of the cache key
_LARGEST_LAYERS = 4096  # alpha-tested surfaces that one ray may step through
_FLAT = ("specular", "shininess", "triangle", "valid")


@dataclass(frozen=True)
class ViewSamples:
    """One sample for each pixel, arrays `[h, w]` or `[h, w, 3]`, row 0 at the top.

    - `position_m`: float32, view space; 0 where nothing was hit.
    - `normal`: float32, view space, unit, geometric, facing the eye where we traced it.
    - `base_colour`, `emissive`, `specular`, `shininess`: float32, of the material.
    - `triangle`: int32, -1 where nothing was hit.
    - `valid`: there is a surface, and its depth lies in `[near, far]`.
    """

    camera: Camera
    position_m: np.ndarray
    normal: np.ndarray
    base_colour: np.ndarray
    specular: np.ndarray
    shininess: np.ndarray
    emissive: np.ndarray
    triangle: np.ndarray
    valid: np.ndarray

    def __post_init__(self):
        height, width = self.camera.viewport.height_px, self.camera.viewport.width_px
        for field in fields(self)[1:]:
            shape = (height, width) if field.name in _FLAT else (height, width, 3)
            if getattr(self, field.name).shape != shape:
                raise InputError(f"view samples `{field.name}` has shape {getattr(self, field.name).shape}, not {shape}.")

    @property
    def n_valid(self) -> int:
        return int(self.valid.sum())

    @cached_property
    def key(self) -> str:
        """SHA-256 of the content, in hexadecimal."""
        digest = hashlib.sha256(self.camera.key.encode())
        for field in fields(self)[1:]:
            digest.update(np.ascontiguousarray(getattr(self, field.name)).data)
        return digest.hexdigest()

    def world_positions_m(self) -> np.ndarray:
        """World-space positions of the valid samples, float64 `[n_valid, 3]`."""
        matrix = self.camera.view_from_world
        return (self.position_m[self.valid].astype(np.float64) - matrix[:3, 3]) @ matrix[:3, :3]


class Tracer:
    """A scene in Embree, built once for all frames of a path.

    Embree sees float32 coordinates relative to the centre of the scene. Triangles of `blend` materials are left out:
    view samples are the opaque layer.
    """

    def __init__(self, scene: Scene):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = scene
        low, high = scene.bounds_m
        self._centre_m = (low + high) / 2
        blended = np.array([material.alpha_mode == "blend" for material in scene.materials])
        masked = np.array([material.alpha_mode == "mask" for material in scene.materials])
        self._is_masked = masked[scene.material_index]
        # Embree's primitive numbers count opaque triangles only.
        self._triangle_of = np.flatnonzero(~blended[scene.material_index]).astype(np.int32)
        self._embree = EmbreeScene(robust=True)
        self._is_empty = len(self._triangle_of) == 0
        if not self._is_empty:
            vertices = (scene.vertices_m - self._centre_m).astype(np.float32)
            TriangleMesh(self._embree, vertices, scene.triangles[self._triangle_of])
            self._embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first query builds it

    def first_hits(self, origin_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest triangle of each ray, alpha tests not applied.

        **Arguments:** world-space float64 `[N, 3]`; directions of any length.

        **Returns:** int32 triangle indices, -1 for none, and float32 parameters along the rays.
        """
        if self._is_empty or len(origin_m) == 0:
            return np.full(len(origin_m), -1, np.int32), np.full(len(origin_m), np.inf, np.float32)
        hits = self._embree.run(
            np.ascontiguousarray(origin_m - self._centre_m, np.float32),
            np.ascontiguousarray(direction, np.float32),
            output=True,
        )
        primitive = hits["primID"]
        return np.where(primitive >= 0, self._triangle_of[primitive], -1), hits["tfar"]

    def hit_distances_m(self, origin_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance to the first surface along unit directions; infinite where there is none. float64 `[N]`."""
        triangle, distance_m = self.first_hits(origin_m, direction)
        return np.where(triangle >= 0, distance_m.astype(np.float64), np.inf)

    def triangles(self, camera: Camera) -> np.ndarray:
        """The triangle that each pixel sees, int32 `[h, w]`, -1 for none.

        Rays start at the near plane, as a rasteriser clips there.
        """
        planes = _Planes(self.scene, camera)
        seen = np.empty((camera.viewport.height_px, camera.viewport.width_px), np.int32)

        def trace(rows: slice) -> None:
            x, y = _slopes(camera, rows)
            seen[rows] = self._visible(planes, camera, x, y).reshape(-1, seen.shape[1])

        _by_bands(camera, trace)
        return seen

    def _visible(self, planes: _Planes, camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Triangles on rays of slopes `x`, `y`, float64 `[N]`, alpha tests applied."""
        right, up, backward = camera.view_from_world[:3, :3]
        direction = x[:, None] * right + y[:, None] * up - backward
        eye_m = np.asarray(camera.eye_m, np.float64)
        triangle, _ = self.first_hits(eye_m + camera.near_m * direction, direction)
        ray = np.flatnonzero(self._is_masked[triangle] & (triangle >= 0))
        depth_m = np.zeros(len(ray))
        # The first step past a surface: some float32 roundings of the coordinates that Embree sees.
        resolution_m = 4 * float(np.finfo(np.float32).eps) * (self.scene.diagonal_m + camera.near_m)
        step_m = np.full(len(ray), resolution_m)
        last = np.full(len(ray), -1, np.int32)
        for _ in range(_LARGEST_LAYERS):
            hit = triangle[ray]
            is_again = hit == last
            # Hit again by rounding: go twice as far as before. Else start from the surface just found.
            step_m = np.where(is_again, 2 * step_m, resolution_m)
            at_m = planes.depth_m(hit, x[ray], y[ray])
            is_opaque = np.zeros(len(ray), bool)
            is_tested = (hit >= 0) & ~is_again
            is_opaque[is_tested] = planes.is_opaque(hit[is_tested], x[ray[is_tested]], y[ray[is_tested]])
            is_opaque[is_tested] |= ~self._is_masked[hit[is_tested]]
            goes_on = (hit >= 0) & ~is_opaque
            depth_m = np.maximum(np.where(is_again, depth_m, at_m), depth_m) + step_m
            ray, depth_m, step_m, last = ray[goes_on], depth_m[goes_on], step_m[goes_on], hit[goes_on]
            if len(ray) == 0:
                return triangle
            triangle[ray], _ = self.first_hits(eye_m + depth_m[:, None] * direction[ray], direction[ray])
        log.warning("%d rays met more than %d transparent surfaces; they see nothing", len(ray), _LARGEST_LAYERS)
        triangle[ray] = -1
        return triangle


def trace_view_samples(scene: Scene, camera: Camera, tracer: Tracer | None = None) -> ViewSamples:
    """What each pixel of a view sees.

    The triangle of each pixel is read from the cache, or traced and kept there; a damaged cache file is replaced.
    `tracer` holds the scene for several frames; without one it is built here, and only if the cache has no answer.
    """
    cached = cache_dir() / "view_samples" / f"{_cache_key(scene, camera)}.npy"
    triangle = _read_cached(cached, camera, scene.n_triangles)
    if triangle is None:
        triangle = (tracer or Tracer(scene)).triangles(camera)
        try:
            _write_cached(cached, triangle)
        except InputError as error:  # a cache that cannot be written costs time, not the result
            log.warning("view samples are not cached: %s", error)
    return _samples_from(scene, camera, triangle)


class _Planes:
    """The triangles of a scene in view space, float64: where the ray of a pixel meets their planes."""

    def __init__(self, scene: Scene, camera: Camera):
        matrix = camera.view_from_world
        vertices = scene.vertices_m @ matrix[:3, :3].T + matrix[:3, 3]
        self.scene = scene
        self.v0, v1, v2 = (vertices[scene.triangles[:, corner]] for corner in range(3))
        self.edge1, self.edge2 = v1 - self.v0, v2 - self.v0
        self.normal = np.cross(self.edge1, self.edge2)
        self.offset = (self.normal * self.v0).sum(axis=1)
        depths = -np.stack([self.v0[:, 2], v1[:, 2], v2[:, 2]])
        self.low_m, self.high_m = depths.min(axis=0), depths.max(axis=0)

    def depth_m(self, triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Distance along -z at which rays `(x, y, -1)` meet the planes of triangles.

        A plane seen edge-on has no answer, or a far one: the triangle's own range of depths bounds it.
        """
        normal = self.normal[triangle]
        along = normal[:, 0] * x + normal[:, 1] * y - normal[:, 2]
        low_m = self.low_m[triangle]
        depth_m = np.divide(self.offset[triangle], along, out=low_m.copy(), where=along != 0)
        return np.clip(depth_m, low_m, self.high_m[triangle])

    def is_opaque(self, triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Alpha test of alpha-tested triangles where rays meet them; `triangle` may be any, bool `[N]`."""
        opaque = np.ones(len(triangle), bool)
        index = self.scene.material_index[triangle]
        for m in np.unique(index):
            material = self.scene.materials[m]
            if material.alpha_mode != "mask":
                continue
            here = index == m
            if material.alpha_image is None or self.scene.uv is None:
                opaque[here] = material.opacity >= material.alpha_cutoff
            else:
                u, v = self._uv(triangle[here], x[here], y[here])
                opaque[here] = material.opacity * _bilinear(material.alpha_image, u, v) >= material.alpha_cutoff
        return opaque

    def _uv(self, triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Texture coordinates where rays meet triangles, float64 `[N]` each."""
        assert self.scene.uv is not None
        depth_m = self.depth_m(triangle, x, y)
        from_v0 = np.stack([x * depth_m, y * depth_m, -depth_m], axis=1) - self.v0[triangle]
        normal = self.normal[triangle]
        squared = np.maximum((normal * normal).sum(axis=1), np.finfo(np.float64).tiny)
        b1 = (np.cross(from_v0, self.edge2[triangle]) * normal).sum(axis=1) / squared
        b2 = (np.cross(self.edge1[triangle], from_v0) * normal).sum(axis=1) / squared
        b1 = np.clip(b1, 0, 1)  # the pixel's centre may lie outside by Embree's rounding
        b2 = np.clip(b2, 0, 1 - b1)
        uv0, uv1, uv2 = (self.scene.uv[self.scene.triangles[triangle, k]].astype(np.float64) for k in range(3))
        uv = uv0 + b1[:, None] * (uv1 - uv0) + b2[:, None] * (uv2 - uv0)
        return uv[:, 0], uv[:, 1]


def _bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """An image at texture coordinates, repeated; texel centres lie at `(i + 1/2) / n`."""
    height, width = image.shape
    column, row = (u % 1.0) * width - 0.5, (v % 1.0) * height - 0.5
    left, above = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    s, t = column - left, row - above
    upper = image[above % height, left % width] * (1 - s) + image[above % height, (left + 1) % width] * s
    lower = image[(above + 1) % height, left % width] * (1 - s) + image[(above + 1) % height, (left + 1) % width] * s
    return upper * (1 - t) + lower * t


def _samples_from(scene: Scene, camera: Camera, triangle: np.ndarray) -> ViewSamples:
    """Positions, normals and materials of the triangles that pixels see."""
    planes = _Planes(scene, camera)
    height, width = triangle.shape
    vectors = {name: np.zeros((height, width, 3), np.float32) for name in ("position_m", "normal", "base_colour", "emissive")}
    numbers = {name: np.zeros((height, width), np.float32) for name in ("specular", "shininess")}
    valid = np.zeros((height, width), bool)
    table = {name: _material_table(scene.materials, name) for name in ("base_colour", "emissive", "specular", "shininess")}

    def fill(rows: slice) -> None:
        x, y = _slopes(camera, rows)
        at = np.flatnonzero(triangle[rows].ravel() >= 0)
        seen, x, y = triangle[rows].ravel()[at], x[at], y[at]
        depth_m = planes.depth_m(seen, x, y)
        valid[rows].reshape(-1)[at] = (depth_m >= camera.near_m) & (depth_m <= camera.far_m)
        position = vectors["position_m"][rows].reshape(-1, 3)
        position[at] = np.stack([x * depth_m, y * depth_m, -depth_m], axis=1)
        vectors["normal"][rows].reshape(-1, 3)[at] = _facing_normals(planes.normal[seen], x, y)
        material = scene.material_index[seen]
        for name in ("base_colour", "emissive"):
            vectors[name][rows].reshape(-1, 3)[at] = table[name][material]
        for name in ("specular", "shininess"):
            numbers[name][rows].reshape(-1)[at] = table[name][material]

    _by_bands(camera, fill)
    return ViewSamples(camera=camera, triangle=triangle, valid=valid, **vectors, **numbers)


def _facing_normals(normal: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Unit normals on the side from which rays `(x, y, -1)` come; the ray's own where a triangle has no area."""
    along = normal[:, 0] * x + normal[:, 1] * y - normal[:, 2]
    length = np.sqrt((normal * normal).sum(axis=1))
    unit = normal * (np.where(along > 0, -1.0, 1.0) / np.maximum(length, np.finfo(np.float64).tiny))[:, None]
    flat = length <= np.finfo(np.float64).tiny
    if flat.any():
        back = np.stack([-x[flat], -y[flat], np.ones(int(flat.sum()))], axis=1)
        unit[flat] = back / np.linalg.norm(back, axis=1, keepdims=True)
    return unit


def _material_table(materials: tuple[Material, ...], name: str) -> np.ndarray:
    return np.array([getattr(material, name) for material in materials], np.float32)


def _slopes(camera: Camera, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """`x / depth` and `y / depth` of the pixels of some rows, float64 `[rows * w]` each."""
    x, y = camera.pixel_slopes()
    y = y[rows]
    return np.tile(x, len(y)), np.repeat(y, len(x))


def _by_bands(camera: Camera, work: Callable[[slice], None]) -> None:
    """Call `work` for bands of rows, on all cores: Embree and large NumPy operations let other threads run."""
    height, width = camera.viewport.height_px, camera.viewport.width_px
    n_rows = max(1, 2**16 // width)  # a band's float64 arrays stay in the second-level cache
    bands = [slice(row, min(row + n_rows, height)) for row in range(0, height, n_rows)]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()) as pool:
        list(pool.map(work, bands))


def _cache_key(scene: Scene, camera: Camera) -> str:
    return hashlib.sha256(f"{_VERSION} {scene.key} {camera.key}".encode()).hexdigest()


def _read_cached(path: Path, camera: Camera, n_triangles: int) -> np.ndarray | None:
    """The cached triangle indices, or None where there are none or the file is damaged.

    The file is an `.npy` with the SHA-256 of its bytes behind it.
    """
    shape = (camera.viewport.height_px, camera.viewport.width_px)
    try:
        if not path.is_file() or path.stat().st_size > 4 * shape[0] * shape[1] + 4096:
            return None
        content = path.read_bytes()
    except OSError:
        return None
    body, checksum = content[:-32], content[-32:]
    if hashlib.sha256(body).digest() != checksum:
        log.warning("%s: damaged; tracing again", path)
        return None
    triangle = np.load(io.BytesIO(body), allow_pickle=False)
    if triangle.shape != shape or triangle.dtype != np.int32 or triangle.max() >= n_triangles:
        return None
    return triangle


def _write_cached(path: Path, triangle: np.ndarray) -> None:
    body = io.BytesIO()
    np.save(body, triangle, allow_pickle=False)
    write_atomically(path, body.getvalue() + hashlib.sha256(body.getvalue()).digest())
