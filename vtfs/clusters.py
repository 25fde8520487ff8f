"""Occupied clusters: which cells hold samples, their bounds, and the samples of each."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.bit_lists import bits_below, last_not_above, n_bits_set, pack_bits, set_bits, starts_of
from vtfs.bounds import Aabb
from vtfs.cell_shapes import CellSections, within_box
from vtfs.cluster_grid import ClusterGrid, cell_boxes, cell_keys, cell_sections, tile_pixels
from vtfs.gbuffer import RUN, Positions
from vtfs.normal_cones import (
    Components,
    ConeKind,
    NormalCones,
    bin_of_normal,
    bins_per_cell,
    cones_of_bins,
    cones_of_samples,
)

Bounds = Literal["implicit", "explicit", "packed", "frustum", "depth_range"]
Unique = Literal["sort", "page_table"]

_PACKED_STEPS = 10
_LAST_KEY = 2**31 - 1


class Clusters(eqx.Module):
    """Occupied clusters in order of their keys, and the blocks that samples are shaded in.

    A block is the part of a run of 32 samples that lies in one cluster: all its samples have the same
    list of lights. A run has as many blocks as it meets clusters.

    - `key`, `box`: of each cluster; the first `n_clusters` of `capacity` entries count.
    - `block_run`, `block_cluster`: run and cluster of each block; the first `n_blocks` of `capacity` count.
    - `block_of_sample`: for each sample; meaningless where the sample is invalid.
    - `n_solid_blocks`: blocks of solid samples, which come before those of transparent ones.
    - `overflowed`: there are more blocks than `capacity`; the rest is meaningless.
    - `section`: the cells themselves, or the parts of them that hold the samples; only for culls that read them.
    - `cones`: of the normals of each cluster, where asked for.
    """

    key: Int[Array, " capacity"]
    box: Aabb
    n_clusters: Int[Array, ""]
    block_run: Int[Array, " capacity"]
    block_cluster: Int[Array, " capacity"]
    n_blocks: Int[Array, ""]
    n_solid_blocks: Int[Array, ""]
    block_of_sample: Int[Array, "runs 32"]
    overflowed: Bool[Array, ""]
    section: CellSections | None = None
    cones: NormalCones | None = None


def form_clusters(
    positions: Positions,
    grid: ClusterGrid,
    bounds: Bounds,
    cells_capacity: int,
    capacity: int,
    unique: Unique = "page_table",
    sections: bool = False,
    normals: Components | None = None,
    normal_cones: ConeKind = "implicit",
    two_lists: bool = False,
) -> Clusters:
    """Find the occupied cells, and bound them.

    A key is a cell's, or with bins of normals `cell * bins + bin`. Keys are made unique within runs first: the rest
    works on blocks, some twenty times fewer than samples.

    **Arguments:**

    - `bounds`: `implicit`, `frustum`: the cell; `depth_range`: the cell's tile between its nearest and farthest
      sample; `explicit`: the box of its samples; `packed`: that box in tenths of the cell's, as 10 bits an axis hold
      it (Olsson et al. 2014, Sec. 4.4).
    - `cells_capacity`: at least the keys of the grid (twice as many with two lists), a multiple of 32.
    - `capacity`: of blocks and clusters.
    - `unique`: `page_table`: one flag a key (Olsson et al. 2012, Sec. 4.2); `sort`: keys in order, runs of equal
      ones cut to one. The result is the same.
    - `sections`: make `Clusters.section`, for culls other than `box`.
    - `normals`: of the samples, for bins and cones.
    - `normal_cones`: `implicit`: around the bin; `explicit`: around the samples' normals.
    - `two_lists`: transparent samples form clusters of their own, whose keys follow those of all solid ones. With
      `depth_range` they reach from the near plane to the farthest solid sample of the tile, or to the far plane where
      a pixel of it shows none (Olsson and Assarsson 2011, Sec. 6.3).
    """
    key = cell_keys(grid, positions)
    n_bins = bins_per_cell(grid.normal_bins) if normals is not None else 1
    if normals is not None:
        key = key * n_bins + bin_of_normal(grid.normal_bins, normals)
    columns, rows = grid.tiles(positions.viewport)
    n_keys = columns * rows * grid.depth_slices * n_bins
    if two_lists:
        is_transparent_run = jnp.arange(key.shape[0]) >= positions.n_solid_runs
        key = key + jnp.where(is_transparent_run, n_keys, 0)[:, None]
    key = jnp.where(positions.valid, key, -1)
    # Bit i of a sample's word: sample i of the same run lies in the same cell. The lowest one leads.
    together = _equal_in_run(key)
    leader = n_bits_set(~together & (together - jnp.uint32(1)))
    leads = pack_bits((leader == jnp.arange(RUN)) & positions.valid)
    start, n_blocks = starts_of(n_bits_set(leads[:, 0]))
    n_solid_blocks = start[positions.n_solid_runs] if positions.n_transparent_runs else n_blocks
    block_of_sample = start[:, None] + n_bits_set(leads & bits_below(leader))

    place = jnp.arange(capacity, dtype=jnp.int32)
    block_run, lane = set_bits(leads, start, place)
    in_use = place < n_blocks
    block_key = jnp.where(in_use, key[block_run, lane], 0)

    find = _by_sorting if unique == "sort" else _by_page_table
    cluster_key, n_clusters, block_cluster = find(block_key, in_use, cells_capacity)
    used = place < n_clusters
    cluster_key = jnp.where(used, cluster_key, 0)
    solid_key, viewport = cluster_key % n_keys if two_lists else cluster_key, positions.viewport
    cell = solid_key // n_bins

    target = jnp.where(in_use, block_cluster, capacity)
    in_block = key[block_run] == block_key[:, None]
    depths = None
    if bounds == "depth_range":
        low_z, high_z = _extent(positions.z_m[block_run], in_block, target)
        # Unused clusters have no samples: infinite depths would make NaNs of their corners.
        depths = (jnp.where(used, -high_z, 1.0), jnp.where(used, -low_z, 1.0))
        if two_lists:
            n_samples = jnp.zeros(capacity, jnp.int32).at[target].add(jnp.sum(in_block, axis=1), mode="drop")
            is_transparent = cluster_key >= n_keys
            behind = _farthest_solid_m(
                grid, positions, cell, used & ~is_transparent, depths[1], n_samples, cells_capacity
            )
            depths = (
                jnp.where(is_transparent, grid.z_near_m, depths[0]),
                jnp.where(is_transparent, behind, depths[1]),
            )
    if bounds in ("explicit", "packed"):
        (low_x, high_x), (low_y, high_y), (low_z, high_z) = (
            _extent(component[block_run], in_block, target)
            for component in (positions.x_m, positions.y_m, positions.z_m)
        )
        box = Aabb(low_x, low_y, low_z, high_x, high_y, high_z)
        if bounds == "packed":
            box = _packed(box, cell_boxes(grid, viewport, cell))
    else:
        box = cell_boxes(grid, viewport, cell, depths)
    section = cell_sections(grid, viewport, cell, depths) if sections else None
    if section is not None and bounds in ("explicit", "packed"):
        section = within_box(section, box)
    cones = None
    if normals is not None:
        if normal_cones == "explicit":
            in_blocks = tuple(component[block_run] for component in normals)
            cones = cones_of_samples(in_blocks, in_block, target)  # type: ignore[arg-type]  # three of them
        else:
            cones = cones_of_bins(grid.normal_bins, solid_key % n_bins)
    return Clusters(
        cluster_key,
        box,
        n_clusters,
        block_run,
        block_cluster,
        n_blocks,
        n_solid_blocks,
        block_of_sample,
        n_blocks > capacity,
        section,
        cones,
    )


def _equal_in_run(key: Int[Array, "runs 32"]) -> UInt32[Array, "runs 32"]:
    """For each sample one bit for each sample of its run: have they the same key?"""
    if jax.default_backend() == "cpu":
        return pack_bits(key[:, :, None] == key[:, None, :])[..., 0]
    # On a GPU a thread makes a word of its own: a reduction would have 32 threads meet for each.
    key = jax.lax.optimization_barrier(key)
    words = jnp.zeros(key.shape, jnp.uint32)
    for lane in range(RUN):
        words |= (key == key[:, lane, None]).astype(jnp.uint32) << lane
    return words


def _farthest_solid_m(
    grid: ClusterGrid,
    positions: Positions,
    cell: Int[Array, " capacity"],
    is_solid: Bool[Array, " capacity"],
    far_m: Float[Array, " capacity"],
    n_samples: Int[Array, " capacity"],
    cells_capacity: int,
) -> Float[Array, " capacity"]:
    """Depth of the farthest solid sample of each cluster's cell: no visible transparent sample lies beyond it. The far
    plane where a pixel shows no solid sample."""
    solid_cell = jnp.where(is_solid, cell, cells_capacity)
    farthest_m = jnp.zeros(cells_capacity, jnp.float32).at[solid_cell].max(far_m, mode="drop")[cell]
    n_solid = jnp.zeros(cells_capacity, jnp.int32).at[solid_cell].add(n_samples, mode="drop")[cell]
    return jnp.where(n_solid == tile_pixels(grid, positions.viewport, cell), farthest_m, grid.z_far_m)


Found = tuple[Int[Array, " capacity"], Int[Array, ""], Int[Array, " capacity"]]


def _by_page_table(block_key: Int[Array, " capacity"], in_use: Bool[Array, " capacity"], cells_capacity: int) -> Found:
    """Keys of the clusters in ascending order, their number, and the cluster of each block."""
    place = jnp.arange(block_key.shape[0], dtype=jnp.int32)
    # Unused places write past the end, which `drop` leaves out.
    # Bytes are a quarter of the memory to clear, but a GPU writes one by replacing the word around it.
    flag = jnp.bool_ if jax.default_backend() == "cpu" else jnp.int32
    flags = jnp.zeros(cells_capacity, flag).at[jnp.where(in_use, block_key, cells_capacity)].set(True, mode="drop")
    words = pack_bits(flags.reshape(-1, RUN) != 0)
    cell_start, n_clusters = starts_of(n_bits_set(words[:, 0]))
    row, bit = set_bits(words, cell_start, place)
    block_word = block_key // RUN
    block_cluster = cell_start[block_word] + n_bits_set(words[block_word, 0] & bits_below(block_key % RUN))
    return row * RUN + bit, n_clusters, block_cluster


def _by_sorting(block_key: Int[Array, " capacity"], in_use: Bool[Array, " capacity"], cells_capacity: int) -> Found:
    """The same without a flag for every key: keys alone are sorted (a CPU sorts pairs six times slower), and each
    block finds its cluster by bisection."""
    capacity = block_key.shape[0]
    place = jnp.arange(capacity, dtype=jnp.int32)
    ordered = jnp.sort(jnp.where(in_use, block_key, _LAST_KEY))
    is_first = (ordered != jnp.concatenate([jnp.full(1, -1, jnp.int32), ordered[:-1]])) & (ordered < _LAST_KEY)
    words = pack_bits(jnp.pad(is_first, (0, -capacity % RUN)).reshape(-1, RUN))
    start, n_clusters = starts_of(n_bits_set(words[:, 0]))
    row, bit = set_bits(words, start, place)
    key = jnp.where(place < n_clusters, ordered[jnp.minimum(row * RUN + bit, capacity - 1)], _LAST_KEY)
    return key, n_clusters, last_not_above(key, block_key)


def _packed(box: Aabb, cell: Aabb) -> Aabb:
    """Boxes grown to tenths of their cells' boxes: the range between the lowest and the highest bit of an axis.

    The bits themselves need an atomic or, which XLA does not have; the lowest bit of all samples is the one of the
    least coordinate.
    """

    def outward(low, high, cell_low, cell_high):
        step = (cell_high - cell_low) / _PACKED_STEPS
        # Where rounding puts a bit's edge inside, the sample itself is the bound.
        below = cell_low + jnp.clip(jnp.floor((low - cell_low) / step), 0, _PACKED_STEPS - 1) * step
        above = cell_low + (jnp.clip(jnp.floor((high - cell_low) / step), 0, _PACKED_STEPS - 1) + 1) * step
        return jnp.minimum(below, low), jnp.maximum(above, high)

    low_x, high_x = outward(box.low_x_m, box.high_x_m, cell.low_x_m, cell.high_x_m)
    low_y, high_y = outward(box.low_y_m, box.high_y_m, cell.low_y_m, cell.high_y_m)
    low_z, high_z = outward(box.low_z_m, box.high_z_m, cell.low_z_m, cell.high_z_m)
    return Aabb(low_x, low_y, low_z, high_x, high_y, high_z)


def _extent(
    value: Float[Array, "capacity 32"], in_block: Bool[Array, "capacity 32"], cluster: Int[Array, " capacity"]
) -> tuple[Float[Array, " capacity"], Float[Array, " capacity"]]:
    """Least and greatest value over the samples of each cluster; its blocks first, then one scatter a block."""
    low = jnp.min(jnp.where(in_block, value, jnp.inf), axis=1)
    high = jnp.max(jnp.where(in_block, value, -jnp.inf), axis=1)
    return (
        jnp.full(cluster.shape, jnp.inf, jnp.float32).at[cluster].min(low, mode="drop"),
        jnp.full(cluster.shape, -jnp.inf, jnp.float32).at[cluster].max(high, mode="drop"),
    )


def everything(positions: Positions) -> Clusters:
    """One cluster that holds all samples, without bounds: what `forward` shades."""
    n_runs = positions.z_m.shape[0]
    run = jnp.arange(n_runs, dtype=jnp.int32)
    nowhere = jnp.zeros(n_runs)
    return Clusters(
        key=jnp.zeros(n_runs, jnp.int32),
        box=Aabb(nowhere, nowhere, nowhere, nowhere, nowhere, nowhere),
        n_clusters=jnp.int32(1),
        block_run=run,
        block_cluster=jnp.zeros(n_runs, jnp.int32),
        n_blocks=jnp.int32(n_runs),
        n_solid_blocks=jnp.int32(positions.n_solid_runs),
        block_of_sample=jnp.broadcast_to(run[:, None], (n_runs, RUN)),
        overflowed=jnp.bool_(False),
    )
