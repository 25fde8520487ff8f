"""Shadow volumes against clusters of view samples in a tree over their Morton order (Sintorn et al. 2014)."""

from __future__ import annotations

import jax.numpy as jnp

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.full_tree import at_their_keys
from vtfs.shadow_volumes.hierarchy import Hierarchy, node_table
from vtfs.shadow_volumes.merge import shadow_merge
from vtfs.shadow_volumes.sample_tiles import relative_boxes, sample_clusters, sample_tiles
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
    """Clusters of the samples that receive shadow, and the tree over them: compact, or over all cells of the grid."""
    samples = sample_tiles(frame.positions, frame.receives, plan.tile_px)
    clusters = sample_clusters(samples, frame.grid, plan.bounds == "explicit", plan.clusters)
    overflowed = clusters.n_blocks > plan.clusters
    if plan.tree == "full":
        clusters, beyond = at_their_keys(clusters, samples, plan.cells, plan.branching)
        overflowed = overflowed | beyond
    table = node_table(relative_boxes(clusters.box, origin_m(frame)), plan.branching, is_frustum=False)
    n_in_tile = jnp.sum(samples.receives, axis=1, dtype=jnp.int32)[clusters.tile]
    return Hierarchy(
        samples, table, clusters.tile, clusters.of_sample, clusters.members, n_in_tile, clusters.n_clusters,
        clusters.n_blocks, overflowed, frame.counted, is_frustum=False,
    )  # fmt: skip
