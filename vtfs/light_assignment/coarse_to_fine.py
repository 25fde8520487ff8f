"""Lights listed for groups of clusters, then for the clusters of each group: nothing is sorted.

The tree is over the clusters and the lights walk down it, where Olsson et al. 2012 (Sec. 3.3) put the lights in a tree
and walk the clusters down: O(N + hits), as each light is tested only in groups that it reaches. Building is one
reduction a level, of clusters that are few, instead of codes, a sort and boxes of lights that may be millions.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.bit_lists import WORD_BITS, last_not_above, list_bits, pack_bits, starts_of
from vtfs.bounds import Aabb, Cone, Sphere, sphere_meets_box
from vtfs.clusters import Clusters
from vtfs.light_assignment.occupancy import list_near_any
from vtfs.light_culling import Cull, may_reach
from vtfs.light_lists import AssignCounts, LightLists
from vtfs.wide_tree import n_leaf_nodes

GROUP = 32
"""Clusters of a group, where nothing says otherwise."""

_WHOLE = 2**21
"""Words of a level that are tested in one step on a GPU, whatever the chunk."""


_MANY = 2**19
"""From so many lights on, those near no cluster are dropped first."""


class NodeLists(eqx.Module):
    """The lights that may reach each node of a level: `light[offset[n] : offset[n] + count[n]]`."""

    light: Int[Array, " entries"]
    offset: Int[Array, " nodes"]
    count: Int[Array, " nodes"]


class Blocks(eqx.Module):
    """The lists of a level cut into blocks of 32 lights, one list after the other.

    - `first`, `count`: blocks of each node.
    - `total`: of all nodes.
    """

    first: Int[Array, " nodes"]
    count: Int[Array, " nodes"]
    total: Int[Array, ""]


Keep = Callable[[Int[Array, " rows"], Sphere, Cone | None], Bool[Array, "rows 32"]]


def assign_coarse_to_fine(
    lights: Sphere,
    clusters: Clusters,
    capacity: int,
    chunk: int,
    branching: int = GROUP,
    cull: Cull = "box",
    cones: Cone | None = None,
) -> tuple[LightLists, AssignCounts]:
    """Refine the list of all lights to lists of groups of `branching` consecutive clusters, and those to clusters.

    Clusters are in order of their keys, so that a group is a piece of a row of tiles. Any boxes will do. Lights are
    listed in ascending order. Groups are tested by their boxes, so that `cull` must be one that lets no light pass
    whose sphere misses the cluster's box: `box` or `frustum`.

    **Arguments:**

    - `capacity`: of the lists on any level.
    - `chunk`: words of 32 tests made at once.

    **Returns:**

    Lists, and as counts words of 32 lights tested on each level and, as `short`, the lanes of them that hold no
    light: see `n_tests`.
    """
    levels = cluster_levels(clusters, branching)
    n_lights = lights.x_m.shape[0]
    n_words = n_leaf_nodes(n_lights, WORD_BITS)
    rooms = _rooms(capacity, n_lights, len(levels))
    overflowed, words, absent, held = jnp.bool_(False), [], [], n_words * WORD_BITS
    # Places past the lights are read by lanes that are masked.
    lights, cones = jax.tree.map(lambda column: jnp.pad(column, (0, held - n_lights)), (lights, cones))
    near, n_near = None, jnp.int32(n_lights)
    if n_lights >= _MANY:
        held = rooms[0]
        near, n_near = list_near_any(lights, n_lights, clusters.box, _used(clusters), held)
        overflowed = n_near > held
        # Their columns are so few that a GPU's cache holds them, wherever in the lists they are read.
        lights, cones = jax.tree.map(lambda column: column[near], (lights, cones))
    lists = NodeLists(jnp.arange(held, dtype=jnp.int32), jnp.zeros(1, jnp.int32), n_near[None])
    culls_more = cull != "box" or cones is not None or clusters.cones is not None

    def keep(cluster, sphere, cone):
        return may_reach(sphere, cone, clusters, cluster, cull, "sphere")

    for depth, boxes in enumerate(levels):
        n_below = branching ** (len(levels) - 1 - depth)
        n_children = _n_children(-(-clusters.n_clusters // n_below), *boxes.shape[1:])
        # A list that is not whole is not refined.
        count = jnp.where(overflowed | (n_children == 0), 0, lists.count[: boxes.shape[1]])
        lists = NodeLists(lists.light, lists.offset[: boxes.shape[1]], count)
        first, total = starts_of(-(-count // WORD_BITS))
        blocks = Blocks(first, -(-count // WORD_BITS), total)
        words.append(jnp.sum(n_children * blocks.count, dtype=jnp.int32))
        absent.append(jnp.sum(n_children * (blocks.count * WORD_BITS - count), dtype=jnp.int32))
        room = rooms[depth + 1]
        most_blocks = held // WORD_BITS + boxes.shape[1]
        if depth == len(levels) - 1 and culls_more:
            lists, total = refine(lights, lists, blocks, boxes, most_blocks, room, chunk, cones, keep)
        else:
            lists, total = refine(lights, lists, blocks, boxes, most_blocks, room, chunk)
        overflowed |= total > room
        held = room
    n = clusters.key.shape[0]
    index = lists.light if near is None else near[lists.light]
    counts = AssignCounts(_stack(words[:-1]), _stack(absent[:-1]), words[-1], absent[-1])
    return LightLists(lists.offset[:n], lists.count[:n], index, total, overflowed), counts


def n_tests(counts: AssignCounts) -> tuple[int, int]:
    """Tests of (group, light) pairs on all levels, and of (cluster, light) pairs; host integers."""
    words, absent = np.asarray(counts.node_rows, np.int64), np.asarray(counts.short_rows, np.int64)
    coarse = int(words.sum()) * WORD_BITS - int(absent.sum())
    return coarse, int(counts.leaf_rows) * WORD_BITS - int(counts.short_leaf_rows)


def _rooms(capacity: int, n_lights: int, n_levels: int) -> tuple[int, ...]:
    """Places for the lights that are near any cluster, and for the lists of each level; the last are the clusters'.

    Room costs: fresh memory on a CPU, and work on a GPU, which lists all places at once. Few lights are in fewer lists
    of groups than of clusters. Of many, each that is near a cluster is in some group of a thousand, and half of those
    in several groups of 32: `benchmarks/light_assignment.py` prints the tests. A capacity that grows makes all grow.
    """
    if n_lights < _MANY:
        first, coarse, last_coarse = n_lights, capacity // 4 + 3 * n_lights // 4, capacity // 4 + 3 * n_lights // 2
    else:
        first = coarse = (capacity + n_lights) // 8
        last_coarse = (capacity + n_lights) // 2
    rooms = [first, *[coarse] * (n_levels - 2), *[last_coarse] * (n_levels > 1)]
    return (*(-(-room // WORD_BITS) * WORD_BITS for room in rooms), capacity)


def _used(clusters: Clusters) -> Bool[Array, " clusters"]:
    return jnp.arange(clusters.key.shape[0]) < clusters.n_clusters


def cluster_levels(clusters: Clusters, branching: int) -> list[Float[Array, "6 nodes branching"]]:
    """Boxes of the children of each node, level by level from the root; the last are the clusters'.

    Lower bounds and negated upper ones, so that one reduction makes a level. Children that are absent have empty boxes.
    """
    used, box = _used(clusters), clusters.box
    bounds = jnp.stack([box.low_x_m, box.low_y_m, box.low_z_m, -box.high_x_m, -box.high_y_m, -box.high_z_m])
    bounds = jnp.where(used, bounds, jnp.inf)
    levels: list[Float[Array, "6 nodes branching"]] = []
    while True:
        n_nodes = n_leaf_nodes(bounds.shape[1], branching)
        # All lights are tested against every child of the root: it has no absent ones.
        width = branching if n_nodes > 1 else bounds.shape[1]
        padded = jnp.pad(bounds, ((0, 0), (0, n_nodes * width - bounds.shape[1])), constant_values=jnp.inf)
        levels.insert(0, padded.reshape(6, n_nodes, width))
        if n_nodes == 1:
            return levels
        bounds = jnp.min(levels[0], axis=2)


def refine(
    lights: Sphere,
    lists: NodeLists,
    blocks: Blocks,
    boxes: Float[Array, "6 nodes branching"],
    most_blocks: int,
    capacity: int,
    chunk: int,
    cones: Cone | None = None,
    keep: Keep | None = None,
) -> tuple[NodeLists, Int[Array, ""]]:
    """Lists of the children from those of their parents.

    Lights are loaded once for all children of a node: loading costs a CPU more than testing.

    **Arguments:**

    - `keep`: a further test of each child (numbered through all nodes) against 32 lights that meet its box.

    **Returns:** the children's lists, and their total length, also where it is more than `capacity`.
    """
    branching = boxes.shape[2]
    hits = _test_blocks(lights, lists, blocks, boxes, most_blocks, chunk, cones, keep)

    def words_of(row):
        """Row after row: the children of a node, the blocks of a child."""
        node = last_not_above(blocks.first * branching, row)
        n_blocks = jnp.maximum(blocks.count[node], 1)
        within = row - blocks.first[node] * branching
        child = jnp.minimum(within // n_blocks, branching - 1)
        block = within - child * n_blocks
        word = hits[jnp.minimum(blocks.first[node] + block, most_blocks - 1), child]
        return jnp.where(row < n_rows, word, 0)[:, None], (lists.offset[node] + block * WORD_BITS,)

    n_rows = blocks.total * branching
    mark = (blocks.first * branching)[:, None] + jnp.arange(branching) * blocks.count[:, None]
    (light,), total, offset = list_bits(
        n_rows,
        words_of,
        lambda first, bit: (lists.light[first[0] + bit],),
        1,
        mark.reshape(-1),
        capacity,
        chunk,
        most_blocks * branching,
    )
    return NodeLists(light, offset, jnp.diff(offset, append=total)), total


def _test_blocks(
    lights: Sphere,
    lists: NodeLists,
    blocks: Blocks,
    boxes: Float[Array, "6 nodes branching"],
    most_blocks: int,
    chunk: int,
    cones: Cone | None,
    keep: Keep | None,
) -> UInt32[Array, "blocks branching"]:
    """Which lights of each block meet each child of its node: bit `l` for the `l`-th light."""
    branching = boxes.shape[2]
    lane = jnp.arange(WORD_BITS, dtype=jnp.int32)

    def test(block):
        node = last_not_above(blocks.first, block)
        before = (block - blocks.first[node]) * WORD_BITS
        there = before[:, None] + lane < lists.count[node][:, None]
        light = lists.light[jnp.where(there, (lists.offset[node] + before)[:, None] + lane, 0)]
        light = jnp.where(there, light, 0)
        # Loaded before, not within, the tests: a GPU would load each light again for every child.
        sphere, cone = jax.lax.optimization_barrier(jax.tree.map(lambda column: column[light], (lights, cones)))
        low, high = boxes[:3, node, :, None], -boxes[3:, node, :, None]
        in_row = jax.tree.map(lambda column: column[:, None, :], sphere)
        meets = there[:, None, :] & sphere_meets_box(in_row, Aabb(*low, *high))
        if keep is not None:
            # One row a child, as `may_reach` has them.
            of_child = jax.tree.map(lambda column: jnp.repeat(column, branching, axis=0), (sphere, cone))
            child = node[:, None] * branching + jnp.arange(branching)
            meets &= keep(child.reshape(-1), *of_child).reshape(meets.shape)
        return pack_bits(meets).reshape(-1, branching)

    if jax.default_backend() != "cpu" and most_blocks * branching <= max(chunk, _WHOLE):
        return test(jnp.arange(most_blocks, dtype=jnp.int32))
    step = max(chunk // branching, 1)

    def test_chunk(state):
        first, hits = state
        words = test(first + jnp.arange(step, dtype=jnp.int32))
        return first + step, jax.lax.dynamic_update_slice(hits, words, (first, 0))

    empty = jnp.zeros((most_blocks + step, branching), jnp.uint32)
    return jax.lax.while_loop(lambda state: state[0] < blocks.total, test_chunk, (jnp.int32(0), empty))[1]


def _n_children(n_below: Int[Array, ""], n_nodes: int, branching: int) -> Int[Array, " nodes"]:
    return jnp.clip(n_below - jnp.arange(n_nodes, dtype=jnp.int32) * branching, 0, branching)


def _stack(values: list[Int[Array, ""]]) -> Int[Array, " values"]:
    return jnp.stack(values) if values else jnp.zeros(0, jnp.int32)
