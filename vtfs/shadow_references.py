"""What shadows are right: float64 brute force, Embree's shadow rays, and why a mask may differ from them."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight

if TYPE_CHECKING:
    from vtfs.view_samples import ViewSamples

EDGE_BAND_RAD = 1e-5
PLANE_BAND_BIASES = 2.0

_PAIRS_AT_ONCE = 2**22


def view_points_m(samples: ViewSamples, mask: np.ndarray) -> np.ndarray:
    """World-space float64 positions `[n, 3]` of the samples of a mask `[h, w]`, relative to the eye."""
    return samples.position_m[mask].astype(np.float64) @ samples.camera.view_from_world[:3, :3]


def facing_light(casters: Casters, light: ShadowLight) -> np.ndarray:
    """Triangles whose front (counter-clockwise) faces the light, bool `[T]`."""
    a, b, c = (casters.vertices_m[casters.triangles[:, k]] for k in range(3))
    toward = light.homogeneous[:3] - light.homogeneous[3] * a
    return (np.cross(b - a, c - a) * toward).sum(axis=1) > 0


def kept_casters(casters: Casters, light: ShadowLight, front_faces: FrontFaces) -> Casters:
    """The subset that casts: the references use the same one as the algorithm under test."""
    if front_faces == "cast":
        return casters
    return Casters(casters.vertices_m, casters.triangles[~facing_light(casters, light)])


def _moved(points_m: np.ndarray, light: np.ndarray, bias_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points moved toward the light by the bias, at most onto it; and the way from there to the light."""
    if light[3] == 0:
        moved = points_m + bias_m * light[:3]
        return moved, np.broadcast_to(light[:3], points_m.shape)
    way = light[:3] - points_m
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    share = np.divide(bias_m, distance, out=np.ones_like(distance), where=distance > bias_m)
    return points_m + way * share, way * (1 - share)


def brute_force(
    points_m: np.ndarray,
    casters: Casters,
    light: ShadowLight,
    bias_m: float,
    origin_m: np.ndarray | None = None,
    own_triangle: np.ndarray | None = None,
) -> np.ndarray:
    """Shadowed points, bool `[n]`: every triangle against every point in float64; points on an edge are inside.

    **Arguments:**

    - `points_m`: float64 `[n, 3]`, relative to `origin_m` (the world's origin unless given), not turned.
    - `own_triangle`: the triangle that each point lies on, which does not shadow it; -1 for none.
    """
    origin = np.zeros(3) if origin_m is None else np.asarray(origin_m, np.float64)
    shadowed = np.zeros(len(points_m), bool)
    if not casters.n_triangles or not len(points_m):
        return shadowed
    homogeneous = light.homogeneous - np.append(origin, 0) * light.homogeneous[3]
    moved, _ = _moved(points_m, homogeneous, bias_m)
    planes, behind = _volume_planes(casters, origin, homogeneous)
    moved = moved if light.directional else moved - homogeneous[:3]
    n_points = max(1, min(len(points_m), _PAIRS_AT_ONCE // casters.n_triangles))

    def test(first: int) -> None:
        some = moved[first : first + n_points]
        held = some @ planes[3].T > behind[3]
        for normal, offset in zip(planes[:3], behind[:3], strict=True):
            held &= some @ normal.T >= offset
        if own_triangle is not None:
            own = own_triangle[first : first + n_points]
            held[np.flatnonzero(own >= 0), own[own >= 0]] = False
        shadowed[first : first + n_points] = held.any(axis=1)

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        list(threads.map(test, range(0, len(points_m), n_points)))
    return shadowed


def brute_force_on_device(
    points_m: np.ndarray, casters: Casters, light: ShadowLight, bias_m: float, origin_m: np.ndarray | None = None
) -> np.ndarray:
    """`brute_force` by XLA: a GPU tests every sample of a large view in a second."""
    origin = np.zeros(3) if origin_m is None else np.asarray(origin_m, np.float64)
    if not casters.n_triangles or not len(points_m):
        return np.zeros(len(points_m), bool)
    homogeneous = light.homogeneous - np.append(origin, 0) * light.homogeneous[3]
    moved, _ = _moved(points_m, homogeneous, bias_m)
    moved = moved if light.directional else moved - homogeneous[:3]
    planes, behind = _volume_planes(casters, origin, homogeneous)
    n_points = -(-len(moved) // _POINTS_STEP) * _POINTS_STEP
    n_triangles = -(-casters.n_triangles // _TRIANGLES_STEP) * _TRIANGLES_STEP
    more = n_triangles - casters.n_triangles
    normals = np.pad(np.stack(planes).transpose(0, 2, 1), ((0, 0), (0, 0), (0, more)))
    offsets = np.pad(np.stack(behind), ((0, 0), (0, more)), constant_values=np.inf)
    padded = np.pad(moved, ((0, n_points - len(moved)), (0, 0)))
    with jax.enable_x64(True):
        return np.asarray(_held_by_some(padded.T, normals, offsets))[: len(moved)]


_POINTS_STEP, _TRIANGLES_STEP = 2**16, 2**12


@jax.jit
def _held_by_some(
    point: Float[Array, "3 points"], normals: Float[Array, "4 3 triangles"], offsets: Float[Array, "4 triangles"]
) -> Bool[Array, " points"]:
    def step(i, held):
        some = (jax.lax.dynamic_slice_in_dim(c, i * _TRIANGLES_STEP, _TRIANGLES_STEP, c.ndim - 1) for c in
                (normals, offsets))  # fmt: skip
        normal, offset = some
        x, y, z = point
        inside = True
        for k in range(4):
            n = normal[k]
            distance = n[0][:, None] * x + n[1][:, None] * y + n[2][:, None] * z
            inside = inside & (distance > offset[k][:, None] if k == 3 else distance >= offset[k][:, None])
        return held | jnp.any(inside, axis=0)

    n_steps = offsets.shape[1] // _TRIANGLES_STEP
    return jax.lax.fori_loop(0, n_steps, step, jnp.zeros(point.shape[1], bool))


def _volume_planes(
    casters: Casters, origin_m: np.ndarray, light: np.ndarray
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Inward normals `[T, 3]` of the three side planes and the triangle's, and the products that points inside exceed.

    Of a triangle that the light sees edge-on, or that has no area, no point is inside.
    """
    a, b, c = (casters.vertices_m[casters.triangles[:, k]] - origin_m for k in range(3))
    if light[3] == 0:
        sides = [np.cross(light[:3], first - second) for first, second in ((b, c), (c, a), (a, b))]
        offsets = [(n * v).sum(1) for n, v in zip(sides, (b, c, a), strict=True)]
    else:
        a, b, c = a - light[:3], b - light[:3], c - light[:3]
        sides = [np.cross(b, c), np.cross(c, a), np.cross(a, b)]
        offsets = [np.zeros(len(a))] * 3
    face = np.cross(b - a, c - a)
    away = -(face @ light[:3]) if light[3] == 0 else (face * a).sum(axis=1)
    # What is seen edge-on up to rounding has no inside: its orientation would be noise.
    size = sum(np.linalg.norm(n, axis=1) * np.linalg.norm(v, axis=1) for n, v in zip(sides, (a, b, c), strict=True))
    sign = np.where(np.abs(away) > 1e-12 * size, np.sign(away), 0.0)[:, None]
    height = np.where(sign[:, 0] != 0, (face * a).sum(axis=1) * sign[:, 0], np.inf)
    planes = tuple(n * sign for n in (*sides, face))
    return planes, (*(offset * sign[:, 0] for offset in offsets), height)


class ShadowRays:
    """Casters in Embree, for occlusion queries; robust, float32, relative to the middle of the casters."""

    def __init__(self, casters: Casters):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        used = casters.vertices_m[casters.triangles.ravel()] if casters.n_triangles else np.zeros((1, 3))
        self._middle_m = (used.min(axis=0) + used.max(axis=0)) / 2
        self._extent_m = casters.extent_m
        self._scene = EmbreeScene(robust=True)
        self._is_empty = casters.n_triangles == 0
        if not self._is_empty:
            TriangleMesh(self._scene, (casters.vertices_m - self._middle_m).astype(np.float32), casters.triangles)
            self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first query builds it

    def shadowed(
        self, points_m: np.ndarray, light: ShadowLight, bias_m: float, origin_m: np.ndarray | None = None
    ) -> np.ndarray:
        """Shadowed points, bool `[n]`; arguments as of `brute_force`, on all cores."""
        if self._is_empty or not len(points_m):
            return np.zeros(len(points_m), bool)
        origin = np.zeros(3) if origin_m is None else np.asarray(origin_m, np.float64)
        homogeneous = light.homogeneous
        start, way = _moved(points_m, homogeneous - np.append(origin, 0) * homogeneous[3], bias_m)
        if light.directional:
            way = way * (4 * self._extent_m + 4 * np.abs(start + origin - self._middle_m).max())
        start = np.ascontiguousarray(start + (origin - self._middle_m), np.float32)
        way = np.ascontiguousarray(way, np.float32)
        n_threads = os.cpu_count() or 1
        bounds = np.linspace(0, len(start), n_threads + 1).astype(int)

        def query(k: int) -> np.ndarray:
            some = slice(bounds[k], bounds[k + 1])
            return self._scene.run(start[some], way[some], dists=1.0, query="OCCLUDED") == 0

        with ThreadPoolExecutor(n_threads) as threads:
            return np.concatenate(list(threads.map(query, range(n_threads))))


@dataclass(frozen=True)
class Mismatches:
    """Samples where a mask differs from a reference, by reason.

    - `near_edge`: within 1e-5 rad of a caster's edge, seen from the light (directional: 1e-5 of the extent).
    - `near_plane`: not that, but within twice the bias of the plane of a caster that covers it.
    - `errors`: neither; `error_points`: their indices.
    """

    near_edge: int
    near_plane: int
    errors: int
    error_points: np.ndarray

    @property
    def total(self) -> int:
        return self.near_edge + self.near_plane + self.errors


def classify(
    points_m: np.ndarray,
    differs: np.ndarray,
    casters: Casters,
    light: ShadowLight,
    bias_m: float,
    origin_m: np.ndarray | None = None,
) -> Mismatches:
    """Sort the points where a mask differs from its reference; arguments as of `brute_force`."""
    origin = np.zeros(3) if origin_m is None else np.asarray(origin_m, np.float64)
    corners = [casters.vertices_m[casters.triangles[:, k]] - origin for k in range(3)]
    homogeneous = light.homogeneous - np.append(origin, 0) * light.homogeneous[3]
    extent_m = max(casters.extent_m, 1e-300)
    near_edge, near_plane, errors = 0, 0, []
    for index in np.flatnonzero(differs):
        point = points_m[index]
        if _edge_angle(point, corners, homogeneous, extent_m) <= EDGE_BAND_RAD:
            near_edge += 1
        elif _plane_distance(point, corners, homogeneous) <= PLANE_BAND_BIASES * bias_m:
            near_plane += 1
        else:
            errors.append(index)
    return Mismatches(near_edge, near_plane, len(errors), np.array(errors, np.int64))


def _edge_angle(point: np.ndarray, corners: list[np.ndarray], light: np.ndarray, extent_m: float) -> float:
    """Least angle at the light between a point and the edges of triangles; one without area has edges too."""
    least = np.inf
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if light[3] == 0:
            axis = light[:3]
            flat = [v - (v @ axis)[:, None] * axis for v in corners]
            target = point - (point @ axis) * axis
            for k in range(3):
                a, edge = flat[k], flat[(k + 1) % 3] - flat[k]
                t = np.clip(((target - a) * edge).sum(1) / np.maximum((edge * edge).sum(1), 1e-300), 0, 1)
                least = min(least, np.min(np.linalg.norm(a + t[:, None] * edge - target, axis=1), initial=np.inf))
            return least / extent_m
        way = point - light[:3]
        way /= max(np.linalg.norm(way), 1e-300)
        seen = [v - light[:3] for v in corners]
        for k in range(3):
            a, b = seen[k], seen[(k + 1) % 3]
            # Angle to the arc between both directions: to its great circle where the point lies abreast, else to an
            # end.
            a = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)
            b = b / np.maximum(np.linalg.norm(b, axis=1, keepdims=True), 1e-300)
            normal = np.cross(a, b)
            length = np.linalg.norm(normal, axis=1)
            unit = normal / np.maximum(length, 1e-300)[:, None]
            to_ends = np.minimum(np.linalg.norm(a - way, axis=1), np.linalg.norm(b - way, axis=1))
            abreast = (np.cross(unit, a) @ way >= 0) & (np.cross(b, unit) @ way >= 0) & (length > 1e-14)
            angle = np.where(abreast, np.abs(unit @ way), to_ends)
            least = min(least, float(np.min(angle, initial=np.inf)))
    return least


def _plane_distance(point: np.ndarray, corners: list[np.ndarray], light: np.ndarray) -> float:
    """Least distance from the planes of triangles, along the way to the light, where that way crosses the triangle."""
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    way = light[:3] - light[3] * point
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = ((a - point) * normal).sum(1) / (normal @ way)
        at = point + t[:, None] * way
        inside = np.ones(len(a), bool)
        for first, second in ((a, b), (b, c), (c, a)):
            inside &= (np.cross(second - first, at - first) * normal).sum(1) >= 0
        distance = np.abs(t) * np.linalg.norm(way)
    return float(np.min(np.where(inside & np.isfinite(distance), distance, np.inf), initial=np.inf))
