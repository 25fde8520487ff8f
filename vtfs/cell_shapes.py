"""The cells of a view as they are, not their boxes: parts of a frustum between two depths, and what meets them."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vtfs.bounds import SLACK, Aabb, Sphere


class CellSections(eqx.Module):
    """`left * w <= x <= right * w`, `bottom * w <= y <= top * w`, `near_m <= depth <= far_m`, with depth = -z.

    - `converges`: 1 in a perspective view, where the width `w` is the depth; 0 in a parallel one, where it is 1.
    - `view_near_m`: the near plane of the view, in front of which nothing is seen.
    """

    left: Float[Array, "*cells"]
    right: Float[Array, "*cells"]
    bottom: Float[Array, "*cells"]
    top: Float[Array, "*cells"]
    near_m: Float[Array, "*cells"]
    far_m: Float[Array, "*cells"]
    converges: Float[Array, ""]
    view_near_m: Float[Array, ""]

    def width(self, depth_m: Float[Array, "*cells"]) -> Float[Array, "*cells"]:
        return self.converges * depth_m + (1 - self.converges)


def section_rows(section: CellSections, row) -> CellSections:
    """Some cells as a column, to broadcast against each one's candidates."""
    return CellSections(
        section.left[row][:, None],
        section.right[row][:, None],
        section.bottom[row][:, None],
        section.top[row][:, None],
        section.near_m[row][:, None],
        section.far_m[row][:, None],
        section.converges,
        section.view_near_m,
    )


def within_box(section: CellSections, box: Aabb) -> CellSections:
    """Sections that hold what lies in both a section and a box; the box's depths are above 0."""
    near_m, far_m = -box.high_z_m, -box.low_z_m
    # A box in use has depths; an unused one is infinite, and would make NaNs.
    near_m, far_m = (jnp.where(jnp.isfinite(depth_m), depth_m, 1.0) for depth_m in (near_m, far_m))
    width_near, width_far = section.width(near_m), section.width(far_m)

    def least(low_m):
        slope = jnp.minimum(low_m / width_near, low_m / width_far)
        return slope - SLACK * jnp.abs(slope)

    def greatest(high_m):
        return -least(-high_m)

    return CellSections(
        jnp.maximum(section.left, least(box.low_x_m)),
        jnp.minimum(section.right, greatest(box.high_x_m)),
        jnp.maximum(section.bottom, least(box.low_y_m)),
        jnp.minimum(section.top, greatest(box.high_y_m)),
        near_m,
        far_m,
        section.converges,
        section.view_near_m,
    )


def sphere_meets_section(sphere: Sphere, section: CellSections) -> Bool[Array, "*pairs"]:
    """Does a sphere touch a cell? Exact: the distance to the cell is compared, not to its planes or its box.

    At one depth the cell is a rectangle, and the squared distance from the centre to it is, as a function of the
    depth, convex with a continuous derivative: one of three parabolas for x (left of the rectangle, within, right of
    it) plus one of three for y plus that of the depth. Where it is least, so is one of these nine sums, over all
    depths or at an end: the true distance is taken at the nine depths, and the least counts.

    Rounding: with u = 2^-24 and M the sum of all magnitudes that enter, the nine depths are off by at most 7uM over
    the root of their parabola's curvature, which moves a distance by no more than 7uM; evaluating it adds 5uM. `SLACK`
    is 16u: no touching sphere is missed.
    """
    p = section.converges
    q = 1 - p
    depth_m = -sphere.z_m
    edges_x = (section.left, None, section.right)
    edges_y = (section.bottom, None, section.top)

    def distance2(d):
        w = p * d + q
        dx = jnp.maximum(jnp.maximum(section.left * w - sphere.x_m, sphere.x_m - section.right * w), 0)
        dy = jnp.maximum(jnp.maximum(section.bottom * w - sphere.y_m, sphere.y_m - section.top * w), 0)
        dz = d - depth_m
        return dx * dx + dy * dy + dz * dz

    least = jnp.float32(jnp.inf)
    for x_edge in edges_x:
        x_pull, x_square = _pull(x_edge, sphere.x_m, p, q)
        for y_edge in edges_y:
            y_pull, y_square = _pull(y_edge, sphere.y_m, p, q)
            d = (depth_m + x_pull + y_pull) / (1 + x_square + y_square)
            least = jnp.minimum(least, distance2(jnp.clip(d, section.near_m, section.far_m)))
    reach = sphere.radius_m + SLACK * _magnitude(sphere, section)
    return (least <= reach * reach) & jnp.isfinite(sphere.x_m)


def sphere_meets_planes(sphere: Sphere, section: CellSections) -> Bool[Array, "*pairs"]:
    """Is a sphere outside none of the cell's six planes? Accepts spheres beside edges and corners too (Olsson and
    Assarsson 2011; van Oosten 2017, Fig. 1.3)."""
    p, depth_m = section.converges, -sphere.z_m
    w = section.width(depth_m)
    reach = sphere.radius_m + SLACK * _magnitude(sphere, section)

    def beyond(slope, centre_m, side):
        return side * (centre_m - slope * w) > reach * jnp.sqrt(1 + p * slope * slope)

    outside = beyond(section.left, sphere.x_m, -1) | beyond(section.right, sphere.x_m, 1)
    outside |= beyond(section.bottom, sphere.y_m, -1) | beyond(section.top, sphere.y_m, 1)
    outside |= (section.near_m - depth_m > reach) | (depth_m - section.far_m > reach)
    return ~outside & jnp.isfinite(sphere.x_m)


def sphere_meets_screen_rect(sphere: Sphere, section: CellSections) -> Bool[Array, "*pairs"]:
    """Does the rectangle around a sphere's projection overlap the cell's tile, and its depths the cell's?

    The rectangle is exact on each axis, the part of the sphere behind the near plane cut off (Mara and McGuire 2013).
    Their tangents are not computed: on one axis the sphere is a disc, whose projection overlaps the tile where the
    disc meets the wedge of the tile beyond the near plane. Three depths as above decide that without a division by
    what vanishes when the eye lies on the sphere.
    """
    p = section.converges
    q = 1 - p
    depth_m = -sphere.z_m
    reach = sphere.radius_m + SLACK * _magnitude(sphere, section)

    def overlaps(low, high, centre_m):
        least = jnp.float32(jnp.inf)
        for edge in (low, None, high):
            pull, square = _pull(edge, centre_m, p, q)
            d = jnp.maximum((depth_m + pull) / (1 + square), section.view_near_m)
            w = p * d + q
            aside = jnp.maximum(jnp.maximum(low * w - centre_m, centre_m - high * w), 0)
            least = jnp.minimum(least, aside * aside + (d - depth_m) * (d - depth_m))
        return least <= reach * reach

    meets = overlaps(section.left, section.right, sphere.x_m) & overlaps(section.bottom, section.top, sphere.y_m)
    meets &= (section.near_m - depth_m <= reach) & (depth_m - section.far_m <= reach)
    return meets & jnp.isfinite(sphere.x_m)


def _pull(edge, centre_m, p, q):
    """Linear and square term by which one edge moves the depth of least distance; none within the rectangle."""
    if edge is None:
        return jnp.float32(0), jnp.float32(0)
    return p * edge * (centre_m - q * edge), p * edge * edge


def _magnitude(sphere: Sphere, section: CellSections) -> Float[Array, "*pairs"]:
    slope = jnp.maximum(jnp.abs(section.left), jnp.abs(section.right))
    slope += jnp.maximum(jnp.abs(section.bottom), jnp.abs(section.top))
    centre = jnp.abs(sphere.x_m) + jnp.abs(sphere.y_m) + jnp.abs(sphere.z_m)
    return centre + section.far_m + slope * section.width(section.far_m)
