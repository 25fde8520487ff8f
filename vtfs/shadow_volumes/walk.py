"""All volumes down a tree of samples: what the algorithms of 2011 and 2014 share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from vtfs.bit_lists import n_bits_set
from vtfs.input_error import InputError
from vtfs.node_lists import NodeLists, grouped, one_list, pairs_of
from vtfs.shadow_mask import ShadowPlan
from vtfs.shadow_volumes.hierarchy import Hierarchy, merged_up
from vtfs.shadow_volumes.leaf_tests import held_counts, held_samples
from vtfs.shadow_volumes.levels import LANES, AtLevel, LevelCounts, descend, n_shadowed_places, no_counts
from vtfs.shadow_volumes.volumes import Volumes


class Walk(eqx.Module):
    """What a walk found, and what it took.

    - `shadowed`: bits of the samples of each item's tile that lie in some volume.
    - `counts`: of the nodes; `of_triangle` holds the samples' tests too.
    - `list_length`: triangles listed at each item; `tests`: triangles that each sample was tested against, of the lists
      of its own item.
    - `sample_tests`, `dropped_samples`: (sample of the tile, triangle) pairs tested, and left out because an earlier
      batch shadows the sample.
    - `n_pairs`: what `plan.pairs` must hold.
    """

    shadowed: UInt32[Array, "items words"]
    counts: LevelCounts
    list_length: Int[Array, " items"]
    tests: Int[Array, "tiles lanes"]
    sample_tests: Int[Array, ""]
    dropped_samples: Int[Array, ""]
    n_pairs: Int[Array, ""]
    overflowed: Bool[Array, ""]


def restart_level(plan: ShadowPlan, n_levels: int) -> int:
    """The level at which the first of two passes ends: `plan.level`, or halfway down where it is 0.

    **Raises:** `InputError` where the tree has no such level.
    """
    if n_levels < 2:
        raise InputError(f"passes=2: the tree has one level with branching={plan.branching}; use passes=1.")
    level = plan.level or n_levels // 2
    if not 1 <= level < n_levels:
        raise InputError(
            f"level={plan.level}: this tree has {n_levels} levels of nodes with branching={plan.branching}; use 1 to "
            f"{n_levels - 1}, or 0 for halfway."
        )
    return level


def walk_volumes(volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> Walk:
    """Walk the volumes down the tree and test the samples of the items they reach.

    In batches of triangles, where the plan says so. With `feedback` those that block most of the light come first, and
    what they shadow is left out of later batches: nodes and samples. In two passes, the first ends at a level and
    appends what goes on to one list of (triangle, node) pairs, with which the second begins (Sintorn et al. 2014,
    Sec. 4.2): pairs of batches that were walked before a node was found in shadow are dropped there too.
    """
    n_triangles, n_levels = volume.safe.shape[0], len(hierarchy.table.level_nodes)
    size = plan.batch if 0 < plan.batch < n_triangles else n_triangles
    n_batches = -(-n_triangles // size)
    in_order = jnp.arange(n_triangles, dtype=jnp.int32)
    if plan.feedback and n_batches > 1:
        in_order = jnp.argsort(-volume.solid_angle).astype(jnp.int32)
    triangle = jnp.pad(in_order, (0, n_batches * size - n_triangles), constant_values=n_triangles)
    casts = jnp.append(volume.safe, False)[triangle]

    def batch_to(level: int, i, shadowed: Bool[Array, " places"]) -> AtLevel:
        """A batch down to a level; `shadowed` by earlier ones."""
        own = jnp.append(jax.lax.dynamic_slice_in_dim(triangle, i * size, size), n_triangles)
        root = one_list(jax.lax.dynamic_slice_in_dim(casts, i * size, size), LANES, size)
        root = NodeLists(own[root.triangle], root.start, root.count, root.node)
        before = shadowed if plan.feedback else jnp.zeros_like(shadowed)
        counts = no_counts(n_levels, n_triangles)
        at = AtLevel(root, jnp.zeros(1, bool), jnp.zeros(1, jnp.int32), before, counts)
        return descend(at, 0, level, volume, hierarchy, plan)

    if plan.passes not in (1, 2):
        raise InputError(f"passes={plan.passes}: must be 1 or 2.")
    if plan.passes == 1:
        return _one_pass(batch_to, n_batches, volume, hierarchy, plan)
    return _two_passes(batch_to, n_batches, volume, hierarchy, plan)


BatchTo = Callable[[int, Any, Bool[Array, " places"]], AtLevel]


def _one_pass(batch_to: BatchTo, n_batches: int, volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> Walk:
    """Each batch down to the samples."""
    n_levels = len(hierarchy.table.level_nodes)
    nothing = jnp.zeros(n_shadowed_places(hierarchy), bool)
    walk = _no_walk(volume, hierarchy)
    if n_batches == 1:
        at = batch_to(n_levels, 0, nothing)
        return _with_whole_items(_with_samples(walk, at, volume, hierarchy, plan), at.shadowed, hierarchy)

    def one_batch(i, state):
        walk, shadowed = state
        at = batch_to(n_levels, i, shadowed)
        walk = _with_samples(walk, at, volume, hierarchy, plan)
        shadowed = shadowed | at.shadowed
        return walk, _with_full_items(shadowed, walk.shadowed, hierarchy) if plan.feedback else shadowed

    walk, shadowed = jax.lax.fori_loop(0, n_batches, one_batch, (walk, nothing))
    return _with_whole_items(walk, shadowed, hierarchy)


def _two_passes(batch_to: BatchTo, n_batches: int, volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> Walk:
    """Each batch down to a level; then what goes on there, all together."""
    table, n_triangles = hierarchy.table, volume.safe.shape[0]
    n_levels = len(table.level_nodes)
    middle = restart_level(plan, n_levels)

    def one_batch(i, state):
        counts, shadowed, listed, node, n_pairs = state
        at = batch_to(middle, i, shadowed)
        (more_listed, more_node), n_more = pairs_of(at.lists, n_triangles, plan.pairs)
        # What does not fit is counted, not written: the walk is thrown away.
        place = jnp.minimum(n_pairs, plan.pairs)
        listed = jax.lax.dynamic_update_slice_in_dim(listed, more_listed, place, 0)
        node = jax.lax.dynamic_update_slice_in_dim(node, more_node, place, 0)
        return counts.plus(at.counts), shadowed | at.shadowed, listed, node, jnp.minimum(n_pairs, 2**29) + n_more

    places, none = jnp.zeros(n_shadowed_places(hierarchy), bool), jnp.full(2 * plan.pairs, n_triangles, jnp.int32)
    state = (no_counts(n_levels, n_triangles), places, none, none, jnp.int32(0))
    state = one_batch(0, state) if n_batches == 1 else jax.lax.fori_loop(0, n_batches, one_batch, state)
    counts, shadowed, listed, node, n_pairs = state
    listed, node, n_nodes = listed[: plan.pairs], node[: plan.pairs], table.level_nodes[middle]
    if n_batches > 1:  # each batch is in order of its nodes, all together are not
        there = jnp.arange(plan.pairs, dtype=jnp.int32) < n_pairs
        node, listed = jax.lax.sort((jnp.where(there, node, n_nodes), listed), num_keys=1)
    own = int(table.first_child[middle - 1])
    in_shadow = shadowed[own : own + n_nodes]
    capacity = plan.level_groups[middle - 1] if plan.level_groups else plan.groups
    lists = grouped(listed, node, n_pairs, in_shadow & plan.feedback, LANES, n_triangles, capacity)
    n_dropped = jnp.minimum(n_pairs, plan.pairs) - jnp.sum(lists.count, dtype=jnp.int32)
    counts = eqx.tree_at(
        lambda counts: (counts.dropped, counts.refined), counts,
        (counts.dropped.at[middle - 1].add(n_dropped), counts.refined.at[middle - 1].add(-n_dropped)),
    )  # fmt: skip
    at = AtLevel(lists, in_shadow, jnp.zeros(n_nodes, jnp.int32), shadowed, counts)
    at = descend(at, middle, n_levels, volume, hierarchy, plan)
    walk = eqx.tree_at(
        lambda walk: (walk.n_pairs, walk.overflowed), _no_walk(volume, hierarchy), (n_pairs, n_pairs > plan.pairs)
    )
    return _with_whole_items(_with_samples(walk, at, volume, hierarchy, plan), at.shadowed, hierarchy)


def _no_walk(volume: Volumes, hierarchy: Hierarchy) -> Walk:
    n_samples, n_items = hierarchy.samples.z_m.shape, hierarchy.tile_of_item.shape[0]
    zero = jnp.int64(0)
    return Walk(
        jnp.zeros((n_items, max(1, n_samples[1] // 32)), jnp.uint32),
        no_counts(len(hierarchy.table.level_nodes), volume.safe.shape[0]), jnp.zeros(n_items, jnp.int32),
        jnp.zeros(n_samples, jnp.int32), zero, zero, jnp.int32(0), jnp.bool_(False),
    )  # fmt: skip


def _with_samples(walk: Walk, at: AtLevel, volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> Walk:
    """The walk with the samples of what the lists of items reach."""
    shadowed = walk.shadowed | held_samples(at.lists, volume, hierarchy, plan)
    walk = eqx.tree_at(
        lambda walk: (walk.counts, walk.overflowed),
        walk,
        (walk.counts.plus(at.counts), walk.overflowed | too_many(at.counts.groups, plan)),
    )
    walk = jax.lax.cond(hierarchy.counted, lambda: _with_sample_tests(walk, at, hierarchy, plan.feedback), lambda: walk)
    return eqx.tree_at(lambda walk: walk.shadowed, walk, shadowed)


def _with_sample_tests(walk: Walk, at: AtLevel, hierarchy: Hierarchy, feedback: bool) -> Walk:
    """The walk with the counts of such samples' tests; with `feedback` without those shadowed by earlier batches."""
    n_items = hierarchy.tile_of_item.shape[0]
    length = at.lists.count[:n_items]
    done = n_bits_set(walk.shadowed).sum(axis=1, dtype=jnp.int32) if feedback else jnp.zeros_like(length)
    tested = hierarchy.n_in_tile - done
    known = bits_of_samples(walk.shadowed, hierarchy) & feedback
    own_length = length[jnp.clip(hierarchy.item_of_sample, 0, n_items - 1)]
    is_used = jnp.arange(at.lists.triangle.shape[0], dtype=jnp.int32) < at.lists.n_groups
    each = jnp.where(is_used, tested[jnp.minimum(at.lists.nodes(), n_items - 1)], 0)
    of_triangle = walk.counts.of_triangle.at[at.lists.triangle].add(each[:, None])
    length64 = length.astype(jnp.int64)
    return Walk(
        walk.shadowed,
        eqx.tree_at(lambda counts: counts.of_triangle, walk.counts, of_triangle),
        walk.list_length + length,
        walk.tests + jnp.where(hierarchy.samples.receives & ~known, own_length, 0),
        walk.sample_tests + jnp.sum(length64 * tested),
        walk.dropped_samples + jnp.sum(length64 * done),
        walk.n_pairs,
        walk.overflowed,
    )


def bits_of_samples(bits: UInt32[Array, "items words"], hierarchy: Hierarchy) -> Bool[Array, "tiles lanes"]:
    """Each sample's own bit; of one that receives no shadow false."""
    n_items, words = bits.shape
    lane = jnp.arange(hierarchy.item_of_sample.shape[1], dtype=jnp.int32)
    item = jnp.clip(hierarchy.item_of_sample, 0, n_items - 1)
    word = bits.reshape(-1)[item * words + lane // 32]
    return hierarchy.samples.receives & ((word >> (lane % 32).astype(jnp.uint32) & 1) == 1)


def _with_whole_items(walk: Walk, shadowed: Bool[Array, " places"], hierarchy: Hierarchy) -> Walk:
    """All samples of items that lie in shadow as a whole."""
    whole = _items(shadowed, hierarchy)
    bits = jnp.where(whole[:, None], jnp.uint32(2**32 - 1), walk.shadowed)
    return eqx.tree_at(lambda walk: walk.shadowed, walk, bits)


def _with_full_items(
    shadowed: Bool[Array, " places"], bits: UInt32[Array, "items words"], hierarchy: Hierarchy
) -> Bool[Array, " places"]:
    """Items all of whose samples are shadowed, each by some triangle, lie in shadow; and so nodes of such items."""
    first = int(hierarchy.table.first_child[-1])
    exists = (hierarchy.members != 0).any(axis=1)
    full = ((hierarchy.members & ~bits) == 0).all(axis=1) & exists
    shadowed = shadowed.at[first : first + full.shape[0]].set(_items(shadowed, hierarchy) | full)
    return merged_up(shadowed, hierarchy.table)


def _items(shadowed: Bool[Array, " places"], hierarchy: Hierarchy) -> Bool[Array, " items"]:
    return shadowed[int(hierarchy.table.first_child[-1]) :][: hierarchy.tile_of_item.shape[0]]


def too_many(groups: Int[Array, " levels_and_1"], plan: ShadowPlan) -> Bool[Array, ""]:
    """Do the lists of some level overflow? The root's always fit."""
    capacities = plan.level_groups or (plan.groups,) * (groups.shape[0] - 2)
    return jnp.any(groups[1:] > jnp.array((*capacities, plan.leaf_groups), jnp.int32))


def count_volumes(volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> tuple[Int[Array, "items lanes"], Walk]:
    """In how many volumes each sample of the items' tiles lies; the walk's own bits are empty."""
    at, walk = to_items(volume, hierarchy, plan)
    return held_counts(at.lists, at.cover, volume, hierarchy), walk


def to_items(volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> tuple[AtLevel, Walk]:
    """All triangles down to the lists of the items, in one batch and one pass; no sample is tested here."""
    n_triangles, n_levels = volume.safe.shape[0], len(hierarchy.table.level_nodes)
    root = AtLevel(
        one_list(volume.safe, LANES, n_triangles), jnp.zeros(1, bool), jnp.zeros(1, jnp.int32),
        jnp.zeros(n_shadowed_places(hierarchy), bool), no_counts(n_levels, n_triangles),
    )  # fmt: skip
    at = descend(root, 0, n_levels, volume, hierarchy, plan)
    walk = eqx.tree_at(
        lambda walk: (walk.counts, walk.overflowed),
        _no_walk(volume, hierarchy),
        (at.counts, too_many(at.counts.groups, plan)),
    )
    return at, jax.lax.cond(hierarchy.counted, lambda: _with_sample_tests(walk, at, hierarchy, False), lambda: walk)
