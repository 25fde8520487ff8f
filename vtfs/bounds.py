"""Boxes and spheres, and whether they meet. Components apart: see `Aabb`."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

SLACK = 1e-6
"""Relative error bound of the float32 tests below: eight times 2^-23, for the at most five roundings
between the operands and either side of the comparison. Tests err on the side of touching."""


class Aabb(eqx.Module):
    """Axis-aligned boxes in view space, metres. Empty where `low > high`.

    Components are separate arrays: on a CPU `[N, 3]` costs four times as much.
    """

    low_x_m: Float[Array, "*boxes"]
    low_y_m: Float[Array, "*boxes"]
    low_z_m: Float[Array, "*boxes"]
    high_x_m: Float[Array, "*boxes"]
    high_y_m: Float[Array, "*boxes"]
    high_z_m: Float[Array, "*boxes"]


class Sphere(eqx.Module):
    """Spheres in view space, metres. One that must meet nothing has its centre at infinity."""

    x_m: Float[Array, "*spheres"]
    y_m: Float[Array, "*spheres"]
    z_m: Float[Array, "*spheres"]
    radius_m: Float[Array, "*spheres"]


def sphere_meets_box(sphere: Sphere, box: Aabb) -> Bool[Array, "*pairs"]:
    """Does a sphere touch a box? Arvo (1990); touching counts, within `SLACK` (and below 1e-18 m: squares underflow).

    Shapes broadcast: clusters against lights, or pairs against pairs.
    """
    # Squared, to spare a root for every pair; three scalars, to stay in registers.
    dx = sphere.x_m - jnp.clip(sphere.x_m, box.low_x_m, box.high_x_m)
    dy = sphere.y_m - jnp.clip(sphere.y_m, box.low_y_m, box.high_y_m)
    dz = sphere.z_m - jnp.clip(sphere.z_m, box.low_z_m, box.high_z_m)
    return dx * dx + dy * dy + dz * dz <= sphere.radius_m * sphere.radius_m * (1 + SLACK)


def boxes_meet(a: Aabb, b: Aabb) -> Bool[Array, "*pairs"]:
    """Do two boxes overlap? Touching counts; comparisons are exact. Shapes broadcast."""
    return (
        (a.low_x_m <= b.high_x_m)
        & (b.low_x_m <= a.high_x_m)
        & (a.low_y_m <= b.high_y_m)
        & (b.low_y_m <= a.high_y_m)
        & (a.low_z_m <= b.high_z_m)
        & (b.low_z_m <= a.high_z_m)
    )


def box_of_sphere(sphere: Sphere) -> Aabb:
    """The box around a sphere, grown by the rounding of its own faces: it holds the exact sphere."""

    def extent(centre_m: Float[Array, "*spheres"]) -> tuple[Float[Array, "*spheres"], Float[Array, "*spheres"]]:
        grown_m = sphere.radius_m + SLACK * (jnp.abs(centre_m) + sphere.radius_m)
        # A centre at infinity means "meets nothing": an empty box.
        never = jnp.isinf(centre_m)
        return jnp.where(never, jnp.inf, centre_m - grown_m), jnp.where(never, -jnp.inf, centre_m + grown_m)

    (low_x, high_x), (low_y, high_y), (low_z, high_z) = map(extent, (sphere.x_m, sphere.y_m, sphere.z_m))
    return Aabb(low_x, low_y, low_z, high_x, high_y, high_z)


def sphere_of_box(box: Aabb) -> Sphere:
    """The sphere around a box: through its corners, grown by rounding."""
    x_m, y_m, z_m = (
        0.5 * (box.low_x_m + box.high_x_m),
        0.5 * (box.low_y_m + box.high_y_m),
        0.5 * (box.low_z_m + box.high_z_m),
    )
    dx, dy, dz = box.high_x_m - x_m, box.high_y_m - y_m, box.high_z_m - z_m
    radius_m = jnp.sqrt(dx * dx + dy * dy + dz * dz) * (1 + SLACK)
    return Sphere(x_m, y_m, z_m, radius_m + SLACK * (jnp.abs(x_m) + jnp.abs(y_m) + jnp.abs(z_m)))


class Cone(eqx.Module):
    """Solid cones without end; the apex is kept apart. Axes are unit vectors.

    - `cos`, `sin`: of the half angle, from 0 to 180 degrees.
    """

    x: Float[Array, "*cones"]
    y: Float[Array, "*cones"]
    z: Float[Array, "*cones"]
    cos: Float[Array, "*cones"]
    sin: Float[Array, "*cones"]


def sphere_meets_cone(sphere: Sphere, apex: Sphere, cone: Cone) -> Bool[Array, "*pairs"]:
    """Does a sphere touch a cone whose apex is the centre of `apex`? Exact in its plane, at any half angle; the
    published tests (Wronski 2017) measure to the cone's side only, also behind the apex. Touching counts.
    """
    vx, vy, vz = sphere.x_m - apex.x_m, sphere.y_m - apex.y_m, sphere.z_m - apex.z_m
    along = vx * cone.x + vy * cone.y + vz * cone.z
    # Not sqrt(v.v - along**2), which cancels for narrow cones.
    ax, ay, az = vy * cone.z - vz * cone.y, vz * cone.x - vx * cone.z, vx * cone.y - vy * cone.x
    aside = jnp.sqrt(ax * ax + ay * ay + az * az)
    distance = jnp.sqrt(vx * vx + vy * vy + vz * vz)
    beyond_side = aside * cone.cos - along * cone.sin
    along_side = aside * cone.sin + along * cone.cos
    size = jnp.abs(sphere.x_m) + jnp.abs(sphere.y_m) + jnp.abs(sphere.z_m)
    size += jnp.abs(apex.x_m) + jnp.abs(apex.y_m) + jnp.abs(apex.z_m)
    reach = sphere.radius_m + SLACK * size
    # Where the foot on the cone's side lies behind the apex, the apex is nearest.
    return (beyond_side <= 0) | (jnp.where(along_side >= 0, beyond_side, distance) <= reach)
