"""Occupied clusters, their bounds and their blocks, against a loop over samples."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import SMALL, WIDE, positions_of, samples_in_slices, seeds
from vtfs.cluster_grid import cluster_grid
from vtfs.clusters import everything, form_clusters

some = settings(max_examples=8, deadline=None)
CELLS, CAPACITY = 2**15, 2**12
form = jax.jit(form_clusters, static_argnums=(2, 3, 4))


@pytest.mark.parametrize(
    ("bounds", "viewport"), [("implicit", WIDE), ("explicit", SMALL), ("depth_range", WIDE)], ids=str
)
@given(
    tile_px=st.integers(2, 80),
    n_slices=st.sampled_from([1, 7, 24]),
    seed=seeds,
    valid_share=st.sampled_from([0.0, 0.02, 0.8, 1.0]),
)
@some
def test_clusters_are_the_cells_that_hold_samples(viewport, bounds, tile_px, n_slices, seed, valid_share):
    samples, slices = samples_in_slices(viewport, n_slices, seed, valid_share)
    grid = cluster_grid(samples.camera, tile_px, n_slices, 0.0)
    clusters = form(positions_of(samples), grid, bounds, CELLS, CAPACITY)
    cells = oracles.cells(samples, tile_px, slices)
    columns, rows = -(-viewport.width_px // tile_px), -(-viewport.height_px // tile_px)
    keys = sorted((k * rows + j) * columns + i for k, j, i in cells)
    n_clusters, n_blocks = int(clusters.n_clusters), int(clusters.n_blocks)
    key = np.asarray(clusters.key)
    assert not clusters.overflowed and key[:n_clusters].tolist() == keys

    # Each valid sample is in one block, of its own run and of its own cluster; no block is empty.
    block = oracles.as_image(clusters.block_of_sample, viewport)
    run_of_pixel = oracles.as_image(
        np.broadcast_to(np.arange(len(clusters.block_of_sample))[:, None], clusters.block_of_sample.shape), viewport
    )
    seen = set()
    for (k, j, i), pixels in cells.items():
        for y, x in pixels:
            b = block[y, x]
            assert 0 <= b < n_blocks and clusters_run(clusters)[b] == run_of_pixel[y, x]
            assert key[np.asarray(clusters.block_cluster)[b]] == (k * rows + j) * columns + i
            seen.add(b)
    assert len(seen) == n_blocks == len({(run_of_pixel[p], cell) for cell, pixels in cells.items() for p in pixels})

    box = [np.asarray(a)[:n_clusters] for a in jax.tree.leaves(clusters.box)]
    for (k, j, i), pixels in cells.items():
        n = keys.index((k * rows + j) * columns + i)
        inside = samples.position_m[tuple(np.transpose(pixels))]
        low, high = np.array([b[n] for b in box[:3]]), np.array([b[n] for b in box[3:]])
        if bounds == "explicit":
            assert (low == inside.min(0)).all() and (high == inside.max(0)).all()
        else:
            assert (low <= inside.min(0)).all() and (inside.max(0) <= high).all()
        if bounds == "depth_range":
            slack = 3e-5 * -inside[:, 2].min()
            assert high[2] <= inside[:, 2].max() + slack and low[2] >= inside[:, 2].min() - slack


def clusters_run(clusters):
    return np.asarray(clusters.block_run)


def test_blocks_that_do_not_fit_say_so():
    samples, _ = samples_in_slices(SMALL, 24, 0)
    grid, positions = cluster_grid(samples.camera, 2, 24, 0.0), positions_of(samples)
    needed = int(form(positions, grid, "implicit", CELLS, CAPACITY).n_blocks)
    for capacity, overflows in ((needed - 1, True), (needed, False)):
        clusters = form(positions, grid, "implicit", CELLS, capacity)
        assert int(clusters.n_blocks) == needed and bool(clusters.overflowed) == overflows


def test_everything_is_one_cluster_of_all_runs():
    samples, _ = samples_in_slices(WIDE, 24, 0)
    clusters = everything(positions_of(samples))
    assert int(clusters.n_clusters) == 1 and int(clusters.n_blocks) == 8 * 10
    assert (np.asarray(clusters.block_of_sample) == np.arange(80)[:, None]).all()
