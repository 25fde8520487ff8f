"""The tree's boxes hold what is below them; the walk finds what a loop over everything finds, in order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import seeds
from vtfs.bounds import Aabb, boxes_meet
from vtfs.light_culling import box_rows
from vtfs.wide_tree import build_tree, inner_level_nodes, n_child_tests, n_leaf_nodes, walk

SHAPES = [(1, 2), (37, 2), (64, 8), (65, 8), (37, 64), (513, 8)]
N_QUERIES, CAPACITY, CHUNK = 20, 2**14, 128
some = settings(max_examples=6, deadline=None)


def random_boxes(n, rng, spread=10.0):
    low = rng.normal(size=(n, 3)) * spread
    return low.astype(np.float32), (low + rng.random((n, 3)) * rng.choice([0.0, 1.0, spread])).astype(np.float32)


def as_aabb(low, high):
    return Aabb(*(jnp.asarray(a[:, c]) for a in (low, high) for c in range(3)))


@pytest.mark.parametrize(("n_items", "branching"), SHAPES)
def test_the_boxes_of_children_are_those_of_all_items_below(n_items, branching):
    low, high = random_boxes(n_items, np.random.default_rng(n_items))
    tree = build_tree(as_aabb(low, high), branching)
    children = np.asarray(tree.children)
    assert len(children) == sum(tree.level_nodes)
    first, below = len(children), branching  # items below one child of the lowest inner level
    for n_nodes in reversed(tree.level_nodes):
        first -= n_nodes
        for node in range(n_nodes):
            for child in range(branching):
                start = (node * branching + child) * below
                box = children[first + node, :, child]
                if start >= n_items:
                    assert (box[:3] == np.inf).all() and (box[3:] == -np.inf).all()
                else:
                    assert (box[:3] == low[start : start + below].min(0)).all()
                    assert (box[3:] == high[start : start + below].max(0)).all()
        below *= branching
    assert first == 0 and (not tree.level_nodes or tree.level_nodes[0] == 1)


@pytest.mark.parametrize(
    ("n_items", "branching", "levels"),
    [
        (1, 32, ()),
        (32, 32, ()),
        (33, 32, (1,)),
        (1024, 32, (1,)),
        (1025, 32, (1, 2)),
        (5_000_000, 32, (1, 5, 153, 4883)),
    ],
)
def test_levels_have_as_few_nodes_as_hold_the_items(n_items, branching, levels):
    assert inner_level_nodes(n_items, branching) == levels
    assert n_leaf_nodes(n_items, branching) == -(-n_items // branching)


def test_a_tree_over_five_million_lights_has_the_published_number_of_nodes():
    # equations.md, section 3: 161,292 nodes of all levels, the leaves' included
    assert sum(inner_level_nodes(5_000_000, 32)) + n_leaf_nodes(5_000_000, 32) == 161_292


def walk_boxes(low, high, query_low, query_high, kept, branching, capacity=CAPACITY, chunk=CHUNK):
    """Queries are boxes; of the items that they reach, those of a table `kept` are listed."""
    tree = build_tree(as_aabb(low, high), branching)
    queries = as_aabb(query_low, query_high)
    n_items = len(low)

    def keep(query, node):
        item = node[:, None] * branching + jnp.arange(branching)
        return (item < n_items) & kept[query[:, None], jnp.minimum(item, n_items - 1)]

    def descend(query, children):
        return boxes_meet(children, box_rows(queries, query))

    return walk(tree, jnp.int32(len(query_low)), descend, keep, capacity, chunk)


walk_jit = jax.jit(walk_boxes, static_argnums=(5, 6, 7))


def slow_walk(low, high, query_low, query_high, kept, branching):
    def descend(query, items):
        return bool((query_low[query] <= high[items].max(0)).all() and (low[items].min(0) <= query_high[query]).all())

    return oracles.walk(len(low), branching, len(query_low), descend, lambda query, item: bool(kept[query, item]))


@pytest.mark.parametrize(("n_items", "branching"), SHAPES)
@given(seed=seeds, share=st.sampled_from([0.0, 0.1, 1.0]))
@example(seed=0, share=1.0)
@some
def test_a_walk_finds_and_counts_what_the_slow_one_does(n_items, branching, seed, share):
    rng = np.random.default_rng(seed)
    low, high = random_boxes(n_items, rng)
    query_low, query_high = random_boxes(N_QUERIES, rng)
    kept = rng.random((N_QUERIES, n_items)) < share
    found = walk_jit(low, high, query_low, query_high, kept, branching, CAPACITY, CHUNK)
    expected = slow_walk(low, high, query_low, query_high, kept, branching)
    assert not found.overflowed and int(found.total) == len(expected.pairs)
    pairs = np.stack([found.query, found.item], axis=1)[: len(expected.pairs)]
    assert pairs.tolist() == [list(pair) for pair in expected.pairs]
    levels = inner_level_nodes(n_items, branching)
    n_below = (*levels[1:], n_leaf_nodes(n_items, branching))[: len(levels)]
    assert n_child_tests(found.node_rows, found.short_rows, n_below, branching) == expected.child_tests
    leaf_tests = n_child_tests(found.leaf_rows[None], found.short_leaf_rows[None], (n_items,), branching)
    assert leaf_tests == expected.item_tests


@pytest.mark.parametrize("chunk", [7, 2**15])
def test_the_chunk_changes_nothing(chunk):
    rng = np.random.default_rng(0)
    boxes = (*random_boxes(200, rng), *random_boxes(N_QUERIES, rng), rng.random((N_QUERIES, 200)) < 0.5)
    expected, found = (walk_jit(*boxes, 8, CAPACITY, width) for width in (CHUNK, chunk))
    n = int(expected.total)
    assert n > 0 and int(found.total) == n
    assert (found.query[:n] == expected.query[:n]).all() and (found.item[:n] == expected.item[:n]).all()
    assert (found.node_rows == expected.node_rows).all() and (found.short_rows == expected.short_rows).all()


@pytest.mark.parametrize(("capacity", "share"), [(19, 0.0), (64, 0.0), (256, 0.0), (1, 1.0), (512, 1.0)])
def test_what_does_not_fit_on_any_level_says_so(capacity, share):
    """With share 0 only inner levels are crowded, never the result."""
    rng = np.random.default_rng(1)
    low, high = random_boxes(200, rng)
    everything = np.full((N_QUERIES, 3), -1e3, np.float32), np.full((N_QUERIES, 3), 1e3, np.float32)
    kept = np.full((N_QUERIES, 200), share == 1)
    found = walk_jit(low, high, *everything, kept, 8, capacity, CHUNK)
    assert bool(found.overflowed)
    found = walk_jit(low, high, *everything, kept, 8, CAPACITY, CHUNK)
    assert not found.overflowed and int(found.total) == kept.sum()


def test_counts_beyond_32_bits_stay_exact():
    rows = np.array([2**31 - 1, 2**31 - 1], np.int64)
    assert n_child_tests(rows, np.array([2**30, 0]), (33, 64), 32) == 2 * (2**31 - 1) * 32 - 2**30 * 31  # type: ignore[arg-type]
