"""A complete tree of any width over ordered items, and the walk that many queries take down it.

Light lists and shadow volumes are the same walk: they differ in the predicate.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from vtfs.bit_lists import gather_hits
from vtfs.bounds import Aabb

Rows = Int[Array, " chunk"]
Mask = Bool[Array, "chunk branching"]


class WideTree(eqx.Module):
    """`branching` consecutive items form a leaf node, `branching` nodes a parent, up to one root.

    - `children`: for each inner node, level by level from the root, its children's boxes as one row
      (low x, y, z, high x, y, z by child): a visit loads one row. Absent children have empty boxes.
    """

    children: Float[Array, "nodes 6 branching"]
    n_items: int = eqx.field(static=True)
    branching: int = eqx.field(static=True)

    @property
    def level_nodes(self) -> tuple[int, ...]:
        return inner_level_nodes(self.n_items, self.branching)


def n_leaf_nodes(n_items: int, branching: int) -> int:
    return max(1, -(-n_items // branching))


def inner_level_nodes(n_items: int, branching: int) -> tuple[int, ...]:
    """Nodes of each inner level, the root first; none where a single leaf node holds all items."""
    levels: list[int] = []
    n_children = n_leaf_nodes(n_items, branching)
    while n_children > 1:
        n_children = -(-n_children // branching)
        levels.insert(0, n_children)
    return tuple(levels)


def in_leaf_nodes(item: Float[Array, " items"], branching: int, absent: float) -> Float[Array, "leaves branching"]:
    """One row a leaf node, padded with `absent`."""
    n_leaves = n_leaf_nodes(item.shape[0], branching)
    padded = jnp.pad(item, (0, n_leaves * branching - item.shape[0]), constant_values=absent)
    return padded.reshape(n_leaves, branching)


def build_tree(items: Aabb, branching: int) -> WideTree:
    """Bound the nodes bottom up: one reduction a level."""
    n_items = items.low_x_m.shape[0]
    lows, highs = (items.low_x_m, items.low_y_m, items.low_z_m), (items.high_x_m, items.high_y_m, items.high_z_m)
    # The greatest is minus the least of what is negated: all six at once.
    bounds = jnp.stack([*lows, *(-high for high in highs)])
    levels: list[Float[Array, "nodes 6 branching"]] = []
    for n_nodes in (n_leaf_nodes(n_items, branching), *reversed(inner_level_nodes(n_items, branching))):
        padding = ((0, 0), (0, n_nodes * branching - bounds.shape[1]))
        rows = jnp.pad(bounds, padding, constant_values=jnp.inf).reshape(6, n_nodes, branching)
        levels.insert(0, jnp.concatenate([rows[:3], -rows[3:]]).transpose(1, 0, 2))
        bounds = jnp.min(rows, axis=2)
    levels = levels[:-1]  # the leaves' own rows are the items
    children = jnp.concatenate(levels) if levels else jnp.zeros((0, 6, branching))
    return WideTree(children, n_items, branching)


class Walk(eqx.Module):
    """What a walk found: (query, item) pairs in order of queries, and of items within a query.

    - `total`: pairs there are, also where they are more than the capacity.
    - `overflowed`: the pairs, or the nodes of a level, did not fit: the rest is meaningless.
    - `node_rows`, `short_rows`, `leaf_rows`, `short_leaf_rows`: see `AssignCounts`.
    """

    query: Int[Array, " pairs"]
    item: Int[Array, " pairs"]
    total: Int[Array, ""]
    overflowed: Bool[Array, ""]
    node_rows: Int[Array, " levels"]
    short_rows: Int[Array, " levels"]
    leaf_rows: Int[Array, ""]
    short_leaf_rows: Int[Array, ""]


def walk(
    tree: WideTree,
    n_queries: Int[Array, ""],
    descend: Callable[[Rows, Aabb], Mask],
    keep: Callable[[Rows, Rows], Mask],
    capacity: int,
    chunk: int,
) -> Walk:
    """Walk all queries down the tree, level by level, and list the items that are kept.

    **Arguments:**

    - `descend`: for each (query, node): into which of the node's children, given their boxes.
    - `keep`: for each (query, leaf node): which of its items.
    - `capacity`: of the pairs on any level; costs memory, not time.
    - `chunk`: pairs tested at once.
    """
    b, level_nodes = tree.branching, tree.level_nodes
    width = capacity + chunk
    # The frontier: (query, node) pairs in order of queries. It starts with the root for every query.
    start = jnp.arange(width, dtype=jnp.int32)
    overflowed = n_queries > capacity
    n_rows = jnp.minimum(n_queries, capacity)
    first_node = np.cumsum([0, *level_nodes[:-1]]).astype(np.int32) if level_nodes else np.zeros(1, np.int32)
    last_node = np.array(level_nodes or (1,), np.int32) - 1

    def visit(level, state):
        query, node, n_rows, overflowed, node_rows, short_rows = state

        def test(row: Rows) -> Mask:
            box = tree.children[jnp.asarray(first_node)[level] + node[row]]
            return descend(query[row], Aabb(*(box[:, c] for c in range(6))))

        def emit(row: Rows, child: Rows) -> tuple[Rows, Rows]:
            return query[row], node[row] * b + child

        live = jnp.arange(width) < n_rows
        short = jnp.sum(live & (node == jnp.asarray(last_node)[level]), dtype=jnp.int32)
        (next_query, next_node), total = gather_hits(n_rows, test, emit, 2, capacity, chunk)
        return (
            next_query,
            next_node,
            jnp.minimum(total, capacity),
            overflowed | (total > capacity),
            node_rows.at[level].set(n_rows),
            short_rows.at[level].set(short),
        )

    zeros = jnp.zeros(len(level_nodes), jnp.int32)
    state = (start, jnp.zeros(width, jnp.int32), n_rows, overflowed, zeros, zeros)
    if level_nodes:
        state = jax.lax.fori_loop(0, len(level_nodes), visit, state)
    query, node, n_rows, overflowed, node_rows, short_rows = state

    n_leaves = n_leaf_nodes(tree.n_items, b)
    (found_query, found_item), total = gather_hits(
        n_rows,
        lambda row: keep(query[row], node[row]),
        lambda row, item: (query[row], node[row] * b + item),
        2,
        capacity,
        chunk,
    )
    short_leaf_rows = jnp.sum((jnp.arange(width) < n_rows) & (node == n_leaves - 1), dtype=jnp.int32)
    return Walk(
        found_query,
        found_item,
        total,
        overflowed | (total > capacity),
        node_rows,
        short_rows,
        n_rows,
        short_leaf_rows,
    )


def n_child_tests(node_rows: ArrayLike, short_rows: ArrayLike, n_children: tuple[int, ...], branching: int) -> int:
    """Tests of existing children: a whole node's for each visit, less what the level's last node lacks."""
    rows, short = np.asarray(node_rows, np.int64), np.asarray(short_rows, np.int64)
    missing = np.array([-count % branching if count else branching for count in n_children], np.int64)
    return int(np.sum(rows * branching - short * missing))
