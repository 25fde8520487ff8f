"""Shadow volumes against clusters of view samples in a tree over their Morton order (Sintorn et al. 2014)."""

from __future__ import annotations

import jax.numpy as jnp

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.full_tree import at_their_keys, keys_of, n_cells
from vtfs.shadow_volumes.hierarchy import Hierarchy, compact_table, node_table
from vtfs.shadow_volumes.merge import shadow_merge
from vtfs.shadow_volumes.sample_tiles import KEY_BITS, relative_boxes, sample_clusters, sample_tiles
from vtfs.shadow_volumes.volumes import Volumes, origin_m, volumes
from vtfs.shadow_volumes.walk import walk_volumes as shadow_traverse


def cluster_hierarchy(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows by a tree over the clusters.

    At a leaf all samples of the tile are tested, as in the paper, also those of its other clusters.
    """
    volume, hierarchy = shadow_planes(frame, plan), shadow_build(frame, plan)
    return shadow_merge(volume, hierarchy, shadow_traverse(volume, hierarchy, plan))


def shadow_planes(frame: ShadowFrame, plan: ShadowPlan) -> Volumes:
    """Planes of all triangles, relative to the light."""
    return volumes(frame, plan, about_light=not frame.directional)


def shadow_build(frame: ShadowFrame, plan: ShadowPlan) -> Hierarchy:
    """Clusters of the samples that receive shadow, and the tree over them: its nodes that hold any, or all of them."""
    samples = sample_tiles(frame.positions, frame.receives, plan.tile_px)
    clusters = sample_clusters(samples, frame.grid, plan.bounds == "explicit", plan.clusters)
    overflowed = clusters.n_blocks > plan.clusters
    # Where a plan does not say, as many as there could be.
    cells = plan.cells or n_cells(samples.columns, samples.rows, 2**KEY_BITS)
    place, beyond = keys_of(clusters, samples, cells)
    overflowed = overflowed | beyond
    if plan.tree == "full":
        clusters = at_their_keys(clusters, place, cells)
        table = node_table(relative_boxes(clusters.box, origin_m(frame)), plan.branching, is_frustum=False)
        n_nodes = jnp.int32(0)
    else:
        box = relative_boxes(clusters.box, origin_m(frame))
        capacity = plan.nodes or plan.clusters
        table, n_nodes = compact_table(box, place, clusters.n_clusters, cells, plan.branching, capacity)
        overflowed = overflowed | (n_nodes > capacity)
    n_in_tile = jnp.sum(samples.receives, axis=1, dtype=jnp.int32)[clusters.tile]
    return Hierarchy(
        samples, table, clusters.tile, clusters.of_sample, clusters.members, n_in_tile, clusters.n_clusters,
        clusters.n_blocks, n_nodes, overflowed, frame.counted, is_frustum=False,
    )  # fmt: skip
