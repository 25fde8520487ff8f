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


class NodeTable(eqx.Module):
    """The nodes of all levels as tests read them: one row a node, its children's boxes, the root first.

    - `row`: centre and padded half extent of boxes (or parts of the view); NaN where a child does not exist.
    - `n_children`: existing ones; `n_below`: existing nodes of each level below the root, the items last.
    """

    row: Float[Array, "nodes 6 branching"]
    n_children: Int[Array, " nodes"]
    n_below: Int[Array, " levels"]
    level_nodes: tuple[int, ...] = eqx.field(static=True)

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
        return sum(self.level_nodes[1:]) + self.level_nodes[-1] * self.branching


class Hierarchy(eqx.Module):
    """Samples, the tiles or clusters that they form, and the tree above.

    - `tile_of_item`: whose samples are tested at each item; `item_of_sample`: whose bits a sample reads.
    - `members`: bits of the samples of each item itself.
    - `n_in_tile`: samples that receive shadow, of each item's tile.
    - `n_items`: that exist; `n_blocks`: see `SampleClusters`; `counted`: see `ShadowFrame`.
    """

    samples: SampleTiles
    table: NodeTable
    tile_of_item: Int[Array, " items"]
    item_of_sample: Int[Array, "tiles lanes"]
    members: UInt32[Array, "items words"]
    n_in_tile: Int[Array, " items"]
    n_items: Int[Array, ""]
    n_blocks: Int[Array, ""]
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


def merged_up(shadowed: Bool[Array, " places"], table: NodeTable) -> Bool[Array, " places"]:
    """Nodes all of whose children lie in shadow do too: bottom up, one reduction a level."""
    for level in range(len(table.level_nodes) - 1, 0, -1):
        n_nodes, n_children = table.level_nodes[level], table.level_nodes[level] * table.branching
        first = int(table.first_child[level])
        exists = ~jnp.isnan(table.row[int(table.first_row[level]) :][:n_nodes, 0])
        children = jax.lax.slice_in_dim(shadowed, first, min(first + n_children, shadowed.shape[0]))
        children = jnp.pad(children, (0, n_children - children.shape[0])).reshape(n_nodes, -1)
        whole = (children | ~exists).all(axis=1) & exists.any(axis=1)
        own = int(table.first_child[level - 1])
        shadowed = shadowed.at[own : own + n_nodes].set(shadowed[own : own + n_nodes] | whole)
    return shadowed
