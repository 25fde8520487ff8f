"""Expected lighting computations: a smooth function of the grid, the lights and the camera.

The exact count of a frame is a step function of the tile size, of the slices and of every light. Averaged over the
phase of the grid (its tiles and slices shifted by a random part of a cell, so that a sample lies uniformly within
its cell) it is continuous, and its gradient says which way to move:

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

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vtfs.camera import Viewport
from vtfs.phase_average import Point, Screen, cell_box, depth_share, tile_at, tile_rays, tile_share

CHUNK = 2**13
"""Pairs evaluated at once: their temporaries stay in the cache of a CPU."""

_SHALLOWEST_M = 1e-6

Scalar = Float[Array, ""]
Columns = tuple[Float[Array, "pairs 1"], ...]


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
    eye_m: Float[Array, 3]
    turn_rad: Float[Array, 3]
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

    - `in_use`: false for padding, which comes last.
    """

    sample: Int[Array, " capacity"]
    light: Int[Array, " capacity"]
    in_use: Bool[Array, " capacity"]


def expected_lighting_computations(
    variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, temperature: Scalar | float = 0.0
) -> Scalar:
    """Lighting computations of the whole frame with implicit bounds, averaged over the phase of the grid.

    Differentiable in `variables`, with hard and with soft edges. One exception: in tiled shading (`depth_slices`
    None) with hard edges, a light that begins to reach into the view from outside is counted at once by all tiles
    along that side, a step of the count itself; a temperature above 0 makes it smooth.

    **Arguments:**

    - `pairs`: of these variables, or of others within the margin of `candidate_pairs`.
    - `temperature`: the radius of a light is spread evenly over `1 - temperature` to `1 + temperature` times its
      range: what a cell does at the light's edge falls linearly from counted to not. In [0, 1); 0 is a hard edge.
    """
    shares = _shares(variables, frame, temperature)

    def add_chunk(total, chunk):
        return total + jnp.sum(shares(chunk)), None

    # What a chunk leaves behind is made again on the way back: keeping it costs more than the arithmetic.
    total, _ = jax.lax.scan(jax.checkpoint(add_chunk), jnp.zeros((), frame.x_m.dtype), _chunks(pairs))
    return total * frame.weight


def expected_list_lengths(
    variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, temperature: Scalar | float = 0.0
) -> Float[Array, " samples"]:
    """Lights that each sample is expected to be shaded with; arguments as `expected_lighting_computations`.

    Their standard deviation over the root of their number bounds the standard error of subsampling: the samples
    are spread evenly over the image, which leaves less.
    """
    shares = jax.lax.map(_shares(variables, frame, temperature), _chunks(pairs)).ravel()[: pairs.sample.shape[0]]
    return jax.ops.segment_sum(shares, pairs.sample, num_segments=frame.n_samples)


def lighting_computations_at_phase(
    variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, phase: Float[Array, 3]
) -> Int[Array, ""]:
    """What the frame's own samples cost on one grid, exactly: what `expected_lighting_computations` is the mean of.

    **Arguments:**

    - `phase`: x, y and depth, in [0, 1): the share of a cell by which the grid is shifted to the left, up and
      towards the eye. At 0 its cells are those of `cluster_grid`.

    **Returns:** a count of the frame's samples; times `frame.weight`, of the whole image.
    """
    screen, rows_of = _screen(variables, frame), _rows(variables, frame)
    height_px = frame.viewport.height_px

    def n_listed(chunk: CandidatePairs) -> Int[Array, ""]:
        (x_px, y_px, depth_m), (*centre_m, range_m), _ = rows_of(chunk)
        u = (x_px / variables.tile_px_x + phase[0]) % 1
        from_bottom = 1 - ((height_px - y_px) / variables.tile_px_y + phase[1]) % 1
        rays = tile_rays(screen, tile_at(x_px, variables.tile_px_x, u), tile_at(y_px, variables.tile_px_y, from_bottom))
        if variables.depth_slices is None:
            box = cell_box(rays, variables.near_m, frame.far_m)
        else:
            growth = log_growth(variables, frame.far_m)
            w = (jnp.log(depth_m / variables.near_m) / growth + phase[2]) % 1
            box = cell_box(rays, depth_m * jnp.exp(-w * growth), depth_m * jnp.exp((1 - w) * growth))
        squares = sum(span.distance(c) ** 2 for span, c in zip(box, centre_m, strict=True))
        return jnp.sum((squares <= range_m**2) & chunk.in_use[:, None], dtype=jnp.int32)

    def add_chunk(total, chunk: CandidatePairs):
        return total + jax.lax.cond(chunk.in_use[0], n_listed, lambda _: jnp.int32(0), chunk), None

    return jax.lax.scan(add_chunk, jnp.int32(0), _chunks(pairs))[0]


def log_growth(variables: CountVariables, far_m: Scalar) -> Scalar:
    """Log of the ratio of two slice planes; of the whole depth range where there are no slices."""
    return jnp.log(far_m / variables.near_m) / (1 if variables.depth_slices is None else variables.depth_slices)


def cubic_depth_slices(tile_px_y: Scalar, near_m: Scalar, tan_half_y: Scalar, frame: RelaxedFrame) -> Scalar:
    """Slices that make cells as deep as they are high: `log(far / near) / log g`, `g = 1 + 2 tan(theta) / S_y`,
    `S_y = h / t_y`.

    Olsson et al. 2012, Eq. 1; van Oosten 2017, Eq. 8.2, both without rounding, so that in a function that is
    differentiated `depth_slices` may follow `tile_px_y`.
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


def _chunks(pairs: CandidatePairs) -> CandidatePairs:
    """`[chunks, CHUNK]`, or one chunk of fewer."""
    n_pairs = pairs.sample.shape[0]
    size = max(1, min(CHUNK, n_pairs))
    return jax.tree.map(lambda column: jnp.pad(column, (0, -n_pairs % size)).reshape(-1, size), pairs)


def _rows(variables: CountVariables, frame: RelaxedFrame) -> Callable[[CandidatePairs], tuple[Columns, Columns, Array]]:
    """What gathers, for a chunk of pairs, its samples (pixel from the left and the bottom, depth), its lights (x,
    y, depth, range) and its phases; columns, to broadcast against phases."""
    lights = in_view(variables, frame, variables.light_x_m, variables.light_y_m, variables.light_z_m)
    # Whole rows: one gather, and on the way back one scatter.
    light_row = jnp.stack([*lights, variables.light_range_m], axis=1)
    sample_row = jnp.stack(on_screen(variables, frame), axis=1)
    if not light_row.shape[0]:
        light_row = jnp.zeros((1, 4), light_row.dtype)  # what padding reads where there are no lights

    def gather(chunk: CandidatePairs) -> tuple[Columns, Columns, Array]:
        sample, light = sample_row[chunk.sample], light_row[chunk.light]
        return _columns(sample), _columns(light), frame.phase[chunk.sample]

    return gather


def _columns(rows: Float[Array, "pairs columns"]) -> Columns:
    return tuple(rows[:, c : c + 1] for c in range(rows.shape[1]))


def _shares(
    variables: CountVariables, frame: RelaxedFrame, temperature: Scalar | float
) -> Callable[[CandidatePairs], Float[Array, " pairs"]]:
    """What gives the share of the phases at which each pair of a chunk counts."""
    screen, rows_of = _screen(variables, frame), _rows(variables, frame)
    tile_px = (variables.tile_px_x, variables.tile_px_y)

    def shares(chunk: CandidatePairs) -> Float[Array, " pairs"]:
        (x_px, y_px, depth_m), (x_m, y_m, z_m, range_m), phase = rows_of(chunk)
        u, v, edge = phase[..., 0], phase[..., 1], phase[..., 2]
        if variables.depth_slices is None:
            depth_range_m = (variables.near_m, frame.far_m)
            radius_m = (range_m * (1 - temperature), range_m * (1 + temperature))
            share = tile_share(screen, (x_px, y_px), tile_px, depth_range_m, (x_m, y_m, z_m), radius_m, (edge, u))
        else:
            rays = tile_rays(screen, tile_at(x_px, tile_px[0], u), tile_at(y_px, tile_px[1], v))
            radius = range_m * (1 + temperature * (2 * edge - 1)) / depth_m
            centre = (x_m / depth_m, y_m / depth_m, z_m / depth_m)
            share = depth_share(rays, centre, radius, log_growth(variables, frame.far_m))
        return jnp.where(chunk.in_use, jnp.mean(share, axis=1), 0.0)

    def none(chunk: CandidatePairs) -> Float[Array, " pairs"]:
        return jnp.zeros(chunk.sample.shape, frame.x_m.dtype)

    # Pairs in use come first: chunks of padding cost nothing.
    return lambda chunk: jax.lax.cond(chunk.in_use[0], shares, none, chunk)
