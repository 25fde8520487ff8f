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
