"""Morton order: positions near each other in space get codes near each other."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from vtfs.bounds import Sphere

BITS = 10  # per axis: van Oosten 2017, Alg. 6.3
BITS_FINE = 21  # per axis, in 63 bits: where lights are much nearer to each other than their box is long

LARGEST = 2**BITS - 1


def morton_codes(spheres: Sphere, low_m: Float[Array, 3], high_m: Float[Array, 3]) -> UInt32[Array, " spheres"]:
    """30-bit codes of the centres within a box; centres outside are clamped to it.

    `q = (p - low) / (high - low) * (2**10 - 1)`, bit `s` of x, y, z at `3s`, `3s + 1`, `3s + 2` (van Oosten 2017,
    Alg. 6.2 and 6.3). An axis without extent gives 0.
    """
    code = jnp.zeros(spheres.x_m.shape, jnp.uint32)
    for axis, cell in enumerate(_cells(spheres, low_m, high_m, BITS)):
        code = code | (_spread(cell) << axis)
    return code


def morton_codes_fine(
    spheres: Sphere, low_m: Float[Array, 3], high_m: Float[Array, 3]
) -> tuple[UInt32[Array, " spheres"], UInt32[Array, " spheres"]]:
    """63-bit codes, 21 bits an axis, as two words, the more significant first: the rest is as in `morton_codes`."""
    high = low = jnp.zeros(spheres.x_m.shape, jnp.uint32)
    for axis, cell in enumerate(_cells(spheres, low_m, high_m, BITS_FINE)):
        # Bits 0 to 9 fill the low word up to its bit 29; bit 10 of x, y and z are bits 30, 31 and 32 of the code.
        low = low | (_spread(cell & LARGEST) << axis)
        middle = (cell >> BITS) & 1
        low, high = (low | (middle << (30 + axis)), high) if axis < 2 else (low, high | middle)
        high = high | (_spread(cell >> (BITS + 1)) << (axis + 1))
    return high, low


def _cells(
    spheres: Sphere, low_m: Float[Array, 3], high_m: Float[Array, 3], bits: int
) -> list[UInt32[Array, " spheres"]]:
    """Cell of each centre along x, y and z, in `[0, 2**bits)`."""
    cells, largest = [], 2**bits - 1
    for axis, centre_m in enumerate((spheres.x_m, spheres.y_m, spheres.z_m)):
        extent_m = high_m[axis] - low_m[axis]
        scale = jnp.where(extent_m > 0, largest / jnp.where(extent_m > 0, extent_m, 1.0), 0.0)
        cells.append(jnp.clip((centre_m - low_m[axis]) * scale, 0, largest).astype(jnp.uint32))
    return cells


def _spread(value: UInt32[Array, "*n"]) -> UInt32[Array, "*n"]:
    """The low ten bits, three places apart."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        value = (value | (value << shift)) & jnp.uint32(mask)
    return value
