"""One light and one sample: at what share of the phases of the grid the light is in the list of the sample's cell.

Bounds are implicit: a cell is its tile's rays cut by two depths, and a light is listed where its sphere meets the box
of the cell. The phases `u`, `v`, `w` of a sample are uniform in [0, 1] and independent: its tile spans
pixels `X - u t_x` to `X + (1 - u) t_x` (cut off at the image's sides, as the last tiles of a grid are), `Y` likewise
with `v`; its slice spans depths `F / g` to `F` with `F = d g**(1 - w)`, where `d` is its depth and `g` the growth from
slice to slice.

An average of the indicator over sampled phases would have no derivative. Instead one phase is integrated
in closed form, on an interval whose ends move smoothly with all variables, for a hard edge of the light as well.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vtfs.cluster_grid import _BOX_SLACK, _PIXEL_SLACK_PX

NEWTON_STEPS = 4
"""Enough to find the faces that a root lies outside of; its place is then computed exactly."""

_SMALLEST = 1e-9
_FLATTEST = 1e-6
"""Floors of a distance and of its rise, relative to the sample's depth: their product squared is still a float32."""

Pairs = Float[Array, "*pairs"]


class Span(eqx.Module):
    """Where a box is on one axis."""

    low: Pairs | float
    high: Pairs | float

    def distance(self, c: Pairs) -> Pairs:
        return jnp.maximum(jnp.maximum(self.low - c, c - self.high), 0)


Box = tuple[Span, Span, Span]
Point = tuple[Pairs, Pairs, Pairs]
"""x, y and depth, all in view space."""


class Screen(eqx.Module):
    """The image: its size in pixels, and view-space x or y at depth 1 per pixel."""

    width_px: float
    height_px: float
    slope_per_px: Float[Array, ""]


def tile_rays(screen: Screen, x_px: Span, y_px: Span) -> tuple[Span, Span]:
    """View-space x and y at depth 1 of a tile's sides; `y_px` counts from the bottom edge of the image.

    Cut off at the image's sides, and as much wider as the boxes of `cluster_grid.cell_boxes`.
    """

    def rays(px: Span, size_px: float) -> Span:
        low, high = jnp.clip(px.low, 0, size_px), jnp.clip(px.high, 0, size_px)
        middle_px = size_px / 2
        return Span(
            (low - _PIXEL_SLACK_PX - middle_px) * screen.slope_per_px,
            (high + _PIXEL_SLACK_PX - middle_px) * screen.slope_per_px,
        )

    return rays(x_px, screen.width_px), rays(y_px, screen.height_px)


def tile_at(position_px: Pairs, tile_px: Pairs, phase: Pairs) -> Span:
    """The tile that a sample lies in where `phase` of the tile is before it."""
    return Span(position_px - phase * tile_px, position_px + (1 - phase) * tile_px)


def cell_box(rays: tuple[Span, Span], near: Pairs, far: Pairs) -> Box:
    """Box of a cell: its tile's rays cut by two depths, with the slack of `cluster_grid.cell_boxes`."""
    slack = _BOX_SLACK * far
    x, y = (
        Span(jnp.minimum(r.low * near, r.low * far) - slack, jnp.maximum(r.high * near, r.high * far) + slack)
        for r in rays
    )
    return x, y, Span(near - slack, far + slack)


def depth_share(rays: tuple[Span, Span], centre: Point, radius: Pairs, log_growth: Float[Array, ""]) -> Pairs:
    """Share of the depth phases at which a sphere meets the box of the sample's cell; lengths in units of its depth.

    Given `u` and `v`, the box of the cell is `F B`, where `B` is that for `F = 1`: it grows from the eye. The
    distance from the light's centre to `F B` is a norm of terms `max(0, low F - c, c - high F)`, so convex in `F`:
    the light is met on one interval `[F_a, F_b]` of `[1, g]`. As `log F` is uniform, the share is `log(F_b / F_a) /
    log g`. The ends are roots of the distance minus the radius; Newton's method comes to a root of a convex
    function from one side and never passes it.

    The share is continuous in `u`, `v` and everything else, which the indicator is not: a mean over points of `u`
    and `v` has the derivative of the expectation as its expected derivative.
    """
    growth = jnp.exp(log_growth)
    nearest, farthest = (cell_box(rays, far / growth, far) for far in (jnp.ones_like(growth), growth))
    # From either end, each in its own units: where the sphere is met at an end, it stays 1.
    first, last = _first_met(nearest, centre, radius, growth, 1.0), _first_met(farthest, centre, radius, growth, -1.0)
    return jnp.maximum(log_growth + jnp.log(last) - jnp.log(first), 0.0) / log_growth


def _first_met(box: Box, centre: Point, radius: Pairs, growth: Float[Array, ""], side: float) -> Pairs:
    """The factor nearest to 1, on the upper (1) or lower (-1) side of it, at which a sphere meets so many times the
    box; at least by a factor of `growth` away where it meets none."""

    def parabola(f: Pairs, box: Box, centre: Point, radius: Pairs) -> tuple[Pairs, Pairs, Pairs]:
        """a, b, c of `a s**2 + 2 b s + c`, the squared distance at `f + s` minus that of the radius, while the
        sphere's centre is outside the same faces as at `f`."""
        a, b, c = jnp.zeros_like(f), jnp.zeros_like(f), -(radius**2)
        for at, span in zip(centre, box, strict=True):
            below, above = span.low * f - at, at - span.high * f
            is_outside = jnp.maximum(below, above) > 0
            rise = jnp.where(is_outside, jnp.where(below > above, span.low, -span.high), 0.0)
            outside = jnp.where(is_outside, jnp.maximum(below, above), 0.0)
            a, b, c = a + rise * rise, b + outside * rise, c + outside * outside
        return a, b, c

    # Only the last step is differentiated: through all of them, XLA computes each one again for each use of it.
    fixed = jax.lax.stop_gradient((box, centre, radius))
    limits = jax.lax.stop_gradient((1 / growth, growth))
    one = jnp.ones_like(fixed[2])

    def newton(_, f: Pairs) -> Pairs:
        _, b, c = parabola(f, *fixed)
        distance = jnp.sqrt(jnp.maximum(c + fixed[2] ** 2, _SMALLEST**2))
        # The distance rises by b / distance. Where it does not fall to the side, the step leaves the range.
        fall = jnp.maximum(-side * b, _FLATTEST * distance) / distance
        return jnp.clip(f + side * jnp.maximum(distance - fixed[2], 0) / fall, *limits)

    near_root = jax.lax.stop_gradient(jax.lax.fori_loop(0, NEWTON_STEPS, newton, one))
    # The root of the parabola, which does not depend on where it was taken. It is exact too where the sphere is
    # hardly met, and Newton's method comes to the double root by halves.
    a, b, c = parabola(near_root, box, centre, radius)
    discriminant = b * b - a * c
    falls = -side * b + jnp.sqrt(jnp.where(discriminant > 0, discriminant, 1.0))
    has_root = (discriminant > 0) & (falls > _SMALLEST)
    root = near_root + side * c / jnp.where(has_root, falls, 1.0)
    root = jnp.where(has_root, jnp.clip(root, 1 / growth, growth), limits[0] if side < 0 else limits[1])
    return jnp.where(parabola(one, *fixed)[2] <= 0, 1.0, root)


def tile_share(
    screen: Screen,
    position_px: tuple[Pairs, Pairs],
    tile_px: tuple[Pairs, Pairs],
    depth_range_m: tuple[Pairs, Pairs],
    centre_m: Point,
    radius_m: tuple[Pairs, Pairs],
    points: tuple[Pairs, Pairs],
) -> Pairs:
    """Share of the tile phases at which a sphere meets the box of the sample's tile, which has no depth phase.

    Without it the depth of the light is outside the tile by a fixed `d_z`, and `d_x(u)**2 + d_y(v)**2 + d_z**2 <=
    r**2` has to hold. Each `d` falls and rises again with its phase, so it is below a bound on one interval, in
    closed form. The interval of `u` leaves out what no `v` makes good: there the length of the interval of `v`,
    which is exact, is continuous. One point within the interval of `u`, times the lengths of both, has the share as
    its expectation.

    A light that no tile of the image holds in x, y or depth is met by all tiles along that side at once as its
    radius grows. That is a step of the count itself, unless the edge is soft: radii are then a third interval.

    **Arguments:**

    - `position_px`, `tile_px`: x and y; y counts from the bottom edge.
    - `radius_m`: smallest and largest of the soft edge.
    - `points`: places within the intervals of the radius and of `u`, in (0, 1).
    """
    near_m, far_m = depth_range_m
    whole = cell_box(tile_rays(screen, Span(0.0, screen.width_px), Span(0.0, screen.height_px)), near_m, far_m)
    least_x, least_y, least_z = (span.distance(c) for span, c in zip(whole, centre_m, strict=True))
    least_m = _root(least_x**2 + least_y**2 + least_z**2)

    smallest_m, largest_m = radius_m
    width_m = jnp.maximum(largest_m - smallest_m, _SMALLEST * largest_m)
    edge_share = jnp.clip((largest_m - least_m) / width_m, 0, 1)
    reach2 = (largest_m - (1 - points[0]) * edge_share * width_m) ** 2 - least_z**2

    def interval(axis: int, size_px: float, reach: Pairs) -> tuple[Pairs, Pairs]:
        """First and last phase at which the tile comes within `reach` of the centre on an axis."""
        low_m, high_m = centre_m[axis] + reach + _BOX_SLACK * far_m, centre_m[axis] - reach - _BOX_SLACK * far_m
        # The box begins at the lesser of two products, which is low enough where either is.
        low = jnp.maximum(low_m / near_m, low_m / far_m) / screen.slope_per_px + size_px / 2 + _PIXEL_SLACK_PX
        high = jnp.minimum(high_m / near_m, high_m / far_m) / screen.slope_per_px + size_px / 2 - _PIXEL_SLACK_PX
        first = jnp.clip((position_px[axis] - low) / tile_px[axis], 0, 1)
        return first, jnp.maximum(first, jnp.clip(1 - (high - position_px[axis]) / tile_px[axis], 0, 1))

    first_u, last_u = interval(0, screen.width_px, _root(reach2 - least_y**2))
    u = first_u + (last_u - first_u) * points[1]
    rays = tile_rays(screen, tile_at(position_px[0], tile_px[0], u), Span(0.0, screen.height_px))
    outside_x = cell_box(rays, near_m, far_m)[0].distance(centre_m[0])
    first_v, last_v = interval(1, screen.height_px, _root(reach2 - outside_x**2))
    return edge_share * (last_u - first_u) * (last_v - first_v)


def _root(squares: Pairs) -> Pairs:
    """Square root whose derivative stays finite at 0."""
    return jnp.sqrt(jnp.maximum(squares, _SMALLEST**2))
