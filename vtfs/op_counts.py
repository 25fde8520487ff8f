"""What a frame did, counted: 64-bit integers on the host, from the lists that the device made."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from vtfs.clusters import Clusters
from vtfs.gbuffer import RUN, GBuffer, from_runs
from vtfs.light_lists import AssignCounts, LightLists
from vtfs.shading import chunk_work
from vtfs.wide_tree import inner_level_nodes, n_child_tests, n_leaf_nodes

CAPS = (32, 64, 128, 256, 512, 1024)

OpCounts = dict[str, int]


@dataclass(frozen=True)
class ListLengths:
    """Lists of one frame on the host.

    - `of_sample`: `[h, w]`, lights in the list of each valid sample; 0 where invalid.
    - `of_cluster`: of each occupied cluster.
    - `of_block`: of each block, see `Clusters`.
    """

    of_sample: np.ndarray
    of_cluster: np.ndarray
    of_block: np.ndarray


def list_lengths(gbuffer: GBuffer, clusters: Clusters, lists: LightLists) -> ListLengths:
    """Bring the lengths of a frame's lists to the host."""
    n_blocks, n_clusters = int(clusters.n_blocks), int(clusters.n_clusters)
    of_cluster = np.asarray(lists.count)[:n_clusters].astype(np.int64)
    of_block = of_cluster[np.asarray(clusters.block_cluster)[:n_blocks]]
    valid = np.asarray(gbuffer.positions.valid)
    block = np.where(valid, np.asarray(clusters.block_of_sample), 0)
    of_run = np.where(valid, of_block[block] if n_blocks else 0, 0)
    return ListLengths(from_runs(of_run, gbuffer.positions.viewport), of_cluster, of_block)


def uniform_lengths(gbuffer: GBuffer, n_lights: int) -> ListLengths:
    """What `forward` has: every sample's list holds every light."""
    valid = np.asarray(gbuffer.positions.valid)
    of_sample = from_runs(np.where(valid, n_lights, 0), gbuffer.positions.viewport).astype(np.int64)
    return ListLengths(of_sample, np.array([n_lights]), np.full(len(valid), n_lights, np.int64))


def shading_counts(lengths: ListLengths, n_samples: int, tile_px: int) -> OpCounts:
    """Counts of shading that the technique has, whoever implements it.

    - `lighting_computations`: valid samples times their list's length.
    - `divergence`: over runs of 32 samples in tile order, 32 times the longest list: what warps pay.
    """
    return {
        "samples": n_samples,
        "lighting_computations": int(lengths.of_sample.sum(dtype=np.int64)),
        "divergence": _divergence(lengths.of_sample, tile_px),
        "shading_blocks": len(lengths.of_block),
    }


def batch_counts(
    of_block: np.ndarray, walk_rows: tuple[int, ...], batch: int, capacity: int, walk_chunk: int
) -> OpCounts:
    """What this implementation pays for its chunks.

    - `shading_lanes`, `shading_steps`: lanes of all chunks times their longest list, and the steps of the loops.
    - `assign_steps`: chunks of (cluster, node) pairs that are tested.

    **Arguments:**

    - `of_block`: list lengths; `walk_rows`: pairs on each level, see `AssignCounts`.
    - `capacity`: of the blocks; `walk_chunk`: pairs tested at once.
    """
    lanes, steps = chunk_work(of_block, batch, capacity)
    return {
        "shading_lanes": lanes,
        "shading_steps": steps,
        "assign_steps": sum(-(-rows // walk_chunk) for rows in walk_rows),
    }


def _divergence(of_sample: np.ndarray, tile_px: int) -> int:
    """Tiles row by row, samples of a tile row by row, cut into runs of 32 that do not cross tiles."""
    height, width = of_sample.shape
    padded = np.pad(of_sample, ((0, -height % tile_px), (0, -width % tile_px)))
    rows, columns = padded.shape[0] // tile_px, padded.shape[1] // tile_px
    tiles = padded.reshape(rows, tile_px, columns, tile_px).transpose(0, 2, 1, 3).reshape(rows * columns, -1)
    runs = np.pad(tiles, ((0, 0), (0, -tiles.shape[1] % RUN))).reshape(-1, RUN)
    return int(runs.max(axis=1).sum(dtype=np.int64)) * RUN


def cluster_counts(lengths: ListLengths, cells_total: int, n_lights: int) -> OpCounts:
    """Counts of the lists, and what a cap of so many lights a cell would drop (`dropped_at_cap_*`)."""
    of_cluster = lengths.of_cluster
    return {
        "cells_total": cells_total,
        "clusters_occupied": len(of_cluster),
        "lights": n_lights,
        "light_cluster_pairs": int(of_cluster.sum(dtype=np.int64)),
        "longest_list": int(of_cluster.max(initial=0)),
        **{f"dropped_at_cap_{cap}": int(np.maximum(of_cluster - cap, 0).sum(dtype=np.int64)) for cap in CAPS},
    }


def assign_counts(counts: AssignCounts, n_lights: int, branching: int) -> OpCounts:
    """Tests of existing children of inner nodes, and of lights."""
    levels = inner_level_nodes(n_lights, branching) if len(counts.node_rows) else ()
    n_leaves = n_leaf_nodes(n_lights, branching)
    below = (*levels[1:], n_leaves)[: len(levels)]
    return {
        "tree_tests": n_child_tests(counts.node_rows, counts.short_rows, below, branching),
        "leaf_tests": n_child_tests(
            np.atleast_1d(counts.leaf_rows), np.atleast_1d(counts.short_leaf_rows), (n_lights,), branching
        ),
        "tree_nodes": sum(levels) + n_leaves,
    }


def walk_rows(counts: AssignCounts) -> tuple[int, ...]:
    """(cluster, node) pairs on each level, the leaves' last."""
    return (*map(int, np.asarray(counts.node_rows)), int(counts.leaf_rows))


def memory_counts(gbuffer: GBuffer, structures: object, n_samples: int, n_pairs: int) -> OpCounts:
    """Bytes.

    - `memory`: of the G-buffer and of all structures a frame makes, at their capacities.
    - `bytes_moved`: read or written at least once: each valid sample's G-buffer and colour, each list
      entry written and read.
    """
    arrays = jax.tree.leaves((gbuffer, structures))
    channels = [gbuffer.normal, gbuffer.base_colour, gbuffer.specular, gbuffer.shininess, gbuffer.emissive]
    sample_bytes = 3 * 4 + 1 + sum(leaf.dtype.itemsize for leaf in jax.tree.leaves(channels))
    return {
        "memory": int(sum(array.nbytes for array in arrays)),
        "bytes_moved": n_samples * (sample_bytes + 3 * 4) + 2 * 4 * n_pairs,
    }
