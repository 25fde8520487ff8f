"""Morton order: positions near each other in space get codes near each other."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from vtfs.bounds import Sphere

BITS = 10  # per axis: van Oosten 2017, Alg. 6.3


LARGEST = 2**BITS - 1


def morton_codes(spheres: Sphere, low_m: Float[Array, 3], high_m: Float[Array, 3]) -> UInt32[Array, " spheres"]:
    """30-bit codes of the centres within a box; centres outside are clamped to it.

    `q = (p - low) / (high - low) * (2**10 - 1)`, bit `s` of x, y, z at `3s`, `3s + 1`, `3s + 2` (van Oosten 2017,
    Alg. 6.2 and 6.3). An axis without extent gives 0.
    """
    code = jnp.zeros(spheres.x_m.shape, jnp.uint32)
    for axis, centre_m in enumerate((spheres.x_m, spheres.y_m, spheres.z_m)):
        extent_m = high_m[axis] - low_m[axis]
        scale = jnp.where(extent_m > 0, LARGEST / jnp.where(extent_m > 0, extent_m, 1.0), 0.0)
        cell = jnp.clip((centre_m - low_m[axis]) * scale, 0, LARGEST).astype(jnp.uint32)
        code = code | (_spread(cell) << axis)
    return code


def _spread(value: UInt32[Array, "*n"]) -> UInt32[Array, "*n"]:
    """The low ten bits, three places apart."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | (value << shift)) & jnp.uint32(mask)
    return value
