"""Shading of blocks with given lists, against the float64 loop; and the work that it takes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import SMALL, a_camera, gbuffer_of, nearby_lights, seeds, surface_samples
from vtfs.bounds import Aabb
from vtfs.camera import Viewport
from vtfs.clusters import Clusters, everything
from vtfs.light_lists import LightLists, view_lights
from vtfs.reference import largest_relative_difference
from vtfs.shading import chunk_blocks, chunk_work, longest_first, shade

shade_jit = jax.jit(shade, static_argnums=5)
few = settings(max_examples=10, deadline=None)


def on_host(image, viewport):
    return np.stack([oracles.as_image(np.asarray(channel), viewport) for channel in image], axis=-1)


def a_frame(viewport, n_lights, seed, spots=False):
    samples = surface_samples(a_camera(viewport), seed)
    lights = nearby_lights(samples, n_lights, seed, spots)
    return samples, lights, gbuffer_of(samples, "float32")


@pytest.mark.parametrize("batch", [0, 96, 2**24])
@given(seed=seeds)
@few
def test_each_cluster_is_lit_by_its_own_list_only(batch, seed):
    """A cluster for each run, with lists of very different lengths, in any place and order of the index."""
    samples, lights, gbuffer = a_frame(SMALL, 37, seed)
    rng = np.random.default_rng(seed)
    clusters = everything(gbuffer.positions)
    n_runs = len(clusters.block_run)
    capacity = n_runs + 9  # some blocks are not used
    run = np.concatenate([rng.permutation(n_runs), np.zeros(9)]).astype(np.int32)
    of_sample = np.broadcast_to(np.argsort(run[:n_runs])[:, None], (n_runs, 32))
    counts = np.where(rng.random(n_runs) < 0.3, 0, rng.integers(0, 38, n_runs))
    lists = [rng.permutation(37)[:count] for count in counts]
    index = np.full(n_runs * 38, 36, np.int32)  # one shape for all examples
    index[: counts.sum()] = np.concatenate(lists)
    filled = np.concatenate([counts, np.full(9, 37)]).astype(np.int32)  # what is not used holds anything
    offset = np.concatenate([np.cumsum(counts) - counts, np.zeros(9)]).astype(np.int32)
    clusters = Clusters(
        clusters.key, clusters.box, jnp.int32(n_runs), jnp.asarray(run), jnp.arange(capacity), jnp.int32(n_runs),
            jnp.int32(n_runs),
        jnp.asarray(of_sample.astype(np.int32)), jnp.bool_(False),
    )  # fmt: skip
    device = LightLists(
        jnp.asarray(offset), jnp.asarray(filled), jnp.asarray(index), jnp.int32(len(index)), jnp.bool_(False)
    )
    image = on_host(
        shade_jit(gbuffer, clusters, device, view_lights(lights, samples.camera).row, np.float32(0), batch), SMALL
    )
    listed = np.zeros((n_runs, 37), bool)
    for block, some in enumerate(lists):
        listed[run[block], some] = True
    run_of_pixel = oracles.as_image(np.broadcast_to(np.arange(n_runs)[:, None], (n_runs, 32)), SMALL)
    expected = oracles.image(samples, lights, listed=listed[run_of_pixel])
    assert largest_relative_difference(image, expected, samples.valid) < 1e-4
    assert (image[~samples.valid] == 0).all()


@pytest.mark.parametrize("batch", [0, 64])
def test_very_long_lists_lose_no_light(batch):
    """2^18 blocks leave 14 bits to sort by: lists of 16,390 and of 16,500 lights count as equally long."""
    lengths, capacity = np.array([16_390, 16_500]), 2**18
    samples, _, gbuffer = a_frame(Viewport(16, 4), 1, 0)
    zeros = jnp.zeros(capacity, jnp.int32)
    two = zeros.at[:2].set(jnp.arange(2, dtype=jnp.int32))
    clusters = Clusters(
        zeros, Aabb(*(jnp.zeros(1),) * 6), jnp.int32(2), two, two,
        jnp.int32(2), jnp.int32(2), jnp.broadcast_to(jnp.arange(2, dtype=jnp.int32)[:, None], (2, 32)),
        jnp.bool_(False),
    )  # fmt: skip
    # All but the last entry of each list name a black light.
    index = np.zeros(lengths.sum(), np.int32)
    index[np.cumsum(lengths) - 1] = 1
    offset = jnp.array([0, lengths[0]], jnp.int32)
    lists = LightLists(
        offset, jnp.asarray(lengths, jnp.int32), jnp.asarray(index), jnp.int32(len(index)), jnp.bool_(False)
    )
    lights = nearby_lights(samples, 2, 0)
    lights.range_m[:], lights.colour[0] = 1e3, 0
    image = on_host(
        shade_jit(gbuffer, clusters, lists, view_lights(lights, samples.camera).row, np.float32(0), batch),
        Viewport(16, 4),
    )
    assert largest_relative_difference(image, oracles.image(samples, lights), samples.valid) < 1e-4


@pytest.mark.parametrize("capacity", [1, 2, 37, 1024, 2**18])
def test_blocks_are_ordered_by_length_and_those_not_used_come_last(capacity):
    rng = np.random.default_rng(capacity)
    counts = rng.integers(0, [3, 100, 20_000][capacity % 3], capacity).astype(np.int32)
    n_blocks = max(1, capacity // 2)
    order = np.asarray(jax.jit(longest_first)(jnp.asarray(counts), jnp.int32(0), jnp.int32(n_blocks)))
    assert sorted(order) == list(range(capacity))
    assert set(order[:n_blocks]) == set(range(n_blocks))
    assert (np.diff(counts[order[:n_blocks]]) <= 0).all()


@given(
    of_block=st.lists(st.integers(0, 30), min_size=1, max_size=200),
    batch=st.sampled_from([0, 32, 64, 1024, 2**24]),
    spare=st.sampled_from([0, 1, 100, 2000]),
)
@example(of_block=[5] * 64, batch=0, spare=0)
@example(of_block=[0], batch=0, spare=0)
@settings(max_examples=100, deadline=None)
def test_lanes_and_steps_are_those_of_the_slow_loop(of_block, batch, spare):
    capacity = len(of_block) + spare
    expected = oracles.shading_work(of_block, chunk_blocks(capacity, batch), capacity)
    assert chunk_work(np.array(of_block), batch, capacity) == expected


def test_lanes_beyond_32_bits_stay_exact():
    lengths = np.full(2**16, 2**20, np.int32)
    lanes, steps = chunk_work(lengths, 2**24, 2**16)
    assert (lanes, steps) == (2**20 * 2**16 * 32, 2**20)
    assert chunk_work(np.zeros(0, np.int64), 0, 8) == (0, 0)


def test_a_batch_counts_samples_and_is_never_more_than_all():
    assert [chunk_blocks(100, batch) for batch in (0, 32, 64, 1024, 2**24)] == [100, 1, 2, 32, 100]


@pytest.mark.parametrize(("backend", "blocks"), [("cpu", 128), ("gpu", 2**20)])
def test_all_at_once_is_what_stays_in_the_cache_of_a_cpu(monkeypatch, backend, blocks):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert chunk_blocks(2**20, 0) == blocks and chunk_blocks(2**20, 2**25) == 2**20
