"""Occupied clusters: which cells hold samples, their bounds, and the samples of each."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vtfs.bit_lists import bits_below, n_bits_set, pack_bits, set_bits, starts_of
from vtfs.bounds import Aabb
from vtfs.cluster_grid import ClusterGrid, cell_boxes, cell_keys, grid_cells, tile_pixels
from vtfs.gbuffer import RUN, Positions

Bounds = Literal["implicit", "explicit", "depth_range"]


class Clusters(eqx.Module):
    """Occupied clusters in order of their keys, and the blocks that samples are shaded in.

    A block is the part of a run of 32 samples that lies in one cluster: all its samples have the same
    list of lights. A run has as many blocks as it meets clusters.

    - `key`, `box`: of each cluster; the first `n_clusters` of `capacity` entries count.
    - `block_run`, `block_cluster`: run and cluster of each block; the first `n_blocks` of `capacity` count.
    - `block_of_sample`: for each sample; meaningless where the sample is invalid.
    - `n_solid_blocks`: blocks of solid samples, which come before those of transparent ones.
    - `overflowed`: there are more blocks than `capacity`; the rest is meaningless.
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


def form_clusters(
    positions: Positions,
    grid: ClusterGrid,
    bounds: Bounds,
    cells_capacity: int,
    capacity: int,
    two_lists: bool = False,
) -> Clusters:
    """Find the occupied cells by a page table of one flag a cell, and bound them.

    Olsson et al. 2012, Sec. 4.2 ("page tables"). Flags are set by blocks, not samples: some twenty times
    fewer scatters.

    **Arguments:**

    - `bounds`: `implicit`: the cell; `depth_range`: the cell's tile between its nearest and farthest
      sample; `explicit`: the box of its samples.
    - `cells_capacity`: at least the cells of the grid (twice as many with two lists), a multiple of 32.
    - `capacity`: of blocks and clusters.
    - `two_lists`: transparent samples form clusters of their own. With `depth_range` those reach from the near plane
      to the farthest solid sample of the tile, or to the far plane where a pixel of it shows none (Olsson and
      Assarsson 2011, Sec. 6.3).
    """
    n_grid_cells = grid_cells(grid, positions.viewport)
    cell_key = cell_keys(grid, positions)
    if two_lists:
        is_transparent = jnp.arange(cell_key.shape[0]) >= positions.n_solid_runs
        cell_key = cell_key + jnp.where(is_transparent, n_grid_cells, 0)[:, None]
    key = jnp.where(positions.valid, cell_key, -1)
    # Bit i of a sample's word: sample i of the same run lies in the same cell. The lowest one leads.
    together = pack_bits(key[:, :, None] == key[:, None, :])[..., 0]
    leader = n_bits_set(~together & (together - jnp.uint32(1)))
    leads = pack_bits((leader == jnp.arange(RUN)) & positions.valid)
    start, n_blocks = starts_of(n_bits_set(leads[:, 0]))
    n_solid_blocks = start[positions.n_solid_runs] if positions.n_transparent_runs else n_blocks
    block_of_sample = start[:, None] + n_bits_set(leads & bits_below(leader))

    place = jnp.arange(capacity, dtype=jnp.int32)
    block_run, lane = set_bits(leads, start, place)
    in_use = place < n_blocks
    block_key = jnp.where(in_use, key[block_run, lane], 0)

    # Unused places write past the end, which `drop` leaves out.
    flags = jnp.zeros(cells_capacity, bool).at[jnp.where(in_use, block_key, cells_capacity)].set(True, mode="drop")
    words = pack_bits(flags.reshape(-1, RUN))
    cell_start, n_clusters = starts_of(n_bits_set(words[:, 0]))
    row, bit = set_bits(words, cell_start, place)
    cluster_key = row * RUN + bit

    def cluster_of(key: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Of occupied cells."""
        return cell_start[key // RUN] + n_bits_set(words[key // RUN, 0] & bits_below(key % RUN))

    block_cluster = cluster_of(block_key)
    cluster_key = jnp.where(place < n_clusters, cluster_key, 0)
    cluster_cell = cluster_key % n_grid_cells if two_lists else cluster_key
    if bounds == "implicit":
        box = cell_boxes(grid, positions.viewport, cluster_cell)
    else:
        target = jnp.where(in_use, block_cluster, capacity)
        in_block = key[block_run] == block_key[:, None]
        if bounds == "depth_range":
            low_z, high_z = _extent(positions.z_m[block_run], in_block, target)
            # Unused clusters have no samples: infinite depths would make NaNs of their corners.
            used = place < n_clusters
            near_m, far_m = jnp.where(used, -high_z, 1.0), jnp.where(used, -low_z, 1.0)
            if two_lists:
                # Where every pixel of a tile shows a solid sample, none of its transparent ones lies beyond those.
                n_samples = jnp.zeros(capacity, jnp.int32).at[target].add(jnp.sum(in_block, axis=1), mode="drop")
                is_transparent = cluster_key >= n_grid_cells
                solid = jnp.minimum(cluster_of(cluster_cell), capacity - 1)
                is_covered = flags[cluster_cell] & (
                    n_samples[solid] == tile_pixels(grid, positions.viewport, cluster_cell)
                )
                z_far_m = grid.z_near_m * jnp.exp(grid.depth_slices.astype(jnp.float32) * grid.log_growth)
                near_m = jnp.where(is_transparent, grid.z_near_m, near_m)
                far_m = jnp.where(is_transparent, jnp.where(is_covered, far_m[solid], z_far_m), far_m)
            box = cell_boxes(grid, positions.viewport, cluster_cell, (near_m, far_m))
        else:
            (low_x, high_x), (low_y, high_y), (low_z, high_z) = (
                _extent(component[block_run], in_block, target)
                for component in (positions.x_m, positions.y_m, positions.z_m)
            )
            box = Aabb(low_x, low_y, low_z, high_x, high_y, high_z)
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
    )


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
