"""Lists refined from groups to clusters are those of brute force, whatever the boxes, the levels and the chunks."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import LIGHT_KINDS, a_camera, adversarial_lights, cameras, positions_of, random_samples, seeds
from tests.vtfs.test_light_assignment import as_spheres, boxes_and_spheres, clusters_of, lists_of
from vtfs.bit_lists import last_not_above_in_order, list_bits, n_bits_set, pack_bits
from vtfs.bounds import Aabb
from vtfs.cluster_grid import cluster_grid, n_cells
from vtfs.clusters import Clusters, form_clusters
from vtfs.light_assignment import coarse_to_fine
from vtfs.light_assignment.brute_force import assign_brute_force
from vtfs.light_assignment.coarse_to_fine import assign_coarse_to_fine, n_tests
from vtfs.light_assignment.occupancy import near_any
from vtfs.light_lists import view_lights

CAPACITY = 2**14
some = settings(max_examples=20, deadline=None)

assign = jax.jit(assign_coarse_to_fine, static_argnums=(2, 3, 4))


def with_unused(clusters, n_clusters):
    """Only the first clusters count; what stands in the others is not to be read."""
    return Clusters(
        clusters.key,
        clusters.box,
        jnp.int32(n_clusters),
        clusters.block_run,
        clusters.block_cluster,
        clusters.n_blocks,
        clusters.n_solid_blocks,
        clusters.block_of_sample,
        clusters.overflowed,
    )


@pytest.mark.parametrize(("n_lights", "branching"), [(1, 4), (200, 8)])
@given(spread=st.sampled_from([0.1, 3.0, 1e5]), n_clusters=st.sampled_from([0, 1, 49, 50]), seed=seeds)
@example(spread=3.0, n_clusters=33, seed=1)
@some
def test_lists_are_those_of_float64_within_the_slack(n_lights, branching, spread, n_clusters, seed):
    low, high, centre, radius = boxes_and_spheres(n_lights, spread, seed)
    clusters = with_unused(clusters_of(low, high), n_clusters)
    lists, _ = assign(as_spheres(centre, radius), clusters, CAPACITY, 256, branching)
    must = oracles.spheres_in_boxes(centre, radius, low, high)
    # 1e-6 on the squared radius, and as much for rounding, is 1e-6 on the radius.
    may = oracles.spheres_in_boxes(centre, radius, low, high, share=1 + 1e-6)
    must[n_clusters:], may[n_clusters:] = False, False
    assert not lists.overflowed and int(lists.total) == int(lists.count.sum())
    assert (lists.offset == jnp.cumsum(lists.count) - lists.count).all()
    for found, needed, allowed in zip(lists_of(lists), must, may, strict=True):
        assert set(np.flatnonzero(needed)) <= set(found) <= set(np.flatnonzero(allowed))
        assert (np.diff(found) > 0).all()  # ascending, so none twice


@pytest.fixture
def lights_are_many(monkeypatch):
    """From the first light on, those near no cluster are dropped before anything else."""
    monkeypatch.setattr(coarse_to_fine, "_MANY", 1)
    return jax.jit(lambda s, c: coarse_to_fine.assign_coarse_to_fine(s, c, CAPACITY, 256, 8)[0])


def test_lists_of_many_lights_are_those_of_few(lights_are_many):
    for spread, seed in itertools.product((0.1, 3.0, 1e5), range(4)):
        low, high, centre, radius = boxes_and_spheres(200, spread, seed)
        spheres = as_spheres(centre, radius)
        for n_clusters in (0, 1, 50):
            clusters = with_unused(clusters_of(low, high), n_clusters)
            expected, _ = assign(spheres, clusters, CAPACITY, 256, 8)
            lists = lights_are_many(spheres, clusters)
            assert not lists.overflowed
            assert [a.tolist() for a in lists_of(lists)] == [a.tolist() for a in lists_of(expected)]


@pytest.mark.parametrize(("spread", "most_near"), [(0.1, 1.0), (3.0, 0.9), (1e5, 0.5)])
def test_what_meets_a_box_is_near_and_what_is_far_from_all_is_not(spread, most_near):
    n_near = 0
    for seed in range(10):
        low, high, centre, radius = boxes_and_spheres(200, spread, seed)
        n_used = 7
        used, box = jnp.arange(len(low)) < n_used, clusters_of(low, high).box
        near = np.asarray(near_any_box(as_spheres(centre, radius), box, used))
        meets = oracles.spheres_in_boxes(centre, radius, low[:n_used], high[:n_used]).any(axis=0)
        assert not (meets & ~near).any() and not near[np.isinf(centre[:, 0])].any()
        n_near += near.sum()
        beyond = np.full_like(centre, high[:n_used].max() + 10)
        assert not near_any_box(as_spheres(beyond, np.ones_like(radius)), box, used).any()
    assert n_near <= most_near * 10 * 200


near_any_box = jax.jit(near_any)


def brute_force_and_refined(camera, tile_px, bounds, kinds, seed):
    samples = random_samples(camera, seed)
    spheres = view_lights(adversarial_lights(samples, 200, kinds, seed), camera).spheres(jnp.float32(0))
    grid = cluster_grid(camera, tile_px, 24, camera.near_m * 1e4)
    positions = positions_of(samples)
    cells = 2**17
    assert n_cells(grid, camera.viewport) <= cells
    clusters = form(positions, grid, bounds, cells, 1024)
    return brute(spheres, clusters, 2**18, 512), assign(spheres, clusters, 2**18, 512, 16)


form = jax.jit(form_clusters, static_argnums=(2, 3, 4))
brute = jax.jit(assign_brute_force, static_argnums=(2, 3))
every_kind = st.one_of(st.just(LIGHT_KINDS), st.sampled_from([(kind,) for kind in LIGHT_KINDS]))


@given(
    camera=cameras(),
    tile_px=st.sampled_from([2, 8, 32]),
    bounds=st.sampled_from(["implicit", "explicit"]),
    kinds=every_kind,
    seed=seeds,
)
@some
def test_the_lists_of_a_view_are_those_of_brute_force(camera, tile_px, bounds, kinds, seed):
    """Lights behind the camera, around it, huge, without range, on the planes of cells: nothing is special."""
    (expected, _), (lists, _) = brute_force_and_refined(camera, tile_px, bounds, kinds, seed)
    assert not lists.overflowed and not expected.overflowed
    # A light at rounding's edge of a box may be judged otherwise in another program: multiply-adds are contracted.
    differing = int(jnp.abs(lists.count - expected.count).sum())
    assert differing <= max(2, 1e-4 * int(expected.total))
    if not differing:
        total = int(lists.total)
        assert (lists.count == expected.count).all() and (lists.index[:total] == expected.index[:total]).all()


@pytest.mark.parametrize("chunk", [32, 2**15])
def test_the_chunk_never_changes_a_list_or_a_count(chunk):
    low, high, centre, radius = boxes_and_spheres(200, 3.0, 3)
    spheres, clusters = as_spheres(centre, radius), clusters_of(low, high)
    expected, counts = assign(spheres, clusters, CAPACITY, 256, 8)
    lists, same_counts = assign(spheres, clusters, CAPACITY, chunk, 8)
    assert [a.tolist() for a in lists_of(lists)] == [a.tolist() for a in lists_of(expected)]
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), counts, same_counts))


def test_without_loops_the_lists_are_the_same(monkeypatch):
    """What a GPU runs where one step holds everything."""
    low, high, centre, radius = boxes_and_spheres(200, 3.0, 3)
    spheres, clusters = as_spheres(centre, radius), clusters_of(low, high)
    expected, _ = assign(spheres, clusters, CAPACITY, 256, 8)
    with monkeypatch.context() as patched:
        patched.setattr(jax, "default_backend", lambda: "gpu")
        program = jax.jit(lambda s, c: assign_coarse_to_fine(s, c, CAPACITY, 2**16, 8)[0])
        compiled = program.lower(spheres, clusters).compile()
    assert " while(" not in str(compiled.as_text())
    lists = compiled(spheres, clusters)
    assert not lists.overflowed and lists.index.shape == (CAPACITY,)
    assert [a.tolist() for a in lists_of(lists)] == [a.tolist() for a in lists_of(expected)]


@pytest.mark.parametrize("capacity", [64, 1024])
def test_what_does_not_fit_on_any_level_is_said(capacity):
    low, high, centre, radius = boxes_and_spheres(200, 3.0, 3)
    spheres, clusters = as_spheres(centre, radius), clusters_of(low, high)
    whole, _ = assign(spheres, clusters, CAPACITY, 256, 8)
    assert int(whole.total) > 1024
    assert bool(assign(spheres, clusters, capacity, 256, 8)[0].overflowed)


def test_no_lights_make_empty_lists():
    low, high, _, _ = boxes_and_spheres(1, 3.0, 3)
    lists, counts = assign(as_spheres(np.zeros((0, 3), np.float32), np.zeros(0, np.float32)), clusters_of(low, high),
                           CAPACITY, 256, 8)  # fmt: skip
    assert int(lists.total) == 0 and not lists.overflowed and not lists.count.any()
    assert n_tests(counts) == (0, 0)


def test_more_tests_than_32_bits_count_are_not_taken_for_none():
    """2^18 clusters in one point against 2^18 lights around it: 2^36 pairs."""
    n = 2**18
    zeros, whole = jnp.zeros(n), jnp.zeros(n, jnp.int32)
    box = Aabb(zeros, zeros, zeros, zeros, zeros, zeros)
    clusters = Clusters(
        whole, box, jnp.int32(n), whole, whole, jnp.int32(n), jnp.int32(n), whole[None], jnp.bool_(False)
    )
    lists, _ = assign(as_spheres(np.zeros((n, 3), np.float32), np.ones(n, np.float32)), clusters, 1024, 1024, 32)
    assert bool(lists.overflowed)


@pytest.mark.parametrize(("n_clusters", "n_lights"), [(50, 200), (33, 200), (1, 200)])
def test_tests_are_counted_as_a_loop_counts_them(n_clusters, n_lights):
    """Of existing children of nodes only, and of lights in their lists."""
    low, high, centre, radius = boxes_and_spheres(n_lights, 3.0, 5)
    centre[np.isinf(centre[:, 0]), 0] = 1e6  # far away: its tests count like all others
    clusters = with_unused(clusters_of(low, high), n_clusters)
    _, counts = assign(as_spheres(centre, radius), clusters, CAPACITY, 256, 8)
    n_coarse, kept = 0, {}
    for n in range(-(-n_clusters // 8)):
        last = min(8 * n + 8, n_clusters)
        box = low[8 * n : last].min(0)[None], high[8 * n : last].max(0)[None]
        n_coarse += n_lights
        kept[n] = np.flatnonzero(oracles.spheres_in_boxes(centre, radius, *box)[0])
    n_fine = sum(len(kept[cluster // 8]) for cluster in range(n_clusters))
    assert n_tests(counts) == (n_coarse, n_fine)


# --- lists of bits: marks, one step, and the search in windows ----------------------------------------


@pytest.mark.parametrize("most_rows", [None, 64])
@given(seed=seeds, n_rows=st.integers(0, 64), share=st.sampled_from([0.0, 0.05, 0.5, 1.0]))
@some
def test_bits_are_listed_and_marks_counted(most_rows, seed, n_rows, share):
    rng = np.random.default_rng(seed)
    mask = rng.random((64, 32)) < share
    mark = rng.integers(0, 65, 9)
    (row, bit), total, before = listed(jnp.asarray(mask), jnp.int32(n_rows), jnp.asarray(mark, jnp.int32), most_rows)
    expected = np.argwhere(mask[:n_rows])
    assert int(total) == len(expected)
    assert np.array_equal(np.stack([row, bit], axis=1)[: len(expected)], expected)
    below = np.minimum(mark, n_rows)
    assert before[mark < max(n_rows, 1)].tolist() == [mask[:n].sum() for n in below[mark < max(n_rows, 1)]]


@jax.jit
def _listed_in_loops(mask, n_rows, mark):
    return _list(mask, n_rows, mark, 32, None)


@jax.jit
def _listed_at_once(mask, n_rows, mark):
    return _list(mask, n_rows, mark, 2048, 64)


def listed(mask, n_rows, mark, most_rows):
    return (_listed_at_once if most_rows else _listed_in_loops)(mask, n_rows, mark)


def _list(mask, n_rows, mark, chunk, most_rows):
    def words_of(row):
        there = (row < n_rows)[:, None] & mask[jnp.minimum(row, 63)]
        return pack_bits(there), (row,)

    return list_bits(n_rows, words_of, lambda row, bit: (row[0], bit), 2, mark, 2048, chunk, most_rows)


@given(seed=seeds, share=st.sampled_from([1e-3, 0.05, 0.9]), first=st.integers(0, 5000))
@example(seed=0, share=1e-3, first=0)  # too far apart for windows
@some
def test_values_in_order_find_the_last_entry_not_above(seed, share, first):
    rng = np.random.default_rng(seed)
    counts = np.asarray(n_bits_set(jnp.asarray(rng.integers(0, 2**32, 1000, dtype=np.uint32))))
    counts = np.where(rng.random(1000) < share, counts, 0)
    ascending = np.cumsum(counts) - counts
    values = first + np.arange(256)
    found = in_order(jnp.asarray(ascending, jnp.int32), jnp.asarray(values, jnp.int32))
    assert found.tolist() == (np.searchsorted(ascending, values, side="right") - 1).tolist()


in_order = jax.jit(last_not_above_in_order)


def test_a_camera_is_not_needed():
    """One cluster that is everything: lights behind the eye too."""
    samples = random_samples(a_camera(), 5)
    lights = view_lights(adversarial_lights(samples, 37, ("behind", "around_eye"), 7), samples.camera)
    big = np.full((1, 3), 1e6, np.float32)
    lists, _ = assign(lights.spheres(jnp.float32(0)), clusters_of(-big, big), CAPACITY, 256, 4)
    assert int(lists.total) == 37
