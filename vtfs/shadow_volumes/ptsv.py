"""Per-triangle shadow volumes: every volume down the depth hierarchy of the image (Sintorn et al. 2011)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.sample_tiles import depth_parts, sample_tiles, tile_order
from vtfs.shadow_volumes.walk import SampleTree, mask_of_tree, node_table, volumes, walk_volumes


def ptsv(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows by a hierarchy of least and greatest depths.

    A node is a rectangle of the image between two depths; `branching` 32 makes 8 x 4 and 4 x 8 in turn. Its leaves are
    tiles of `tile_px` squared samples, all of which are tested.
    """
    tree = depth_tree(frame, plan)
    volume = volumes(frame, plan, about_light=False)
    walked = walk_volumes(volume, tree.table, tree.samples, tree.tile_of_item, True, plan)
    return mask_of_tree(walked, volume.safe, tree)


def depth_tree(frame: ShadowFrame, plan: ShadowPlan) -> SampleTree:
    """The depth hierarchy of a frame."""
    samples = sample_tiles(frame.positions, frame.receives, plan.tile_px)
    tile, place_of = tile_order(samples.columns, samples.rows)
    table = node_table(depth_parts(samples, frame.grid), plan.branching, is_frustum=True)
    tiles = jnp.asarray(np.maximum(tile, 0))
    n_received = jnp.sum(samples.receives, axis=1, dtype=jnp.int32)
    in_item = jnp.where(jnp.asarray(tile >= 0), n_received[tiles], 0)
    item_of_sample = jnp.broadcast_to(jnp.asarray(place_of)[:, None], samples.receives.shape)
    n_items = jnp.sum(in_item > 0, dtype=jnp.int32)
    return SampleTree(
        samples, table, tiles, item_of_sample, in_item, in_item, n_items, jnp.int32(0), jnp.bool_(False), True
    )
