"""Deferred shading light by light: each light's volume is drawn, and shades the pixels that it covers.

Olsson and Assarsson 2011, Sec. 2: the G-buffer is read once for each light and sample.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.bit_lists import WORD_BITS, gather_hits, pack_bits
from vtfs.bounds import SLACK, Sphere
from vtfs.cluster_grid import ClusterGrid
from vtfs.gbuffer import RUN, RUN_HEIGHT_PX, RUN_WIDTH_PX, GBuffer, Positions, runs_across
from vtfs.shading import Image, Surface, reflected, surface_of

_MAX_ROWS = 2**30
_PIXEL_SLACK_PX = 0.02  # what a user's positions may lie outside of their pixel, and rounding


class LightPixels(eqx.Module):
    """(light, run) pairs in order of lights, and which pixels of the run the light shades.

    - `total`: what is needed, also where it is more than the capacity.
    - `overflowed`: pairs are missing; such a result is thrown away.
    """

    light: Int[Array, " pairs"]
    run: Int[Array, " pairs"]
    mask: UInt32[Array, " pairs"]
    total: Int[Array, ""]
    overflowed: Bool[Array, ""]


def draw_light_volumes(
    lights: Sphere, positions: Positions, grid: ClusterGrid, stencil: bool, capacity: int, chunk: int
) -> LightPixels:
    """Which pixels each light shades: those inside its projected sphere or, with `stencil`, only valid samples inside
    the sphere itself.

    Lights are listed in ascending order.
    """
    n_runs = positions.n_visible_runs
    n_words = -(-n_runs // WORD_BITS)
    n_lights = lights.x_m.shape[0]
    across = runs_across(positions.viewport)

    def test(row):
        light = row // n_words
        run = row[:, None] % n_words * WORD_BITS + jnp.arange(WORD_BITS, dtype=jnp.int32)
        left_px, top_px = run % across * RUN_WIDTH_PX, run // across * RUN_HEIGHT_PX
        x, y, depth, radius = (c[light][:, None] for c in (lights.x_m, lights.y_m, -lights.z_m, lights.radius_m))
        low_x = grid.slope_x + (left_px - _PIXEL_SLACK_PX) * grid.slope_per_px
        high_x = grid.slope_x + (left_px + RUN_WIDTH_PX + _PIXEL_SLACK_PX) * grid.slope_per_px
        high_y = grid.slope_y - (top_px - _PIXEL_SLACK_PX) * grid.slope_per_px
        low_y = grid.slope_y - (top_px + RUN_HEIGHT_PX + _PIXEL_SLACK_PX) * grid.slope_per_px

        def is_within(along, slope):
            """Not wholly beyond the plane on which `along = slope * depth`; in a parallel view, `along = slope`."""
            width = grid.converges * depth + (1 - grid.converges)
            return along - slope * width >= -radius * jnp.sqrt(1 + grid.converges * slope * slope)

        inside = is_within(x, low_x) & is_within(-x, -high_x) & is_within(y, low_y) & is_within(-y, -high_y)
        return inside & (depth >= -radius) & jnp.isfinite(x) & (run < n_runs)

    def emit(row, bit):
        return row // n_words, row % n_words * WORD_BITS + bit

    too_many = n_lights * n_words > _MAX_ROWS
    n_rows = jnp.int32(0 if too_many else n_lights * n_words)
    (light, run), total = gather_hits(n_rows, test, emit, 2, capacity, chunk)

    def cover(state):
        first, mask = state
        own_light = jax.lax.dynamic_slice(light, (first,), (chunk,))
        own_run = jax.lax.dynamic_slice(run, (first,), (chunk,))
        sphere = Sphere(*(c[own_light][:, None] for c in (lights.x_m, lights.y_m, lights.z_m, lights.radius_m)))
        covered = _covered(sphere, positions, grid, own_run, stencil)
        return first + chunk, jax.lax.dynamic_update_slice(mask, pack_bits(covered)[:, 0], (first,))

    found = jnp.minimum(total, capacity)
    blank = jnp.zeros(light.shape[0], jnp.uint32)
    _, mask = jax.lax.while_loop(lambda state: state[0] < found, cover, (jnp.int32(0), blank))
    mask = jnp.where(jnp.arange(mask.shape[0]) < found, mask, jnp.uint32(0))
    return LightPixels(light, run, mask, total, (total > capacity) | too_many)


def _covered(
    sphere: Sphere, positions: Positions, grid: ClusterGrid, run: Int[Array, " chunk"], stencil: bool
) -> Bool[Array, "chunk 32"]:
    x_m, y_m, z_m = positions.x_m[run], positions.y_m[run], positions.z_m[run]
    dx, dy, dz = x_m - sphere.x_m, y_m - sphere.y_m, z_m - sphere.z_m
    radius2 = sphere.radius_m * sphere.radius_m
    is_inside = positions.valid[run] & (dx * dx + dy * dy + dz * dz <= radius2 * (1 + SLACK))
    if stencil:
        return is_inside
    lane = jnp.arange(RUN, dtype=jnp.int32)[None, :]
    across = runs_across(positions.viewport)
    x_px = run[:, None] % across * RUN_WIDTH_PX + lane % RUN_WIDTH_PX
    y_px = run[:, None] // across * RUN_HEIGHT_PX + lane // RUN_WIDTH_PX
    a = grid.slope_x + (x_px + 0.5) * grid.slope_per_px
    b = grid.slope_y - (y_px + 0.5) * grid.slope_per_px
    # The ray r = (a, b, -1) from the eye passes the centre c at the distance |c x r| / |r|. In a parallel view rays
    # start at (a, b, 0), and r is (0, 0, -1).
    p = grid.converges
    centre_x, centre_y, centre_z = sphere.x_m - (1 - p) * a, sphere.y_m - (1 - p) * b, sphere.z_m
    a, b = p * a, p * b
    cross_x = -centre_y - centre_z * b
    cross_y = centre_z * a + centre_x
    cross_z = centre_x * b - centre_y * a
    squared = cross_x * cross_x + cross_y * cross_y + cross_z * cross_z
    r2 = a * a + b * b + 1
    is_ahead = centre_x * a + centre_y * b - centre_z > 0
    holds_start = centre_x**2 + centre_y**2 + centre_z**2 <= radius2
    is_in_image = (x_px < positions.viewport.width_px) & (y_px < positions.viewport.height_px)
    return is_in_image & (is_inside | holds_start | (is_ahead & (squared <= radius2 * r2)))


def shade_light_volumes(
    gbuffer: GBuffer,
    pixels: LightPixels,
    light_rows: Float[Array, "lights columns"],
    light_cutoff: Float[Array, ""],
    chunk: int,
) -> Image:
    """Add each light to the pixels that it covers: linear red, green and blue of the visible runs, 0 where invalid."""
    visible = jax.tree.map(lambda channel: channel[: gbuffer.positions.n_visible_runs], gbuffer)
    lane = jnp.arange(RUN, dtype=jnp.uint32)[None, :]
    n_pairs = jnp.minimum(pixels.total, pixels.light.shape[0])
    # Padded, so that the last chunk's slice is not moved; padding shades nothing.
    light, run, mask = (jnp.pad(column, (0, chunk)) for column in (pixels.light, pixels.run, pixels.mask))

    def add_chunk(state):
        first, image = state
        own_light, own_run, own_mask = (jax.lax.dynamic_slice(c, (first,), (chunk,)) for c in (light, run, mask))
        part = jax.tree.map(lambda channel: channel[own_run], visible)
        listed = (own_mask[:, None] >> lane) & 1 == 1
        added = reflected(_widened(part), light_rows[own_light][:, None, :], light_cutoff, listed)
        return first + chunk, tuple(c.at[own_run].add(a) for c, a in zip(image, added, strict=True))

    start = tuple(e.astype(jnp.float32) for e in visible.emissive)
    _, image = jax.lax.while_loop(lambda state: state[0] < n_pairs, add_chunk, (jnp.int32(0), start))
    return tuple(jnp.where(visible.positions.valid, channel, 0) for channel in image)


def _widened(part: GBuffer) -> Surface:
    return jax.tree.map(lambda channel: channel.astype(jnp.float32), surface_of(part))


def lights_of_samples(pixels: LightPixels, n_runs: int) -> np.ndarray:
    """How many lights shade each pixel, int32 `[runs, 32]`. On the host, lane by lane: all bits at once are 128 bytes a
    pair."""
    n_pairs = int(pixels.total)
    run, mask = np.asarray(pixels.run)[:n_pairs], np.asarray(pixels.mask)[:n_pairs]
    lanes = [np.bincount(run[(mask >> np.uint32(lane)) & 1 == 1], minlength=n_runs) for lane in range(RUN)]
    return np.stack(lanes, axis=1).astype(np.int32)
