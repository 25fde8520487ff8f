"""The grid of cells that cuts up the view: screen tiles times depth slices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vtfs.bounds import Aabb
from vtfs.camera import Camera, Viewport
from vtfs.cell_shapes import CellSections
from vtfs.gbuffer import RUN, RUN_HEIGHT_PX, RUN_WIDTH_PX, Positions, runs_across
from vtfs.input_error import InputError
from vtfs.parameters import GRID_OFF, Value, grid_cells

_BOX_SLACK = 1e-5
"""How far, relative to its depth, a sample may lie outside its cell: float32 logs of depth ratios up to
1e5 put a slice's planes off by 3e-6, and pixel slopes are right to 1e-6."""

_PIXEL_SLACK_PX = 0.02
"""A user's G-buffer may have positions up to 0.01 pixels outside their own pixel."""

_SLOPE_SLACK = 1e-6
"""Relative to the image's edge and to its own: slopes of cells and of samples are right to some 2^-22 of those."""

MAX_CELLS = 2**31 - 1


DepthScheme = Literal["self_similar", "linear", "ndc"]
_SCHEMES: tuple[DepthScheme, ...] = ("self_similar", "linear", "ndc")


class ClusterGrid(eqx.Module):
    """Screen tiles times depth slices, times bins of normals. Traced: no field fixes a shape.

    - `tile_px_x`, `tile_px_y`: width and height of a tile.
    - `depth_slices`: already resolved; 0 in a configuration means "cubic cells".
    - `scheme`: place in `self_similar`, `linear`, `ndc`; see `slice_depth_m`.
    - `log_growth`: of self-similar slices, log of the ratio of two slice planes.
    - `slope_per_px`, `slope_x`, `slope_y`: view-space x and y at depth 1 per pixel and at the image's
      left and top edge.
    - `converges`: 1 in a perspective view; 0 in a parallel one, whose slopes are x and y at every depth.
    - `normal_bins`: subdivisions of a cube's face; 0: normals do not split cells.
    """

    tile_px_x: Int[Array, ""]
    tile_px_y: Int[Array, ""]
    depth_slices: Int[Array, ""]
    scheme: Int[Array, ""]
    z_near_m: Float[Array, ""]
    z_far_m: Float[Array, ""]
    log_growth: Float[Array, ""]
    slope_per_px: Float[Array, ""]
    slope_x: Float[Array, ""]
    slope_y: Float[Array, ""]
    converges: Float[Array, ""]
    normal_bins: Int[Array, ""]

    def tiles(self, viewport: Viewport) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Columns and rows of tiles; the last ones may stick out of the image."""
        return -(-viewport.width_px // self.tile_px_x), -(-viewport.height_px // self.tile_px_y)


def cluster_grid(
    camera: Camera,
    tile_px: int | tuple[int, int],
    depth_slices: int,
    deepest_m: float,
    depth_scheme: DepthScheme = "self_similar",
    normal_bins: int = 0,
) -> ClusterGrid:
    """The grid of a camera.

    `depth_slices` 0 makes cells cubic: `g = 1 + 2 tan(theta) / S_y`, `S = ceil(log(far/near) / log g)` (van
    Oosten 2017, Eq. 8.2, with a ceiling so that no depth is left without a slice); in a parallel view, whose cells
    are equally high everywhere, linear slices as deep as that. Otherwise `depth_slices` cut up `[near, far]`.

    **Arguments:**

    - `tile_px`: side of a tile, or its width and height.
    - `deepest_m`: the deepest sample; stands for the far plane where that is infinite.

    **Raises:** `InputError` for 0 slices of a scheme that has no cubic cells, and where the grid has more cells than
    a 32-bit key can name.
    """
    viewport = camera.viewport
    tile_px_x, tile_px_y = tile_px if isinstance(tile_px, tuple) else (tile_px, tile_px)
    rows, columns = -(-viewport.height_px // tile_px_y), -(-viewport.width_px // tile_px_x)
    far_m = camera.far_m if math.isfinite(camera.far_m) else max(deepest_m, camera.near_m * (1 + 1e-6))
    if depth_slices == 0 and depth_scheme != "self_similar":
        raise InputError(
            f"parameter `depth_scheme` = {depth_scheme!r} with depth_slices=0: cubic cells are `self_similar`; "
            "give depth_slices of 1 or more."
        )
    log_range = math.log(far_m / camera.near_m)
    log_growth = log_range / depth_slices if depth_slices else math.log1p(2 * camera.tan_half_y / rows)
    n_slices = depth_slices or max(1, math.ceil(log_range / log_growth))
    if camera.is_orthographic and depth_scheme == "ndc":
        depth_scheme = "linear"  # as the depth buffer of a parallel view is
    if camera.is_orthographic and depth_slices == 0:
        depth_scheme = "linear"
        depth_m = 2 * camera.tan_half_y * tile_px_y / viewport.height_px
        n_slices = max(1, math.ceil((far_m - camera.near_m) / depth_m))
        far_m = camera.near_m + n_slices * depth_m
        log_growth = math.log(far_m / camera.near_m) / n_slices
    n_cells = rows * columns * n_slices * max(1, 6 * normal_bins**2)
    if n_cells > MAX_CELLS:
        tile = f"{tile_px_x}" if tile_px_x == tile_px_y else f"{tile_px_x}x{tile_px_y}"
        bins = f" and normal_bins={normal_bins}" if normal_bins else ""
        raise InputError(
            f"tile_px={tile} with depth_slices={depth_slices}{bins} makes {n_cells:,} cells: at most {MAX_CELLS:,} "
            "have a key; use larger tiles or fewer slices."
        )
    # NumPy scalars: a jnp scalar would compile a program for each dtype.
    return ClusterGrid(
        tile_px_x=np.int32(tile_px_x),  # type: ignore[arg-type]
        tile_px_y=np.int32(tile_px_y),  # type: ignore[arg-type]
        depth_slices=np.int32(n_slices),  # type: ignore[arg-type]
        scheme=np.int32(_SCHEMES.index(depth_scheme)),  # type: ignore[arg-type]
        z_near_m=np.float32(camera.near_m),  # type: ignore[arg-type]
        z_far_m=np.float32(far_m),  # type: ignore[arg-type]
        log_growth=np.float32(log_growth),  # type: ignore[arg-type]
        slope_per_px=np.float32(2 * camera.tan_half_y / viewport.height_px),  # type: ignore[arg-type]
        slope_x=np.float32(camera.slope_left),  # type: ignore[arg-type]
        slope_y=np.float32(camera.slope_top),  # type: ignore[arg-type]
        converges=np.float32(not camera.is_orthographic),  # type: ignore[arg-type]
        normal_bins=np.int32(normal_bins),  # type: ignore[arg-type]
    )


def configured_grid(
    camera: Camera, params: Mapping[str, Value], deepest_m: float, one_slice: bool = False
) -> ClusterGrid:
    """The grid that a configuration's parameters ask for; those that it lacks have their defaults.

    **Arguments:**

    - `one_slice`: cells are whole tiles, whatever the depth.

    **Raises:** `InputError`, see `cluster_grid`.
    """
    tile_px, n_slices = tile_and_slices(params, camera.viewport)
    scheme: DepthScheme = "self_similar" if one_slice else params.get("depth_scheme", "self_similar")  # type: ignore[assignment]
    n_bins = int(params.get("normal_bins", 0))
    return cluster_grid(camera, tile_px, 1 if one_slice else n_slices, deepest_m, scheme, n_bins)


def tile_and_slices(params: Mapping[str, Value], viewport: Viewport) -> tuple[tuple[int, int], int]:
    """Width and height of a tile in pixels, and depth slices, from `grid` or from the parameters of their own.

    Tiles of `grid = "16x9x24"` are as large as 16 columns and 9 rows need; rounding up may leave fewer of them.
    """
    named = grid_cells(str(params.get("grid", GRID_OFF)))
    if named:
        columns, rows, n_slices = named
        return (-(-viewport.width_px // columns), -(-viewport.height_px // rows)), n_slices
    tile_px = int(params["tile_px"])
    width_px, height_px = (int(params.get(name, 0)) or tile_px for name in ("tile_px_x", "tile_px_y"))
    return (width_px, height_px), int(params.get("depth_slices", 0))


def n_cells(grid: ClusterGrid, viewport: Viewport) -> int:
    """Cells of the grid, occupied or not; a host integer."""
    columns, rows = jax.device_get(grid).tiles(viewport)  # on the host: each division there would be a program
    return int(columns) * int(rows) * int(grid.depth_slices)


def tile_pixels(grid: ClusterGrid, viewport: Viewport, key: Int[Array, "*cells"]) -> Int[Array, "*cells"]:
    """Pixels of each cell's tile: fewer where the image ends."""
    columns, rows = grid.tiles(viewport)
    i, j = key % columns, key // columns % rows
    width_px = jnp.minimum(grid.tile_px_x, viewport.width_px - i * grid.tile_px_x)
    height_px = jnp.minimum(grid.tile_px_y, viewport.height_px - j * grid.tile_px_y)
    return width_px * height_px


def n_keys(grid: ClusterGrid, viewport: Viewport) -> int:
    """Keys that clusters can have: cells times bins of normals; a host integer."""
    return n_cells(grid, viewport) * max(1, 6 * int(grid.normal_bins) ** 2)


def slice_depth_m(grid: ClusterGrid, k: Int[Array, "*slices"]) -> Float[Array, "*slices"]:
    """Depth at which slice `k` begins; the last one ends where slice `depth_slices` would begin.

    - `self_similar`: `near * g**k` (Olsson et al. 2012, Eq. 1).
    - `linear`: `near + (far - near) k/S`.
    - `ndc`: equal steps of the depth buffer's value, whose 1/depth is linear in it. A reversed depth buffer has the
      same planes, in reverse.
    """
    share, rest = k.astype(jnp.float32), (grid.depth_slices - k).astype(jnp.float32)
    n_slices = grid.depth_slices.astype(jnp.float32)
    growing = grid.z_near_m * jnp.exp(share * grid.log_growth)
    linear = (grid.z_near_m * rest + grid.z_far_m * share) / n_slices
    # As a sum of two positive terms: 1/near - k/S (1/near - 1/far) cancels at the far end.
    ndc = n_slices / (rest / grid.z_near_m + share / grid.z_far_m)
    return jnp.where(grid.scheme == 0, growing, jnp.where(grid.scheme == 1, linear, ndc))


def depth_slices(grid: ClusterGrid, depth_m: Float[Array, "*samples"]) -> Int[Array, "*samples"]:
    """Depth slice of each view sample: `slice_depth_m` solved for `k`.

    The papers' Eq. 2 rounds up, which is off by one from their Eq. 1.

    **Arguments:**

    - `depth_m`: distance along -z of view space, within `[z_near, z_far]`.

    **Returns:** slices in `[0, grid.depth_slices)`.
    """
    # log1p of the growth was taken where it was made: at 512 rows g is 1.002, and a float32
    # log of that is right to four digits.
    growing = jnp.floor(jnp.log(depth_m / grid.z_near_m) / grid.log_growth)
    span_m = grid.z_far_m - grid.z_near_m
    linear = jnp.floor((depth_m - grid.z_near_m) * (grid.depth_slices / span_m))
    # Counted from the far end, where the slices of `ndc` are deep and float32 must tell depths apart.
    to_far = (grid.z_far_m - depth_m) / depth_m * (grid.depth_slices * (grid.z_near_m / span_m))
    ndc = grid.depth_slices - jnp.ceil(to_far)
    k = jnp.where(grid.scheme == 0, growing, jnp.where(grid.scheme == 1, linear, ndc))
    return jnp.clip(k, 0, grid.depth_slices - 1).astype(jnp.int32)


def cell_keys(grid: ClusterGrid, positions: Positions) -> Int[Array, "runs 32"]:
    """Key `(k * S_y + j) * S_x + i` of the cell of each sample."""
    viewport, across = positions.viewport, runs_across(positions.viewport)
    place, lane = positions.place[:, None], jnp.arange(RUN, dtype=jnp.int32)[None, :]
    x_px = place % across * RUN_WIDTH_PX + lane % RUN_WIDTH_PX
    y_px = place // across * RUN_HEIGHT_PX + lane // RUN_WIDTH_PX
    columns, rows = grid.tiles(viewport)
    # Padding beyond the image shares the last tiles: it is invalid, but its keys stay in range.
    i = jnp.minimum(x_px // grid.tile_px_x, columns - 1)
    j = jnp.minimum(y_px // grid.tile_px_y, rows - 1)
    return (depth_slices(grid, -positions.z_m) * rows + j) * columns + i


DepthRange = tuple[Float[Array, " clusters"], Float[Array, " clusters"]]


def cell_sections(
    grid: ClusterGrid, viewport: Viewport, key: Int[Array, " clusters"], depth_range_m: DepthRange | None = None
) -> CellSections:
    """Each cell: the rays through its tile's edges between its two slice planes.

    van Oosten 2017, Alg. 8.1, with the tile size where that prints the number of cells. Slightly grown, so that each
    sample lies in its own cell.

    **Arguments:**

    - `depth_range_m`: nearest and farthest depth instead of the slice planes (min-max of the samples).
    """
    left, right, bottom, top = _edges(grid, viewport, key)
    near_m, far_m = depth_range_m or _slice_range_m(grid, viewport, key)
    return CellSections(
        left,
        right,
        bottom,
        top,
        near_m * (1 - _BOX_SLACK),
        far_m * (1 + _BOX_SLACK),
        grid.converges,
        grid.z_near_m * (1 - _BOX_SLACK),
    )


def cell_boxes(
    grid: ClusterGrid, viewport: Viewport, key: Int[Array, " clusters"], depth_range_m: DepthRange | None = None
) -> Aabb:
    """Box around each cell; see `cell_sections`. Neighbouring boxes overlap."""
    left, right, bottom, top = _edges(grid, viewport, key)
    near_m, far_m = depth_range_m or _slice_range_m(grid, viewport, key)
    slack_m = _BOX_SLACK * far_m
    width_near, width_far = (grid.converges * depth_m + (1 - grid.converges) for depth_m in (near_m, far_m))
    return Aabb(
        jnp.minimum(left * width_near, left * width_far) - slack_m,
        jnp.minimum(bottom * width_near, bottom * width_far) - slack_m,
        -far_m - slack_m,
        jnp.maximum(right * width_near, right * width_far) + slack_m,
        jnp.maximum(top * width_near, top * width_far) + slack_m,
        -near_m + slack_m,
    )


def _slice_range_m(grid: ClusterGrid, viewport: Viewport, key: Int[Array, " clusters"]) -> DepthRange:
    columns, rows = grid.tiles(viewport)
    k = key // (columns * rows)
    return slice_depth_m(grid, k), slice_depth_m(grid, k + 1)


def _edges(
    grid: ClusterGrid, viewport: Viewport, key: Int[Array, " clusters"]
) -> tuple[Float[Array, " clusters"], ...]:
    """Slopes of the left, right, bottom and top edge of each cell's tile, a little outside it."""
    columns, rows = grid.tiles(viewport)
    i, j = key % columns, key // columns % rows
    left_px, top_px = i * grid.tile_px_x, j * grid.tile_px_y
    right_px = jnp.minimum(left_px + grid.tile_px_x, viewport.width_px)
    bottom_px = jnp.minimum(top_px + grid.tile_px_y, viewport.height_px)
    left, right = (
        grid.slope_x + x_px * grid.slope_per_px for x_px in (left_px - _PIXEL_SLACK_PX, right_px + _PIXEL_SLACK_PX)
    )
    top, bottom = (
        grid.slope_y - y_px * grid.slope_per_px for y_px in (top_px - _PIXEL_SLACK_PX, bottom_px + _PIXEL_SLACK_PX)
    )

    def slack(edge, start):
        return _SLOPE_SLACK * (jnp.abs(edge) + jnp.abs(start))

    return (
        left - slack(left, grid.slope_x),
        right + slack(right, grid.slope_x),
        bottom - slack(bottom, grid.slope_y),
        top + slack(top, grid.slope_y),
    )
