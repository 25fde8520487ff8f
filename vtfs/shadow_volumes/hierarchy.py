"""The tree of samples that volumes are walked down, as node tests read it."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.bounds import Aabb
from vtfs.shadow_volumes.planes import PAD
from vtfs.shadow_volumes.sample_tiles import SampleTiles
from vtfs.wide_tree import build_tree, in_leaf_nodes, inner_level_nodes, n_leaf_nodes

NO_SLOT = 2**30
"""Of a node that does not exist: past all slots."""


class NodeTable(eqx.Module):
    """The nodes of all levels as tests read them: one row a node, its children's boxes, the root first.

    - `row`: centre and padded half extent of boxes (or parts of the view); NaN where a child does not exist.
    - `n_children`: existing ones; `n_below`: existing nodes of each level below the root, the items last.
    - `child`: the child in each of a node's slots, among those of the next level, -1: none; `slot`: where each node
      below the root stands among the slots of the level above, past all of them if it does not exist. `None` where each
      slot holds the node of its own number, so that a tree has a place for every node that could be.
    """

    row: Float[Array, "nodes 6 branching"]
    n_children: Int[Array, " nodes"]
    n_below: Int[Array, " levels"]
    level_nodes: tuple[int, ...] = eqx.field(static=True)
    child: Int[Array, "nodes branching"] | None = None
    slot: Int[Array, " places"] | None = None

    @property
    def branching(self) -> int:
        return self.row.shape[2]

    @property
    def first_row(self) -> np.ndarray:
        """Row of the first node of each level."""
        return np.cumsum([0, *self.level_nodes[:-1]]).astype(np.int32)

    @property
    def first_child(self) -> np.ndarray:
        """Place of the first child of each level among all nodes below the root."""
        return np.cumsum([0, *self.level_nodes[1:]]).astype(np.int32)

    @property
    def n_places(self) -> int:
        """Places for nodes below the root: of each level those that exist, and whole leaf nodes of items."""
        if self.slot is not None:
            return self.slot.shape[0]
        return sum(self.level_nodes[1:]) + self.level_nodes[-1] * self.branching

    def children_of(self, level, n_parents: int) -> Int[Array, " slots"] | None:
        """`child` of the first nodes of a level, slot by slot."""
        if self.child is None:
            return None
        first = jnp.asarray(self.first_row)[level]
        return jax.lax.dynamic_slice_in_dim(self.child, first, n_parents).reshape(-1)

    def slots_of(self, level, n_kept: int) -> Int[Array, " kept"] | None:
        """`slot` of the first nodes below a level."""
        if self.slot is None:
            return None
        slot = jax.lax.dynamic_slice_in_dim(self.slot, jnp.asarray(self.first_child)[level], n_kept)
        return jnp.where(jnp.arange(n_kept, dtype=jnp.int32) < self.n_below[level], slot, NO_SLOT)


class Hierarchy(eqx.Module):
    """Samples, the tiles or clusters that they form, and the tree above.

    - `tile_of_item`: whose samples are tested at each item; `item_of_sample`: whose bits a sample reads.
    - `members`: bits of the samples of each item itself.
    - `n_in_tile`: samples that receive shadow, of each item's tile.
    - `n_items`: that exist; `n_blocks`: see `SampleClusters`; `n_nodes`: what `plan.nodes` must hold.
    - `counted`: see `ShadowFrame`.
    """

    samples: SampleTiles
    table: NodeTable
    tile_of_item: Int[Array, " items"]
    item_of_sample: Int[Array, "tiles lanes"]
    members: UInt32[Array, "items words"]
    n_in_tile: Int[Array, " items"]
    n_items: Int[Array, ""]
    n_blocks: Int[Array, ""]
    n_nodes: Int[Array, ""]
    overflowed: Bool[Array, ""]
    counted: Bool[Array, ""]
    is_frustum: bool = eqx.field(static=True)


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
    levels = (*inner_level_nodes(n_items, branching), n_leaf_nodes(n_items, branching))
    row, n_children = _padded(rows, is_frustum)
    is_of = np.repeat(np.arange(len(levels)), levels) == np.arange(len(levels))[:, None]
    return NodeTable(row, n_children, jnp.sum(jnp.where(is_of, n_children, 0), axis=1, dtype=jnp.int32), levels)


def _padded(rows: Float[Array, "nodes 6 branching"], is_frustum: bool) -> tuple[Array, Array]:
    """`row` and `n_children` of a `NodeTable`."""
    low, high = rows[:, :3], rows[:, 3:]
    exists = low[:, 2] <= high[:, 2]
    centre = low + (high - low) * 0.5
    half = (high - low) * (0.5 * (1 + PAD)) + PAD * (jnp.abs(low) + jnp.abs(high)) + 1e-37
    if is_frustum:
        depths = low[:, 2] * (1 - PAD), high[:, 2] * (1 + PAD)
        centre, half = centre.at[:, 2].set(depths[0]), half.at[:, 2].set(depths[1])
    row = jnp.where(exists[:, None], jnp.concatenate([centre, half], axis=1), jnp.nan)
    return row, jnp.sum(exists, axis=1, dtype=jnp.int32)


def compact_table(
    items: Aabb, key: Int[Array, " items"], n_items: Int[Array, ""], n_keys: int, branching: int, capacity: int
) -> tuple[NodeTable, Int[Array, ""]]:
    """The nodes of the full tree over all keys that hold an item: `branching` keys in turn are a node, and so up.

    Of `branching` items in turn some would lie far apart, on both sides of where a curve jumps: five times the tests.

    **Arguments:**

    - `key`: of each item, ascending; `n_items`: that exist.
    - `n_keys`: keys there can be; `capacity`: of the nodes of each level.

    **Returns:** the table, and the nodes of the level that has the most, also where they are more than `capacity`.
    """
    full = (*inner_level_nodes(n_keys, branching), n_leaf_nodes(n_keys, branching))
    levels = tuple(min(n, capacity) for n in full)
    leaf = _parents(key, n_items, levels[-1:], branching)
    parent_key = jnp.full(levels[-1], n_keys, key.dtype).at[leaf.ids[1]].set(key // branching, mode="drop")
    inner = _parents(parent_key, jnp.minimum(leaf.n[1], levels[-1]), levels[-2::-1], branching)
    child, slot = [*leaf.child, *inner.child], [*leaf.slot, *inner.slot]
    lows, highs = (items.low_x_m, items.low_y_m, items.low_z_m), (items.high_x_m, items.high_y_m, items.high_z_m)
    # The greatest is minus the least of what is negated: all six at once.
    bounds = jnp.stack([*lows, *(-high for high in highs)], axis=1)
    of_levels: list[Array] = []
    for of_node in child:
        row = jnp.where(of_node[:, None] >= 0, bounds[jnp.maximum(of_node, 0)], jnp.inf).reshape(-1, branching, 6)
        of_levels.insert(0, row.transpose(0, 2, 1))
        # Else XLA for GPUs makes one kernel of all levels, in which each node bounds all that lies below it again.
        bounds = jax.lax.optimization_barrier(jnp.min(row, axis=1))
    rows = jnp.concatenate(of_levels).astype(jnp.float32)
    row, n_children = _padded(jnp.concatenate([rows[:, :3], -rows[:, 3:]], axis=1), is_frustum=False)
    n_below = jnp.concatenate([inner.n[-2::-1], leaf.n[:1]])
    by_node = jnp.concatenate([of_node.reshape(-1, branching) for of_node in reversed(child)])
    most = jnp.maximum(jnp.max(leaf.n[1:]), jnp.max(inner.n[1:], initial=0))
    return NodeTable(row, n_children, n_below, levels, by_node, jnp.concatenate(slot[::-1])), most


class _Parents(eqx.Module):
    """Levels above some ordered keys, bottom up.

    - `ids`: the node of each key, of the keys themselves and on each level; past all where there is none.
    - `n`: how many there are, likewise; `child`, `slot`: of each level, see `NodeTable`.
    """

    ids: list[Int[Array, " keys"]]
    n: Int[Array, " levels_and_1"]
    child: list[Int[Array, " slots"]]
    slot: list[Int[Array, " nodes"]]


def _parents(key: Int[Array, " keys"], n_keys: Int[Array, ""], capacities: tuple[int, ...], branching: int) -> _Parents:
    """All levels at once, as a GPU has a price for each step: one scan, and two scatters."""
    n, n_levels = key.shape[0], len(capacities)
    power = jnp.asarray([branching**k for k in range(n_levels + 1)], key.dtype)
    of_level = key[None] // power[:, None]
    exists = jnp.arange(n, dtype=jnp.int32) < n_keys
    before = jnp.pad(of_level[:, :-1], ((0, 0), (1, 0)), constant_values=-1)
    first = (of_level != before) & exists
    ids = jnp.where(exists, jnp.cumsum(first, axis=1, dtype=jnp.int32) - 1, n)
    n_of_level = jnp.sum(first, axis=1, dtype=jnp.int32)
    if not n_levels:
        return _Parents([ids[0]], n_of_level, [], [])
    own, parent = ids[:-1], ids[1:]
    widths = np.array((n, *capacities[:-1]))
    fits = first[:-1] & (parent < np.array(capacities)[:, None]) & (own < widths[:, None])
    slot = parent * branching + (of_level[:-1] % branching).astype(jnp.int32)
    ends, node_ends = np.cumsum(np.array(capacities, int) * branching), np.cumsum(widths)

    def scattered(place, ends: np.ndarray, values, absent: int) -> list[Array]:
        starts = np.concatenate([[0], ends[:-1]]).astype(np.int32)
        size = int(ends[-1])
        place = jnp.where(fits, starts[:, None] + place, size)
        flat = jnp.full(size, absent, jnp.int32).at[place.reshape(-1)].set(values.reshape(-1), mode="drop")
        return [flat[start:end] for start, end in zip(starts, ends, strict=True)]

    child, slots = scattered(slot, ends, own, -1), scattered(own, node_ends, slot, NO_SLOT)
    return _Parents(list(ids), n_of_level, child, slots)


def merged_up(shadowed: Bool[Array, " places"], table: NodeTable) -> Bool[Array, " places"]:
    """Nodes all of whose children lie in shadow do too: bottom up, one reduction a level."""
    for level in range(len(table.level_nodes) - 1, 0, -1):
        n_nodes, n_children = table.level_nodes[level], table.level_nodes[level] * table.branching
        first = int(table.first_child[level])
        exists = ~jnp.isnan(table.row[int(table.first_row[level]) :][:n_nodes, 0])
        of_slot = table.children_of(level, n_nodes)
        if of_slot is None:
            children = jax.lax.slice_in_dim(shadowed, first, min(first + n_children, shadowed.shape[0]))
            children = jnp.pad(children, (0, n_children - children.shape[0]))
        else:
            children = shadowed[first + jnp.maximum(of_slot, 0)]
        children = children.reshape(n_nodes, -1)
        whole = (children | ~exists).all(axis=1) & exists.any(axis=1)
        own = int(table.first_child[level - 1])
        shadowed = shadowed.at[own : own + n_nodes].set(shadowed[own : own + n_nodes] | whole)
    return shadowed
