"""The grid of cells that cuts up the view: screen tiles times depth slices."""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vtfs.bounds import Aabb
from vtfs.camera import Camera, Viewport
from vtfs.gbuffer import RUN, RUN_HEIGHT_PX, RUN_WIDTH_PX, Positions, runs_across
from vtfs.input_error import InputError

_BOX_SLACK = 1e-5
"""How far, relative to its depth, a sample may lie outside its cell: float32 logs of depth ratios up to
1e5 put a slice's planes off by 3e-6, and pixel slopes are right to 1e-6."""

_PIXEL_SLACK_PX = 0.02
"""A user's G-buffer may have positions up to 0.01 pixels outside their own pixel."""

MAX_CELLS = 2**31 - 1


class ClusterGrid(eqx.Module):
    """Screen tiles times depth slices. Traced: no field fixes a shape.

    - `z_near_m`, `log_growth`: slice `k` covers `[z_near * g**k, z_near * g**(k + 1))`.
    - `depth_slices`: already resolved; 0 in a configuration means "cubic cells".
    - `slope_per_px`, `slope_x`, `slope_y`: view-space x and y at depth 1 per pixel and at the image's
      left and top edge.
    """

    tile_px: Int[Array, ""]
    depth_slices: Int[Array, ""]
    z_near_m: Float[Array, ""]
    log_growth: Float[Array, ""]
    slope_per_px: Float[Array, ""]
    slope_x: Float[Array, ""]
    slope_y: Float[Array, ""]

    def tiles(self, viewport: Viewport) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Columns and rows of tiles; the last ones may stick out of the image."""
        return -(-viewport.width_px // self.tile_px), -(-viewport.height_px // self.tile_px)


def cluster_grid(camera: Camera, tile_px: int, depth_slices: int, deepest_m: float) -> ClusterGrid:
    """The grid of a camera.

    `depth_slices` 0 makes cells cubic: `g = 1 + 2 tan(theta) / S_y`, `S = ceil(log(far/near) / log g)` (van
    Oosten 2017, Eq. 8.2, with a ceiling so that no depth is left without a slice); otherwise
    `g = (far/near)**(1/S)`.

    **Arguments:**

    - `deepest_m`: the deepest sample; stands for the far plane where that is infinite.

    **Raises:** `InputError` where the grid has more cells than a 32-bit key can name.
    """
    viewport = camera.viewport
    rows, columns = -(-viewport.height_px // tile_px), -(-viewport.width_px // tile_px)
    far_m = camera.far_m if math.isfinite(camera.far_m) else max(deepest_m, camera.near_m * (1 + 1e-6))
    log_range = math.log(far_m / camera.near_m)
    log_growth = log_range / depth_slices if depth_slices else math.log1p(2 * camera.tan_half_y / rows)
    n_slices = depth_slices or max(1, math.ceil(log_range / log_growth))
    n_cells = rows * columns * n_slices
    if n_cells > MAX_CELLS:
        raise InputError(
            f"tile_px={tile_px} with depth_slices={depth_slices} makes {n_cells:,} cells: at most {MAX_CELLS:,} have "
            "a key; use larger tiles or fewer slices."
        )
    # NumPy scalars: a jnp scalar would compile a program for each dtype.
    return ClusterGrid(
        tile_px=np.int32(tile_px),  # type: ignore[arg-type]
        depth_slices=np.int32(n_slices),  # type: ignore[arg-type]
        z_near_m=np.float32(camera.near_m),  # type: ignore[arg-type]
        log_growth=np.float32(log_growth),  # type: ignore[arg-type]
        slope_per_px=np.float32(2 * camera.tan_half_y / viewport.height_px),  # type: ignore[arg-type]
        slope_x=np.float32(-camera.tan_half_x),  # type: ignore[arg-type]
        slope_y=np.float32(camera.tan_half_y),  # type: ignore[arg-type]
    )


def n_cells(grid: ClusterGrid, viewport: Viewport) -> int:
    """Cells of the grid, occupied or not; a host integer."""
    columns, rows = grid.tiles(viewport)
    return int(columns) * int(rows) * int(grid.depth_slices)


def grid_cells(grid: ClusterGrid, viewport: Viewport) -> Int[Array, ""]:
    """The same, on the device."""
    columns, rows = grid.tiles(viewport)
    return columns * rows * grid.depth_slices


def tile_pixels(grid: ClusterGrid, viewport: Viewport, key: Int[Array, "*cells"]) -> Int[Array, "*cells"]:
    """Pixels of each cell's tile: fewer where the image ends."""
    columns, rows = grid.tiles(viewport)
    i, j = key % columns, key // columns % rows
    width_px = jnp.minimum(grid.tile_px, viewport.width_px - i * grid.tile_px)
    height_px = jnp.minimum(grid.tile_px, viewport.height_px - j * grid.tile_px)
    return width_px * height_px


def depth_slices(grid: ClusterGrid, depth_m: Float[Array, "*samples"]) -> Int[Array, "*samples"]:
    """Depth slice of each view sample.

    Slice `k` covers `[z_near * g**k, z_near * g**(k + 1))` (Olsson et al. 2012, Eq. 1); this is solved here
    for `k`. The papers' Eq. 2 rounds up, which is off by one from their Eq. 1.

    **Arguments:**

    - `depth_m`: distance along -z of view space, within `[z_near, z_far]`.

    **Returns:** slices in `[0, grid.depth_slices)`.
    """
    # log1p of the growth was taken where it was made: at 512 rows g is 1.002, and a float32
    # log of that is right to four digits.
    k = jnp.floor(jnp.log(depth_m / grid.z_near_m) / grid.log_growth)
    return jnp.clip(k, 0, grid.depth_slices - 1).astype(jnp.int32)


def cell_keys(grid: ClusterGrid, positions: Positions) -> Int[Array, "runs 32"]:
    """Key `(k * S_y + j) * S_x + i` of the cell of each sample."""
    viewport, across = positions.viewport, runs_across(positions.viewport)
    place, lane = positions.place[:, None], jnp.arange(RUN, dtype=jnp.int32)[None, :]
    x_px = place % across * RUN_WIDTH_PX + lane % RUN_WIDTH_PX
    y_px = place // across * RUN_HEIGHT_PX + lane // RUN_WIDTH_PX
    columns, rows = grid.tiles(viewport)
    # Padding beyond the image shares the last tiles: it is invalid, but its keys stay in range.
    i = jnp.minimum(x_px // grid.tile_px, columns - 1)
    j = jnp.minimum(y_px // grid.tile_px, rows - 1)
    return (depth_slices(grid, -positions.z_m) * rows + j) * columns + i


def cell_boxes(
    grid: ClusterGrid,
    viewport: Viewport,
    key: Int[Array, " clusters"],
    depth_range_m: tuple[Float[Array, " clusters"], Float[Array, " clusters"]] | None = None,
) -> Aabb:
    """Box around each cell: the rays through its tile's corners cut by its two slice planes.

    van Oosten 2017, Alg. 8.1, with the tile size where that prints the number of cells. Neighbouring
    boxes overlap. Slightly grown, so that each sample lies in the box of its own cell.

    **Arguments:**

    - `depth_range_m`: nearest and farthest depth instead of the slice planes (min-max of the samples).
    """
    columns, rows = grid.tiles(viewport)
    i, j, k = key % columns, key // columns % rows, key // (columns * rows)
    if depth_range_m is None:
        near_m = grid.z_near_m * jnp.exp(k.astype(jnp.float32) * grid.log_growth)
        far_m = grid.z_near_m * jnp.exp((k + 1).astype(jnp.float32) * grid.log_growth)
    else:
        near_m, far_m = depth_range_m
    left_px, top_px = i * grid.tile_px, j * grid.tile_px
    right_px = jnp.minimum(left_px + grid.tile_px, viewport.width_px)
    bottom_px = jnp.minimum(top_px + grid.tile_px, viewport.height_px)
    slack_px = _PIXEL_SLACK_PX
    left, right = (grid.slope_x + x_px * grid.slope_per_px for x_px in (left_px - slack_px, right_px + slack_px))
    top, bottom = (grid.slope_y - y_px * grid.slope_per_px for y_px in (top_px - slack_px, bottom_px + slack_px))
    slack_m = _BOX_SLACK * far_m
    return Aabb(
        jnp.minimum(left * near_m, left * far_m) - slack_m,
        jnp.minimum(bottom * near_m, bottom * far_m) - slack_m,
        -far_m - slack_m,
        jnp.maximum(right * near_m, right * far_m) + slack_m,
        jnp.maximum(top * near_m, top * far_m) + slack_m,
        -near_m + slack_m,
    )
