"""The planes of a triangle's shadow volume: exact ones for samples, padded ones for nodes.

The volume of triangle ABC and light L lies behind the triangle's plane and inside the three planes through L and an
edge (Sintorn et al. 2011, Sec. 3). Coordinates are relative to the light, in view space; for a directional light to
the eye.

**Samples** are tested in float64. An edge's normal is made from its vertices in index order, so that both triangles of
the edge get the same numbers, negated; a sample exactly in the plane counts as moved by an infinitesimal step that is
the same for every triangle. So a closed mesh is watertight, and each sample lies in exactly one of two neighbours.

**Nodes** are tested in float32 with unit normals. Their boxes are padded by what rounding may do: a node is rejected or
accepted only where every sample in it would be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Extra = Literal["off", "vertex", "silhouette"]
"""Three more planes, for rejection only: through each vertex and the light with the mean direction of the two side
planes that meet there (Sintorn et al. 2014, Sec. 3), or those of them that also hold the eye and bound the volume on
the screen (the silhouette edges of Sintorn et al. 2011, Sec. 4.2)."""

Precision = Literal["float64", "float32"]
"""Of the test of a sample against planes."""

SMALLEST_VOLUME = 1e-10
"""A triangle is left out where its signed volume with the light is below this share of the product of edge normals and
vertices that it is summed from: it is seen edge-on, or narrower than 1e-10 rad. Rounding (2^-52) then moves the border
of what is kept by at most 1e-5 of its size, and its orientation is certain."""

LEAST_HEIGHT = 1e-12
"""A triangle is left out, too, where its volume with the light is below this share of two of its edges times the
distance of a vertex: rounding is far below, and decides alone where the light is at a vertex."""

BELOW_ZERO = -1e-300
"""Below zero, above every product that is not zero, and no subnormal, which some devices take for zero."""

_BELOW_ZERO_32 = -2e-38
"""The same in float32."""

PAD = 16 * 2.0**-24
"""Relative error bound of a float32 plane test: under eight roundings, each 2^-24, of every product; doubled."""

Vector = tuple[Array, ...]
"""Components x, y and z."""


class EdgePlanes(eqx.Module):
    """Exact planes, float64, one entry a triangle and a last one that holds no sample.

    - `normal`: inward normals of the planes opposite vertex A, B and C, three components each; zero where the triangle
      casts nothing. Their dot products with a sample, divided by their sum, are barycentric coordinates.
    - `offset`: of these planes; zero for a point light.
    - `least`: a sample is inside of a plane where its product is above this: 0, or just below it where the tie-break
      says
      that a sample in the plane is inside.
    - `face`: normal of the triangle's plane, pointing away from the light. The sum of the other three says the same of
      a point light, but far from it carries the square of its distance as rounding.
    - `behind`: a sample is behind the plane where the face's product is above this.
    """

    normal: tuple[Vector, ...]
    offset: tuple[Float[Array, " n"], ...]
    least: tuple[Float[Array, " n"], ...]
    face: Vector
    behind: Float[Array, " n"]


class NodePlanes(eqx.Module):
    """Planes for culling, float32, one entry a triangle and a last one that every node rejects.

    - `side`: unit inward normals of the three side planes; `face`: unit normal of the triangle's plane.
    - `extra`: three more planes through the light, zero where there is none; empty if they are off.
    - `offset`: of the side planes, the face and the extra planes; of the face alone where the rest hold the origin.
    """

    side: tuple[Vector, ...]
    face: Vector
    extra: tuple[Vector, ...]
    offset: tuple[Float[Array, " n"], ...]


def dot(a: Vector, b: Vector) -> Float[Array, "*n"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def corners(vertex_m: Vector, triangles: Int[Array, "n 3"]) -> tuple[Vector, Vector, Vector]:
    """Vertices A, B and C of each triangle: one gather."""
    gathered = jnp.stack(vertex_m)[:, triangles]
    return tuple(tuple(gathered[c, :, k] for c in range(3)) for k in range(3))  # type: ignore[return-value]


def with_none(triangles: Int[Array, "n 3"]) -> Int[Array, "n_and_1 3"]:
    """And one more, without area."""
    return jnp.concatenate([triangles, jnp.zeros((1, 3), triangles.dtype)])


def times(a: Vector, s: Float[Array, "*n"]) -> Vector:
    return a[0] * s, a[1] * s, a[2] * s


def length(a: Vector) -> Float[Array, "*n"]:
    return jnp.sqrt(dot(a, a))


def _pick(which: Bool[Array, "*n"], a: Vector, b: Vector) -> Vector:
    return jnp.where(which, a[0], b[0]), jnp.where(which, a[1], b[1]), jnp.where(which, a[2], b[2])


def edge_planes(
    vertex_m: Vector,
    triangles: Int[Array, "n 3"],
    light_m: Vector,
    directional: bool,
    bias_m: Float[Array, ""],
    culls_front: Bool[Array, ""],
) -> tuple[EdgePlanes, Float[Array, " n_and_1"]]:
    """Exact planes of all volumes.

    **Arguments:**

    - `vertex_m`: float64, relative to the light (directional: to the eye), in view space; `light_m`: a directional
      light's
      unit direction, else unused.
    - `culls_front`: leave out triangles that face the light.

    **Returns:** the planes, and the orientation of each triangle and of none at the end: -1 where its front
    (counter-clockwise) faces the light, 1 where it turns away, 0 where it has no volume: edge-on, without area, or of
    uncertain orientation.
    """
    # One without area at the end: everything comes out with an entry that holds nothing, and is copied for none.
    triangles = with_none(triangles)
    corner = corners(vertex_m, triangles)
    index = tuple(triangles[:, k] for k in range(3))
    normals, offsets = [], []
    for k in range(3):
        first, second = (k + 1) % 3, (k + 2) % 3
        in_order = index[first] < index[second]
        low, high = _pick(in_order, corner[first], corner[second]), _pick(in_order, corner[second], corner[first])
        normal = cross(light_m, minus(low, high)) if directional else _through_light(low, high)
        sign = jnp.where(in_order, 1.0, -1.0)
        normals.append(times(normal, sign))
        offsets.append(dot(normal, low) * sign if directional else None)
    face = cross(minus(corner[1], corner[0]), minus(corner[2], corner[0]))
    volume = -dot(face, light_m) if directional else dot(face, corner[0])
    bound = sum(length(normals[k]) * length(corner[k]) for k in range(3))
    safe = (jnp.abs(volume) > SMALLEST_VOLUME * bound) & jnp.isfinite(bound)
    if not directional:
        # Where the light is at a vertex the bound vanishes, and the volume is rounding.
        edge_1, edge_2 = minus(corner[1], corner[0]), minus(corner[2], corner[0])
        safe = safe & (jnp.abs(volume) > LEAST_HEIGHT * length(edge_1) * length(edge_2) * length(corner[0]))
    # Counter-clockwise as seen from the light: it sees the front.
    safe = safe & ~(culls_front & (volume < 0))
    inward = jnp.where(safe, jnp.where(volume > 0, 1.0, -1.0), 0.0)

    normals = [times(normal, inward) for normal in normals]
    least = [jnp.where(first_is_positive(normal), BELOW_ZERO, 0.0) for normal in normals]
    behind = (dot(face, corner[0]) + bias_m * volume if directional else volume) * inward
    planes = EdgePlanes(
        tuple(normals),
        tuple(offset * inward for offset in offsets) if directional else (),
        tuple(least),
        times(face, inward),
        jnp.where(safe, behind, jnp.inf),
    )
    return planes, inward


def _through_light(low: Vector, high: Vector) -> Vector:
    """`low x high`. Of a light far from an edge the vertices are nearly parallel: their product would carry the
    square of the distance as rounding, one with the edge itself the distance alone."""
    edge = minus(high, low)
    return cross(low, _pick(dot(edge, edge) < dot(high, high), edge, high))


def in_precision(planes: EdgePlanes, precision: Precision) -> EdgePlanes:
    """The planes as a test in another precision reads them: rounded, ties broken as before."""
    if precision == "float64":
        return planes
    least = tuple(jnp.where(value < 0, jnp.float32(_BELOW_ZERO_32), jnp.float32(0)) for value in planes.least)
    return eqx.tree_at(lambda p: p.least, jax.tree.map(lambda c: c.astype(jnp.float32), planes), least)


def inside(planes: EdgePlanes, sample: Vector, moved: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    """Does a sample lie in a volume? Shapes broadcast; exact up to the rounding of float64.

    **Arguments:**

    - `sample`: float64, relative to the light. NaN lies in no volume.
    - `moved`: bias over the distance to a point light; a directional light's is part of the planes.
    """
    holds = jnp.bool_(True)
    for k, normal in enumerate(planes.normal):
        distance = dot(normal, sample)
        if planes.offset:
            distance = distance - planes.offset[k]
        holds = holds & (distance > planes.least[k])
    # A sample moved along its line to the light stays on its side of the edges.
    behind = dot(planes.face, sample)
    return holds & ((behind if planes.offset else behind * (1 - moved)) > planes.behind)


def node_planes(
    planes: EdgePlanes,
    inward: Float[Array, " n_and_1"],
    vertex_m: Vector,
    triangles: Int[Array, "n 3"],
    light_m: Vector,
    directional: bool,
    extra: Extra,
    about_light: bool,
) -> NodePlanes:
    """Planes for culling from the exact ones.

    **Arguments:**

    - `light_m`: float64, relative to the eye; a directional light's unit direction.
    - `about_light`: nodes are given relative to the light: side planes hold the origin. Otherwise relative to the eye.
    """

    units = [unit(normal) for normal in planes.normal]
    corner = corners(vertex_m, with_none(triangles))
    face = unit(cross(minus(corner[1], corner[0]), minus(corner[2], corner[0])))
    away = -dot(face, light_m) if directional else dot(face, corner[0])
    face = times(face, jnp.where(away < 0, -1.0, 1.0))
    scale = (dot(face, corner[0]) + dot(face, corner[1]) + dot(face, corner[2])) / 3
    offsets = [scale]
    extras: list[Vector] = []
    if extra == "vertex":
        for k in range(3):
            a, b = units[(k + 1) % 3], units[(k + 2) % 3]
            total = (a[0] + b[0], a[1] + b[1], a[2] + b[2])
            extras.append(_pick(length(total) > 1e-6, unit(total), times(total, jnp.zeros_like(scale))))
    elif extra == "silhouette":
        seen = corner if directional else tuple(tuple(c + o for c, o in zip(v, light_m, strict=True)) for v in corner)
        extras = [_silhouette(light_m, seen, k) for k in range(3)]
    if not about_light:
        if directional:
            sides = [_overlength(offset, normal) for offset, normal in zip(planes.offset, planes.normal, strict=True)]
            more = [dot(normal, corner[k]) for k, normal in enumerate(extras)] if extra == "vertex" else None
        else:
            sides = [dot(unit, light_m) for unit in units]
            offsets = [scale + dot(face, light_m)]
            more = [dot(normal, light_m) for normal in extras] if extra == "vertex" else None
        more = [jnp.zeros_like(scale) for _ in extras] if more is None else more
        offsets = [*sides, *offsets, *more]
    at = 0 if about_light else 3
    offsets[at] = jnp.where(inward != 0, offsets[at], jnp.inf)

    def narrow(v: Vector) -> Vector:
        return tuple(c.astype(jnp.float32) for c in v)  # type: ignore[return-value]

    return NodePlanes(
        tuple(map(narrow, units)),  # type: ignore[arg-type]
        narrow(face),
        tuple(map(narrow, extras)),
        tuple(offset.astype(jnp.float32) for offset in offsets),
    )


def unit(v: Vector) -> Vector:
    size = length(v)
    return times(v, jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 0.0))


def first_is_positive(v: Vector) -> Bool[Array, " n"]:
    """Is the first component that is not zero positive? On that side a sample in the plane is moved."""
    return (v[0] > 0) | ((v[0] == 0) & ((v[1] > 0) | ((v[1] == 0) & (v[2] > 0))))


def _overlength(value: Float[Array, " n"], v: Vector) -> Float[Array, " n"]:
    size = length(v)
    return jnp.where(size > 0, value / jnp.where(size > 0, size, 1.0), 0.0)


def _silhouette(light_m: Vector, seen: tuple[Vector, ...], k: int) -> Vector:
    """The plane through eye, light and vertex `k`, if both other vertices lie on one side of it; else zero."""
    shape = seen[k][0].shape
    light = tuple(jnp.broadcast_to(c, shape) for c in light_m)
    normal = unit(cross(light, seen[k]))  # type: ignore[arg-type]
    a, b = (dot(normal, seen[j]) / jnp.maximum(length(seen[j]), 1e-300) for j in ((k + 1) % 3, (k + 2) % 3))
    least, most = jnp.minimum(a, b), jnp.maximum(a, b)
    # Certain signs only: 1e-9 is far above the rounding of float64, and far below a pixel.
    positive, negative = (least > -1e-14) & (most > 1e-9), (most < 1e-14) & (least < -1e-9)
    return times(normal, jnp.where(positive, 1.0, jnp.where(negative, -1.0, 0.0)))


Range = tuple[Float[Array, "*n"], Float[Array, "*n"]]


def box_range(normal: Vector, offset: Float[Array, "*n"] | None, box: tuple[Array, ...]) -> Range:
    """Least and greatest distance of a box from a plane; `box`: centre x, y, z and padded half extents."""
    middle = normal[0] * box[0] + normal[1] * box[1] + normal[2] * box[2]
    reach = jnp.abs(normal[0]) * box[3] + jnp.abs(normal[1]) * box[4] + jnp.abs(normal[2]) * box[5]
    if offset is None:
        return middle - reach, middle + reach
    pad = PAD * jnp.abs(offset)
    return middle - reach - (offset + pad), middle + reach - (offset - pad)


def frustum_range(normal: Vector, offset: Float[Array, "*n"] | None, part: tuple[Array, ...]) -> Range:
    """The same for a part of the view: a rectangle of slopes x / depth and y / depth between two depths.

    This is the box in normalised device coordinates of Sintorn et al. 2011, which is linear in a plane. `part`: centre
    of
    both slopes and least depth, padded half extents of both slopes and greatest depth.
    """
    middle = normal[0] * part[0] + normal[1] * part[1] - normal[2]
    reach = jnp.abs(normal[0]) * part[3] + jnp.abs(normal[1]) * part[4] + jnp.abs(normal[2]) * PAD
    low, high = middle - reach, middle + reach
    low, high = jnp.minimum(part[2] * low, part[5] * low), jnp.maximum(part[2] * high, part[5] * high)
    if offset is None:
        return low, high
    pad = PAD * jnp.abs(offset)
    return low - (offset + pad), high - (offset - pad)


def test_nodes(planes: NodePlanes, node: tuple[Array, ...], is_frustum: bool, bias_m) -> tuple[Array, Array, Array]:
    """Reject, accept or refine nodes against volumes; shapes broadcast.

    **Returns:** whether a node is neither rejected by the four planes nor accepted, whether the extra planes keep it,
    and
    whether it is accepted: every sample in it lies in the volume.
    """
    distance_range = frustum_range if is_frustum else box_range
    everywhere = len(planes.offset) > 1
    met = accepted = None
    for k, normal in enumerate((*planes.side, planes.face)):
        offset = planes.offset[k] if everywhere else (planes.offset[0] if k == 3 else None)
        low, high = distance_range(normal, offset, node)
        # Comparisons with NaN are false: nodes without samples are not met.
        is_met, is_inside = high >= 0, low > (bias_m if k == 3 else 0)
        met = is_met if met is None else met & is_met
        accepted = is_inside if accepted is None else accepted & is_inside
    kept = None
    for k, normal in enumerate(planes.extra):
        _, high = distance_range(normal, planes.offset[4 + k] if everywhere else None, node)
        kept = high >= 0 if kept is None else kept & (high >= 0)
    assert met is not None and accepted is not None
    accepted = accepted & met
    refined = met & ~accepted
    return refined, refined if kept is None else refined & kept, accepted


Planes = TypeVar("Planes", EdgePlanes, NodePlanes)


class PlaneTable(eqx.Module, Generic[Planes]):
    """All planes as one array, a row a triangle: a gather loads what lies together."""

    values: Float[Array, "n components"]
    layout: Planes = eqx.field(static=True)

    def at(self, triangle: Int[Array, "*n"]) -> Planes:
        """The planes of some triangles."""
        leaves, structure = jax.tree.flatten(self.layout)
        columns = jnp.moveaxis(self.values.at[triangle].get(mode="promise_in_bounds"), -1, 0)
        return jax.tree.unflatten(
            structure, [column.astype(leaf.dtype) for column, leaf in zip(columns, leaves, strict=True)]
        )


def plane_table(planes: Planes) -> PlaneTable[Planes]:
    leaves, structure = jax.tree.flatten(planes)
    layout = jax.tree.unflatten(structure, [_Dtype(leaf.dtype) for leaf in leaves])
    columns = jnp.stack([leaf.astype(leaves[0].dtype) for leaf in leaves])
    # Stacked and turned, two sweeps in order: stacked as rows, every number would be written by itself.
    return PlaneTable(jax.lax.optimization_barrier(columns).T, layout)


@dataclass(frozen=True)
class _Dtype:
    dtype: np.dtype
