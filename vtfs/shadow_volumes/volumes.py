"""The shadow volumes of all triangles before one light: what is walked down a tree of samples."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vtfs.shadow_mask import ShadowFrame, ShadowPlan
from vtfs.shadow_volumes.planes import (
    EdgePlanes,
    NodePlanes,
    PlaneTable,
    Vector,
    corners,
    cross,
    dot,
    edge_planes,
    in_precision,
    length,
    minus,
    node_planes,
    plane_table,
)


class Volumes(eqx.Module):
    """The volumes of all triangles, and where samples stand to the light.

    - `origin_m`: view space, float64; what planes and samples are relative to.
    - `solid_angle`: of each triangle seen from the light, steradians; of a directional light its projected area.
    """

    edges: PlaneTable[EdgePlanes]
    nodes: PlaneTable[NodePlanes]
    safe: Bool[Array, " triangles"]
    solid_angle: Float[Array, " triangles"]
    origin_m: tuple[Float[Array, ""], ...]
    bias_m: Float[Array, ""]


def rotated(frame: ShadowFrame, v: Vector) -> Vector:
    """World axes to those of view space."""
    return tuple(
        frame.rotation[k, 0] * v[0] + frame.rotation[k, 1] * v[1] + frame.rotation[k, 2] * v[2] for k in range(3)
    )


def light_m(frame: ShadowFrame) -> Vector:
    """A point light relative to the eye, or the direction toward a directional one; view space, float64."""
    return rotated(frame, tuple(frame.light_m if frame.directional else frame.light_m - frame.eye_m))


def origin_m(frame: ShadowFrame) -> tuple[Float[Array, ""], ...]:
    """What planes and samples are relative to, in view space: a point light, else the eye."""
    return tuple(jnp.zeros(3, jnp.float64)) if frame.directional else light_m(frame)


def volumes(frame: ShadowFrame, plan: ShadowPlan, about_light: bool) -> Volumes:
    """Planes of all triangles.

    **Arguments:**

    - `about_light`: the nodes' coordinates are relative to the light, not the eye; never for a directional light.
    """
    world_origin = frame.eye_m if frame.directional else frame.light_m
    # Relative first, then turned: a scene far from its origin loses nothing.
    vertex = rotated(frame, tuple(c - world_origin[k] for k, c in enumerate(frame.vertex_m)))
    light = light_m(frame)
    edges, inward = edge_planes(vertex, frame.triangles, light, frame.directional, frame.bias_m, frame.culls_front)
    nodes = node_planes(edges, inward, vertex, frame.triangles, light, frame.directional, plan.extra, about_light)
    seen = _solid_angle(corners(vertex, frame.triangles), light, frame.directional)
    edges = in_precision(edges, plan.precision)
    return Volumes(plane_table(edges), plane_table(nodes), inward[:-1] != 0, seen, origin_m(frame), frame.bias_m)


def _solid_angle(corner: tuple[Vector, Vector, Vector], light: Vector, directional: bool) -> Float[Array, " n"]:
    """How much of the light a triangle may block (van Oosterom and Strackee 1983, Eq. 8)."""
    a, b, c = corner
    if directional:
        return jnp.abs(dot(cross(minus(b, a), minus(c, a)), light)) / 2
    size = length(a), length(b), length(c)
    below = size[0] * size[1] * size[2] + dot(a, b) * size[2] + dot(a, c) * size[1] + dot(b, c) * size[0]
    return 2 * jnp.arctan2(jnp.abs(dot(a, cross(b, c))), below)
