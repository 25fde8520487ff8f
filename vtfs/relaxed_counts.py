"""Expected lighting computations: a smooth function of the grid, the lights and the camera.

The exact count of a frame is a step function of the tile size, of the slices and of every light. Averaged over the phase
of the grid (its tiles and slices shifted by a random part of a cell, so that a sample lies uniformly within its cell)
it is continuous, and its gradient says which way to move:

```python
frame = relaxed_frame(samples, n_samples=2048)
variables = count_variables(samples.camera, lights, tile_px=32, depth_slices=24)
pairs = candidate_pairs(variables, frame)
slope = jax.grad(expected_lighting_computations)(variables, frame, pairs)
saved_by_1_percent = 0.01 * slope.tile_px_x * variables.tile_px_x  # computations fewer with tiles 1 % narrower
```

As 1 % narrower and 1 % lower tiles cost the same number of cells, the one that saves more is the way to go until both
save the same; `slope.depth_slices * variables.depth_slices` compares slices with them, and the largest of
`slope.light_range_m` are the lights whose range costs most. A count is not a time: more cells cost building and
assigning, which a cost model knows.

How a pair of a light and a sample is averaged, and why that has a derivative: `phase_average`. Sum over the samples and
the lights: the phases `u` and `v` take the points of a low-discrepancy sequence, other ones for each sample.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vtfs.camera import Viewport
from vtfs.phase_average import Point, Screen, Span, cell_box, depth_share, tile_at, tile_rays, tile_share

CHUNK = 2**13
"""Pairs evaluated at once: their temporaries stay in the cache of a CPU."""

_SHALLOWEST_M = 1e-6

Scalar = Float[Array, ""]


class CountVariables(eqx.Module):
    """What a count is differentiated by. All traced; whole numbers of the exact pipeline are real ones here.

    - `depth_slices`: between `near_m` and the frame's far plane: `g = (far / near)**(1 / depth_slices)`. `None`: tiled
      shading, whose cells reach from `near_m` to the far plane.
    - `near_m`: the near plane of the grid.
    - `light_x_m`, ...: in world axes, relative to the eye where the frame was taken; so many lights.
    - `eye_m`: how far the eye has moved since, in world axes; the samples stay where they are in the world.
    - `turn_rad`: how far it has turned about its own axes right, up and backward; exact to second order.
    - `tan_half_y`: of half the vertical angle of view.
    """

    tile_px_x: Scalar
    tile_px_y: Scalar
    depth_slices: Scalar | None
    near_m: Scalar
    light_x_m: Float[Array, " lights"]
    light_y_m: Float[Array, " lights"]
    light_z_m: Float[Array, " lights"]
    light_range_m: Float[Array, " lights"]
    eye_m: Float[Array, "3"]
    turn_rad: Float[Array, "3"]
    tan_half_y: Scalar


class RelaxedFrame(eqx.Module):
    """Some view samples of a frame, fixed in the world; made by `relaxed_frame`.

    - `x_m`, `y_m`, `z_m`: in world axes, relative to the eye where the frame was taken.
    - `phase`: points in (0, 1)^3 of each sample: u, v and a place within the soft edge.
    - `weight`: how many samples of the whole frame each one stands for.
    - `view_from_world`: rotation where the frame was taken.
    """

    x_m: Float[Array, " samples"]
    y_m: Float[Array, " samples"]
    z_m: Float[Array, " samples"]
    phase: Float[Array, "samples phases 3"]
    weight: Scalar
    view_from_world: Float[Array, "3 3"]
    far_m: Scalar
    viewport: Viewport = eqx.field(static=True)

    @property
    def n_samples(self) -> int:
        return self.x_m.shape[0]


class CandidatePairs(eqx.Module):
    """All pairs of a sample and a light that count at some phase, by sample; made by `candidate_pairs`.

    - `in_use`: false for padding, which pairs the first sample with the first light.
    """

    sample: Int[Array, " capacity"]
    light: Int[Array, " capacity"]
    in_use: Bool[Array, " capacity"]


def expected_lighting_computations(
    variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, temperature: Scalar | float = 0.0
) -> Scalar:
    """Lighting computations of the whole frame with implicit bounds, averaged over the phase of the grid.

    Differentiable in `variables`, with hard and with soft edges. One exception: in tiled shading (`depth_slices` None) with
    hard edges, a light that begins to reach into the view from outside is counted at once by all tiles along that
    side, a step of the count itself; a temperature above 0 makes it smooth.

    **Arguments:**

    - `pairs`: of these variables, or of others within the margin of `candidate_pairs`.
    - `temperature`: the radius of a light is spread evenly over `1 - temperature` to `1 + temperature` times its
      range: what a cell does at the light's edge falls linearly from counted to not. In [0, 1); 0 is a hard edge.
    """

    def add_chunk(total, rows):
        return total + jnp.sum(_expected(variables, frame, temperature, rows)), None

    # What a chunk leaves behind is made again on the way back: keeping it costs more than the arithmetic.
    zero = jnp.zeros((), frame.x_m.dtype)
    total, _ = jax.lax.scan(jax.checkpoint(add_chunk), zero, _chunks(variables, frame, pairs))
    return total * frame.weight


def expected_list_lengths(
    variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, temperature: Scalar | float = 0.0
) -> Float[Array, " samples"]:
    """Lights that each sample is expected to be shaded with; arguments as `expected_lighting_computations`.

    Their standard deviation over the root of their number bounds the standard error of subsampling: the samples
    are spread evenly over the image, which leaves less.
    """
    shares = jax.lax.map(lambda rows: _expected(variables, frame, temperature, rows), _chunks(variables, frame, pairs))
    shares = shares.ravel()[: pairs.sample.shape[0]]
    return jax.ops.segment_sum(shares, pairs.sample, num_segments=frame.n_samples)


def lighting_computations_at_phase(
    variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, phase: Float[Array, "3"]
) -> Int[Array, ""]:
    """What the frame's own samples cost on one grid, exactly: what `expected_lighting_computations` is the mean of.

    **Arguments:**

    - `phase`: x, y and depth, in [0, 1): the share of a cell by which the grid is shifted to the left, up and
      towards the eye. At 0 its cells are those of `cluster_grid`.

    **Returns:** a count of the frame's samples; times `frame.weight`, of the whole image.
    """

    def add_chunk(total, rows):
        screen, (x_px, y_px), depth_m, centre_m, range_m, _ = _pair(variables, frame, rows)
        height_px = frame.viewport.height_px
        u = (x_px / variables.tile_px_x + phase[0]) % 1
        from_bottom = 1 - ((height_px - y_px) / variables.tile_px_y + phase[1]) % 1
        rays = tile_rays(
            screen, tile_at(x_px, variables.tile_px_x, u), tile_at(y_px, variables.tile_px_y, from_bottom)
        )
        if variables.depth_slices is None:
            box = cell_box(rays, variables.near_m, frame.far_m)
        else:
            growth = log_growth(variables, frame.far_m)
            w = (jnp.log(depth_m / variables.near_m) / growth + phase[2]) % 1
            box = cell_box(rays, depth_m * jnp.exp(-w * growth), depth_m * jnp.exp((1 - w) * growth))
        squares = sum(span.distance(c) ** 2 for span, c in zip(box, centre_m, strict=True))
        is_listed = (squares <= range_m**2) & rows[3][:, None]
        return total + jnp.sum(is_listed, dtype=jnp.int32), None

    # Every phase point of a sample would count the same: one is enough.
    alone = eqx.tree_at(lambda f: f.phase, frame, frame.phase[:, :1])
    return jax.lax.scan(add_chunk, jnp.int32(0), _chunks(variables, alone, pairs))[0]


def log_growth(variables: CountVariables, far_m: Scalar) -> Scalar:
    """Log of the ratio of two slice planes; of the whole depth range where there are no slices."""
    return jnp.log(far_m / variables.near_m) / (1 if variables.depth_slices is None else variables.depth_slices)


def cubic_depth_slices(tile_px_y: Scalar, near_m: Scalar, tan_half_y: Scalar, frame: RelaxedFrame) -> Scalar:
    """Slices that make cells as deep as they are high: `log(far / near) / log g`, `g = 1 + 2 tan(theta) / S_y`, `S_y = h / t_y`.

    Olsson et al. 2012, Eq. 1; van Oosten 2017, Eq. 8.2, both without rounding, so that in a function that is differentiated
    `depth_slices` may follow `tile_px_y`.
    """
    return jnp.log(frame.far_m / near_m) / jnp.log1p(2 * tan_half_y * tile_px_y / frame.viewport.height_px)


def in_view(variables: CountVariables, frame: RelaxedFrame, x_m: Array, y_m: Array, z_m: Array) -> Point:
    """View-space x, y and depth of points in world axes relative to the eye where the frame was taken."""
    half = variables.turn_rad / 2
    zero = jnp.zeros_like(half[0])
    cross = jnp.array([[zero, -half[2], half[1]], [half[2], zero, -half[0]], [-half[1], half[0], zero]])
    # Cayley's form of a rotation: smooth where there is none. Sums of products: a GPU would take TF32 for `@`.
    turned = jnp.eye(3) + 2 / (1 + jnp.sum(half**2)) * (cross + _product(cross, cross))
    rotation = _product(turned.T, frame.view_from_world)
    x, y, z = x_m - variables.eye_m[0], y_m - variables.eye_m[1], z_m - variables.eye_m[2]
    right, up, backward = (rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z for k in range(3))
    return right, up, -backward


def on_screen(variables: CountVariables, frame: RelaxedFrame) -> tuple[Array, Array, Array]:
    """Pixels of each sample from the left and the bottom edge, and its depth.

    One that a moved camera no longer sees counts as if it were at the image's edge.
    """
    x_m, y_m, depth_m = in_view(variables, frame, frame.x_m, frame.y_m, frame.z_m)
    depth_m = jnp.maximum(depth_m, _SHALLOWEST_M)
    width_px, height_px = frame.viewport.width_px, frame.viewport.height_px
    per_px = _screen(variables, frame).slope_per_px
    x_px = jnp.clip(x_m / depth_m / per_px + width_px / 2, 0, width_px)
    y_px = jnp.clip(y_m / depth_m / per_px + height_px / 2, 0, height_px)
    return x_px, y_px, depth_m


def _screen(variables: CountVariables, frame: RelaxedFrame) -> Screen:
    viewport = frame.viewport
    return Screen(viewport.width_px, viewport.height_px, 2 * variables.tan_half_y / viewport.height_px)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, None] * b[None, :, :], axis=1)


def _chunks(variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs) -> tuple[Array, Array, Array, Array]:
    """Sample, light, phases and use of all pairs in chunks, gathered once, a row a pair."""
    lights = in_view(variables, frame, variables.light_x_m, variables.light_y_m, variables.light_z_m)
    light_row = jnp.stack([*lights, variables.light_range_m], axis=1)
    sample_row = jnp.stack(on_screen(variables, frame), axis=1)
    n_pairs = pairs.sample.shape[0]
    size = max(1, min(CHUNK, n_pairs))

    def chunked(rows: Array) -> Array:
        padded = jnp.pad(rows, ((0, -n_pairs % size), *((0, 0),) * (rows.ndim - 1)))
        return padded.reshape(-1, size, *rows.shape[1:])

    in_use = chunked(pairs.in_use)
    return chunked(sample_row[pairs.sample]), chunked(light_row[pairs.light]), chunked(frame.phase[pairs.sample]), in_use


def _pair(variables: CountVariables, frame: RelaxedFrame, rows):
    """Screen, pixel, depth, light and phases of the pairs of a chunk, as columns to broadcast against phases."""
    sample, light, phase, in_use = rows
    # Padding may have depth 0, where derivatives are not finite.
    x_px, y_px, depth_m = (jnp.where(in_use, sample[:, c], 1.0)[:, None] for c in range(3))
    x_m, y_m, z_m, range_m = (light[:, c][:, None] for c in range(4))
    return _screen(variables, frame), (x_px, y_px), depth_m, (x_m, y_m, z_m), range_m, jnp.moveaxis(phase, -1, 0)


def _expected(variables: CountVariables, frame: RelaxedFrame, temperature: Scalar | float, rows) -> Array:
    """Share of the phases at which each pair of a chunk counts."""
    screen, position_px, depth_m, centre_m, range_m, (u, v, edge) = _pair(variables, frame, rows)
    tile_px = (variables.tile_px_x, variables.tile_px_y)
    if variables.depth_slices is None:
        depth_range_m = (variables.near_m, frame.far_m)
        radius_m = (range_m * (1 - temperature), range_m * (1 + temperature))
        share = tile_share(screen, position_px, tile_px, depth_range_m, centre_m, radius_m, (edge, u))
    else:
        tiles: list[Span] = [tile_at(p, t, phase) for p, t, phase in zip(position_px, tile_px, (u, v), strict=True)]
        rays = tile_rays(screen, tiles[0], tiles[1])
        radius = range_m * (1 + temperature * (2 * edge - 1)) / depth_m
        x, y, z = (c / depth_m for c in centre_m)
        share = depth_share(rays, (x, y, z), radius, log_growth(variables, frame.far_m))
    return jnp.where(rows[3], jnp.mean(share, axis=1), 0.0)
