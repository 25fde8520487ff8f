"""The walk of shadow volumes down a wide tree, by nodes: each node has the list of the triangles that may meet it.

`wide_tree.walk` keeps pairs in order of queries. Here they are kept in order of nodes, which is what merging needs:
whether any triangle accepts a node is a difference of two prefix sums, and the triangles of a leaf come out side by
side. Lists are padded to groups, so that one row of the tree is loaded for a group and its tests pack into one word a
child. Nothing is sorted; and nothing is scattered in `split`, which suits a CPU, where a GPU is better off with
`split_at_once`.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from vtfs.bit_lists import bits_below, last_not_above, n_bits_set, nth_bit_set

Hits = tuple[UInt32[Array, "groups branching"], UInt32[Array, "groups branching"], Int[Array, ""]]
"""For each group and child: which of the group's triangles go on to the child, and which accept it; and any count."""


class NodeLists(eqx.Module):
    """The triangles listed at each node of one level, in groups.

    Node `m` has groups `start[m]` to `start[m + 1]`, and `count[m]` triangles in them.

    - `triangle`: of each group; what a list does not fill is `absent`, a triangle that meets nothing.
    - `node`: of each group, where it is known: else `nodes` finds it.
    """

    triangle: Int[Array, "groups lanes"]
    start: Int[Array, " nodes_and_1"]
    count: Int[Array, " nodes"]
    node: Int[Array, " groups"] | None = None

    @property
    def n_groups(self) -> Int[Array, ""]:
        return self.start[-1]

    @property
    def overflowed(self) -> Bool[Array, ""]:
        return self.n_groups > self.triangle.shape[0]

    def nodes(self) -> Int[Array, " groups"]:
        """The node of each group; of one that is not used any node."""
        if self.node is not None:
            return self.node
        return owners(self.start, self.n_groups, self.triangle.shape[0])

    def of_first(self, n: int) -> NodeLists:
        """Without the nodes from the `n`-th on, whose lists are empty."""
        return NodeLists(self.triangle, self.start[: n + 1], self.count[:n], self.node)

    def at_slots(self, slot: Int[Array, " kept"], number: Int[Array, " nodes"]) -> NodeLists:
        """Of some of the nodes alone, in order, where all others have empty lists.

        **Arguments:**

        - `slot`: those nodes; past all of them: none, an empty list. `number`: the place in `slot` of each of them.
        """
        n = self.count.shape[0]
        start = jnp.concatenate([self.start[jnp.minimum(slot, n)], self.start[-1:]])
        count = jnp.where(slot < n, self.count[jnp.minimum(slot, n - 1)], 0)
        node = None if self.node is None else jnp.maximum(number[self.node], 0)
        return NodeLists(self.triangle, start, count, node)


_GROUPS_AT_ONCE = {"cpu": 2**13}
"""Of which `owners` looks for the node in one step of its loop; elsewhere a step costs more than all of them."""


def owners(start: Int[Array, " nodes_and_1"], n_groups: Int[Array, ""], capacity: int) -> Int[Array, " capacity"]:
    """The node of each group that is used, of others any node: lists are often far shorter than their capacity."""
    last = start.shape[0] - 2
    width = min(capacity, _GROUPS_AT_ONCE.get(jax.default_backend(), capacity))
    n_padded = _whole_chunks(capacity, width)

    def find(state):
        first, node = state
        own = last_not_above(start, first + jnp.arange(width, dtype=jnp.int32))
        return first + width, jax.lax.dynamic_update_slice_in_dim(node, own, first, 0)

    state = (jnp.int32(0), jnp.zeros(n_padded, jnp.int32))
    if width == capacity:
        _, node = find(state)
    else:
        # Of lists that overflow, which are thrown away, no more than there is room for.
        used = jnp.minimum(n_groups, capacity)
        _, node = jax.lax.while_loop(lambda state: state[0] < used, find, state)
    return jnp.minimum(node[:capacity], last)


def group_starts(count: Int[Array, " nodes"], lanes: int) -> Int[Array, " nodes_and_1"]:
    groups = -(-count // lanes)
    # Saturates: past 2^31 a total would be negative, and look as if it fitted.
    ends = jnp.minimum(jnp.cumsum(groups, dtype=jnp.int64), 2**30).astype(jnp.int32)
    return jnp.concatenate([jnp.zeros(1, jnp.int32), ends])


def one_list(member: Bool[Array, " triangles"], lanes: int, absent: int) -> NodeLists:
    """The list of the root: every triangle that is a member."""
    n = member.shape[0]
    ends = jnp.cumsum(member, dtype=jnp.int32)
    count = ends[-1:]
    n_groups = -(-n // lanes)
    place = jnp.where(member, ends - 1, n_groups * lanes)
    triangle = jnp.full(n_groups * lanes, absent, jnp.int32)
    triangle = triangle.at[place].set(jnp.arange(n, dtype=jnp.int32), mode="drop", unique_indices=True)
    node = jnp.zeros(n_groups, jnp.int32)
    return NodeLists(triangle.reshape(n_groups, lanes), group_starts(count, lanes), count, node)


Pairs = tuple[Int[Array, " capacity"], Int[Array, " capacity"]]
"""A triangle, and a node that it goes on to."""


def pairs_of(lists: NodeLists, absent: int, capacity: int) -> tuple[Pairs, Int[Array, ""]]:
    """All (triangle, node) pairs in order of nodes, and how many there are, also where they are more."""
    ends = jnp.cumsum(lists.count, dtype=jnp.int32)
    starts = jnp.concatenate([jnp.zeros(1, jnp.int32), ends])
    place = jnp.arange(capacity, dtype=jnp.int32)
    node = jnp.minimum(last_not_above(starts, place), lists.count.shape[0] - 1)
    lane = place - starts[node]
    lanes = lists.triangle.shape[1]
    group = jnp.minimum(lists.start[node] + lane // lanes, lists.triangle.shape[0] - 1)
    there = place < ends[-1]
    return (jnp.where(there, lists.triangle[group, lane % lanes], absent), jnp.where(there, node, 0)), ends[-1]


def grouped(
    triangle: Int[Array, " capacity"],
    node: Int[Array, " capacity"],
    n_pairs: Int[Array, ""],
    dropped: Bool[Array, " nodes"],
    lanes: int,
    absent: int,
    capacity: int,
) -> NodeLists:
    """Pairs in order of nodes, as lists; those of dropped nodes are left out."""
    n_nodes, n_places = dropped.shape[0], triangle.shape[0]
    there = jnp.arange(n_places, dtype=jnp.int32) < n_pairs
    ascending = jnp.concatenate([jnp.full(1, -1, jnp.int32), jnp.where(there, node, n_nodes)])
    first = last_not_above(ascending, jnp.arange(-1, n_nodes, dtype=jnp.int32))
    count = jnp.where(dropped, 0, first[1:] - first[:-1])
    start = group_starts(count, lanes)
    group = jnp.arange(capacity, dtype=jnp.int32)
    own = jnp.minimum(last_not_above(start, group), n_nodes - 1)
    lane = ((group - start[own]) * lanes)[:, None] + jnp.arange(lanes, dtype=jnp.int32)
    listed = triangle[jnp.minimum(first[own][:, None] + lane, n_places - 1)]
    return NodeLists(jnp.where(lane < count[own][:, None], listed, absent), start, count)


class Split(eqx.Module):
    """What one level did.

    - `lists`: of the children; `accepts`: how many triangles accept each child.
    - `n_accepted`: (triangle, child) pairs accepted; `n_refined`: pairs that went on; `n_dropped`: that would have, but
      for `drop`; `extra`: see `Hits`.
    """

    lists: NodeLists
    accepts: Int[Array, " children"]
    n_accepted: Int[Array, ""]
    n_refined: Int[Array, ""]
    n_dropped: Int[Array, ""]
    extra: Int[Array, ""]


Test = Callable[[Int[Array, "chunk lanes"], Int[Array, " chunk"]], Hits]
Drop = Callable[[Bool[Array, " children"]], Bool[Array, " children"]]


def split(
    lists: NodeLists,
    test: Test,
    drop: Drop,
    branching: int,
    lanes: int,
    absent: int,
    capacity: int,
    chunk: int,
) -> Split:
    """From the lists of a level to those of its children, in chunks; each place looks for its triangle by bisection.

    **Arguments:**

    - `test`: hits of some groups, given their triangles and their node.
    - `drop`: children whose lists are left out, given which are accepted.
    - `lanes`: of the children's groups; `capacity`: children's groups.
    - `chunk`: groups tested or written at once.
    """
    n_in, lanes_in = lists.triangle.shape
    n_groups = jnp.minimum(lists.n_groups, n_in)

    # Bisected for many groups at once: in the loop below its small steps would each be a call.
    node_of_group = owners(lists.start, n_groups, _whole_chunks(n_in, chunk))

    def test_chunk(first, before):
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        node = jax.lax.dynamic_slice_in_dim(node_of_group, first, chunk)
        triangle = jax.lax.dynamic_slice_in_dim(lists.triangle, first, chunk)
        triangle = jnp.where((group < n_groups)[:, None], triangle, absent)
        goes_on, accepts, extra = test(triangle, node)
        both = jnp.concatenate([n_bits_set(goes_on), n_bits_set(accepts)], axis=1)
        ends = jnp.cumsum(both, axis=0, dtype=jnp.int32) + before[None]
        return goes_on, ends - both, ends[-1], extra

    def loop(state):
        first, bits, below, totals, extra = state
        goes_on, starts, totals, more = test_chunk(first, totals)
        bits = jax.lax.dynamic_update_slice_in_dim(bits, goes_on, first, 0)
        below = jax.lax.dynamic_update_slice_in_dim(below, starts, first, 0)
        return first + chunk, bits, below, totals, extra + more

    n_padded = _whole_chunks(n_in, chunk)
    pad = jnp.full((n_padded - n_in, lanes_in), absent, jnp.int32)
    lists = NodeLists(jnp.concatenate([lists.triangle, pad]), lists.start, lists.count)
    state = (
        jnp.int32(0), jnp.zeros((n_padded, branching), jnp.uint32), jnp.zeros((n_padded, 2 * branching), jnp.int32),
        jnp.zeros(2 * branching, jnp.int32), jnp.int64(0),
    )  # fmt: skip
    _, bits, below, totals, extra = jax.lax.while_loop(lambda state: state[0] < n_groups, loop, state)

    # Counts of each (node, child), by the difference of what lies below its first and behind its last group.
    n_rows = below.shape[0]

    def below_at(group):
        return jnp.where((group < n_groups)[:, None], below[jnp.minimum(group, n_rows - 1)], totals[None])

    at = below_at(lists.start)
    counts = at[1:] - at[:-1]
    count, accepts = counts[:, :branching].reshape(-1), counts[:, branching:].reshape(-1)
    accepted = accepts > 0
    kept = jnp.where(drop(accepted), 0, count)
    start = group_starts(kept, lanes)
    n_out = jnp.minimum(start[-1], capacity)
    widest = jnp.max(lists.start[1:] - lists.start[:-1])
    flat_below, flat_bits = below.reshape(-1), bits.reshape(-1)
    flat_triangle = lists.triangle.reshape(-1)

    child_of_group = owners(start, n_out, _whole_chunks(capacity, chunk))

    def write_chunk(first):
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        child = jax.lax.dynamic_slice_in_dim(child_of_group, first, chunk)
        node, which = child // branching, child % branching
        k = ((group - start[child]) * lanes)[:, None] + jnp.arange(lanes, dtype=jnp.int32)
        low, size = lists.start[node], lists.start[node + 1] - lists.start[node]
        wanted = at[node, which][:, None] + k
        # First where the group's first and last triangle come from; the others lie between.
        ends = jnp.stack([wanted[:, 0], jnp.minimum(wanted[:, -1], at[node + 1, which] - 1)], axis=1)
        ends = _last_not_above_in(flat_below, 2 * branching, which, low, size, ends, widest, n_in)
        span = jnp.maximum(ends[:, 1] - ends[:, 0], 0) + 1
        used = jnp.max(jnp.where(group < n_out, span, 1))
        source = _last_not_above_in(flat_below, 2 * branching, which, ends[:, 0], span, wanted, used, n_in)
        word = flat_bits[source * branching + which[:, None]]
        bit = nth_bit_set(word, wanted - flat_below[source * 2 * branching + which[:, None]])
        triangle = flat_triangle[source * lanes_in + jnp.minimum(bit, lanes_in - 1)]
        is_there = (k < kept[child][:, None]) & (group < n_out)[:, None]
        return jnp.where(is_there, triangle, absent)

    def write(state):
        first, triangle = state
        return first + chunk, jax.lax.dynamic_update_slice_in_dim(triangle, write_chunk(first), first, 0)

    state = (jnp.int32(0), jnp.full((_whole_chunks(capacity, chunk), lanes), absent, jnp.int32))
    _, triangle = jax.lax.while_loop(lambda state: state[0] < n_out, write, state)
    triangle = triangle[:capacity]
    return Split(
        NodeLists(triangle, start, kept), accepts, *_totals(accepts, count, kept), extra
    )  # fmt: skip


def _totals(accepts: Array, count: Array, kept: Array) -> tuple[Array, Array, Array]:
    """Pairs accepted, gone on and dropped."""
    n_accepted, n_on, n_kept = (jnp.sum(c, dtype=jnp.int64) for c in (accepts, count, kept))
    return n_accepted, n_kept, n_on - n_kept


def split_at_once(
    lists: NodeLists, test: Test, drop: Drop, branching: int, lanes: int, absent: int, capacity: int
) -> Split:
    """What `split` does, without loops: each triangle is scattered to its place in each child's list.

    A GPU tells the many that go nowhere apart at the speed of arithmetic; a CPU would take 20 ns for each.
    """
    n_in, lanes_in = lists.triangle.shape
    n_nodes = lists.count.shape[0]
    n_groups = jnp.minimum(lists.n_groups, n_in)
    node = lists.nodes()
    is_live = (jnp.arange(n_in, dtype=jnp.int32) < n_groups)[:, None]
    triangle = jnp.where(is_live, lists.triangle, absent)
    goes_on, accepting, extra = test(triangle, node)

    n_on, n_accepting = n_bits_set(goes_on), n_bits_set(accepting)
    ends = jnp.cumsum(n_on, axis=0, dtype=jnp.int32)
    below = ends - n_on
    inside = (lists.start < n_groups)[:, None]
    at = jnp.where(inside, below[jnp.minimum(lists.start, n_in - 1)], ends[-1])
    count = (at[1:] - at[:-1]).reshape(-1)
    row = jnp.where((n_accepting > 0).any(axis=1), node, n_nodes)
    accepts = jnp.zeros((n_nodes, branching), jnp.int32).at[row].add(n_accepting, mode="drop").reshape(-1)
    kept = jnp.where(drop(accepts > 0), 0, count)
    start = group_starts(kept, lanes)

    child = node[:, None] * branching + jnp.arange(branching, dtype=jnp.int32)
    first = jnp.where(kept[child] > 0, start[child] * lanes + below - at[node], capacity * lanes)
    lane = jnp.arange(lanes_in, dtype=jnp.int32)
    word = goes_on[:, :, None]
    place = first[:, :, None] + n_bits_set(word & bits_below(lane))
    place = jnp.where((word >> lane.astype(jnp.uint32) & 1) == 1, place, capacity * lanes)
    # Each takes its node along, so that nobody has to look for a group's.
    listed = child[:, :, None].astype(jnp.int64) << 32 | triangle[:, None, :]
    out = jnp.full(capacity * lanes, absent, jnp.int64).at[place].set(listed, mode="drop", unique_indices=True)
    out = out.reshape(capacity, lanes)
    written = NodeLists((out & (2**32 - 1)).astype(jnp.int32), start, kept, (out[:, 0] >> 32).astype(jnp.int32))
    return Split(written, accepts, *_totals(accepts, count, kept), extra.astype(jnp.int64))


def _whole_chunks(n: int, chunk: int) -> int:
    return -(-n // chunk) * chunk


def _last_not_above_in(flat, stride: int, column, low, size, value, widest, capacity: int):
    """For each value: the last of `size` rows from `low` whose entry in a column is not above it. Bisection."""
    n_steps = max(capacity - 1, 1).bit_length()

    def halve(i, at):
        candidate = at + (jnp.int32(1) << (n_steps - 1 - i))
        there = flat[jnp.minimum(low[:, None] + candidate, capacity - 1) * stride + column[:, None]]
        return jnp.where((candidate < size[:, None]) & (there <= value), candidate, at)

    # Most lists are short: only the steps that the longest one needs.
    needed = jnp.int32(32) - jax.lax.clz(jnp.maximum(widest - 1, 1)).astype(jnp.int32)
    first = jnp.int32(n_steps) - jnp.minimum(needed, n_steps)
    return low[:, None] + jax.lax.fori_loop(first, jnp.int32(n_steps), halve, jnp.zeros_like(value))
