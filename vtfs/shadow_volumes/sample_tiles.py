"""View samples in square tiles: what shadow volumes are tested against, and the nodes above them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32, UInt64

from vtfs.bit_lists import WORD_BITS, bits_below, n_bits_set, pack_bits, set_bits, starts_of
from vtfs.bounds import Aabb
from vtfs.camera import Viewport
from vtfs.cluster_grid import ClusterGrid, cell_boxes, depth_slices
from vtfs.gbuffer import RUN, RUN_HEIGHT_PX, RUN_WIDTH_PX, Positions, runs_across

KEY_BITS = 13
"""Of the columns, rows and slices of a cluster's key; the block it came from takes the other 25 bits of 64."""

_PLACE_BITS = 64 - 3 * KEY_BITS
MAX_BLOCKS = 2**_PLACE_BITS

_PIXEL_SLACK_PX = 0.02  # a user's G-buffer may have positions up to 0.01 pixels outside their own pixel


class SampleTiles(eqx.Module):
    """Samples of square tiles, row by row: float32, view space, metres.

    A tile is padded to `lanes`, a multiple of 32 or a power of two below. What receives no shadow is NaN.

    - `receives`: valid samples that are tested.
    """

    x_m: Float[Array, "tiles lanes"]
    y_m: Float[Array, "tiles lanes"]
    z_m: Float[Array, "tiles lanes"]
    receives: Bool[Array, "tiles lanes"]
    viewport: Viewport = eqx.field(static=True)
    tile_px: int = eqx.field(static=True)

    @property
    def columns(self) -> int:
        return -(-self.viewport.width_px // self.tile_px)

    @property
    def rows(self) -> int:
        return -(-self.viewport.height_px // self.tile_px)


def lanes_of(tile_px: int) -> int:
    """Samples of a tile, padded so that they fill words."""
    n = tile_px * tile_px
    return -(-n // WORD_BITS) * WORD_BITS if n > WORD_BITS else 1 << (n - 1).bit_length()


def sample_tiles(positions: Positions, receives: Bool[Array, "runs 32"], tile_px: int) -> SampleTiles:
    """Samples in the order of tiles: transpositions, no gathers."""
    receives = receives & positions.valid
    viewport = positions.viewport

    def tiles(runs: Array, absent) -> Array:
        return _image_to_tiles(_runs_to_image(runs, viewport), tile_px, absent)

    x, y, z = (
        tiles(jnp.where(receives, component, jnp.nan), jnp.nan)
        for component in (positions.x_m, positions.y_m, positions.z_m)
    )
    return SampleTiles(x, y, z, tiles(receives, False), viewport, tile_px)


def in_runs(tiles: Bool[Array, "tiles lanes"], viewport: Viewport, tile_px: int) -> Bool[Array, "runs 32"]:
    """Back to runs, as the G-buffer has them; padding of the runs is false."""
    columns, rows = -(-viewport.width_px // tile_px), -(-viewport.height_px // tile_px)
    boxes = tiles[:, : tile_px * tile_px].reshape(rows, columns, tile_px, tile_px).transpose(0, 2, 1, 3)
    image = boxes.reshape(rows * tile_px, columns * tile_px)[: viewport.height_px, : viewport.width_px]
    across = runs_across(viewport)
    down = -(-viewport.height_px // RUN_HEIGHT_PX)
    image = jnp.pad(
        image, ((0, down * RUN_HEIGHT_PX - viewport.height_px), (0, across * RUN_WIDTH_PX - viewport.width_px))
    )
    runs = image.reshape(down, RUN_HEIGHT_PX, across, RUN_WIDTH_PX).transpose(0, 2, 1, 3)
    return runs.reshape(down * across, RUN)


def _runs_to_image(runs: Array, viewport: Viewport) -> Array:
    boxes = runs.reshape(-1, runs_across(viewport), RUN_HEIGHT_PX, RUN_WIDTH_PX).transpose(0, 2, 1, 3)
    image = boxes.reshape(-1, runs_across(viewport) * RUN_WIDTH_PX)
    return image[: viewport.height_px, : viewport.width_px]


def _image_to_tiles(image: Array, tile_px: int, absent) -> Array:
    height, width = image.shape
    image = jnp.pad(image, ((0, -height % tile_px), (0, -width % tile_px)), constant_values=absent)
    rows, columns = image.shape[0] // tile_px, image.shape[1] // tile_px
    tiles = image.reshape(rows, tile_px, columns, tile_px).transpose(0, 2, 1, 3).reshape(rows * columns, -1)
    return jnp.pad(tiles, ((0, 0), (0, lanes_of(tile_px) - tile_px * tile_px)), constant_values=absent)


# --- depth hierarchy ------------------------------------------------------------------------------------------------


def tile_order(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Tiles in the order in which power-of-two rectangles are consecutive: x, y, x, y, ... from the lowest bit.

    Five bits make nodes of 8 x 4 and 4 x 8 tiles in turn (Sintorn et al. 2011, Sec. 4.1).

    **Returns:** the tile of each place, -1 where a place lies outside the image, and the place of each tile.
    """
    bits_x, bits_y = (columns - 1).bit_length(), (rows - 1).bit_length()
    place = np.arange(1 << (bits_x + bits_y))
    x, y = np.zeros_like(place), np.zeros_like(place)
    bit = 0
    for level in range(max(bits_x, bits_y)):
        for value, n_bits in ((x, bits_x), (y, bits_y)):
            if level < n_bits:
                value |= (place >> bit & 1) << level
                bit += 1
    tile = np.where((x < columns) & (y < rows), y * columns + x, -1)
    place_of = np.zeros(columns * rows, np.int64)
    place_of[tile[tile >= 0]] = place[tile >= 0]
    return tile.astype(np.int32), place_of.astype(np.int32)


def depth_parts(samples: SampleTiles, grid: ClusterGrid, is_parallel: bool) -> Aabb:
    """What each place of `tile_order` covers: its tile, and the depths of its samples.

    Components are x / depth, y / depth and depth; in a parallel view, whose tiles are equally wide everywhere, x, y and
    z, which is a box. Empty where a tile has no samples.
    """
    tile, _ = tile_order(samples.columns, samples.rows)
    some = samples.receives.any(axis=1)
    nearest = jnp.min(jnp.where(samples.receives, -samples.z_m, jnp.inf), axis=1)
    farthest = jnp.max(jnp.where(samples.receives, -samples.z_m, -jnp.inf), axis=1)
    index = np.maximum(tile, 0)
    exists = (tile >= 0) & some[index]
    column, row = (tile % samples.columns).astype(np.float32), (tile // samples.columns).astype(np.float32)
    size, slack = samples.tile_px * grid.slope_per_px, np.float32(_PIXEL_SLACK_PX) * grid.slope_per_px

    low_z, high_z = (-farthest, -nearest) if is_parallel else (nearest, farthest)

    def kept(value, absent: float):
        return jnp.where(exists, value, jnp.float32(absent))

    return Aabb(
        kept(grid.slope_x + column * size - slack, jnp.inf),
        kept(grid.slope_y - (row + 1) * size - slack, jnp.inf),
        kept(low_z[index], jnp.inf),
        kept(grid.slope_x + (column + 1) * size + slack, -jnp.inf),
        kept(grid.slope_y - row * size + slack, -jnp.inf),
        kept(high_z[index], -jnp.inf),
    )


# --- clusters -------------------------------------------------------------------------------------------------------


class SampleClusters(eqx.Module):
    """Occupied clusters in Morton order of column, row and slice.

    - `tile`, `slice_k`: of each cluster; `box`: empty boxes beyond `n_clusters`.
    - `of_sample`: cluster of each sample; meaningless where it receives nothing.
    - `members`: bits of each cluster's samples among those of its tile.
    - `n_blocks`: parts of rows of 32 samples that lie in one cluster. Where they are more than the capacity, the rest
      is
      meaningless.
    """

    tile: Int[Array, " capacity"]
    slice_k: Int[Array, " capacity"]
    box: Aabb
    n_clusters: Int[Array, ""]
    of_sample: Int[Array, "tiles lanes"]
    members: UInt32[Array, "capacity words"]
    n_blocks: Int[Array, ""]


def sample_clusters(samples: SampleTiles, grid: ClusterGrid, explicit: bool, capacity: int) -> SampleClusters:
    """Find the occupied cells of a grid of the same tiles, and bound them (Sintorn et al. 2014, Sec. 2).

    **Arguments:**

    - `explicit`: bound a cluster by its samples; otherwise by its cell.
    - `capacity`: of blocks and clusters.
    """
    n_tiles, lanes = samples.z_m.shape
    width = min(lanes, WORD_BITS)
    slices = depth_slices(grid, jnp.where(samples.receives, -samples.z_m, grid.z_near_m))

    def rows(values: Array) -> Array:
        return values.reshape(n_tiles * lanes // width, width)

    key, receives = rows(slices), rows(samples.receives)
    # Bit i of a sample's word: sample i of the row lies in the same cell. The lowest one leads its block.
    together = pack_bits((key[:, :, None] == key[:, None, :]) & receives[:, None, :])[..., 0]
    leader = n_bits_set(~together & (together - jnp.uint32(1)))
    leads = pack_bits((leader == jnp.arange(width, dtype=jnp.int32)) & receives)
    start, n_blocks = starts_of(n_bits_set(leads[:, 0]))
    block_of_sample = start[:, None] + n_bits_set(leads & bits_below(jnp.minimum(leader, WORD_BITS - 1)))

    place = jnp.arange(capacity, dtype=jnp.int32)
    row, lane = set_bits(leads, start, place)
    in_use = place < n_blocks
    lane = jnp.minimum(lane, width - 1)
    tile, slice_k = row // (lanes // width), key[row, lane]
    code = _spread(tile % samples.columns) | _spread(tile // samples.columns) << 1 | _spread(slice_k) << 2
    largest = jnp.uint64(2**64 - 1)
    # No two are equal where it matters: a stable sort would carry their places too.
    keyed = jnp.where(in_use, code << _PLACE_BITS | place.astype(jnp.uint64), largest)
    sorted_code = jax.lax.sort(keyed, is_stable=False)
    block = jnp.where(in_use, (sorted_code & jnp.uint64(2**_PLACE_BITS - 1)).astype(jnp.int32), 0)
    code = sorted_code >> _PLACE_BITS
    first = (code != jnp.concatenate([jnp.full(1, largest), code[:-1]])) & in_use
    cluster = jnp.cumsum(first, dtype=jnp.int32) - 1
    n_clusters = jnp.max(cluster, initial=-1) + 1
    cluster_of_block = jnp.zeros(capacity, jnp.int32).at[jnp.where(in_use, block, capacity)].set(cluster, mode="drop")

    # What each cluster is, from its first block; its members and bounds from all its blocks.
    row, slice_k = row[block], slice_k[block]
    together = (key[row] == slice_k[:, None]) & receives[row] & in_use[:, None]
    leads_at, belongs_to = jnp.where(first, cluster, capacity), jnp.where(in_use, cluster, capacity)
    cluster_tile, cluster_slice = (
        jnp.zeros(capacity, jnp.int32).at[leads_at].set(values, mode="drop") for values in (tile[block], slice_k)
    )
    words = lanes // width
    members = jnp.zeros((capacity, words), jnp.uint32)
    members = members.at[belongs_to, row % words].add(pack_bits(together)[:, 0], mode="drop")
    if explicit:
        extents = [_extent(rows(c)[row], together) for c in (samples.x_m, samples.y_m, samples.z_m)]
        extents = jnp.stack([low for low, _ in extents] + [-high for _, high in extents], axis=1)
        bounds = jnp.full((capacity, 6), jnp.inf, jnp.float32).at[belongs_to].min(extents, mode="drop")
        box = Aabb(*(bounds[:, c] for c in range(3)), *(-bounds[:, c] for c in range(3, 6)))
    else:
        box = cell_boxes(grid, samples.viewport, _cell_key(grid, samples, cluster_tile, cluster_slice))
        exists = place < n_clusters
        box = Aabb(
            *(jnp.where(exists, c, jnp.inf) for c in (box.low_x_m, box.low_y_m, box.low_z_m)),
            *(jnp.where(exists, c, -jnp.inf) for c in (box.high_x_m, box.high_y_m, box.high_z_m)),
        )
    of_sample = cluster_of_block[jnp.minimum(block_of_sample, capacity - 1)].reshape(n_tiles, lanes)
    return SampleClusters(cluster_tile, cluster_slice, box, n_clusters, of_sample, members, n_blocks)


def _spread(value: Int[Array, "*n"]) -> UInt64[Array, "*n"]:
    """The low 13 bits, three places apart."""
    code = value.astype(jnp.uint64) & jnp.uint64(2**KEY_BITS - 1)
    for shift, mask in (
        (16, 0xFF0000FF),
        (8, 0xF00F00F00F),
        (4, 0x30C30C30C3),
        (2, 0x9249249249),
    ):
        code = (code | (code << shift)) & jnp.uint64(mask)
    return code


def _cell_key(grid: ClusterGrid, samples: SampleTiles, tile: Int[Array, "*n"], slice_k: Int[Array, "*n"]):
    """The key that `cell_boxes` reads."""
    return (slice_k * samples.rows + tile // samples.columns) * samples.columns + tile % samples.columns


def _extent(value: Array, together: Array) -> tuple[Array, Array]:
    """Least and greatest value over the samples of each block."""
    return (
        jnp.min(jnp.where(together, value, jnp.inf), axis=1),
        jnp.max(jnp.where(together, value, -jnp.inf), axis=1),
    )


def relative_boxes(box: Aabb, origin_m: tuple[Float[Array, ""], ...]) -> Aabb:
    """Boxes relative to a light: subtracted in float64, so that nothing is lost near it."""

    def relative(value: Array, origin: Array) -> Array:
        return (value.astype(jnp.float64) - origin).astype(jnp.float32)

    lows, highs = (box.low_x_m, box.low_y_m, box.low_z_m), (box.high_x_m, box.high_y_m, box.high_z_m)
    return Aabb(*map(relative, lows, origin_m), *map(relative, highs, origin_m))
