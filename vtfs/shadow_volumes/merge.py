"""The last pass: each sample takes its bit from its tile or cluster."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from vtfs.shadow_mask import ShadowCounts, ShadowMask
from vtfs.shadow_volumes.hierarchy import Hierarchy
from vtfs.shadow_volumes.sample_tiles import in_runs
from vtfs.shadow_volumes.volumes import Volumes
from vtfs.shadow_volumes.walk import Walk, bits_of_samples


def shadow_merge(volume: Volumes, hierarchy: Hierarchy, walk: Walk) -> ShadowMask:
    """The mask of all samples, in runs, with all counts."""
    return mask_of(bits_of_samples(walk.shadowed, hierarchy), walk, volume.safe, volume, hierarchy)


def mask_of(
    shadowed: Bool[Array, "tiles lanes"],
    walk: Walk,
    casts: Bool[Array, " triangles"],
    planes: Any,
    hierarchy: Hierarchy,
) -> ShadowMask:
    """Samples of tiles back in runs.

    **Arguments:**

    - `planes`: all arrays that say what casts, or their shapes: they are counted as bytes.
    """
    samples, nodes = hierarchy.samples, walk.counts
    view = samples.viewport, samples.tile_px
    in_mask = in_runs(shadowed, *view)

    def counted() -> tuple[Int[Array, "runs 32"], Int[Array, ""]]:
        return in_runs(walk.tests, *view), jnp.sum(walk.tests, dtype=jnp.int64)

    nothing = jnp.zeros(in_mask.shape, jnp.int32), jnp.int64(0)
    tests, tests_in_cluster = jax.lax.cond(hierarchy.counted, counted, lambda: nothing)
    counts = ShadowCounts(
        node_tests=nodes.node_tests,
        accepted=nodes.accepted,
        refined=nodes.refined,
        dropped=nodes.dropped,
        extra_plane_tests=nodes.extra,
        sample_tests=walk.sample_tests,
        sample_tests_in_cluster=tests_in_cluster,
        dropped_samples=walk.dropped_samples,
        stencil_updates=jnp.int64(-1),
        tests_of_triangle=nodes.of_triangle[:-1],
        groups=nodes.groups,
        n_pairs=walk.n_pairs,
        list_length=walk.list_length,
        n_items=hierarchy.n_items,
        n_blocks=hierarchy.n_blocks,
        n_nodes=hierarchy.n_nodes,
        n_casters=jnp.sum(casts, dtype=jnp.int32),
        bytes_held=jnp.array([_n_bytes(held) for held in (planes, *_tree_and_samples(hierarchy))], jnp.int64),
    )
    return ShadowMask(in_mask, walk.overflowed | hierarchy.overflowed, tests, counts)


def _tree_and_samples(hierarchy: Hierarchy) -> tuple[Any, Any]:
    """The nodes with the items below them, and the samples with the bits of the items' tiles."""
    nodes = hierarchy.table, hierarchy.tile_of_item, hierarchy.n_in_tile, hierarchy.members
    return nodes, (hierarchy.samples, hierarchy.item_of_sample, hierarchy.members)


def _n_bytes(arrays: Any) -> int:
    return sum(math.prod(array.shape) * array.dtype.itemsize for array in jax.tree.leaves(arrays))
