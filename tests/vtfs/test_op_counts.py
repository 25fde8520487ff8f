"""Counts from list lengths, against loops over samples; and sums beyond 32 bits."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import SMALL, WIDE, a_camera, gbuffer_of, seeds, surface_samples
from vtfs.light_lists import AssignCounts
from vtfs.op_counts import (
    ListLengths,
    assign_counts,
    batch_counts,
    cluster_counts,
    memory_counts,
    shading_counts,
    uniform_lengths,
)

some = settings(max_examples=25, deadline=None)


@pytest.mark.parametrize("viewport", [SMALL, WIDE], ids=str)
@given(tile_px=st.integers(2, 70), seed=seeds)
@some
def test_divergence_is_the_longest_list_of_each_run_in_tile_order(viewport, tile_px, seed):
    rng = np.random.default_rng(seed)
    of_sample = rng.integers(0, 50, (viewport.height_px, viewport.width_px)) * (rng.random(1) < 0.9)
    counts = shading_counts(ListLengths(of_sample, of_sample, np.zeros(1), np.zeros(7), 7), 123, 0, (tile_px, tile_px))
    assert counts["divergence"] == oracles.divergence(of_sample, tile_px)
    assert counts["lighting_computations"] == sum(int(n) for n in of_sample.ravel())
    assert counts["samples"] == 123 and counts["shading_blocks"] == 7


def test_caps_drop_what_is_above_them():
    of_cluster = np.array([0, 31, 32, 33, 100, 1025, 5000])
    counts = cluster_counts(ListLengths(np.zeros((1, 1)), np.zeros((1, 1)), of_cluster, np.zeros(1), 1), 99, 6000)
    for cap in (32, 64, 128, 256, 512, 1024):
        assert counts[f"dropped_at_cap_{cap}"] == sum(max(0, n - cap) for n in of_cluster.tolist())
    assert counts["light_cluster_pairs"] == 6221 and counts["longest_list"] == 5000
    assert (counts["clusters_occupied"], counts["cells_total"], counts["lights"]) == (7, 99, 6000)
    empty = cluster_counts(
        ListLengths(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros(0, np.int64), np.zeros(0), 0), 99, 6000
    )
    assert empty["light_cluster_pairs"] == empty["longest_list"] == empty["clusters_occupied"] == 0


@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_sums_beyond_32_bits_stay_exact(dtype):
    of_sample = np.full((1024, 1024), 2**20, dtype)
    lengths = ListLengths(of_sample, of_sample, np.full(2**13, 2**20, dtype), np.zeros(1), 1)
    counts = shading_counts(lengths, 2**20, 0, (32, 32)) | cluster_counts(lengths, 2**31 - 1, 2**20)
    assert counts["lighting_computations"] == counts["divergence"] == 2**40
    assert counts["light_cluster_pairs"] == 2**33 and counts["dropped_at_cap_1024"] == 2**13 * (2**20 - 1024)
    rows = jnp.int32(2**31 - 1)
    none = jnp.zeros(0, jnp.int32)
    assert assign_counts(AssignCounts(none, none, rows, jnp.int32(0)), 64, 32)["leaf_tests"] == (2**31 - 1) * 32
    assert all(type(value) is int for value in counts.values())


@pytest.mark.parametrize("n_lights", [0, 1, 32, 37, 200])
def test_brute_force_tests_every_light_for_every_cluster(n_lights):
    none, n_clusters = jnp.zeros(0, jnp.int32), 13
    rows = n_clusters * max(1, -(-n_lights // 32))
    counts = assign_counts(AssignCounts(none, none, jnp.int32(rows), jnp.int32(n_clusters)), n_lights, 32)
    assert counts["leaf_tests"] == n_clusters * n_lights and counts["tree_tests"] == 0


def test_batches_are_counted_in_whole_chunks():
    counts = batch_counts(np.array([3, 1, 7]), 3, (1, 64, 65, 0), 64, 8, 64)
    assert counts["assign_steps"] == 1 + 1 + 2 + 0
    lanes, steps = oracles.shading_work([3, 1, 7], 2, 8)
    assert (counts["shading_lanes"], counts["shading_steps"]) == (lanes, steps)


def test_forward_lists_every_light_for_every_sample():
    samples = surface_samples(a_camera(), 0)
    gbuffer = gbuffer_of(samples, "float32")
    lengths = uniform_lengths(gbuffer.positions, 37)
    assert (lengths.of_sample == np.where(samples.valid, 37, 0)).all()
    assert shading_counts(lengths, samples.n_valid, 0, (32, 32))["lighting_computations"] == 37 * int(
        samples.valid.sum()
    )


@pytest.mark.parametrize(("precision", "channel_bytes"), [("float32", 4), ("float16", 2), ("bfloat16", 2)])
def test_bytes_are_those_of_the_arrays(precision, channel_bytes):
    samples = surface_samples(a_camera(), 0)
    gbuffer = gbuffer_of(samples, precision)
    counts = memory_counts(gbuffer, [jnp.zeros(100), {"a": jnp.zeros(3, jnp.int32)}], 500, 70)
    lanes = 25 * 32  # runs of 33 x 17 pixels
    sample_bytes = 12 + 1 + 11 * channel_bytes  # position, valid; normal, base, emissive, specular, shininess
    assert counts["memory"] == lanes * sample_bytes + 25 * 4 + 400 + 12
    assert counts["bytes_moved"] == 500 * (sample_bytes + 12) + 2 * 4 * 70
