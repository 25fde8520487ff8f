"""Per-triangle shadow volumes: every volume down the depth hierarchy of the image (Sintorn et al. 2011)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from vtfs.bit_lists import pack_bits
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.hierarchy import Hierarchy, NodeTable, node_table
from vtfs.shadow_volumes.merge import shadow_merge
from vtfs.shadow_volumes.sample_tiles import SampleTiles, depth_parts, sample_tiles, tile_order
from vtfs.shadow_volumes.volumes import Volumes, volumes
from vtfs.shadow_volumes.walk import walk_volumes as shadow_traverse


def ptsv(frame: ShadowFrame, plan: ShadowPlan) -> ShadowMask:
    """Shadows by a hierarchy of least and greatest depths.

    A node is a rectangle of the image between two depths, which is a box in a parallel view; `branching` 32 makes 8 x 4
    and 4 x 8 in turn. Its leaves are tiles of `tile_px` squared samples, all of which are tested.
    """
    volume, hierarchy = shadow_planes(frame, plan), shadow_build(frame, plan)
    return shadow_merge(volume, hierarchy, shadow_traverse(volume, hierarchy, plan))


def shadow_planes(frame: ShadowFrame, plan: ShadowPlan) -> Volumes:
    """Planes of all triangles; those for nodes relative to the eye."""
    return volumes(frame, plan, about_light=False)


def shadow_build(frame: ShadowFrame, plan: ShadowPlan) -> Hierarchy:
    """The depths of all tiles of samples that receive shadow, and the tree over them."""
    samples = sample_tiles(frame.positions, frame.receives, plan.tile_px)
    is_frustum = not frame.positions.is_parallel
    table = node_table(depth_parts(samples, frame.grid, not is_frustum), plan.branching, is_frustum)
    return over_tiles(samples, table, frame.counted, is_frustum)


def over_tiles(samples: SampleTiles, table: NodeTable, counted: Bool[Array, ""], is_frustum: bool) -> Hierarchy:
    """A tree whose items are the tiles, in the order of `tile_order`."""
    tile, place_of = tile_order(samples.columns, samples.rows)
    tiles, inside = jnp.asarray(np.maximum(tile, 0)), jnp.asarray(tile >= 0)
    n_in_tile = jnp.where(inside, jnp.sum(samples.receives, axis=1, dtype=jnp.int32)[tiles], 0)
    members = jnp.where(inside[:, None], pack_bits(samples.receives)[tiles], jnp.uint32(0))
    item_of_sample = jnp.broadcast_to(jnp.asarray(place_of)[:, None], samples.receives.shape)
    n_items = jnp.sum(n_in_tile > 0, dtype=jnp.int32)
    return Hierarchy(
        samples, table, tiles, item_of_sample, members, n_in_tile, n_items, jnp.int32(0), jnp.int32(0),
        jnp.bool_(False), counted, is_frustum,
    )  # fmt: skip
