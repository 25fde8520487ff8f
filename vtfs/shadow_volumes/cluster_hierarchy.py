"""Shadow volumes against clusters of view samples in a tree over their Morton order (Sintorn et al. 2014)."""

from __future__ import annotations

import jax.numpy as jnp

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.sample_tiles import relative_boxes, sample_clusters, sample_tiles
from vtfs.shadow_volumes.walk import mask_of, node_table, volumes, walk_volumes


def cluster_hierarchy(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows by a tree over the occupied clusters, as a compact list.

    At a leaf all samples of the tile are tested, as in the paper, also those of its other clusters.
    """
    samples = sample_tiles(frame.positions, frame.receives, plan.tile_px)
    clusters = sample_clusters(samples, frame.grid, plan.bounds == "explicit", plan.clusters)
    volume = volumes(frame, plan, about_light=not frame.directional)
    table = node_table(relative_boxes(clusters.box, volume.origin_m), plan.branching, is_frustum=False)
    walked = walk_volumes(volume, table, samples, clusters.tile, False, plan)
    in_tile = jnp.sum(samples.receives, axis=1, dtype=jnp.int32)[clusters.tile]
    return mask_of(
        walked, volume.safe, samples, clusters.of_sample, in_tile, clusters.n_samples, clusters.n_clusters,
        clusters.n_blocks, clusters.n_blocks > plan.clusters,
    )  # fmt: skip
