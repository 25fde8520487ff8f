# NumPy arrays stand for those of the device.
# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
"""Occupied clusters, their bounds and their blocks, against a loop over samples."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import SMALL, WIDE, gbuffer_of, positions_of, samples_in_slices, seeds
from vtfs.cluster_grid import cell_boxes, cluster_grid
from vtfs.clusters import everything, form_clusters
from vtfs.normal_cones import bin_of_normal

some = settings(max_examples=8, deadline=None)
CELLS, CAPACITY = 2**15, 2**12
form = jax.jit(form_clusters, static_argnums=(2, 3, 4, 5, 6, 8))


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


def test_what_a_gpu_runs_makes_the_same_clusters(monkeypatch):
    samples, _ = samples_in_slices(SMALL, 7, 3, 0.8)
    grid, positions = cluster_grid(samples.camera, 2, 7, 0.0), positions_of(samples)
    expected = form(positions, grid, "implicit", CELLS, CAPACITY)
    with monkeypatch.context() as patched:
        patched.setattr(jax, "default_backend", lambda: "gpu")
        program = jax.jit(lambda p, g: form_clusters(p, g, "implicit", CELLS, CAPACITY)).lower(positions, grid)
    found = program.compile()(positions, grid)
    n_clusters, n_blocks = int(expected.n_clusters), int(expected.n_blocks)
    assert int(found.n_clusters) == n_clusters > 10 and int(found.n_blocks) == n_blocks
    assert np.array_equal(found.key[:n_clusters], expected.key[:n_clusters])
    assert np.array_equal(found.block_cluster[:n_blocks], expected.block_cluster[:n_blocks])
    valid = np.asarray(positions.valid)
    assert np.array_equal(found.block_of_sample[valid], expected.block_of_sample[valid])


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


@given(
    tile_px=st.integers(2, 80),
    n_slices=st.sampled_from([1, 7, 24]),
    seed=seeds,
    valid_share=st.sampled_from([0.0, 0.02, 0.8, 1.0]),
)
@some
def test_sorting_finds_what_the_page_table_finds(tile_px, n_slices, seed, valid_share):
    samples, _ = samples_in_slices(SMALL, n_slices, seed, valid_share)
    grid, positions = cluster_grid(samples.camera, tile_px, n_slices, 0.0), positions_of(samples)
    table, ordered = (form(positions, grid, "explicit", CELLS, CAPACITY, unique) for unique in ("page_table", "sort"))
    n_blocks, n_clusters = int(table.n_blocks), int(table.n_clusters)
    assert (int(ordered.n_blocks), int(ordered.n_clusters)) == (n_blocks, n_clusters)
    for name, n in (("key", n_clusters), ("block_run", n_blocks), ("block_cluster", n_blocks)):
        assert (np.asarray(getattr(table, name))[:n] == np.asarray(getattr(ordered, name))[:n]).all()
    assert (np.asarray(table.block_of_sample) == np.asarray(ordered.block_of_sample))[np.asarray(positions.valid)].all()
    for one, other in zip(jax.tree.leaves(table.box), jax.tree.leaves(ordered.box), strict=True):
        assert (np.asarray(one)[:n_clusters] == np.asarray(other)[:n_clusters]).all()


@given(tile_px=st.integers(2, 40), n_slices=st.sampled_from([1, 24]), seed=seeds)
@some
def test_packed_bounds_are_the_bits_of_each_axis(tile_px, n_slices, seed):
    """10 bits an axis, one for each tenth of the cell's box that holds a sample (equations.md, section 1)."""
    samples, slices = samples_in_slices(SMALL, n_slices, seed)
    grid, positions = cluster_grid(samples.camera, tile_px, n_slices, 0.0), positions_of(samples)
    packed = form(positions, grid, "packed", CELLS, CAPACITY)
    columns, rows = -(-SMALL.width_px // tile_px), -(-SMALL.height_px // tile_px)
    whole = np.array([np.asarray(side) for side in jax.tree.leaves(cell_boxes(grid, SMALL, packed.key))], np.float64)
    found = np.array([np.asarray(side) for side in jax.tree.leaves(packed.box)], np.float64)
    place = {int(key): n for n, key in enumerate(np.asarray(packed.key)[: int(packed.n_clusters)])}
    for (k, j, i), pixels in oracles.cells(samples, tile_px, slices).items():
        n = place[(k * rows + j) * columns + i]
        inside = samples.position_m[tuple(np.transpose(pixels))].astype(np.float64)
        low, high = whole[:3, n], whole[3:, n]
        bit = (inside - low) / (high - low) * 10
        assert (found[:3, n] <= inside.min(0)).all() and (inside.max(0) <= found[3:, n]).all()
        # Within a thousandth of a bit's edge float32 may take the bit beside it.
        least, most = np.floor(bit.min(0) - 1e-3), np.floor(bit.max(0) + 1e-3) + 1
        assert (found[:3, n] >= low + (least - 1e-3) / 10 * (high - low)).all()
        assert (found[3:, n] <= low + (most + 1e-3) / 10 * (high - low)).all()


@pytest.mark.parametrize("normal_cones", ["implicit", "explicit"])
@given(tile_px=st.integers(8, 80), normal_bins=st.integers(1, 4), seed=seeds)
@some
def test_bins_of_normals_split_cells(normal_cones, tile_px, normal_bins, seed):
    samples, _ = samples_in_slices(SMALL, 7, seed)
    grid, positions = (
        cluster_grid(samples.camera, tile_px, 7, 0.0, "self_similar", normal_bins),
        positions_of(samples),
    )
    normals = gbuffer_of(samples).normal
    whole = form(positions, cluster_grid(samples.camera, tile_px, 7, 0.0), "implicit", CELLS, CAPACITY)
    split = form(positions, grid, "implicit", CELLS, CAPACITY, "sort", False, normals, normal_cones)
    n_bins = 6 * normal_bins**2
    valid = np.asarray(positions.valid)

    def of_samples(clusters):
        return np.asarray(clusters.block_cluster)[np.asarray(clusters.block_of_sample)]

    cell, part = (np.asarray(c.key)[of_samples(c)][valid] for c in (whole, split))
    index = np.asarray(bin_of_normal(np.int32(normal_bins), normals))[valid]  # type: ignore[arg-type]
    assert (part // n_bins == cell).all() and (part % n_bins == index).all()
    assert split.cones is not None
    cones = np.array([np.asarray(side) for side in jax.tree.leaves(split.cones)], np.float64)[:, of_samples(split)][
        :, valid
    ]
    normal = np.array([np.asarray(component) for component in normals], np.float64)[:, valid]
    cos = (cones[:3] * normal).sum(0) / np.linalg.norm(cones[:3], axis=0) / np.linalg.norm(normal, axis=0)
    assert (cos >= cones[3]).all()
