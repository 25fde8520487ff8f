"""What shadows every sample of a view: float64 rays against every triangle, on the device.

Independent of the algorithms: no volume, no plane, no tree; a ray from the sample to the light against each triangle
(Möller and Trumbore 1997), in world axes, relative to the light. `vtfs.shadow_references.brute_force` asks another
question in NumPy (which side of four planes), and a test holds one against the other.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from vtfs.shadow_casters import Casters, ShadowLight

LIT, BY_ITSELF, SHADOWED = 0, 1, 2
"""What a sample is: lit; met by the triangle that it lies on alone, which counts as lit; shadowed by another."""

CHUNK = 32
"""Triangles that one kernel tests, one after the other: reduced over as an axis, they took thirty times as long."""

SAMPLES_AT_ONCE = 2**20
PADDED_TO = 2**18
"""Samples, where there are more, to a multiple of so many: few programs."""

LEAST_HEIGHT = 1e-12
"""A light lies in a triangle's plane where its height above it is less than this share of its farthest corner's
distance: rounding, which has no inside."""

Vector = tuple[Float[Array, "*n"], ...]


def answers(
    points_m: np.ndarray,
    own: np.ndarray,
    casters: Casters,
    light: ShadowLight,
    bias_m: float,
    origin_m: np.ndarray,
    casts: np.ndarray | None = None,
) -> np.ndarray:
    """`LIT`, `BY_ITSELF` or `SHADOWED`, uint8 `[n]`.

    **Arguments:**

    - `points_m`: float64 `[n, 3]`, relative to `origin_m`, not turned; `own`: the caster that each lies on, -1: none.
    - `casts`: which casters there are, bool `[T]`; all unless given.
    """
    if not casters.n_triangles:
        return np.zeros(len(points_m), np.uint8)
    toward = light.homogeneous
    about = np.asarray(origin_m, np.float64) if light.directional else toward[:3]
    start = points_m + (np.asarray(origin_m, np.float64) - about)
    if light.directional:
        way = np.broadcast_to(toward[:3], start.shape)
        start = start + bias_m * way
    else:
        distance = np.linalg.norm(start, axis=1, keepdims=True)
        left = np.maximum(distance - bias_m, 0) / np.maximum(distance, 1e-300)
        start = start * left
        way = -start
    triangle = _sent(casters, about, light, casts)
    found = np.zeros(len(points_m), np.uint8)
    with jax.enable_x64(True):
        triangle = jax.device_put(triangle)
        for first in range(0, len(points_m), SAMPLES_AT_ONCE):
            some = slice(first, first + SAMPLES_AT_ONCE)
            n = len(start[some])
            pad = [(0, -n % (PADDED_TO if n > PADDED_TO else 1_024))]
            sent_start, sent_way = (tuple(np.pad(v[some, c], pad) for c in range(3)) for v in (start, way))
            met = _met(
                sent_start,
                sent_way,
                np.pad(own[some].astype(np.int32), pad, constant_values=-1),
                triangle,
                light.directional,
            )
            found[some] = np.asarray(met)[:n]
    return found


def _sent(casters: Casters, about_m: np.ndarray, light: ShadowLight, casts: np.ndarray | None) -> np.ndarray:
    """A corner and two edges from it, in chunks, `[chunks, 9, CHUNK]`; NaN, which no comparison holds for, where there
    is no inside."""
    corner = casters.vertices_m[casters.triangles] - about_m
    edges = corner[:, 1:] - corner[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])
    if light.directional:
        height = normal @ light.homogeneous[:3]
        size = np.linalg.norm(normal, axis=1)
    else:
        height = (normal * corner[:, 0]).sum(axis=1)
        size = np.linalg.norm(normal, axis=1) * np.linalg.norm(corner, axis=2).max(axis=1)
    has_inside = np.abs(height) > LEAST_HEIGHT * size
    if casts is not None:
        has_inside &= casts
    rows = np.full((-(-len(corner) // CHUNK) * CHUNK, 9), np.nan)
    sent = np.concatenate([corner[:, :1], edges], axis=1).reshape(-1, 9)
    rows[: len(corner)] = np.where(has_inside[:, None], sent, np.nan)
    return np.ascontiguousarray(rows.reshape(-1, CHUNK, 9).transpose(0, 2, 1))


@functools.partial(jax.jit, static_argnames="directional")
def _met(
    start: Vector, way: Vector, own: Int[Array, " n"], triangle: Float[Array, "chunks 9 chunk"], directional: bool
) -> UInt8[Array, " n"]:
    """Chunk by chunk, so that nothing of samples times triangles is ever kept."""

    def one_chunk(found, k):
        rows = triangle[k]
        for lane in range(CHUNK):
            a, ab, ac = (tuple(rows[3 * v + i, lane] for i in range(3)) for v in range(3))
            holds = _ray_meets(start, way, a, ab, ac, directional)
            here = jnp.where(holds, jnp.where(k * CHUNK + lane == own, BY_ITSELF, SHADOWED), LIT)
            found = jnp.maximum(found, here.astype(jnp.int32))
        return found, None

    chunks = jnp.arange(triangle.shape[0], dtype=jnp.int32)
    found, _ = jax.lax.scan(one_chunk, jnp.zeros(own.shape, jnp.int32), chunks)
    return found.astype(jnp.uint8)


def _ray_meets(start: Vector, way: Vector, a: Vector, ab: Vector, ac: Vector, directional: bool):
    """Does `start + t way` meet the triangle before the light, at 0 < t < 1 (directional: 0 < t)? Edges count."""
    across = _cross(way, ac)
    det = _dot(ab, across)
    sign = jnp.where(det < 0, -1.0, 1.0)
    det = det * sign
    from_a = _minus(start, a)
    u = _dot(from_a, across) * sign
    turned = _cross(from_a, ab)
    v = _dot(way, turned) * sign
    t = _dot(ac, turned) * sign
    holds = (det > 0) & (u >= 0) & (v >= 0) & (u + v <= det) & (t > 0)
    return holds if directional else holds & (t < det)


def _minus(a: Vector, b: Vector) -> Vector:
    return tuple(p - q for p, q in zip(a, b, strict=True))


def _dot(a: Vector, b: Vector):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
