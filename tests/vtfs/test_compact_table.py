"""The compact tree of clusters: its nodes are those of the full tree that hold an item, and nothing else."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.strategies import seeds
from vtfs.bounds import Aabb
from vtfs.shadow_volumes.hierarchy import NO_SLOT, compact_table

N_PLACES, CAPACITY = 40, 24
some = settings(max_examples=20, deadline=None)


@jax.jit
def _rounded(value):
    return value.astype(jnp.float32)


def table_of(low, high, key, n_items, n_keys: int, branching: int):
    """Traced: shapes from a short list."""
    with jax.enable_x64(True):
        boxes = Aabb(*(_rounded(low[:, c]) for c in range(3)), *(_rounded(high[:, c]) for c in range(3)))
        return compact_table(boxes, jnp.asarray(key), jnp.int32(n_items), n_keys, branching, CAPACITY)


@pytest.mark.parametrize(("n_keys", "branching"), [(4096, 8), (4096, 32), (1000, 5), (64, 2), (8, 8), (4, 32)])
@given(seed=seeds, share=st.sampled_from([0.0, 0.1, 0.5, 1.0]))
@some
def test_nodes_are_those_of_the_full_tree_that_hold_an_item(n_keys, branching, seed, share):
    rng = np.random.default_rng(seed)
    n_items = int(share * min(N_PLACES, n_keys))
    key = np.full(N_PLACES, n_keys, np.int64)
    key[:n_items] = np.sort(rng.choice(n_keys, n_items, replace=False))
    low = rng.normal(size=(N_PLACES, 3)).astype(np.float32)
    high = low + rng.random((N_PLACES, 3)).astype(np.float32)
    found, most = table_of(low, high, key, n_items, n_keys, branching)
    levels = found.level_nodes
    ids = [np.unique(key[:n_items] // branching**k) for k in range(len(levels) + 1)]
    assert int(most) == max(len(nodes) for nodes in ids[1:])
    if int(most) > CAPACITY:
        return  # refused: what is written is not read
    child, slot, row = (np.asarray(value) for value in (found.child, found.slot, found.row))
    first_row, first_child = found.first_row, found.first_child
    for level in range(len(levels)):
        above, below = ids[len(levels) - level], ids[len(levels) - level - 1]
        assert int(found.n_below[level]) == len(below)
        rows = slice(first_row[level], first_row[level] + levels[level])
        # Each child stands in the slot that its key says, of the node of which it is a part.
        expected = np.full((levels[level], branching), -1)
        parent = np.searchsorted(above, below // branching)
        expected[parent, below % branching] = np.arange(len(below))
        assert (child[rows] == expected).all()
        own = slot[first_child[level] :][: levels[level + 1] if level + 1 < len(levels) else N_PLACES]
        assert (own[: len(below)] == parent * branching + below % branching).all() and (
            own[len(below) :] == NO_SLOT
        ).all()
        # Its box holds its items, and but for the padding no more; where there is no child there is no box.
        assert (np.isnan(row[rows][:, 0]) == (expected < 0)).all()
        of_item = np.searchsorted(below, key[:n_items] // branching ** (len(levels) - level - 1))
        for k, place in enumerate(zip(parent, below % branching, strict=True)):
            own_low, own_high = low[:n_items][of_item == k].min(axis=0), high[:n_items][of_item == k].max(axis=0)
            centre, half = row[rows][place[0], :3, place[1]], row[rows][place[0], 3:, place[1]]
            assert (centre - half <= own_low).all() and (centre + half >= own_high).all()
            np.testing.assert_allclose(
                half, (own_high - own_low) / 2, rtol=1e-4, atol=1e-4
            )  # the padding: parts in 1e5
    # All of what lies below the root can be read a level at a time, also past the last level's end.
    assert found.n_places == len(slot) == sum(levels[1:]) + N_PLACES
