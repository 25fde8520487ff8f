"""What a frame did, counted: 64-bit integers on the host, from the lists that the device made."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from vtfs.clusters import Clusters
from vtfs.gbuffer import RUN, GBuffer, Positions, from_runs
from vtfs.light_lists import AssignCounts, LightLists
from vtfs.light_volumes import LightPixels, lights_of_samples
from vtfs.shading import chunk_work
from vtfs.wide_tree import inner_level_nodes, n_child_tests, n_leaf_nodes

CAPS = (32, 64, 128, 256, 512, 1024)

OpCounts = dict[str, int]


@dataclass(frozen=True)
class ListLengths:
    """Lists of one frame on the host.

    - `of_sample`: `[h, w]`, lights in the lists of all shaded samples of a pixel, transparent and hidden ones too.
    - `of_visible`: of the visible solid sample alone.
    - `of_cluster`: of each occupied cluster.
    - `of_block`: of each block, see `Clusters`; the `n_solid_blocks` of solid samples first.
    """

    of_sample: np.ndarray
    of_visible: np.ndarray
    of_cluster: np.ndarray
    of_block: np.ndarray
    n_solid_blocks: int


def list_lengths(positions: Positions, clusters: Clusters, lists: LightLists) -> ListLengths:
    """Bring the lengths of a frame's lists to the host."""
    n_blocks, n_clusters = int(clusters.n_blocks), int(clusters.n_clusters)
    of_cluster = np.asarray(lists.count)[:n_clusters].astype(np.int64)
    of_block = of_cluster[np.asarray(clusters.block_cluster)[:n_blocks]]
    valid = np.asarray(positions.valid)
    block = np.where(valid, np.asarray(clusters.block_of_sample), 0)
    of_run = np.where(valid, of_block[block] if n_blocks else 0, 0)
    return _lengths(of_run, positions, of_cluster, of_block, int(clusters.n_solid_blocks))


def uniform_lengths(positions: Positions, n_lights: int) -> ListLengths:
    """What `forward` has: every sample's list holds every light."""
    valid = np.asarray(positions.valid)
    of_run = np.where(valid, n_lights, 0).astype(np.int64)
    of_block = np.full(len(valid), n_lights, np.int64)
    return _lengths(of_run, positions, np.array([n_lights]), of_block, positions.n_solid_runs)


def light_volume_lengths(positions: Positions, pixels: LightPixels, n_lights: int) -> ListLengths:
    """What deferred shading has: the lights that cover each pixel; transparent samples take every light."""
    valid = np.asarray(positions.valid)
    of_run = np.where(valid, n_lights, 0).astype(np.int64)
    of_run[: positions.n_visible_runs] = lights_of_samples(pixels, positions.n_visible_runs)
    of_block = np.full(positions.n_transparent_runs, n_lights, np.int64)
    return _lengths(of_run, positions, np.empty(0, np.int64), of_block, 0)


def _lengths(
    of_run: np.ndarray, positions: Positions, of_cluster: np.ndarray, of_block: np.ndarray, n_solid_blocks: int
) -> ListLengths:
    n_visible = positions.n_visible_runs
    total = of_run[:n_visible].astype(np.int64)
    np.add.at(total, np.asarray(positions.place)[n_visible:], of_run[n_visible:])
    of_sample, of_visible = (from_runs(runs, positions.viewport) for runs in (total, of_run[:n_visible]))
    return ListLengths(of_sample, of_visible, of_cluster, of_block, n_solid_blocks)


def shading_counts(
    lengths: ListLengths, n_samples: int, n_transparent_samples: int, tile_px: tuple[int, int]
) -> OpCounts:
    """Counts of shading that the technique has, whoever implements it.

    - `samples`: all that are shaded, the `transparent_samples` too.
    - `lighting_computations`: valid samples times their list's length.
    - `divergence`: over runs of 32 visible solid samples in tile order, 32 times the longest list: what warps pay.

    **Arguments:**

    - `tile_px`: width and height of a tile.
    """
    return {
        "samples": n_samples,
        "transparent_samples": n_transparent_samples,
        "lighting_computations": int(lengths.of_sample.sum(dtype=np.int64)),
        "divergence": _divergence(lengths.of_visible, tile_px),
        "shading_blocks": len(lengths.of_block),
    }


def batch_counts(
    of_block: np.ndarray,
    n_solid_blocks: int,
    walk_rows: tuple[int, ...],
    batch: int,
    capacity: int,
    walk_chunk: int,
) -> OpCounts:
    """What this implementation pays for its chunks.

    - `shading_lanes`, `shading_steps`: lanes of all chunks times their longest list, and the steps of the loops.
    - `assign_steps`: chunks of (cluster, node) pairs that are tested.

    **Arguments:**

    - `of_block`: list lengths, those of solid samples first; `walk_rows`: pairs on each level, see `AssignCounts`.
    - `capacity`: of the blocks; `walk_chunk`: pairs tested at once.
    """
    lanes = steps = 0
    for part in (of_block[:n_solid_blocks], of_block[n_solid_blocks:]):
        if len(part):
            own_lanes, own_steps = chunk_work(part, batch, capacity)
            lanes, steps = lanes + own_lanes, steps + own_steps
    return {
        "shading_lanes": lanes,
        "shading_steps": steps,
        "assign_steps": sum(-(-rows // walk_chunk) for rows in walk_rows),
    }


def light_volume_batch_counts(light_runs: int, chunk: int) -> OpCounts:
    """What deferred shading pays for its chunks of (light, run) pairs."""
    steps = -(-light_runs // chunk)
    return {"shading_lanes": steps * chunk * RUN, "shading_steps": steps}


def added(a: OpCounts, b: OpCounts) -> OpCounts:
    """Sums of the counts of both."""
    return {name: a.get(name, 0) + b.get(name, 0) for name in dict.fromkeys((*a, *b))}


def gbuffer_traffic(reads: str, counts: OpCounts) -> OpCounts:
    """Bytes through a G-buffer of four buffers with four channels of 16 or 32 bits and 32-bit depth: written once for
    each solid sample, and read for each sample or each lighting computation (Olsson and Assarsson 2011)."""
    n_solid = counts["samples"] - counts["transparent_samples"]
    accesses = {"never": 0, "per_sample": 2 * n_solid, "per_light": n_solid + counts["lighting_computations"]}[reads]
    return {"bytes_gbuffer_16": 36 * accesses, "bytes_gbuffer_32": 68 * accesses}


def _divergence(of_sample: np.ndarray, tile_px: tuple[int, int]) -> int:
    """Tiles row by row, samples of a tile row by row, cut into runs of 32 that do not cross tiles."""
    height, width = of_sample.shape
    tile_width_px, tile_height_px = tile_px
    padded = np.pad(of_sample, ((0, -height % tile_height_px), (0, -width % tile_width_px)))
    rows, columns = padded.shape[0] // tile_height_px, padded.shape[1] // tile_width_px
    tiles = padded.reshape(rows, tile_height_px, columns, tile_width_px).transpose(0, 2, 1, 3)
    tiles = tiles.reshape(rows * columns, -1)
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


def approximation_counts(listed: ListLengths, kept: ListLengths) -> OpCounts:
    """What `approximate` saves: (cluster, light) pairs evaluated once, and the lighting computations that their samples
    would have taken."""
    saved = listed.of_sample.sum(dtype=np.int64) - kept.of_sample.sum(dtype=np.int64)
    once = listed.of_cluster.sum(dtype=np.int64) - kept.of_cluster.sum(dtype=np.int64)
    return {"approximated_pairs": int(once), "lighting_computations_saved": int(saved)}


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
