"""All volumes down a tree of samples: what the algorithms of 2011 and 2014 share."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.bit_lists import last_not_above, pack_bits
from vtfs.bounds import Aabb
from vtfs.node_lists import NodeLists, Split, one_list, split
from vtfs.shadow_mask import ShadowCounts, ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.planes import (
    PAD,
    EdgePlanes,
    NodePlanes,
    PlaneTable,
    Vector,
    edge_planes,
    inside,
    node_planes,
    plane_table,
    test_nodes,
)
from vtfs.shadow_volumes.sample_tiles import SampleTiles, in_runs
from vtfs.wide_tree import build_tree, in_leaf_nodes, inner_level_nodes, n_leaf_nodes

LANES = 16
"""Triangles of a group on inner levels: both answers of their tests of a child pack into one word."""

LEAF_LANES = 4
"""Triangles of a group at the leaves: short lists waste little, and a tile's samples are loaded once for four."""

_TRIANGLES_AT_ONCE, _SAMPLES_AT_ONCE = {"cpu": 2**15}, {"cpu": 2**18}
"""Triangles listed, and pairs of a triangle and a sample, in one chunk: what stays in the caches of a CPU."""


class Volumes(eqx.Module):
    """The volumes of all triangles, and where samples stand to the light.

    - `origin_m`: view space, float64; what planes and samples are relative to.
    """

    edges: PlaneTable[EdgePlanes]
    nodes: PlaneTable[NodePlanes]
    safe: Bool[Array, " triangles"]
    origin_m: tuple[Float[Array, ""], ...]
    bias_m: Float[Array, ""]


def rotated(frame: ShadowFrame, v: Vector) -> Vector:
    """World axes to those of view space."""
    return tuple(
        frame.rotation[k, 0] * v[0] + frame.rotation[k, 1] * v[1] + frame.rotation[k, 2] * v[2] for k in range(3)
    )


def volumes(frame: ShadowFrame, plan: ShadowPlan, about_light: bool) -> Volumes:
    """Planes of all triangles.

    **Arguments:**

    - `about_light`: the nodes' coordinates are relative to the light, not the eye; never for a directional light.
    """
    zero = jnp.zeros(3, jnp.float64)
    origin = frame.eye_m if frame.directional else frame.light_m
    toward = frame.light_m if frame.directional else frame.light_m - frame.eye_m

    # Relative first, then turned: a scene far from its origin loses nothing.
    vertex = rotated(frame, tuple(c - origin[k] for k, c in enumerate(frame.vertex_m)))
    light = rotated(frame, tuple(toward))
    edges, inward = edge_planes(vertex, frame.triangles, light, frame.directional, frame.bias_m, frame.culls_front)
    nodes = node_planes(edges, inward, vertex, frame.triangles, light, frame.directional, plan.extra, about_light)
    return Volumes(
        plane_table(edges), plane_table(nodes), inward != 0, tuple(zero) if frame.directional else light, frame.bias_m
    )


class NodeTable(eqx.Module):
    """The nodes of all levels as tests read them: one row a node, its children's boxes, the root first.

    - `row`: centre and padded half extent of boxes (or parts of the view); NaN where a child does not exist.
    - `n_children`: existing ones; `n_below`: existing nodes of each level below the root, the items last.
    """

    row: Float[Array, "nodes 6 branching"]
    n_children: Int[Array, " nodes"]
    n_below: Int[Array, " levels"]
    level_nodes: tuple[int, ...] = eqx.field(static=True)


def node_table(items: Aabb, branching: int, is_frustum: bool) -> NodeTable:
    """Bound all nodes over ordered items and pad them by what float32 tests may lose.

    **Arguments:**

    - `is_frustum`: items are slopes and depths, see `frustum_range`.
    """
    n_items = items.low_x_m.shape[0]
    tree = build_tree(items, branching)
    low = [in_leaf_nodes(c, branching, jnp.inf) for c in (items.low_x_m, items.low_y_m, items.low_z_m)]
    high = [in_leaf_nodes(c, branching, -jnp.inf) for c in (items.high_x_m, items.high_y_m, items.high_z_m)]
    rows = jnp.concatenate([tree.children.astype(jnp.float32), jnp.stack([*low, *high], axis=1)])
    low, high = rows[:, :3], rows[:, 3:]
    exists = low[:, 2] <= high[:, 2]
    centre = low + (high - low) * 0.5
    half = (high - low) * (0.5 * (1 + PAD)) + PAD * (jnp.abs(low) + jnp.abs(high)) + 1e-37
    if is_frustum:
        depths = low[:, 2] * (1 - PAD), high[:, 2] * (1 + PAD)
        centre, half = centre.at[:, 2].set(depths[0]), half.at[:, 2].set(depths[1])
    row = jnp.where(exists[:, None], jnp.concatenate([centre, half], axis=1), jnp.nan)
    levels = (*inner_level_nodes(n_items, branching), n_leaf_nodes(n_items, branching))
    n_children = jnp.sum(exists, axis=1, dtype=jnp.int32)
    ends = np.cumsum(levels)
    n_below = [jnp.sum(n_children[end - nodes : end], dtype=jnp.int32) for nodes, end in zip(levels, ends, strict=True)]
    return NodeTable(row, n_children, jnp.stack(n_below), levels)


class SampleTree(eqx.Module):
    """View samples and the tree above them: what a technique walks.

    - `table`: its nodes; `tile_of_item`: of each tile or cluster that is a leaf; `item_of_sample`: which leaf a sample
      is in.
    - `n_in_tile`, `n_in_item`: samples that receive shadow, of each item's tile and of the item itself.
    - `n_items`, `n_blocks`: as in `ShadowCounts`; `overflowed`: of the tree.
    """

    samples: SampleTiles
    table: NodeTable
    tile_of_item: Int[Array, " items"]
    item_of_sample: Int[Array, "tiles lanes"]
    n_in_tile: Int[Array, " items"]
    n_in_item: Int[Array, " items"]
    n_items: Int[Array, ""]
    n_blocks: Int[Array, ""]
    overflowed: Bool[Array, ""]
    is_frustum: bool = eqx.field(static=True)


class Walk(eqx.Module):
    """What a walk found; counts as in `ShadowCounts`.

    - `shadowed`: bits of the samples of each item's tile that lie in some volume.
    """

    shadowed: UInt32[Array, "items words"]
    node_tests: Int[Array, " levels"]
    accepted: Int[Array, " levels"]
    refined: Int[Array, " levels"]
    extra: Int[Array, " levels"]
    groups: Int[Array, " levels_and_1"]
    list_length: Int[Array, " items"]
    overflowed: Bool[Array, ""]


def walk_volumes(
    volume: Volumes,
    table: NodeTable,
    samples: SampleTiles,
    tile_of_item: Int[Array, " items"],
    is_frustum: bool,
    plan: ShadowPlan,
) -> Walk:
    """Walk the volumes down the tree and test the samples of the items they reach.

    With a batch, the triangles of each in turn; what an earlier one accepted is left out of later walks where
    `feedback` is on.
    """
    n_triangles = volume.safe.shape[0]
    n_items = tile_of_item.shape[0]
    words = max(1, samples.z_m.shape[1] // 32)
    batch = plan.batch if 0 < plan.batch < n_triangles else n_triangles
    n_nodes = sum(table.level_nodes[1:]) + table.level_nodes[-1] * plan.branching
    n_levels = len(table.level_nodes)
    sample_rows = rows_of_samples(samples, volume)
    none = jnp.zeros(n_nodes, bool)

    def walk_batch(first, before: Array, bits: Array):
        member = jax.lax.dynamic_slice_in_dim(safe, first, batch)
        lists = one_list(member, LANES, batch)
        lists = NodeLists(
            jnp.where(lists.triangle == batch, n_triangles, lists.triangle + first), lists.start, lists.count
        )
        leaves, shadowed, _, counted = _to_leaves(lists, before, volume, table, is_frustum, plan, n_triangles)
        hits = _test_samples(leaves, volume.edges, sample_rows, tile_of_item, volume.origin_m, plan)
        return shadowed, bits | hits, leaves, counted

    bits = jnp.zeros((n_items, words), jnp.uint32)
    if batch == n_triangles:
        safe = volume.safe
        shadowed, bits, leaves, counted = walk_batch(jnp.int32(0), none, bits)
        node_tests, accepted, refined, extra, groups = counted
        list_length, overflowed = leaves.count[:n_items], leaves.overflowed | _too_many(groups[:-1], plan)
    else:
        n_batches = -(-n_triangles // batch)
        safe = jnp.pad(volume.safe, (0, n_batches * batch - n_triangles))

        def loop(i, state):
            shadowed, bits, sums, groups, length, overflowed = state
            before = shadowed if plan.feedback else none
            now, bits, leaves, counted = walk_batch(i * batch, before, bits)
            sums = tuple(total + part for total, part in zip(sums, counted[:4], strict=True))
            return (
                shadowed | now,
                bits,
                sums,
                jnp.maximum(groups, counted[4]),
                length + leaves.count[:n_items],
                overflowed | leaves.overflowed | _too_many(counted[4][:-1], plan),
            )

        zeros = jnp.zeros(n_levels, jnp.int64)
        state = (
            none, bits, (zeros,) * 4, jnp.zeros(n_levels + 1, jnp.int32), jnp.zeros(n_items, jnp.int32),
            jnp.bool_(False),
        )  # fmt: skip
        shadowed, bits, sums, groups, list_length, overflowed = jax.lax.fori_loop(0, n_batches, loop, state)
        node_tests, accepted, refined, extra = sums
    whole = shadowed[n_nodes - table.level_nodes[-1] * plan.branching :][:n_items]
    bits = jnp.where(whole[:, None], jnp.uint32(2**32 - 1), bits)
    return Walk(bits, node_tests, accepted, refined, extra, groups, list_length, overflowed)


def _too_many(groups: Int[Array, " levels"], plan: ShadowPlan) -> Bool[Array, ""]:
    """Do the lists of some level overflow? The root's always fit."""
    if plan.level_groups:
        return jnp.any(groups[1:] > jnp.array(plan.level_groups, jnp.int32))
    return jnp.any(groups[1:] > plan.groups)


Counted = tuple[Array, Array, Array, Array, Array]


def _to_leaves(
    lists: NodeLists,
    before: Bool[Array, " nodes"],
    volume: Volumes,
    table: NodeTable,
    is_frustum: bool,
    plan: ShadowPlan,
    absent: int,
) -> tuple[NodeLists, Bool[Array, " nodes"], Int[Array, " items"], Counted]:
    """From the list of the root to those of the items, level by level.

    **Returns:** the items' lists, which nodes below the root lie in shadow as a whole, how many triangles accept each
    item
    or a node above it, and the counts.
    """
    b, levels = plan.branching, table.level_nodes
    first_row = np.cumsum([0, *levels[:-1]]).astype(np.int32)
    # Children of a level begin here among all nodes below the root.
    first_child = np.cumsum([0, *levels[1:]]).astype(np.int32)
    chunk_groups = max(1, _TRIANGLES_AT_ONCE.get(jax.default_backend(), 0) // LANES)

    def step(lists: NodeLists, parent_shadowed, was_shadowed, level, n_children, lanes, capacity, chunk) -> Split:
        # A root with one child is no node of the tree: only the capacity's rounding made it.
        only = table.n_below[level] == 1

        def test(triangle, node):
            row = table.row.at[jnp.asarray(first_row)[level] + node].get(mode="promise_in_bounds")
            planes = jax.tree.map(lambda c: c[:, None, :], volume.nodes.at(triangle))
            refined, goes_on, accepted = test_nodes(
                planes, tuple(row[:, c, :, None] for c in range(6)), is_frustum, volume.bias_m.astype(jnp.float32)
            )
            pass_on = jnp.zeros((1, b, 1), bool).at[:, 0].set(True) & (triangle != absent)[:, None, :]
            goes_on = jnp.where(only, pass_on, goes_on)
            accepted = accepted & ~only
            # Both answers in one word: two reductions would each repeat the tests.
            shift = jnp.arange(LANES, dtype=jnp.uint32)
            both = (goes_on.astype(jnp.uint32) << shift) | (accepted.astype(jnp.uint32) << (shift + LANES))
            both = jnp.sum(both, axis=-1, dtype=jnp.uint32)
            extra = jnp.where(only, 0, jnp.sum(refined, dtype=jnp.int32))
            return both & jnp.uint32(2**LANES - 1), both >> LANES, extra

        def drop(accepted):
            if not plan.feedback:
                return jnp.zeros_like(accepted)
            return accepted | jnp.repeat(parent_shadowed, b, total_repeat_length=accepted.shape[0]) | was_shadowed

        return split(lists, test, drop, b, lanes, absent, capacity, chunk)

    def counted(lists: NodeLists, level, done: Split):
        rows = jax.lax.dynamic_slice_in_dim(table.n_children, jnp.asarray(first_row)[level], lists.count.shape[0])
        tests = jnp.sum(lists.count.astype(jnp.int64) * rows, dtype=jnp.int64)
        return (
            jnp.where(table.n_below[level] == 1, 0, tests),
            done.n_accepted,
            jnp.where(table.n_below[level] == 1, 0, done.n_refined),
            done.extra if plan.extra != "off" else jnp.zeros_like(done.extra),
            lists.n_groups,
        )

    shadowed = before
    parent, cover = jnp.zeros(1, bool), jnp.zeros(1, jnp.int32)
    counts: list[tuple[Array, ...]] = []
    if plan.level_groups or len(levels) == 1:
        for level, nodes in enumerate(levels):
            is_last = level == len(levels) - 1
            n_children = nodes * b
            at = int(first_child[level])
            kept = n_children if is_last else levels[level + 1]
            was = jnp.pad(shadowed[at : at + kept], (0, n_children - kept))
            lanes = LEAF_LANES if is_last else LANES
            capacity = plan.leaf_groups if is_last else plan.level_groups[level]
            chunk = capacity + lists.triangle.shape[0] if plan.level_groups else chunk_groups
            done = step(lists, parent, was, level, n_children, lanes, capacity, chunk)
            counts.append(counted(lists, level, done))
            parent = (jnp.repeat(parent, b, total_repeat_length=n_children) | (done.accepts > 0) | was)[:kept]
            cover = (jnp.repeat(cover, b, total_repeat_length=n_children) + done.accepts)[:kept]
            shadowed = shadowed.at[at : at + kept].set(parent)
            lists = NodeLists(done.lists.triangle, done.lists.start[: kept + 1], done.lists.count[:kept])
        totals = [jnp.stack(column) for column in zip(*counts, strict=True)]
    else:
        n_leaf, n_parents = levels[-1], levels[-2]
        pad = jnp.full((max(0, plan.groups - lists.triangle.shape[0]), LANES), absent, jnp.int32)
        triangle = jnp.concatenate([lists.triangle, pad])
        groups = triangle.shape[0]
        lists = NodeLists(
            triangle,
            jnp.concatenate([lists.start, jnp.broadcast_to(lists.start[-1], n_leaf - 1)]),
            jnp.pad(lists.count, (0, n_leaf - 1)),
        )
        parent, cover = jnp.zeros(n_leaf, bool), jnp.zeros(n_leaf, jnp.int32)
        n_inner = len(levels) - 1
        offsets = jnp.asarray(first_child)
        widths = jnp.asarray(np.array(levels[1:], np.int32))
        place = jnp.arange(n_leaf, dtype=jnp.int32)

        def inner(level, state):
            lists, parent, cover, shadowed, counts = state
            parents = NodeLists(lists.triangle, lists.start[: n_parents + 1], lists.count[:n_parents])
            n_children = n_parents * b
            own = place < widths[level]
            index = jnp.where(own, offsets[level] + place, 0)
            was = shadowed[index] & own
            was_all = jnp.pad(was, (0, max(0, n_children - n_leaf)))[:n_children]
            done = step(parents, parent[:n_parents], was_all, level, n_children, LANES, groups, chunk_groups)
            now = jnp.repeat(parent[:n_parents], b, total_repeat_length=n_children) | (done.accepts > 0)
            cover = jnp.repeat(cover[:n_parents], b, total_repeat_length=n_children) + done.accepts
            now = (now[:n_leaf] | was) & own
            shadowed = shadowed.at[jnp.where(own, index, shadowed.shape[0])].set(now, mode="drop")
            values = counted(parents, level, done)
            counts = tuple(column.at[level].set(value) for column, value in zip(counts, values, strict=True))
            lists = NodeLists(done.lists.triangle, done.lists.start[: n_leaf + 1], done.lists.count[:n_leaf])
            return lists, now, cover[:n_leaf], shadowed, counts

        zeros = jnp.zeros(len(levels), jnp.int64)
        columns = (zeros, zeros, zeros, zeros, jnp.zeros(len(levels), jnp.int32))
        state = (lists, parent, cover, shadowed, columns)
        lists, parent, cover, shadowed, columns = jax.lax.fori_loop(0, n_inner, inner, state)
        at, n_children = int(first_child[n_inner]), n_leaf * b
        was = shadowed[at : at + n_children]
        done = step(lists, parent, was, n_inner, n_children, LEAF_LANES, plan.leaf_groups, chunk_groups)
        now = jnp.repeat(parent, b, total_repeat_length=n_children) | (done.accepts > 0) | was
        cover = jnp.repeat(cover, b, total_repeat_length=n_children) + done.accepts
        shadowed = shadowed.at[at : at + n_children].set(now)
        values = counted(lists, n_inner, done)
        totals = [column.at[n_inner].set(value) for column, value in zip(columns, values, strict=True)]
        lists = done.lists
    node_tests, accepted, refined, extra, groups_needed = totals
    groups_needed = jnp.concatenate([groups_needed, lists.n_groups[None]])
    return lists, shadowed, cover, (node_tests, accepted, refined, extra, groups_needed)


def rows_of_samples(samples: SampleTiles, volume: Volumes) -> Float[Array, "tiles 4 lanes"]:
    """Position of each sample of a tile, and its bias over its distance to the light."""
    position = [samples.x_m, samples.y_m, samples.z_m]
    x, y, z = (c.astype(jnp.float64) - o for c, o in zip(position, volume.origin_m, strict=True))
    squared = (x * x + y * y + z * z).astype(jnp.float32)
    moved = volume.bias_m.astype(jnp.float32) * jax.lax.rsqrt(squared)
    return jnp.stack([*position, moved], axis=1)


def _test_samples(
    lists: NodeLists,
    edges: PlaneTable[EdgePlanes],
    sample_rows: Float[Array, "tiles 4 lanes"],
    tile_of_item: Int[Array, " items"],
    origin_m: tuple[Float[Array, ""], ...],
    plan: ShadowPlan,
) -> UInt32[Array, "items words"]:
    """Which samples of each item's tile lie in a volume of its list."""
    capacity, lanes = lists.triangle.shape
    n_samples = sample_rows.shape[2]
    words = max(1, n_samples // 32)
    n_groups = jnp.minimum(lists.n_groups, capacity)
    chunk = max(1, _SAMPLES_AT_ONCE.get(jax.default_backend(), 0) // (lanes * n_samples))
    one_pass = bool(plan.level_groups) or chunk >= capacity
    chunk = capacity if one_pass else chunk

    n_padded = -(-capacity // chunk) * chunk
    item = last_not_above(lists.start, jnp.arange(n_padded, dtype=jnp.int32))
    tile = tile_of_item[jnp.minimum(item, tile_of_item.shape[0] - 1)]

    def test_chunk(first):
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        row = sample_rows.at[jax.lax.dynamic_slice_in_dim(tile, first, chunk)].get(mode="promise_in_bounds")
        position = tuple(row[:, c].astype(jnp.float64) - origin_m[c] for c in range(3))
        moved = row[:, 3].astype(jnp.float64)
        triangle = jax.lax.dynamic_slice_in_dim(lists.triangle, first, chunk)
        planes = edges.at(triangle)
        held = jnp.zeros((chunk, n_samples), bool)
        # One triangle after the other: the samples of a tile are the vector.
        for lane in range(lanes):
            held = held | inside(jax.tree.map(lambda c, lane=lane: c[:, lane : lane + 1], planes), position, moved)
        return jnp.where((group < n_groups)[:, None], pack_bits(held).reshape(chunk, words), jnp.uint32(0))

    if one_pass:
        bits = test_chunk(jnp.int32(0))
    else:
        pad = jnp.zeros((n_padded - capacity, lanes), jnp.int32)
        lists = NodeLists(jnp.concatenate([lists.triangle, pad]), lists.start, lists.count)

        def loop(state):
            first, bits = state
            return first + chunk, jax.lax.dynamic_update_slice_in_dim(bits, test_chunk(first), first, 0)

        state = (jnp.int32(0), jnp.zeros((n_padded, words), jnp.uint32))
        _, bits = jax.lax.while_loop(lambda state: state[0] < n_groups, loop, state)
    return _merged(bits, lists.start, tile_of_item.shape[0])


def count_volumes(
    volume: Volumes,
    table: NodeTable,
    samples: SampleTiles,
    tile_of_item: Int[Array, " items"],
    plan: ShadowPlan,
) -> tuple[Int[Array, "items lanes"], Walk]:
    """In how many volumes each sample of the items' tiles lies; the walk's own bits are empty."""
    n_triangles, n_items = volume.safe.shape[0], tile_of_item.shape[0]
    before = jnp.zeros(sum(table.level_nodes[1:]) + table.level_nodes[-1] * plan.branching, bool)
    root = one_list(volume.safe, LANES, n_triangles)
    leaves, _, cover, counted = _to_leaves(root, before, volume, table, False, plan, n_triangles)
    node_tests, accepted, refined, extra, groups = counted
    capacity, lanes = leaves.triangle.shape
    n_samples = samples.z_m.shape[1]
    chunk = max(1, _SAMPLES_AT_ONCE.get(jax.default_backend(), 2**24) // (lanes * n_samples))
    n_padded = -(-capacity // chunk) * chunk
    triangle = jnp.pad(leaves.triangle, ((0, n_padded - capacity), (0, 0)), constant_values=n_triangles)
    n_groups = jnp.minimum(leaves.n_groups, capacity)
    item_of_group = jnp.minimum(last_not_above(leaves.start, jnp.arange(n_padded, dtype=jnp.int32)), n_items - 1)
    rows = jnp.stack([samples.x_m, samples.y_m, samples.z_m], axis=1)

    def loop(state):
        first, total = state
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        item = jax.lax.dynamic_slice_in_dim(item_of_group, first, chunk)
        row = rows[tile_of_item[item]]
        position = tuple(row[:, c].astype(jnp.float64) for c in range(3))
        planes = volume.edges.at(jax.lax.dynamic_slice_in_dim(triangle, first, chunk))
        held = jnp.zeros((chunk, n_samples), jnp.int32)
        for lane in range(lanes):
            one = jax.tree.map(lambda c, lane=lane: c[:, lane : lane + 1], planes)
            held = held + inside(one, position, jnp.float64(0)).astype(jnp.int32)
        item = jnp.where(group < n_groups, item, n_items)
        return first + chunk, total.at[item].add(held, mode="drop")

    total = jnp.broadcast_to(cover[:n_items, None], (n_items, n_samples))
    _, total = jax.lax.while_loop(lambda state: state[0] < n_groups, loop, (jnp.int32(0), total))
    overflowed = leaves.overflowed | _too_many(groups[:-1], plan)
    none = jnp.zeros((n_items, max(1, n_samples // 32)), jnp.uint32)
    return total, Walk(none, node_tests, accepted, refined, extra, groups, leaves.count[:n_items], overflowed)


def leaf_lists(volume: Volumes, tree: SampleTree, plan: ShadowPlan) -> tuple[NodeLists, Walk]:
    """The triangles that each item's samples are to be tested against where no node may be accepted as a whole; the
    walk's own bits are empty."""
    n_triangles, n_items = volume.safe.shape[0], tree.tile_of_item.shape[0]
    levels = tree.table.level_nodes
    before = jnp.zeros(sum(levels[1:]) + levels[-1] * plan.branching, bool)
    # No node lies farther behind a triangle than infinity.
    unaccepting = eqx.tree_at(lambda v: v.bias_m, volume, jnp.full_like(volume.bias_m, jnp.inf))
    root = one_list(volume.safe, LANES, n_triangles)
    leaves, _, _, counted = _to_leaves(root, before, unaccepting, tree.table, tree.is_frustum, plan, n_triangles)
    node_tests, accepted, refined, extra, groups = counted
    overflowed = leaves.overflowed | _too_many(groups[:-1], plan)
    none = jnp.zeros((n_items, max(1, tree.samples.z_m.shape[1] // 32)), jnp.uint32)
    return leaves, Walk(none, node_tests, accepted, refined, extra, groups, leaves.count[:n_items], overflowed)


def _merged(
    bits: UInt32[Array, "groups words"], start: Int[Array, " items_and_1"], n_items: int
) -> UInt32[Array, "items words"]:
    """All bits of the groups of each item, which are consecutive: in each step a group takes in twice as many."""
    capacity = bits.shape[0]
    longest = jnp.max(start[1:] - start[:-1])
    group = jnp.arange(capacity, dtype=jnp.int32)
    end = start[jnp.minimum(last_not_above(start, group), start.shape[0] - 2) + 1]

    def double(bits, step):
        other = group + step
        taken = bits[jnp.minimum(other, capacity - 1)]
        return jnp.where((other < end)[:, None], bits | taken, bits)

    if jax.default_backend() == "cpu":
        state = (jnp.int32(1), bits)
        _, bits = jax.lax.while_loop(lambda s: s[0] < longest, lambda s: (s[0] * 2, double(s[1], s[0])), state)
    else:
        for k in range(max(capacity - 1, 1).bit_length()):
            bits = double(bits, jnp.int32(1 << k))
    first = start[:n_items]
    some = (start[1 : n_items + 1] > first) & (first < capacity)
    return jnp.where(some[:, None], bits[jnp.minimum(first, capacity - 1)], jnp.uint32(0))


def mask_of(
    walked: Walk,
    casts: Bool[Array, " triangles"],
    samples: SampleTiles,
    item_of_sample: Int[Array, "tiles lanes"],
    n_in_tile: Int[Array, " items"],
    n_in_item: Int[Array, " items"],
    n_items: Int[Array, ""],
    n_blocks: Int[Array, ""],
    overflowed: Bool[Array, ""] | bool,
) -> ShadowMask:
    """The last pass: each sample takes its bit from its item.

    **Arguments:**

    - `n_in_tile`, `n_in_item`: samples that receive shadow, of each item's tile and of the item itself.
    """
    lanes = samples.receives.shape[1]
    lane = jnp.arange(lanes, dtype=jnp.int32)
    last = walked.shadowed.shape[0] - 1
    item = jnp.clip(item_of_sample, 0, last)
    words = walked.shadowed.shape[1]
    word = walked.shadowed.reshape(-1)[item * words + lane // 32]
    shadowed = samples.receives & ((word >> (lane % 32).astype(jnp.uint32) & 1) == 1)
    tests = jnp.where(samples.receives, walked.list_length[item], 0)
    length = walked.list_length.astype(jnp.int64)
    counts = ShadowCounts(
        walked.node_tests,
        walked.accepted,
        walked.refined,
        walked.extra,
        jnp.sum(length * n_in_tile),
        jnp.sum(length * n_in_item),
        jnp.int64(-1),
        walked.groups,
        walked.list_length,
        n_items,
        n_blocks,
        jnp.sum(casts, dtype=jnp.int32),
    )
    view = samples.viewport, samples.tile_px
    return ShadowMask(in_runs(shadowed, *view), walked.overflowed | overflowed, in_runs(tests, *view), counts)


def mask_of_tree(walked: Walk, casts: Bool[Array, " triangles"], tree: SampleTree) -> ShadowMask:
    """The same for a tree."""
    return mask_of(
        walked, casts, tree.samples, tree.item_of_sample, tree.n_in_tile, tree.n_in_item, tree.n_items, tree.n_blocks,
        tree.overflowed,
    )  # fmt: skip
