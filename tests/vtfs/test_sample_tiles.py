"""View samples in tiles and clusters, and nodes above them: against a loop over samples."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.strategies import SMALL, a_camera, positions_of, samples_at
from vtfs.bounds import Aabb
from vtfs.camera import Viewport
from vtfs.cluster_grid import depth_slices
from vtfs.gbuffer import from_runs, to_runs
from vtfs.input_error import InputError
from vtfs.shadow_techniques import grid_of, shadow_grid
from vtfs.shadow_volumes.full_tree import at_their_keys, keys_of, n_cells
from vtfs.shadow_volumes.hierarchy import merged_up, node_table
from vtfs.shadow_volumes.sample_tiles import in_runs, sample_clusters, sample_tiles, tile_order


def deep_samples():
    """Neighbours anywhere between 1 and 1,000 m: of each tile many slices are occupied, far apart."""
    rng = np.random.default_rng(0)
    camera = a_camera(SMALL, near_m=0.5, far_m=2e3)
    shape = SMALL.height_px, SMALL.width_px
    return samples_at(camera, 10 ** rng.uniform(0, 3, shape), rng.random(shape) < 0.8, rng)


def members_of(words: np.ndarray) -> list[int]:
    return [32 * w + bit for w, word in enumerate(words.tolist()) for bit in range(32) if word >> bit & 1]


@pytest.mark.parametrize(("tile_px", "n_slices"), [(8, 8192), (8, 24), (5, 1500), (2, 700)])
def test_clusters_are_the_tiles_and_slices_that_samples_lie_in(tile_px, n_slices):
    samples = deep_samples()
    receives = samples.valid & (np.random.default_rng(1).random(samples.valid.shape) < 0.9)
    grid = shadow_grid(samples, tile_px, n_slices)
    depth_m = -samples.position_m[..., 2]
    slice_k = np.asarray(depth_slices(grid, jnp.where(receives, depth_m, 1.0)))
    columns = -(-SMALL.width_px // tile_px)
    expected: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for y, x in zip(*np.nonzero(receives), strict=True):
        cell = int(y // tile_px * columns + x // tile_px), int(slice_k[y, x])
        expected.setdefault(cell, []).append((int(y), int(x)))
    assert n_slices < 100 or max(k for _, k in expected) > 512 + min(k for _, k in expected)
    with jax.enable_x64(True):
        tiles = sample_tiles(positions_of(samples), jnp.asarray(to_runs(receives)), tile_px)
        found = sample_clusters(tiles, grid, explicit=True, capacity=1024)
        back = from_runs(np.asarray(in_runs(tiles.receives, SMALL, tile_px)), SMALL)
    assert (back == receives).all()
    assert int(found.n_clusters) == len(expected) <= int(found.n_blocks) <= 1024
    cells = [(int(t), int(k)) for t, k in zip(found.tile, found.slice_k, strict=True)][: len(expected)]
    assert sorted(cells) == sorted(expected)
    codes = [morton(t % columns, t // columns, k) for t, k in cells]
    assert codes == sorted(codes)
    box = np.stack([np.asarray(c) for c in jax.tree.leaves(found.box)])
    for c, cell in enumerate(cells):
        own = expected[cell]
        lanes = sorted(y % tile_px * tile_px + x % tile_px for y, x in own)
        assert members_of(np.asarray(found.members[c])) == lanes
        assert {int(found.of_sample[cell[0], lane]) for lane in lanes} == {c}
        at = np.array([samples.position_m[y, x] for y, x in own], np.float32)
        assert (box[:3, c] == at.min(axis=0)).all() and (box[3:, c] == at.max(axis=0)).all()


def morton(column: int, row: int, slice_k: int) -> int:
    parts = (column, row, slice_k)
    return sum((part >> bit & 1) << (3 * bit + k) for bit in range(13) for k, part in enumerate(parts))


@pytest.mark.parametrize("viewport", [Viewport(8193, 1), Viewport(1, 16384)])
def test_more_columns_or_rows_than_a_key_has_bits_for_are_refused(viewport):
    camera = a_camera(viewport)
    assert grid_of(camera, 10.0, 2, 1).depth_slices == 1
    with pytest.raises(InputError, match=r"tile_px=1 cuts [\d,]+ pixels .*at most 8,192"):
        grid_of(camera, 10.0, 1, 1)


def test_a_full_tree_holds_each_cluster_at_a_key_of_its_own():
    samples = deep_samples()
    grid = shadow_grid(samples, 8, 700)
    cells = n_cells(-(-SMALL.width_px // 8), -(-SMALL.height_px // 8), 700)
    with jax.enable_x64(True):
        tiles = sample_tiles(positions_of(samples), jnp.asarray(to_runs(samples.valid)), 8)
        compact = sample_clusters(tiles, grid, explicit=True, capacity=1024)
        key, beyond = keys_of(compact, tiles, cells)
        full = at_their_keys(compact, key, cells)
        _, too_deep = keys_of(compact, tiles, cells // 4)
    n = int(compact.n_clusters)
    assert (np.diff(key[:n]) > 0).all() and (np.asarray(key[n:]) == cells).all()
    exists = np.asarray(full.members).any(axis=1)
    assert not bool(beyond) and bool(too_deep) and exists.sum() == n
    pairs = {(int(t), int(k)) for t, k in zip(compact.tile[:n], compact.slice_k[:n], strict=True)}
    assert {(int(full.tile[c]), int(full.slice_k[c])) for c in np.flatnonzero(exists)} == pairs
    receives = np.asarray(tiles.receives)
    of_sample = np.asarray(full.of_sample)[receives]
    own_slice = np.asarray(compact.slice_k)[np.asarray(compact.of_sample)[receives]]
    assert (np.asarray(full.slice_k)[of_sample] == own_slice).all()
    assert (np.asarray(full.tile)[of_sample] == np.nonzero(receives)[0]).all()


def test_runs_of_32_tiles_are_8_by_4_and_then_4_by_8():
    tile, place_of = tile_order(32, 32)
    assert sorted(tile.tolist()) == list(range(1024)) and (tile[place_of] == np.arange(1024)).all()
    for n, extents in ((32, (8, 4)), (1024, (32, 32))):
        for run in tile.reshape(-1, n):
            assert (np.ptp(run % 32) + 1, np.ptp(run // 32) + 1) == extents
    above = tile[::32].reshape(-1, 32)  # a node of 32 nodes of 8 x 4 tiles: 4 across and 8 down
    assert [len({int(t) % 32 for t in run}) for run in above] == [4]
    assert [len({int(t) // 32 for t in run}) for run in above] == [8]
    ragged, of_tile = tile_order(5, 3)
    assert len(ragged) == 32 and (ragged >= 0).sum() == 15 and (ragged[of_tile] == np.arange(15)).all()


def test_a_node_lies_in_shadow_where_all_its_children_do():
    """50 items under nodes of four: 16 places of leaf nodes, 13 of them there."""
    n_items, b = 64, 4
    low = jnp.where(jnp.arange(n_items) < 50, jnp.arange(n_items, dtype=jnp.float32), jnp.inf)
    high = jnp.where(jnp.arange(n_items) < 50, low + 1, -jnp.inf)
    with jax.enable_x64(True):
        table = node_table(Aabb(low, low, low, high, high, high), b, is_frustum=False)
        first = int(table.first_child[-1])
        rng = np.random.default_rng(0)
        in_shadow = np.zeros(table.n_places, bool)
        items = in_shadow[first : first + n_items]
        items[:50] = rng.random(50) < 0.3
        items[[*range(16), *range(20, 24), 48, 49]] = True  # a node of nodes; one node; the last one, half full
        found = np.asarray(merged_up(jnp.asarray(in_shadow), table))
    assert table.level_nodes == (1, 4, 16)
    assert (found[first : first + n_items] == items).all()
    leaves = [bool(items[4 * k : min(4 * k + 4, 50)].all()) and 4 * k < 50 for k in range(16)]
    inner = [all(leaves[j] for j in range(4 * k, min(4 * k + 4, 13))) for k in range(4)]
    assert found[4:20].tolist() == leaves and found[:4].tolist() == inner
    assert inner[0] and leaves[5] and leaves[12] and not inner[1]
