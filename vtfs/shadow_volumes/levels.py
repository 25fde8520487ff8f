"""Volumes down the levels of a tree: from the lists of one level's nodes to those of a level below."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vtfs.node_lists import NodeLists, Split, split, split_at_once
from vtfs.shadow_mask import ShadowPlan
from vtfs.shadow_volumes.hierarchy import Hierarchy
from vtfs.shadow_volumes.planes import test_nodes
from vtfs.shadow_volumes.volumes import Volumes

LANES = 16
"""Triangles of a group on inner levels: both answers of their tests of a child pack into one word."""

LEAF_LANES = 4
"""Triangles of a group at the leaves: short lists waste little, and a tile's samples are loaded once for four."""

_TRIANGLES_AT_ONCE = {"cpu": 2**15}
"""Triangles listed in one chunk of a loop: what stays in the caches of a CPU. Elsewhere a step of a loop costs more."""


class LevelCounts(eqx.Module):
    """Counts as in `ShadowCounts`, of the levels walked; others are zero.

    - `dropped`: (triangle, child) pairs that would have gone on, into a child that lies in shadow as a whole.
    - `of_triangle`: tests of nodes, by triangle; the last entry is of none.
    """

    node_tests: Int[Array, " levels"]
    accepted: Int[Array, " levels"]
    refined: Int[Array, " levels"]
    extra: Int[Array, " levels"]
    dropped: Int[Array, " levels"]
    groups: Int[Array, " levels_and_1"]
    of_triangle: Int[Array, " triangles_and_1"]

    def plus(self, more: LevelCounts) -> LevelCounts:
        """Both walks; lists are held one after the other."""
        total = jax.tree.map(jnp.add, self, more)
        return eqx.tree_at(lambda counts: counts.groups, total, jnp.maximum(self.groups, more.groups))


def no_counts(n_levels: int, n_triangles: int) -> LevelCounts:
    zeros = jnp.zeros(n_levels, jnp.int64)
    groups, of_triangle = jnp.zeros(n_levels + 1, jnp.int32), jnp.zeros(n_triangles + 1, jnp.int32)
    return LevelCounts(zeros, zeros, zeros, zeros, zeros, groups, of_triangle)


class AtLevel(eqx.Module):
    """Where a walk stands: what is to be tested at the nodes of one level.

    - `in_shadow`: nodes of the level that lie in shadow as a whole; `cover`: triangles that accept each of them, or a
      node above.
    - `shadowed`: of all nodes below the root, with room for one more level.
    """

    lists: NodeLists
    in_shadow: Bool[Array, " nodes"]
    cover: Int[Array, " nodes"]
    shadowed: Bool[Array, " places"]
    counts: LevelCounts


def n_shadowed_places(hierarchy: Hierarchy) -> int:
    """Length of `AtLevel.shadowed`: a level is read and written as if it were full."""
    table = hierarchy.table
    return table.n_places + table.level_nodes[-1] * table.branching


def descend(at: AtLevel, first: int, last: int, volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> AtLevel:
    """From the lists of level `first` (0: the root) to those of level `last` (the number of levels: the items).

    Where `plan.level_groups` says what each level holds, levels are unrolled and nothing loops. Otherwise one loop runs
    over inner levels, all of them as wide as the widest, as one program is compiled faster than seven.
    """
    table = hierarchy.table
    levels, b = table.level_nodes, plan.branching
    at_once = bool(plan.level_groups)
    chunk = _TRIANGLES_AT_ONCE.get(jax.default_backend(), 2**22) // LANES
    n_inner = len(levels) - 1

    def visit(at: AtLevel, level, n_parents: int, n_kept: int, lanes: int, capacity: int) -> AtLevel:
        lists = at.lists.of_first(n_parents)
        n_slots = n_parents * b
        first = jnp.asarray(table.first_child)[level]
        of_slot, slot = table.children_of(level, n_parents), table.slots_of(level, n_kept)
        if of_slot is None:
            was = jax.lax.dynamic_slice_in_dim(at.shadowed, first, n_slots)
        else:
            was = at.shadowed[first + jnp.maximum(of_slot, 0)] & (of_slot >= 0)
        parent = _for_each_child(at.in_shadow[:n_parents], b)

        def drop(accepted):
            return accepted | parent | was if plan.feedback else jnp.zeros_like(accepted)

        # One node below tells nothing apart: keys that no cluster has, or the capacity's rounding, made it.
        only = table.n_below[level] == 1
        row = jnp.asarray(table.first_row)[level]
        done = _split_level(lists, drop, row, only, lanes, capacity, volume, hierarchy, plan, chunk)
        now = parent | (done.accepts > 0) | was
        cover = _for_each_child(at.cover[:n_parents], b) + done.accepts
        counts = _with_level(at.counts, lists, done, level, hierarchy, plan)
        if slot is None or of_slot is None:
            lists, own = done.lists.of_first(n_kept), jnp.asarray((*levels[1:], levels[-1] * b), jnp.int32)[level]
        else:
            lists, own = done.lists.at_slots(slot, of_slot), table.n_below[level]
            there = slot < n_slots
            was = jax.lax.dynamic_slice_in_dim(at.shadowed, first, n_kept)
            slot = jnp.minimum(slot, n_slots - 1)
            now, cover = now[slot] & there, jnp.where(there, cover[slot], 0)
        is_own = jnp.arange(now.shape[0], dtype=jnp.int32) < own
        shadowed = jax.lax.dynamic_update_slice_in_dim(at.shadowed, jnp.where(is_own, now, was), first, 0)
        return AtLevel(lists, (now & is_own)[:n_kept], cover[:n_kept], shadowed, counts)

    if at_once:
        for level in range(first, min(last, n_inner)):
            at = visit(at, level, levels[level], levels[level + 1], LANES, plan.level_groups[level])
    elif first < min(last, n_inner):
        at = _widened(at, levels[-1], plan.groups, volume.safe.shape[0])
        groups = at.lists.triangle.shape[0]

        def inner(level, at: AtLevel) -> AtLevel:
            return visit(at, level, levels[-2], levels[-1], LANES, groups)

        at = jax.lax.fori_loop(first, min(last, n_inner), inner, at)
    if last == len(levels):
        at = visit(at, n_inner, levels[-1], table.n_places - sum(levels[1:]), LEAF_LANES, plan.leaf_groups)
    return at


def _for_each_child(of_parent: Array, branching: int) -> Array:
    """What each child has of its parent. Not `jnp.repeat`, whose scan of places XLA folds while it compiles, for up to
    two minutes."""
    return jnp.broadcast_to(of_parent[:, None], (of_parent.shape[0], branching)).reshape(-1)


def _widened(at: AtLevel, n_nodes: int, capacity: int, absent: int) -> AtLevel:
    """The same lists with room for more nodes and groups."""
    start, count, triangle = at.lists.start, at.lists.count, at.lists.triangle
    more = n_nodes - count.shape[0]
    pad = jnp.full((max(0, capacity - triangle.shape[0]), triangle.shape[1]), absent, jnp.int32)
    lists = NodeLists(
        jnp.concatenate([triangle, pad]),
        jnp.concatenate([start, jnp.broadcast_to(start[-1], (more,))]),
        jnp.pad(count, (0, more)),
    )
    return AtLevel(lists, jnp.pad(at.in_shadow, (0, more)), jnp.pad(at.cover, (0, more)), at.shadowed, at.counts)


def _split_level(
    lists: NodeLists, drop, first_row, only, lanes: int, capacity: int, volume: Volumes, hierarchy: Hierarchy,
    plan: ShadowPlan, chunk: int,
) -> Split:  # fmt: skip
    """Test the triangles listed at the nodes of a level against their children.

    **Arguments:**

    - `first_row`: of the level's nodes in the table; `only`: the level has one child, into which everything goes.
    - `lanes`, `capacity`: of the children's groups.
    """
    table, absent, b = hierarchy.table, volume.safe.shape[0], plan.branching
    bias_m = volume.bias_m.astype(jnp.float32)

    def tested(triangle, node):
        row = table.row.at[first_row + node].get(mode="promise_in_bounds")
        planes = jax.tree.map(lambda c: c[:, None, :], volume.nodes.at(triangle))
        boxes = tuple(row[:, c, :, None] for c in range(6))
        return boxes, test_nodes(planes, boxes, hierarchy.is_frustum, bias_m)

    def n_extra(triangle, node):
        # Apart from the answers: one more reduction over the tests repeats them, and only counting needs it.
        _, (refined, _, _) = tested(triangle, node)
        return jnp.where(only, 0, jnp.sum(refined, dtype=jnp.int32))

    def test(triangle, node):
        boxes, (_, goes_on, accepted) = tested(triangle, node)
        # Wherever it is: in a full tree the only child need not be the first.
        pass_on = ~jnp.isnan(boxes[0]) & (triangle != absent)[:, None, :]
        goes_on, accepted = jnp.where(only, pass_on, goes_on), accepted & ~only
        # Both answers in one word: two reductions would each repeat the tests.
        shift = jnp.arange(LANES, dtype=jnp.uint32)
        both = (goes_on.astype(jnp.uint32) << shift) | (accepted.astype(jnp.uint32) << (shift + LANES))
        both = jnp.sum(both, axis=-1, dtype=jnp.uint32)
        extra = jnp.int32(0)
        if plan.extra != "off":
            extra = jax.lax.cond(hierarchy.counted, n_extra, lambda *_: extra, triangle, node)
        return both & jnp.uint32(2**LANES - 1), both >> LANES, extra

    if plan.level_groups:
        return split_at_once(lists, test, drop, b, lanes, absent, capacity)
    return split(lists, test, drop, b, lanes, absent, capacity, chunk)


def _with_level(
    counts: LevelCounts, lists: NodeLists, done: Split, level, hierarchy: Hierarchy, plan: ShadowPlan
) -> LevelCounts:
    """The counts with those of one level. What the capacities must hold is always counted."""
    table = hierarchy.table
    groups = counts.groups.at[level].max(lists.n_groups).at[level + 1].max(done.lists.n_groups)
    counts = eqx.tree_at(lambda counts: counts.groups, counts, groups)

    def with_tests() -> LevelCounts:
        n_rows = lists.count.shape[0]
        only = table.n_below[level] == 1
        children = jax.lax.dynamic_slice_in_dim(table.n_children, jnp.asarray(table.first_row)[level], n_rows)
        tests = jnp.where(only, 0, jnp.sum(lists.count.astype(jnp.int64) * children, dtype=jnp.int64))
        is_used = jnp.arange(lists.triangle.shape[0], dtype=jnp.int32) < lists.n_groups
        each = jnp.where(is_used & ~only, children[lists.nodes()], 0)
        return LevelCounts(
            counts.node_tests.at[level].add(tests),
            counts.accepted.at[level].add(done.n_accepted),
            counts.refined.at[level].add(jnp.where(only, 0, done.n_refined)),
            counts.extra.at[level].add(done.extra),
            counts.dropped.at[level].add(done.n_dropped),
            groups,
            counts.of_triangle.at[lists.triangle].add(each[:, None]),
        )

    return jax.lax.cond(hierarchy.counted, with_tests, lambda: counts)
