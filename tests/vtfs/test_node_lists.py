"""Splitting the lists of nodes into those of their children does what a loop over lists does, in order."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.strategies import seeds
from vtfs.node_lists import NodeLists, grouped, one_list, owners, pairs_of, split, split_at_once

N_TRIANGLES, N_NODES, BRANCHING, LANES = 100, 5, 4, 8
CAPACITY_IN = 70
some = settings(max_examples=15, deadline=None)


def packed(lists: list[list[int]]) -> NodeLists:
    """Lists in groups of `LANES`, padded with the absent triangle."""
    count = np.array([len(members) for members in lists])
    start = np.concatenate([[0], np.cumsum(-(-count // LANES))])
    triangle = np.full((CAPACITY_IN, LANES), N_TRIANGLES)
    for node, members in enumerate(lists):
        for k, member in enumerate(members):
            triangle[start[node] + k // LANES, k % LANES] = member
    return NodeLists(*(jnp.asarray(values, jnp.int32) for values in (triangle, start, count)))


def split_by_tables(lists: NodeLists, goes_on, accepts, drops: bool, capacity: int, chunk: int):
    """Split where two tables `[triangle, child]` say what happens; at once where `chunk` is 0."""
    shift = jnp.arange(LANES, dtype=jnp.uint32)

    def test(triangle, node):
        child = node[:, None] * BRANCHING + jnp.arange(BRANCHING)
        on, accepted = (table[triangle[:, None, :], child[:, :, None]] for table in (goes_on, accepts))
        words = (jnp.sum(bits.astype(jnp.uint32) << shift, axis=-1, dtype=jnp.uint32) for bits in (on, accepted))
        return next(words), next(words), jnp.sum(on, dtype=jnp.int32)

    def drop(accepted):
        return accepted if drops else jnp.zeros_like(accepted)

    if not chunk:
        return split_at_once(lists, test, drop, BRANCHING, LANES, N_TRIANGLES, capacity)
    return split(lists, test, drop, BRANCHING, LANES, N_TRIANGLES, capacity, chunk)


split_jit = jax.jit(split_by_tables, static_argnums=(3, 4, 5))


@pytest.mark.parametrize(
    ("drops", "capacity", "chunk"), [(True, 300, 7), (False, 300, 1000), (True, 300, 0), (False, 300, 0)]
)
@given(seed=seeds, share=st.sampled_from([0.0, 0.05, 0.5, 1.0]), accepted=st.sampled_from([0.0, 0.02, 1.0]))
@example(seed=0, share=1.0, accepted=0.0)
@some
def test_children_get_what_goes_on_in_order(drops, capacity, chunk, seed, share, accepted):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, N_TRIANGLES + 1, N_NODES)
    lists = [sorted(rng.choice(N_TRIANGLES, n, replace=False).tolist()) for n in sizes]
    shape = (N_TRIANGLES + 1, N_NODES * BRANCHING)
    accepts = rng.random(shape) < accepted
    goes_on = (rng.random(shape) < share) & ~accepts
    goes_on[N_TRIANGLES] = accepts[N_TRIANGLES] = False
    with jax.enable_x64(True):
        done = split_jit(packed(lists), goes_on, accepts, drops, capacity, chunk)
    assert not bool(done.lists.overflowed)
    start, count, triangle = (
        np.asarray(values) for values in (done.lists.start, done.lists.count, done.lists.triangle)
    )
    n_accepted = n_kept = n_on = 0
    for child in range(N_NODES * BRANCHING):
        members = lists[child // BRANCHING]
        is_accepted = [t for t in members if accepts[t, child]]
        n_accepted += len(is_accepted)
        assert int(done.accepts[child]) == len(is_accepted)
        expected = [] if drops and is_accepted else [t for t in members if goes_on[t, child]]
        n_kept += len(expected)
        n_on += sum(goes_on[t, child] for t in members)
        row = triangle[start[child] : start[child + 1]].ravel()
        assert count[child] == len(expected) and row[: len(expected)].tolist() == expected
        assert (row[len(expected) :] == N_TRIANGLES).all() and len(row) - len(expected) < LANES
    assert int(done.n_accepted) == n_accepted and int(done.n_refined) == n_kept
    assert int(done.n_dropped) == n_on - n_kept
    assert int(done.extra) == sum(goes_on[t, c] for c in range(shape[1]) for t in lists[c // BRANCHING])


@pytest.mark.parametrize("chunk", [7, 0])
def test_lists_that_do_not_fit_say_so(chunk):
    everything = np.ones((N_TRIANGLES + 1, N_NODES * BRANCHING), bool)
    everything[N_TRIANGLES] = False
    lists = packed([list(range(N_TRIANGLES))] * N_NODES)
    with jax.enable_x64(True):
        done = split_jit(lists, everything, ~everything & False, True, 100, chunk)
    assert bool(done.lists.overflowed) and int(done.lists.n_groups) == 20 * 13


@pytest.mark.parametrize("members", [[], [0], [99], list(range(100)), [3, 50, 51]])
def test_the_roots_list_holds_the_members(members):
    mask = np.zeros(N_TRIANGLES, bool)
    mask[members] = True
    with jax.enable_x64(True):
        root = one_list(jnp.asarray(mask), LANES, N_TRIANGLES)
        n = int(root.count[0])
        row = np.asarray(root.triangle).ravel()
    assert row[:n].tolist() == members and (row[n:] == N_TRIANGLES).all()


@given(seed=seeds, share=st.sampled_from([0.0, 0.3, 1.0]))
@some
def test_lists_survive_being_pairs(seed, share):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, N_TRIANGLES + 1, N_NODES)
    lists = [sorted(rng.choice(N_TRIANGLES, n, replace=False).tolist()) for n in sizes]
    dropped = rng.random(N_NODES) < share
    with jax.enable_x64(True):
        (triangle, node), n = pairs_of(packed(lists), N_TRIANGLES, N_TRIANGLES * N_NODES)
        back = grouped(triangle, node, n, jnp.asarray(dropped), LANES, N_TRIANGLES, CAPACITY_IN)
    assert int(n) == sizes.sum()
    assert [(int(t), int(m)) for t, m in zip(triangle[: int(n)], node[: int(n)], strict=True)] == [
        (t, m) for m, members in enumerate(lists) for t in members
    ]
    expected = packed([[] if drop else members for members, drop in zip(lists, dropped, strict=True)])
    assert (np.asarray(back.count) == np.asarray(expected.count)).all()
    assert (np.asarray(back.start) == np.asarray(expected.start)).all()
    assert (np.asarray(back.triangle) == np.asarray(expected.triangle)).all()


def test_the_nodes_of_lists_that_overflow_are_found_for_as_many_groups_as_there_is_room():
    # Saturated, as `group_starts` leaves it: a loop over all of them would take minutes.
    start = jnp.array([0, 3, 3, 2**30], jnp.int32)
    node = owners(start, jnp.int32(2**30), 2**14 + 5)
    assert node.shape == (2**14 + 5,)
    assert node[:4].tolist() == [0, 0, 0, 2] and (node[3 : 2**13] == 2).all()
