"""Volumes against the samples of the tiles or clusters that they reach: exact tests, in float64 unless asked."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from vtfs.bit_lists import pack_bits
from vtfs.node_lists import NodeLists, owners
from vtfs.shadow_mask import ShadowPlan
from vtfs.shadow_volumes.hierarchy import Hierarchy
from vtfs.shadow_volumes.planes import Vector, inside, length
from vtfs.shadow_volumes.volumes import Volumes

_SAMPLES_AT_ONCE = {"cpu": 2**18}
"""Pairs of a triangle and a sample in one chunk: what stays in the caches of a CPU."""


def held_samples(
    lists: NodeLists, volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan
) -> UInt32[Array, "items words"]:
    """Which samples of each item's tile lie in a volume of its list."""
    rows = sample_rows(hierarchy, volume)
    if plan.level_groups:
        bits = _tested_at_once(lists, volume, hierarchy, rows)
    else:
        n_pairs = lists.triangle.shape[1] * rows.shape[2]
        chunk = max(1, _SAMPLES_AT_ONCE.get(jax.default_backend(), 2**26) // n_pairs)
        bits = _tested_in_chunks(lists, volume, hierarchy, rows, chunk)
    return _merged(bits, lists, hierarchy.tile_of_item.shape[0])


def sample_rows(hierarchy: Hierarchy, volume: Volumes) -> Float[Array, "tiles 4 lanes"]:
    """Position of each sample of a tile, and its bias over its distance to the light."""
    samples = hierarchy.samples
    position = [samples.x_m, samples.y_m, samples.z_m]
    x, y, z = (c.astype(jnp.float64) - o for c, o in zip(position, volume.origin_m, strict=True))
    # In float64: the square of a distance in metres may overflow or vanish in float32.
    moved = jnp.where(volume.bias_m > 0, volume.bias_m / length((x, y, z)), 0.0)
    return jnp.stack([*position, moved.astype(jnp.float32)], axis=1)


def _about_light(row: Float[Array, "n 4 *lanes"], volume: Volumes) -> Vector:
    """Samples relative to the light. Subtracted in float64, whatever the precision of the test: a scene far from its
    origin loses nothing."""
    relative = (row[:, c].astype(jnp.float64) - volume.origin_m[c] for c in range(3))
    return tuple(c.astype(volume.edges.values.dtype) for c in relative)


def _tested_at_once(lists: NodeLists, volume: Volumes, hierarchy: Hierarchy, rows) -> UInt32[Array, "groups words"]:
    """All groups in one reduction over a group's triangles and a word's samples."""
    capacity = lists.triangle.shape[0]
    n_samples = rows.shape[2]
    words = max(1, n_samples // 32)
    tile = hierarchy.tile_of_item[jnp.minimum(lists.nodes(), hierarchy.tile_of_item.shape[0] - 1)]
    row = rows.at[tile].get(mode="promise_in_bounds").reshape(capacity, 4, words, 1, n_samples // words)
    position = _about_light(row, volume)
    planes = jax.tree.map(lambda c: c[:, None, :, None], volume.edges.at(lists.triangle))
    held = inside(planes, position, row[:, 3].astype(volume.edges.values.dtype))
    bits = held.astype(jnp.uint32) << jnp.arange(n_samples // words, dtype=jnp.uint32)
    bits = jax.lax.reduce(bits, jnp.uint32(0), jax.lax.bitwise_or, (2, 3))
    is_live = jnp.arange(capacity, dtype=jnp.int32) < lists.n_groups
    return jnp.where(is_live[:, None], bits, jnp.uint32(0))


def _tested_in_chunks(
    lists: NodeLists, volume: Volumes, hierarchy: Hierarchy, rows, chunk: int
) -> UInt32[Array, "groups words"]:
    """In chunks, and one triangle of a group after the other: the samples of a tile are the vector."""
    capacity, lanes = lists.triangle.shape
    n_samples = rows.shape[2]
    words = max(1, n_samples // 32)
    n_groups = jnp.minimum(lists.n_groups, capacity)
    n_padded = -(-capacity // chunk) * chunk
    item = owners(lists.start, n_groups, n_padded)
    tile = hierarchy.tile_of_item[jnp.minimum(item, hierarchy.tile_of_item.shape[0] - 1)]
    triangles = jnp.concatenate([lists.triangle, jnp.zeros((n_padded - capacity, lanes), jnp.int32)])

    def test(state):
        first, bits = state
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        row = rows.at[jax.lax.dynamic_slice_in_dim(tile, first, chunk)].get(mode="promise_in_bounds")
        position = _about_light(row, volume)
        moved = row[:, 3].astype(volume.edges.values.dtype)
        planes = volume.edges.at(jax.lax.dynamic_slice_in_dim(triangles, first, chunk))
        held = jnp.zeros((chunk, n_samples), bool)
        for lane in range(lanes):
            held = held | inside(jax.tree.map(lambda c, lane=lane: c[:, lane : lane + 1], planes), position, moved)
        held = jnp.where((group < n_groups)[:, None], pack_bits(held).reshape(chunk, words), jnp.uint32(0))
        return first + chunk, jax.lax.dynamic_update_slice_in_dim(bits, held, first, 0)

    state = (jnp.int32(0), jnp.zeros((n_padded, words), jnp.uint32))
    _, bits = jax.lax.while_loop(lambda state: state[0] < n_groups, test, state)
    return bits


def _merged(bits: UInt32[Array, "groups words"], lists: NodeLists, n_items: int) -> UInt32[Array, "items words"]:
    """All bits of the groups of each item, which are consecutive: in each step a group takes in twice as many."""
    start, capacity = lists.start, lists.triangle.shape[0]
    bits = bits[:capacity]
    longest = jnp.max(start[1:] - start[:-1])
    group = jnp.arange(capacity, dtype=jnp.int32)
    end = start[lists.nodes() + 1]

    def double(bits, step):
        other = group + step
        taken = bits[jnp.minimum(other, capacity - 1)]
        return jnp.where((other < end)[:, None], bits | taken, bits)

    if jax.default_backend() == "cpu":
        state = (jnp.int32(1), bits)
        _, bits = jax.lax.while_loop(lambda s: s[0] < longest, lambda s: (s[0] * 2, double(s[1], s[0])), state)
    else:
        for k in range(max(capacity - 1, 1).bit_length()):
            bits = double(bits, jnp.int32(1 << k))
    first = start[:n_items]
    some = (start[1 : n_items + 1] > first) & (first < capacity)
    return jnp.where(some[:, None], bits[jnp.minimum(first, capacity - 1)], jnp.uint32(0))


def held_counts(
    lists: NodeLists, cover: Int[Array, " items"], volume: Volumes, hierarchy: Hierarchy
) -> Int[Array, "items lanes"]:
    """In how many volumes each sample of each item's tile lies.

    **Arguments:**

    - `cover`: volumes that hold each item as a whole.
    """
    samples, tile_of_item = hierarchy.samples, hierarchy.tile_of_item
    n_triangles, n_items = volume.safe.shape[0], tile_of_item.shape[0]
    capacity, lanes = lists.triangle.shape
    n_samples = samples.z_m.shape[1]
    chunk = max(1, _SAMPLES_AT_ONCE.get(jax.default_backend(), 2**24) // (lanes * n_samples))
    n_padded = -(-capacity // chunk) * chunk
    triangle = jnp.pad(lists.triangle, ((0, n_padded - capacity), (0, 0)), constant_values=n_triangles)
    n_groups = jnp.minimum(lists.n_groups, capacity)
    item_of_group = jnp.minimum(owners(lists.start, n_groups, n_padded), n_items - 1)
    rows = jnp.stack([samples.x_m, samples.y_m, samples.z_m], axis=1)

    def test(state):
        first, total = state
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        item = jax.lax.dynamic_slice_in_dim(item_of_group, first, chunk)
        row = rows[tile_of_item[item]]
        position = _about_light(row, volume)
        planes = volume.edges.at(jax.lax.dynamic_slice_in_dim(triangle, first, chunk))
        held = jnp.zeros((chunk, n_samples), jnp.int32)
        for lane in range(lanes):
            one = jax.tree.map(lambda c, lane=lane: c[:, lane : lane + 1], planes)
            held = held + inside(one, position, jnp.zeros((), position[0].dtype)).astype(jnp.int32)
        item = jnp.where(group < n_groups, item, n_items)
        return first + chunk, total.at[item].add(held, mode="drop")

    total = jnp.broadcast_to(cover[:n_items, None], (n_items, n_samples))
    _, total = jax.lax.while_loop(lambda state: state[0] < n_groups, test, (jnp.int32(0), total))
    return total
