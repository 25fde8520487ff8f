"""Lights as the device reads them, and the lists that say which clusters each may reach."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vtfs.bit_lists import last_not_above
from vtfs.bounds import SLACK, Cone, Sphere

if TYPE_CHECKING:
    from vtfs.camera import Camera
    from vtfs.lights import Lights

POINT_COLUMNS, SPOT_COLUMNS = 8, 16

_COS_SLACK = 1e-6


class ViewLights(eqx.Module):
    """Lights in view space, float32.

    - `row`: what shading reads, one row a light: x, y, z, 1/range, r, g, b, range; where there are spots
      eight more: direction x, y, z, 1/(cos_inner - cos_outer), cos_outer, cosine and sine of the cone to cull with
      and padding.
    """

    row: Float[Array, "lights columns"]

    @property
    def n_lights(self) -> int:
        return self.row.shape[0]

    def spheres(self, light_cutoff: Float[Array, ""]) -> Sphere:
        """Where each light's window is above `light_cutoff`; lights without range reach nothing.

        Grown by the rounding of the centre: a box that is a single sample has no slack of its own.
        """
        x, y, z, range_m = (self.row[:, c] for c in (0, 1, 2, 7))
        radius_m = range_m * reach_of_cutoff(light_cutoff) + SLACK * (jnp.abs(x) + jnp.abs(y) + jnp.abs(z))
        return Sphere(jnp.where(range_m > 0, x, jnp.inf), y, z, radius_m)

    @property
    def cones(self) -> Cone | None:
        """Where spots shine, a little wider; lights that shine everywhere have cones of 180 degrees. `None` where no
        light is a spot."""
        if self.row.shape[1] == POINT_COLUMNS:
            return None
        return Cone(*(self.row[:, c] for c in (8, 9, 10, 13, 14)))


def reach_of_cutoff(light_cutoff: Float[Array, ""]) -> Float[Array, ""]:
    """Share of the range within which the window `(1 - (d/range)**4)**2` is above the cut-off."""
    # 1 - sqrt(c) without its cancellation near 1.
    return jnp.sqrt(jnp.sqrt((1 - light_cutoff) / (1 + jnp.sqrt(light_cutoff))))


def view_lights(lights: Lights, camera: Camera) -> ViewLights:
    """Upload lights in a camera's view space; transformed in float64, so that only the distance to the
    eye limits their precision, not the distance to the origin."""
    relative = lights.relative_to(camera.view_from_world)
    if not relative.n_lights:
        # XLA cannot gather from nothing: one black light without range stands for none.
        return ViewLights(jax.device_put(np.eye(1, POINT_COLUMNS, 3, dtype=np.float32)))
    lit = relative.range_m > 0
    columns = [
        relative.position_m,
        # A light without range is black, and its inverse finite: 0 * inf would be NaN at its centre.
        np.where(lit, 1 / np.where(lit, relative.range_m, 1.0), 1.0)[:, None],
        np.where(lit[:, None], relative.colour, 0.0),
        relative.range_m[:, None],
    ]
    if relative.is_spot.any():
        # Wider by what shading's cosine may be off in float32; the sine would cancel in float32 where cones are narrow.
        cos_cull = np.clip(np.where(relative.is_spot, relative.cos_outer - _COS_SLACK, -1.0), -1, 1)
        columns += [
            relative.direction,
            (1 / (relative.cos_inner - relative.cos_outer))[:, None],
            relative.cos_outer[:, None],
            cos_cull[:, None],
            np.sqrt(1 - cos_cull * cos_cull)[:, None],
            np.zeros((relative.n_lights, SPOT_COLUMNS - POINT_COLUMNS - 7)),
        ]
    return ViewLights(jax.device_put(np.concatenate(columns, axis=1).astype(np.float32)))


class LightLists(eqx.Module):
    """The lights that may reach each cluster: `index[offset[c] : offset[c] + count[c]]`.

    - `total`: what is needed, also where it is more than `index` can hold.
    - `overflowed`: lights are missing; such a result is thrown away, never used.
    """

    offset: Int[Array, " clusters"]
    count: Int[Array, " clusters"]
    index: Int[Array, " capacity"]
    total: Int[Array, ""]
    overflowed: Bool[Array, ""]


class AssignCounts(eqx.Module):
    """What an assignment did: exact, and small enough for 32 bits; the host multiplies.

    - `node_rows`: (cluster, inner node) pairs visited on each level of the tree, the root first.
    - `short_rows`: those of them whose node is the last of its level, which may lack children.
    - `leaf_rows`, `short_leaf_rows`: the same for the nodes that hold lights.
    """

    node_rows: Int[Array, " levels"]
    short_rows: Int[Array, " levels"]
    leaf_rows: Int[Array, ""]
    short_leaf_rows: Int[Array, ""]


def lists_from_pairs(
    cluster: Int[Array, " pairs"],
    light: Int[Array, " pairs"],
    total: Int[Array, ""],
    overflowed: Bool[Array, ""],
    n_clusters_capacity: int,
) -> LightLists:
    """Lists from pairs that are already in order of clusters: each list starts at its first pair."""
    ordered = jnp.where(jnp.arange(cluster.shape[0]) < total, cluster, n_clusters_capacity)
    # Where each cluster ends: after the last pair of a cluster not above it; none of them: at 0.
    with_start = jnp.concatenate([jnp.full(1, -1, jnp.int32), ordered])
    end = last_not_above(with_start, jnp.arange(n_clusters_capacity, dtype=jnp.int32))
    offset = jnp.concatenate([jnp.zeros(1, jnp.int32), end[:-1]])
    return LightLists(offset, end - offset, light, total, overflowed)
