"""Where surfaces face: bins of normals that split clusters, cones around normals, and lights behind all of a cone."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vtfs.bounds import SLACK, Sphere

ConeKind = Literal["implicit", "explicit"]
Components = tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]

_COS_SLACK = 4e-6
"""Cones are this much wider in the cosine: it and the axis are right to 1e-6 in float32."""

_TINY = 1e-30  # below the square of any normal's length


class NormalCones(eqx.Module):
    """Cones that hold the normals of each cluster: unit axes and the cosine of the half angle."""

    x: Float[Array, "*clusters"]
    y: Float[Array, "*clusters"]
    z: Float[Array, "*clusters"]
    cos: Float[Array, "*clusters"]


def bins_per_cell(normal_bins: Int[Array, ""]) -> Int[Array, ""]:
    """Bins that `normal_bins` subdivisions of the six faces of a cube make; 1 where there are none."""
    return jnp.maximum(6 * normal_bins * normal_bins, 1)


def bin_of_normal(normal_bins: Int[Array, ""], normal: Components) -> Int[Array, "*n"]:
    """Bin of each normal: face of the cube, then row and column on it (Olsson et al. 2012, Sec. 3.2).

    **Arguments:**

    - `normal`: of any length.

    **Returns:** bins in `[0, bins_per_cell)`.
    """
    x, y, z = (component.astype(jnp.float32) for component in normal)
    ax, ay, az = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    along_x, along_y = (ax >= ay) & (ax >= az), ay >= az
    major = jnp.where(along_x, x, jnp.where(along_y, y, z))
    u, v = jnp.where(along_x, y, x), jnp.where(along_x | along_y, z, y)
    face = jnp.where(along_x, 0, jnp.where(along_y, 1, 2)) * 2 + (major < 0)

    def cell(side):
        share = 0.5 * (side / jnp.maximum(jnp.abs(major), _TINY) + 1)
        return jnp.clip((share * normal_bins).astype(jnp.int32), 0, jnp.maximum(normal_bins - 1, 0))

    found = (face.astype(jnp.int32) * normal_bins + cell(v)) * normal_bins + cell(u)
    return jnp.where(normal_bins > 0, found, 0)


def cones_of_bins(normal_bins: Int[Array, ""], index: Int[Array, " clusters"]) -> NormalCones:
    """The cone around each bin: through its farthest corner; all directions where there are no bins."""
    bins = jnp.maximum(normal_bins, 1)
    column, row, face = index % bins, index // bins % bins, index // (bins * bins)
    low_u, low_v, size = 2 * column / bins - 1, 2 * row / bins - 1, 2 / bins
    u, v = low_u + size / 2, low_v + size / 2
    # A bin is a rectangle on a plane: of directions within it the corners are farthest from any axis.
    inverse = jax.lax.rsqrt(1 + u * u + v * v)
    cos = jnp.full(index.shape, jnp.inf)
    for du in (0, 1):
        for dv in (0, 1):
            cu, cv = low_u + du * size, low_v + dv * size
            cos = jnp.minimum(cos, (1 + u * cu + v * cv) * inverse * jax.lax.rsqrt(1 + cu * cu + cv * cv))
    axis, major = face // 2, jnp.where(face % 2 == 1, -inverse, inverse)
    u, v = u * inverse, v * inverse
    x = jnp.where(axis == 0, major, u)
    y = jnp.where(axis == 1, major, jnp.where(axis == 0, u, v))
    z = jnp.where(axis == 2, major, v)
    return NormalCones(x, y, z, jnp.where(normal_bins > 0, cos - _COS_SLACK, -1.0))


def cones_of_samples(
    normal: Components, in_block: Bool[Array, "blocks 32"], cluster: Int[Array, " blocks"]
) -> NormalCones:
    """The cone around the normals of each cluster's samples: their mean, and the normal farthest from it.

    **Arguments:**

    - `normal`: `[blocks, 32]` each, of any length; only those `in_block` count.
    - `cluster`: of each block; out of range where unused. Clusters and blocks have one capacity.
    """
    x, y, z = (component.astype(jnp.float32) for component in normal)
    inverse = jax.lax.rsqrt(jnp.maximum(x * x + y * y + z * z, _TINY))
    unit = (x * inverse, y * inverse, z * inverse)

    def total(component):
        of_block = jnp.sum(jnp.where(in_block, component, 0), axis=1)
        return jnp.zeros(cluster.shape).at[cluster].add(of_block, mode="drop")

    x, y, z = (total(component) for component in unit)
    inverse = jax.lax.rsqrt(jnp.maximum(x * x + y * y + z * z, _TINY))
    axis = (x * inverse, y * inverse, z * inverse)
    along = sum(n * a.at[cluster].get(mode="clip")[:, None] for n, a in zip(unit, axis, strict=True))
    of_block = jnp.min(jnp.where(in_block, along, 1), axis=1)
    # Where normals cancel there is no axis: 0 . n = 0 is a cone of half the directions, which would be wrong.
    cos = jnp.ones(cluster.shape).at[cluster].min(of_block, mode="drop")
    has_axis = x * x + y * y + z * z > _TINY
    return NormalCones(*axis, jnp.where(has_axis, cos - _COS_SLACK, -1.0))


def may_face(cones: NormalCones, bounds: Sphere, light: Sphere) -> Bool[Array, "*pairs"]:
    """Can a light be in front of a surface within the bounds, whose normal lies in the cone?

    Olsson et al. 2012, Sec. 3.3: not if omega > pi/2 + alpha + delta, with omega the angle between the cone's axis
    and the direction to the light, alpha the cone's half angle, delta that under which the light sees the bounds
    (here a sphere). Without angles: `axis . v < -(sin(alpha) sqrt(v.v - r**2) + cos(alpha) r)` where
    `r < |v| cos(alpha)`, else alpha + delta is a right angle or more.

    Rounding: positions are off by 2^-23 of their magnitude, the products by as much of |v|; `SLACK` is eight times
    that, and cones are wider than their normals.
    """
    vx, vy, vz = light.x_m - bounds.x_m, light.y_m - bounds.y_m, light.z_m - bounds.z_m
    distance2 = vx * vx + vy * vy + vz * vz
    size = jnp.abs(bounds.x_m) + jnp.abs(bounds.y_m) + jnp.abs(bounds.z_m)
    size += jnp.abs(light.x_m) + jnp.abs(light.y_m) + jnp.abs(light.z_m)
    radius_m = bounds.radius_m + 2 * SLACK * size
    sin = jnp.sqrt(jnp.maximum(1 - cones.cos * cones.cos, 0))
    along = vx * cones.x + vy * cones.y + vz * cones.z
    tangent = jnp.sqrt(jnp.maximum(distance2 - radius_m * radius_m, 0))
    is_behind = along < -(sin * tangent + cones.cos * radius_m)
    is_small = (cones.cos > 0) & (radius_m * radius_m < distance2 * cones.cos * cones.cos)
    return ~(is_behind & is_small)
