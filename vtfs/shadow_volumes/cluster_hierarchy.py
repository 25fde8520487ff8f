"""Shadow volumes against clusters of view samples in a tree over their Morton order (Sintorn et al. 2014)."""

from __future__ import annotations

import jax.numpy as jnp

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.sample_tiles import relative_boxes, sample_clusters, sample_tiles
from vtfs.shadow_volumes.walk import SampleTree, Volumes, mask_of_tree, node_table, volumes, walk_volumes


def cluster_hierarchy(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows by a tree over the occupied clusters, as a compact list.

    At a leaf all samples of the tile are tested, as in the paper, also those of its other clusters.
    """
    volume = volumes(frame, plan, about_light=not frame.directional)
    tree = cluster_tree(frame, plan, volume)
    walked = walk_volumes(volume, tree.table, tree.samples, tree.tile_of_item, False, plan)
    return mask_of_tree(walked, volume.safe, tree)


def cluster_tree(frame: ShadowFrame, plan: ShadowPlan, volume: Volumes) -> SampleTree:
    """The tree over the occupied clusters of a frame, relative to what the volumes are."""
    samples = sample_tiles(frame.positions, frame.receives, plan.tile_px)
    clusters = sample_clusters(samples, frame.grid, plan.bounds == "explicit", plan.clusters)
    table = node_table(relative_boxes(clusters.box, volume.origin_m), plan.branching, is_frustum=False)
    in_tile = jnp.sum(samples.receives, axis=1, dtype=jnp.int32)[clusters.tile]
    return SampleTree(
        samples, table, clusters.tile, clusters.of_sample, in_tile, clusters.n_samples, clusters.n_clusters,
        clusters.n_blocks, clusters.n_blocks > plan.clusters, False,
    )  # fmt: skip
