"""What shadows are right: float64 brute force, Embree's shadow rays, and why a mask may differ from them."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight

if TYPE_CHECKING:
    from vtfs.view_samples import ViewSamples

EDGE_BAND_RAD = 1e-5
"""About edges, seen from the light; of a light further than the casters' extent 1e-5 of that extent, as of a
directional one: from 1e5 extents away the whole scene lies within 1e-5 rad of an edge, and all would be excused."""

PLANE_BAND_BIASES = 2.0
_ON_PLANE_BIASES = 0.1
"""A sample this near to a plane lies on it: float32 positions are off by at most 0.02 biases of 1e-5 of the extent."""

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


def moved_points(points_m: np.ndarray, light: np.ndarray, bias_m: float) -> tuple[np.ndarray, np.ndarray]:
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
    moved, _ = moved_points(points_m, homogeneous, bias_m)
    planes, behind = volume_planes(casters, origin, homogeneous)
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


def volume_planes(
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
    if light[3] != 0:  # with a vertex at the light all of that vanishes, and the volume is rounding
        edges = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
        size = np.maximum(size, edges * np.linalg.norm(a, axis=1))
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
        start, way = moved_points(points_m, homogeneous - np.append(origin, 0) * homogeneous[3], bias_m)
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

    - `near_edge`: within 1e-5 rad of a caster's edge, seen from the light (of a directional one, or one further than
      the extent: 1e-5 of the extent).
    - `near_plane`: not that, but within twice the bias of the plane of a caster that covers it and that it does not lie
      on: a surface that shadows itself is an error.
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
        if _edge_angle(point, corners, homogeneous, extent_m) <= _edge_band_rad(point, homogeneous, extent_m):
            near_edge += 1
        elif _plane_distance(point, corners, homogeneous, _ON_PLANE_BIASES * bias_m) <= PLANE_BAND_BIASES * bias_m:
            near_plane += 1
        else:
            errors.append(index)
    return Mismatches(near_edge, near_plane, len(errors), np.array(errors, np.int64))


def is_excused(
    points_m: np.ndarray,
    shadowed: np.ndarray,
    casters: Casters,
    light: ShadowLight,
    bias_m: float,
    own_triangle: np.ndarray,
    origin_m: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """May an answer differ from the reference because its sample lies in a band, bool `[n]` each?

    The stricter form of `classify`, for samples that lie on casters. There every edge and every plane excuse what is
    near to them. Here an answer is right if a sample moved within the band has it: interior edges do not excuse light
    (a crack between two triangles is an error), nor a surface's own plane that it shadows itself. An edge within
    1e-5 rad excuses shadow: of a triangle seen edge-on it may be too thin to be met by moving.

    **Arguments:** as of `brute_force`; `shadowed`: the answers, `[n]`, each of them the reference's opposite.

    **Returns:** excused by an edge; excused by a plane.
    """
    origin = np.zeros(3) if origin_m is None else np.asarray(origin_m, np.float64)
    homogeneous = light.homogeneous - np.append(origin, 0) * light.homogeneous[3]
    way = homogeneous[:3] - homogeneous[3] * points_m
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    way = way / np.maximum(distance, 1e-300)
    extents = np.full_like(distance, casters.extent_m)
    reach = EDGE_BAND_RAD * (extents if light.directional else np.minimum(distance, extents))
    # Any axis that is not along the way.
    across = np.cross(way, np.eye(3)[np.abs(way).argmin(axis=1)])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    down = np.cross(way, across)

    def is_right(moved_m: np.ndarray, moved_bias_m: float) -> np.ndarray:
        # Moved, a sample may lie below its own triangle.
        return brute_force(moved_m, casters, light, moved_bias_m, origin, own_triangle) == shadowed

    by_edge = np.zeros(len(points_m), bool)
    for share in (0.25, 1.0):
        for angle in 2 * np.pi * np.arange(8) / 8:
            step = share * reach * (np.cos(angle) * across + np.sin(angle) * down)
            by_edge |= is_right(points_m + step, bias_m)
    left = np.flatnonzero(shadowed & ~by_edge)
    if not light.directional:
        band_rad = (reach / np.maximum(distance, 1e-300))[left]
        by_edge[left] = _is_near_an_edge(-way[left], casters, origin + homogeneous[:3], band_rad)
    by_plane = np.zeros(len(points_m), bool)
    for biases in (1 - PLANE_BAND_BIASES, 0.0, 1 + PLANE_BAND_BIASES):
        by_plane |= is_right(points_m, biases * bias_m)
    return by_edge, by_plane


def _edge_band_rad(point: np.ndarray, light: np.ndarray, extent_m: float) -> float:
    if light[3] == 0:
        return EDGE_BAND_RAD
    return EDGE_BAND_RAD * min(1.0, extent_m / max(float(np.linalg.norm(light[:3] - point)), 1e-300))


def _is_near_an_edge(way: np.ndarray, casters: Casters, light_m: np.ndarray, band_rad: np.ndarray) -> np.ndarray:
    """Do unit directions from a light pass within bands `[n, 1]` of an edge, bool `[n]`? As `_edge_angle`, all at
    once."""
    near = np.zeros(len(way), bool)
    corner = [casters.vertices_m[casters.triangles[:, k]] - light_m for k in range(3)]
    corner = [v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300) for v in corner]
    n_ways = max(1, _PAIRS_AT_ONCE // max(1, casters.n_triangles))
    for first in range(0, len(way), n_ways):
        some, found = way[first : first + n_ways], np.zeros(min(n_ways, len(way) - first), bool)
        band = band_rad[first : first + n_ways]
        for k in range(3):
            a, b = corner[k], corner[(k + 1) % 3]
            found |= ((some @ a.T) >= np.cos(band)).any(axis=1)
            normal = np.cross(a, b)
            size = np.linalg.norm(normal, axis=1)
            normal = normal / np.maximum(size, 1e-300)[:, None]
            abreast = (some @ np.cross(normal, a).T >= 0) & (some @ np.cross(b, normal).T >= 0) & (size > 1e-14)
            found |= (abreast & (np.abs(some @ normal.T) <= band)).any(axis=1)
        near[first : first + n_ways] = found
    return near


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


def _plane_distance(point: np.ndarray, corners: list[np.ndarray], light: np.ndarray, on_plane_m: float) -> float:
    """Least distance from the planes of triangles, along the way to the light, where that way crosses the triangle.

    Planes within `on_plane_m` are those of the sample's own surface: the bias lifts it off them for certain, and were
    they to excuse it, every answer would be right.
    """
    a, b, c = corners
    normal = np.cross(b - a, c - a)
    way = light[:3] - light[3] * point
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        off = ((a - point) * normal).sum(1)
        t = off / (normal @ way)
        at = point + t[:, None] * way
        inside = np.abs(off) > on_plane_m * np.linalg.norm(normal, axis=1)
        for first, second in ((a, b), (b, c), (c, a)):
            inside &= (np.cross(second - first, at - first) * normal).sum(1) >= 0
        distance = np.abs(t) * np.linalg.norm(way)
    return float(np.min(np.where(inside & np.isfinite(distance), distance, np.inf), initial=np.inf))
