"""Primary rays: the triangles that each pixel sees, found by Embree, and where its ray meets their planes."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from vtfs.camera import Camera
from vtfs.scene import Scene

log = logging.getLogger("vtfs.view_samples")

_LARGEST_LAYERS = 4096  # surfaces that one ray may step through


class Tracer:
    """A scene in Embree, built once for all frames of a path.

    Embree sees float32 coordinates relative to the centre of the scene. Triangles of `blend` materials are in a scene
    of their own: they hide nothing.
    """

    def __init__(self, scene: Scene):
        self.scene = scene
        low, high = scene.bounds_m
        self._centre_m = (low + high) / 2
        blended = np.array([material.alpha_mode == "blend" for material in scene.materials])[scene.material_index]
        masked = np.array([material.alpha_mode == "mask" for material in scene.materials])
        self._is_masked = masked[scene.material_index]
        vertices = (scene.vertices_m - self._centre_m).astype(np.float32)
        self._solid = _EmbreeScene(vertices, scene.triangles, np.flatnonzero(~blended))
        self._blended = _EmbreeScene(vertices, scene.triangles, np.flatnonzero(blended))

    def hit_distances_m(self, origin_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance to the first solid surface along unit directions; infinite where there is none. float64 `[N]`."""
        triangle, distance_m = self.first_hits(origin_m, direction)
        return np.where(triangle >= 0, distance_m.astype(np.float64), np.inf)

    def triangles(self, camera: Camera, planes: Planes | None = None) -> np.ndarray:
        """The solid triangle that each pixel sees, int32 `[h, w]`, -1 for none.

        Rays start at the near plane, as a rasteriser clips there. `planes`, if the caller has them already.
        """
        found = planes or Planes(self.scene, camera)
        seen = np.full((camera.viewport.height_px, camera.viewport.width_px), -1, np.int32)

        def trace(rows: slice) -> None:
            rays = _Rays(camera, rows, self._centre_m)
            band = seen[rows].reshape(-1)
            first, _ = self._solid.first_hits(*rays.at(camera.near_m))
            masked = np.flatnonzero((first >= 0) & self._is_masked[first])
            band[...] = first
            band[masked] = -1
            # Rays that met an alpha-tested surface go on until one passes its test.
            hits = self._march(self._solid, found, rays, masked, np.inf, only_first=True, hit=first[masked])
            for ray, triangle, _ in hits:
                band[ray] = triangle

        by_bands(camera, trace)
        return seen

    def all_hits(
        self, camera: Camera, planes: Planes, until_m: np.ndarray, blended: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Every surface that the rays of pixels meet: the `blend` ones, or the solid ones that pass their alpha test.

        **Arguments:**

        - `until_m`: `[h, w]`, the depth at which each ray ends.

        **Returns:** pixel, triangle and depth of each hit, int64, int32 and float64 `[hits]`; those of a pixel
        nearest first.
        """
        found: dict[int, list[tuple[np.ndarray, ...]]] = {}

        def trace(rows: slice) -> None:
            rays = _Rays(camera, rows, self._centre_m)
            first_pixel = rows.start * camera.viewport.width_px
            scene = self._blended if blended else self._solid
            ends_m = until_m[rows].reshape(-1)
            hits = self._march(scene, planes, rays, np.arange(len(rays.x)), ends_m, only_first=False)
            found[rows.start] = [(ray + first_pixel, triangle, depth_m) for ray, triangle, depth_m in hits]

        by_bands(camera, trace)
        nothing = np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0)
        steps = [nothing, *(step for start in sorted(found) for step in found[start])]
        pixel, triangle, depth_m = (np.concatenate(column) for column in zip(*steps, strict=True))
        order = np.argsort(pixel, kind="stable")
        return pixel[order], triangle[order], depth_m[order]

    def first_hits(self, origin_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest solid triangle of each ray, alpha tests not applied.

        **Arguments:** world-space float64 `[N, 3]`; directions of any length.

        **Returns:** int32 triangle indices, -1 for none, and float32 parameters along the rays.
        """
        return self._solid.first_hits(
            np.ascontiguousarray(origin_m - self._centre_m, np.float32), np.ascontiguousarray(direction, np.float32)
        )

    def _march(
        self,
        scene: _EmbreeScene,
        planes: Planes,
        rays: _Rays,
        ray: np.ndarray,
        until_m: np.ndarray | float,
        only_first: bool,
        hit: np.ndarray | None = None,
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Steps of rays from surface to surface: ray, triangle and depth of those that pass their alpha test.

        **Arguments:**

        - `ray`: which of `rays` to follow.
        - `until_m`: depth at which they end, of all or `[len(rays)]`.
        - `only_first`: a ray ends at the first surface that passes.
        - `hit`: the triangles that the rays meet first, if the caller has them already.
        """
        ends_m = np.broadcast_to(until_m, len(rays.x))
        # The first step past a surface: some float32 roundings of the coordinates that Embree sees.
        resolution_m = 4 * float(np.finfo(np.float32).eps) * (self.scene.diagonal_m + rays.near_m)
        past_m, step_m = np.full(len(ray), rays.near_m), np.full(len(ray), resolution_m)
        last = np.full(len(ray), -1, np.int32)
        for _ in range(_LARGEST_LAYERS):
            if hit is None:
                hit, _ = scene.first_hits(*rays.at(past_m, ray))
            on = np.flatnonzero(hit >= 0)
            ray, past_m, step_m, last, hit = (values[on] for values in (ray, past_m, step_m, last, hit))
            if len(ray) == 0:
                return
            x, y = rays.x[ray], rays.y[ray]
            is_again = hit == last  # by rounding: go twice as far as before
            depth_m = planes.depth_m(hit, x, y)
            is_over = depth_m > ends_m[ray]
            is_there = ~is_again & ~is_over & planes.is_opaque(hit, x, y, depth_m)
            yield ray[is_there], hit[is_there], depth_m[is_there]
            step_m = np.where(is_again, 2 * step_m, resolution_m)
            past_m = np.maximum(np.where(is_again, past_m, depth_m), past_m) + step_m
            on = np.flatnonzero(~is_over & ~is_there if only_first else ~is_over)
            ray, past_m, step_m, last = (values[on] for values in (ray, past_m, step_m, hit))
            hit = None
        log.warning("%d rays met more than %d surfaces; the others are not seen", len(ray), _LARGEST_LAYERS)


class _EmbreeScene:
    """Some triangles in Embree, which numbers only those."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray, chosen: np.ndarray):
        self.is_empty = len(chosen) == 0
        self._triangle_of = chosen.astype(np.int32)
        if not self.is_empty:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene

            self._embree = EmbreeScene(robust=True)
            TriangleMesh(self._embree, vertices, triangles[chosen])
            self._embree.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first query builds it

    def first_hits(self, origin_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangle and parameter of the first hit of each ray; float32 `[N, 3]`, C-contiguous."""
        if self.is_empty or len(origin_m) == 0:
            return np.full(len(origin_m), -1, np.int32), np.full(len(origin_m), np.inf, np.float32)
        hits = self._embree.run(origin_m, direction, output=True)
        primitive = hits["primID"]
        return np.where(primitive >= 0, self._triangle_of[primitive], -1), hits["tfar"]


class _Rays:
    """The rays of some rows of pixels: slopes `x`, `y`, float64 `[N]`; a depth of 1 along each.

    In a parallel projection slopes are where rays start, and all have one direction.
    """

    def __init__(self, camera: Camera, rows: slice, centre_m: np.ndarray):
        self.near_m = camera.near_m
        self.x, self.y = pixel_rays(camera, rows)
        self._right, self._up, self._backward = camera.view_from_world[:3, :3]
        self._eye_m = np.asarray(camera.eye_m, np.float64)
        self._centre_m = centre_m
        self._is_parallel = camera.is_orthographic

    def at(self, depth_m: np.ndarray | float, ray: np.ndarray | slice = np.s_[:]) -> tuple[np.ndarray, np.ndarray]:
        """Points at a depth on some rays, relative to the centre, and the rays' directions: float32 `[N, 3]`, world
        axes. Float64 until then."""
        x, y = self.x[ray], self.y[ray]
        origin_m, direction = np.empty((2, len(x), 3), np.float32)
        for k in range(3):  # a column at a time: NumPy is slow on rows of three
            aside = x * self._right[k] + y * self._up[k]
            along = -self._backward[k] if self._is_parallel else aside - self._backward[k]
            start_m = self._eye_m[k] + aside if self._is_parallel else self._eye_m[k]
            direction[:, k] = along
            origin_m[:, k] = start_m + depth_m * along - self._centre_m[k]
        return origin_m, direction


class Planes:
    """The triangles of a scene in view space, float64: where the ray of a pixel meets their planes.

    One row a triangle, as pixels gather whole rows: normal (not unit) x, y, z, normal . v0, least and greatest depth.
    """

    def __init__(self, scene: Scene, camera: Camera):
        matrix = camera.view_from_world
        vertices = scene.vertices_m @ matrix[:3, :3].T + matrix[:3, 3]
        v0, v1, v2 = (vertices[scene.triangles[:, corner]] for corner in range(3))
        normal = np.cross(v1 - v0, v2 - v0)
        depths = -np.stack([v0[:, 2], v1[:, 2], v2[:, 2]])
        offset = (normal * v0).sum(axis=1)
        self.scene, self._camera = scene, camera
        self.row = np.column_stack([normal, offset, depths.min(axis=0), depths.max(axis=0)])
        has_image = np.array([material.alpha_image is not None for material in scene.materials])
        textured = np.flatnonzero(has_image[scene.material_index])
        self._uv_row = np.zeros((0, 8))
        if scene.uv is not None and len(textured):
            self._row_of = np.zeros(scene.n_triangles, np.int32)
            self._row_of[textured] = np.arange(len(textured))
            corners = (v0[textured], v1[textured], v2[textured])
            self._uv_row = _uv_rows(corners, normal[textured], scene.uv[scene.triangles[textured]].astype(np.float64))

    def depth_m(self, triangle: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Distance along -z at which rays of slopes `x`, `y` meet the planes of triangles.

        A plane seen edge-on has no answer, or a far one: the triangle's own range of depths bounds it.
        """
        row = self.row[triangle]
        aside = row[:, 0] * x + row[:, 1] * y
        if self._camera.is_orthographic:
            offset, along = aside - row[:, 3], row[:, 2]
        else:
            offset, along = row[:, 3], aside - row[:, 2]
        depth_m = np.divide(offset, along, out=row[:, 4].copy(), where=along != 0)
        return np.clip(depth_m, row[:, 4], row[:, 5])

    def is_opaque(self, triangle: np.ndarray, x: np.ndarray, y: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
        """Alpha test where rays meet triangles at given depths, bool `[N]`; without an alpha test it is passed."""
        materials = self.scene.materials
        cutoff = np.array([m.alpha_cutoff if m.alpha_mode == "mask" else -np.inf for m in materials])
        masked = np.flatnonzero(np.isfinite(cutoff)[self.scene.material_index[triangle]])
        opaque = np.ones(len(triangle), bool)
        at = triangle[masked]
        alpha = self.alpha(at, x[masked], y[masked], depth_m[masked])
        opaque[masked] = alpha >= cutoff[self.scene.material_index[at]]
        return opaque

    def alpha(self, triangle: np.ndarray, x: np.ndarray, y: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
        """`opacity * alpha_image` where rays meet triangles at given depths, float64 `[N]`."""
        index = self.scene.material_index[triangle]
        alpha = np.array([material.opacity for material in self.scene.materials])[index]
        for m in np.flatnonzero(np.bincount(index, minlength=len(self.scene.materials))):
            image = self.scene.materials[m].alpha_image
            if image is None or self.scene.uv is None:
                continue
            here = np.flatnonzero(index == m)
            row = self._uv_row[self._row_of[triangle[here]]]
            width = self._camera.width_at(depth_m[here])
            rx, ry, rz = x[here] * width, y[here] * width, -depth_m[here]
            u = row[:, 0] * rx + row[:, 1] * ry + row[:, 2] * rz + row[:, 3]
            v = row[:, 4] * rx + row[:, 5] * ry + row[:, 6] * rz + row[:, 7]
            alpha[here] *= bilinear(image, u, v)
        return alpha


def _uv_rows(corners: tuple[np.ndarray, np.ndarray, np.ndarray], normal: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Texture coordinates as linear functions of the position: `u = row[0:3] . p + row[3]`, v likewise behind it.

    The barycentric weight of v1 at p is `((p - v0) x e2) . n / n . n = (p - v0) . (e2 x n) / n . n`.
    """
    v0, v1, v2 = corners
    squared = np.maximum((normal * normal).sum(axis=1), np.finfo(np.float64).tiny)[:, None]
    weight1, weight2 = np.cross(v2 - v0, normal) / squared, np.cross(normal, v1 - v0) / squared
    rows = np.empty((len(v0), 8))
    for k in range(2):
        uv0 = uv[:, 0, k]
        gradient = (uv[:, 1, k] - uv0)[:, None] * weight1 + (uv[:, 2, k] - uv0)[:, None] * weight2
        rows[:, 4 * k : 4 * k + 3] = gradient
        rows[:, 4 * k + 3] = uv0 - (gradient * v0).sum(axis=1)
    return rows


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """An image at texture coordinates, repeated; texel centres lie at `(i + 1/2) / n`."""
    height, width = image.shape
    with np.errstate(invalid="ignore"):  # a triangle without area has any coordinates
        column = np.nan_to_num(u - np.floor(u), posinf=0, neginf=0) * width - 0.5
        row = np.nan_to_num(v - np.floor(v), posinf=0, neginf=0) * height - 0.5
    left, above = np.floor(column).astype(np.int32), np.floor(row).astype(np.int32)
    s, t = column - left, row - above
    # Within one of the image: remainders of integers are slow.
    right, below = left + 1, above + 1
    left[left < 0], above[above < 0] = width - 1, height - 1
    right[right >= width], below[below >= height] = 0, 0
    texels = image.ravel()
    upper = texels[above * width + left] * (1 - s) + texels[above * width + right] * s
    lower = texels[below * width + left] * (1 - s) + texels[below * width + right] * s
    return upper * (1 - t) + lower * t


def pixel_rays(camera: Camera, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """`x / depth` and `y / depth` of the pixels of some rows (parallel: x and y), float64 `[rows * w]`."""
    x, y = camera.pixel_slopes()
    y = y[rows]
    return np.tile(x, len(y)), np.repeat(y, len(x))


def by_bands(camera: Camera, work: Callable[[slice], None]) -> None:
    """Call `work` for bands of rows, on all cores: Embree and large NumPy operations let other threads run."""
    height, width = camera.viewport.height_px, camera.viewport.width_px
    n_rows = max(1, 2**16 // width)  # a band's float64 arrays stay in the second-level cache
    bands = [slice(row, min(row + n_rows, height)) for row in range(0, height, n_rows)]
    with ThreadPoolExecutor(
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    ) as pool:
        list(pool.map(work, bands))
