"""Stencil shadow volumes: the polygons around volumes, counted along the line from the eye to each sample.

Each polygon is walked down the tree of tiles as a volume seen from the eye: a sample has the polygon before it where
it lies in its cone and beyond its plane. So nothing is rasterised, and no polygon meets every sample. Sides are drawn
for silhouette edges where two triangles share an edge, and for every edge where they do not, twice where both of two
triangles need them (Sintorn et al. 2011, Sec. 5).
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vtfs.bounds import Aabb
from vtfs.gbuffer import Positions
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan, Stencil
from vtfs.shadow_volumes.hierarchy import Hierarchy, node_table
from vtfs.shadow_volumes.merge import mask_of
from vtfs.shadow_volumes.planes import (
    BELOW_ZERO,
    SMALLEST_VOLUME,
    EdgePlanes,
    NodePlanes,
    Precision,
    Vector,
    corners,
    cross,
    dot,
    edge_planes,
    first_is_positive,
    in_precision,
    inside,
    length,
    minus,
    plane_table,
    times,
    unit,
)
from vtfs.shadow_volumes.ptsv import over_tiles
from vtfs.shadow_volumes.sample_tiles import SampleTiles, in_runs, sample_tiles, tile_order
from vtfs.shadow_volumes.volumes import Volumes, light_m, origin_m, rotated
from vtfs.shadow_volumes.walk import Walk, count_volumes


class Polygons(eqx.Module):
    """Triangles with vertices that may lie at infinity, and where a line from the eye crosses them: in (1) or out (-1).

    - `vertex`: eye-relative position, or direction where `finite` is 0; `index`: of each triangle's vertices.
    - `crossing`: 0 where a polygon is not drawn.
    """

    vertex: Vector
    finite: Float[Array, " vertices"]
    index: Int[Array, "polygons 3"]
    crossing: Int[Array, " polygons"]


class StencilPolygons(eqx.Module):
    """All polygons of all volumes.

    - `casts`: triangles that have a volume; `around_eye`: volumes that hold the eye.
    """

    polygons: Polygons
    casts: Bool[Array, " triangles"]
    around_eye: Int[Array, ""]


class StencilWalk(eqx.Module):
    """How often a line from the eye to each sample of each item enters and leaves volumes, and what it took."""

    entered: Int[Array, "items lanes"]
    left: Int[Array, "items lanes"]
    walk: Walk


class PolygonCounts(eqx.Module):
    """What is drawn over each sample, whatever the stencil: `is_set` tells the shadow from it.

    - `around_eye`: volumes that hold the eye. `adding`, `taking`: polygons that add to the stencil, and take from it.
    """

    around_eye: Int[Array, ""]
    adding: Int[Array, "*samples"]
    taking: Int[Array, "*samples"]


def is_set(counts: PolygonCounts, stencil: Stencil, starts_around_eye: bool) -> Bool[Array, "*samples"]:
    """Is a sample's stencil not zero in the end? For arrays of JAX or NumPy.

    **Arguments:**

    - `starts_around_eye`: the stencil starts with the volumes around the eye; never for z-fail.
    """
    added = counts.around_eye * starts_around_eye + counts.adding
    if stencil == "saturate":  # all that add are drawn first, and leave no more than the largest value
        return (added > counts.taking) & (counts.taking < _LARGEST)
    if stencil == "wrap":
        return (added - counts.taking) % (_LARGEST + 1) != 0
    return added != counts.taking


def stencil_mask(frame: ShadowFrame, plan: ShadowPlan, by_failing: bool) -> ShadowMask:
    """Shadows by counting the polygons before each sample (z-pass) or behind it (z-fail)."""
    polygons, hierarchy = shadow_planes(frame, plan, by_failing), shadow_build(frame, plan)
    return shadow_merge(polygons, hierarchy, shadow_traverse(polygons, hierarchy, plan, by_failing), plan, by_failing)


def count_polygons(frame: ShadowFrame, plan: ShadowPlan, by_failing: bool) -> tuple[PolygonCounts, Bool[Array, ""]]:
    """What is drawn over each sample, in runs, and whether some list overflowed: then it means nothing."""
    polygons, hierarchy = shadow_planes(frame, plan, by_failing), shadow_build(frame, plan)
    walk = shadow_traverse(polygons, hierarchy, plan, by_failing)
    samples, counts = hierarchy.samples, _over_samples(polygons, hierarchy, walk, by_failing)
    adding, taking = (in_runs(c, samples.viewport, samples.tile_px) for c in (counts.adding, counts.taking))
    return PolygonCounts(counts.around_eye, adding, taking), walk.walk.overflowed | hierarchy.overflowed


def shadow_planes(frame: ShadowFrame, plan: ShadowPlan, by_failing: bool) -> StencilPolygons:
    """Sides and, where a line from the eye to a sample may cross them, caps of all volumes, relative to the eye."""
    origin = frame.eye_m
    vertex = rotated(frame, tuple(c - origin[k] for k, c in enumerate(frame.vertex_m)))
    light, apex, zero = light_m(frame), origin_m(frame), jnp.float64(0)
    about_light = tuple(c - o for c, o in zip(vertex, apex, strict=True))
    planes, inward = edge_planes(about_light, frame.triangles, light, frame.directional, zero, frame.culls_front)
    inward = inward[:-1]
    # A parallel view sees samples that have casters between them and its eye.
    with_caps = by_failing or frame.positions.is_parallel
    polygons = _polygons(frame, vertex, light, apex, inward, with_caps)
    around_eye = jnp.sum(inside(planes, tuple(-o for o in apex), zero), dtype=jnp.int32)
    return StencilPolygons(polygons, inward != 0, around_eye)


def shadow_build(frame: ShadowFrame, plan: ShadowPlan) -> Hierarchy:
    """Tiles of the samples, each moved toward the light by the bias, in boxes."""
    samples = sample_tiles(_moved(frame, light_m(frame)), frame.receives, plan.tile_px)
    tile, _ = tile_order(samples.columns, samples.rows)
    table = node_table(_tile_boxes(samples, tile), plan.branching, is_frustum=False)
    return over_tiles(samples, table, frame.counted, is_frustum=False)


def shadow_traverse(polygons: StencilPolygons, hierarchy: Hierarchy, plan: ShadowPlan, by_failing: bool) -> StencilWalk:
    """Walk the polygons down the tree of tiles and count those before, or behind, each sample."""
    plain = replace(plan, feedback=False, extra="off", batch=0)

    def count(crossing: Array) -> tuple[Array, Walk]:
        drawn = polygons.polygons.crossing == crossing
        return count_volumes(_seen_volumes(polygons.polygons, drawn, by_failing, plan.precision), hierarchy, plain)

    # One after the other by the same code: it is compiled once.
    (entered, left), walks = jax.lax.map(count, jnp.array([1, -1], jnp.int32))
    return StencilWalk(entered, left, _together(walks))


def shadow_merge(
    polygons: StencilPolygons, hierarchy: Hierarchy, walk: StencilWalk, plan: ShadowPlan, by_failing: bool
) -> ShadowMask:
    """Samples whose stencil is not zero."""
    counts = _over_samples(polygons, hierarchy, walk, by_failing)
    shadowed = is_set(counts, plan.stencil, plan.around_eye and not by_failing)
    receives = hierarchy.samples.receives
    updates = jnp.sum(jnp.where(receives, counts.adding + counts.taking, 0), dtype=jnp.int64)
    drawn = polygons.polygons
    # Of one direction after the other, and gone by now: their shapes are known.
    seen = jax.eval_shape(lambda drawn: _seen_volumes(drawn, drawn.crossing > 0, by_failing, plan.precision), drawn)
    mask = mask_of(receives & shadowed, walk.walk, polygons.casts, (drawn, seen), hierarchy)
    return eqx.tree_at(lambda mask: mask.counts.stencil_updates, mask, updates)


def _over_samples(
    polygons: StencilPolygons, hierarchy: Hierarchy, walk: StencilWalk, by_failing: bool
) -> PolygonCounts:
    """What is drawn over each sample, in tiles."""
    entered, left = (c[hierarchy.item_of_sample[:, 0]] for c in (walk.entered, walk.left))
    added, taken = (left, entered) if by_failing else (entered, left)
    return PolygonCounts(polygons.around_eye, added, taken)


_LARGEST = 255
"""Of a stencil of 8 bits."""


def _moved(frame: ShadowFrame, light: Vector) -> Positions:
    """The samples, each moved toward the light by the bias, at most onto it.

    In float64: where a light grazes a surface the bias lifts them by less than float32 can tell.
    """
    at = tuple(c.astype(jnp.float64) for c in (frame.positions.x_m, frame.positions.y_m, frame.positions.z_m))
    way = light if frame.directional else minus(light, at)
    share = frame.bias_m / jnp.maximum(length(way), frame.bias_m) if not frame.directional else frame.bias_m
    x, y, z = (a + share * w for a, w in zip(at, way, strict=True))
    return replace(frame.positions, x_m=x, y_m=y, z_m=z)


def _tile_boxes(samples: SampleTiles, tile: np.ndarray) -> Aabb:
    """Boxes of the samples of each tile, in the order of the tree; empty where there are none."""
    index = jnp.asarray(np.maximum(tile, 0))

    def extent(value: Array) -> tuple[Array, Array]:
        low = jnp.min(jnp.where(samples.receives, value, jnp.inf), axis=1)[index]
        high = jnp.max(jnp.where(samples.receives, value, -jnp.inf), axis=1)[index]
        return jnp.where(tile >= 0, low, jnp.float32(jnp.inf)), jnp.where(tile >= 0, high, jnp.float32(-jnp.inf))

    (low_x, high_x), (low_y, high_y), (low_z, high_z) = map(extent, (samples.x_m, samples.y_m, samples.z_m))
    return Aabb(low_x, low_y, low_z, high_x, high_y, high_z)


def _polygons(
    frame: ShadowFrame, vertex: Vector, light: Vector, apex: Vector, inward: Float[Array, " triangles"], with_caps: bool
) -> Polygons:
    """Sides of all volumes, each as two triangles that reach to infinity, and the caps at both ends.

    An edge's weight is the number of volumes that need it as a side, with the side on which they lie: two triangles
    that
    both face the light cancel, and at a silhouette both need it.
    """
    n_vertices = vertex[0].shape[0]
    away = tuple(jnp.broadcast_to(-c, vertex[0].shape) for c in light) if frame.directional else minus(vertex, apex)
    both = tuple(jnp.concatenate(parts) for parts in zip(vertex, away, strict=True))
    finite = jnp.concatenate([jnp.ones(n_vertices), jnp.zeros(n_vertices)])
    low, high = frame.edges[:, 0], frame.edges[:, 1]
    # A directional light has one point at infinity.
    low_far, high_far = (n_vertices + (jnp.zeros_like(e) if frame.directional else e) for e in (low, high))
    facing = -inward.astype(jnp.int32)
    weight = jnp.zeros(low.shape, jnp.int32)
    for side in (frame.edges[:, 2], frame.edges[:, 3]):
        turn = jnp.where(side % 2 == 0, 1, -1) * facing[jnp.maximum(side, 0) // 2]
        weight = weight + jnp.where(side >= 0, turn, 0)
    a, b = (tuple(c[end] for c in vertex) for end in (low, high))
    if frame.directional:
        normal = cross(light, minus(a, b))
        before = -dot(normal, a)
    else:
        normal = cross(minus(a, apex), minus(b, apex))
        before = -dot(normal, apex)
    crossing = jnp.sign(weight) * jnp.sign(before).astype(jnp.int32)
    quads = [jnp.stack([low, high, low_far], axis=1), jnp.stack([high, high_far, low_far], axis=1)]
    index = [quad for quad in quads for _ in range(2)]
    drawn = [jnp.where(jnp.abs(weight) > copy, crossing, 0) for _ in range(2) for copy in range(2)]
    if with_caps:
        v0 = tuple(c[frame.triangles[:, 0]] for c in vertex)
        e1, e2 = (minus(tuple(c[frame.triangles[:, k]] for c in vertex), v0) for k in (1, 2))
        face = cross(e1, e2)
        # The side of the eye, for a normal toward the light.
        index.append(frame.triangles)
        drawn.append(jnp.sign(dot(face, v0) * inward).astype(jnp.int32))
        if not frame.directional:
            index.append(frame.triangles + n_vertices)
            drawn.append(jnp.where(inward != 0, -1, 0))
    return Polygons(both, finite, jnp.concatenate(index), jnp.concatenate(drawn))


def _seen_volumes(polygons: Polygons, drawn: Bool[Array, " polygons"], before: bool, precision: Precision) -> Volumes:
    """The volumes of polygons as seen from the eye: beyond them, or `before` them.

    With barycentric weights that sum to the product of the face's normal over vertices at finite places, one formula
    holds for
    all polygons.
    """
    corner = corners(polygons.vertex, polygons.index)
    normals = []
    for k in range(3):
        first, second = (k + 1) % 3, (k + 2) % 3
        in_order = polygons.index[:, first] < polygons.index[:, second]
        lower = tuple(jnp.where(in_order, a, b) for a, b in zip(corner[first], corner[second], strict=True))
        upper = tuple(jnp.where(in_order, b, a) for a, b in zip(corner[first], corner[second], strict=True))
        normals.append(times(cross(lower, upper), jnp.where(in_order, 1.0, -1.0)))
    volume = dot(normals[0], corner[0])
    bound = sum(length(normals[k]) * length(corner[k]) for k in range(3))
    keeps = drawn & (jnp.abs(volume) > SMALLEST_VOLUME * bound)
    sign = jnp.where(keeps, jnp.sign(volume), 0.0)
    normals = [times(normal, sign) for normal in normals]
    weight = [polygons.finite[polygons.index[:, k]] for k in range(3)]
    face = tuple(dot(tuple(weight), tuple(normal[c] for normal in normals)) for c in range(3))
    flip = -1.0 if before else 1.0
    face, behind = times(face, jnp.float64(flip)), flip * volume * sign
    behind = jnp.where(keeps, behind, jnp.inf)

    def last(values: Array, absent: float = 0.0) -> Array:
        return jnp.concatenate([values, jnp.full(1, absent, values.dtype)])

    edges = EdgePlanes(
        tuple(tuple(map(last, normal)) for normal in normals),
        (),
        tuple(last(jnp.where(first_is_positive(normal), BELOW_ZERO, 0.0)) for normal in normals),
        tuple(map(last, face)),
        last(behind, jnp.inf),
    )
    size = length(face)
    # A cap at infinity has no plane: all samples are before it, none beyond.
    offset = jnp.where(size > 0, behind / jnp.where(size > 0, size, 1.0), behind)

    def narrow(v: Vector) -> Vector:
        return tuple(last(c).astype(jnp.float32) for c in v)

    nodes = NodePlanes(
        tuple(narrow(unit(normal)) for normal in normals), narrow(unit(face)), (),
        (last(offset, jnp.inf).astype(jnp.float32),),
    )  # fmt: skip
    edges = in_precision(edges, precision)
    zero = jnp.zeros(3, jnp.float64)
    return Volumes(plane_table(edges), plane_table(nodes), keeps, jnp.zeros(keeps.shape), tuple(zero), jnp.float64(0))


def _together(walks: Walk) -> Walk:
    """Two walks of the same tree, stacked, as one."""
    total = jax.tree.map(lambda c: jnp.sum(c, axis=0, dtype=c.dtype), walks)
    held = jnp.max(walks.counts.groups, axis=0), jnp.any(walks.overflowed)
    return eqx.tree_at(lambda walk: (walk.counts.groups, walk.overflowed), total, held)
