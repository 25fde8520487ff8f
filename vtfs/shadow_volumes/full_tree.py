"""Keys of the clusters, and the full tree: every cell at the place of its key, and no list that says where."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vtfs.bounds import Aabb
from vtfs.input_error import InputError
from vtfs.shadow_volumes.sample_tiles import SampleClusters, SampleTiles

MOST_BYTES = 256 * 2**20
"""Of the boxes of all nodes and the masks of their children (Sintorn et al. 2014, Sec. 5)."""


def n_cells(columns: int, rows: int, slices: int) -> int:
    """Keys of a grid: a power of two along each axis."""
    return 1 << sum((n - 1).bit_length() for n in (columns, rows, slices))


def require_room(cells: int, branching: int) -> None:
    """**Raises:** `InputError` where a full tree over so many cells needs more than `MOST_BYTES`."""
    n_bytes = n_tree_bytes(cells, branching)
    if n_bytes > MOST_BYTES:
        raise InputError(
            f"tree=full: a grid of this size has {cells:,} places, which take {n_bytes >> 20:,} MiB, more than "
            f"{MOST_BYTES >> 20}; use tree=compact, larger tiles or fewer slices."
        )


def n_tree_bytes(cells: int, branching: int) -> int:
    """24 bytes a node's box and a bit of its parent's mask, on all levels."""
    n_nodes = 0
    while cells > 1:
        n_nodes += cells
        cells = -(-cells // branching)
    return 24 * n_nodes + n_nodes // 8


def keys_of(
    clusters: SampleClusters, samples: SampleTiles, cells: int
) -> tuple[Int[Array, " capacity"], Bool[Array, ""]]:
    """The key of each cluster, ascending, `cells` where there is none; and whether a slice lies beyond them."""
    bits = [(n - 1).bit_length() for n in (samples.columns, samples.rows)]
    bits.append(max(cells.bit_length() - 1 - sum(bits), 0))
    column, row = clusters.tile % samples.columns, clusters.tile // samples.columns
    exists = jnp.arange(clusters.tile.shape[0], dtype=jnp.int32) < clusters.n_clusters
    beyond = jnp.any(exists & (clusters.slice_k >= 1 << bits[2]))
    parts = tuple(part.astype(jnp.int64) for part in (column, row, clusters.slice_k))
    return jnp.where(exists, _interleaved(parts, tuple(bits)), cells), beyond


def at_their_keys(clusters: SampleClusters, place: Int[Array, " capacity"], cells: int) -> SampleClusters:
    """The clusters, each at its key."""

    def put(values: Array, absent) -> Array:
        empty = jnp.full((cells, *values.shape[1:]), absent, values.dtype)
        return empty.at[place].set(values, mode="drop")

    box = clusters.box
    lows = (put(c, jnp.inf) for c in (box.low_x_m, box.low_y_m, box.low_z_m))
    highs = (put(c, -jnp.inf) for c in (box.high_x_m, box.high_y_m, box.high_z_m))
    of_sample = place.astype(jnp.int32)[jnp.clip(clusters.of_sample, 0, place.shape[0] - 1)]
    return SampleClusters(
        put(clusters.tile, 0), put(clusters.slice_k, 0), Aabb(*lows, *highs), clusters.n_clusters, of_sample,
        put(clusters.members, 0), clusters.n_blocks,
    )  # fmt: skip


def _interleaved(parts: tuple[Int[Array, " n"], ...], n_bits: tuple[int, ...]) -> Int[Array, " n"]:
    """Bits of all parts in turn, lowest first; a part that has no more is passed over."""
    code, bit = jnp.zeros_like(parts[0]), 0
    for level in range(max(n_bits)):
        for part, n in zip(parts, n_bits, strict=True):
            if level < n:
                code = code | (part >> level & 1) << bit
                bit += 1
    return code
