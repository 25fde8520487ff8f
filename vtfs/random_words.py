"""Random numbers that are functions of what they are for, so that no order and no batch changes them."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from jaxtyping import Array

Words = TypeVar("Words", np.ndarray, Array)


def random_words(x: Words, y: Words, z: Words, w: Words) -> Words:
    """32 random bits for four words, uint32: the first of PCG4D (Jarzynski and Olano 2020, Listing 17).

    Shapes broadcast; arrays of NumPy or JAX. Words wrap.
    """
    x, y, z, w = (word * np.uint32(1664525) + np.uint32(1013904223) for word in (x, y, z, w))
    x, y, z, w = _mixed(x, y, z, w)
    x, y, z, w = (word ^ (word >> np.uint32(16)) for word in (x, y, z, w))
    return _mixed(x, y, z, w)[0]


def _mixed(x: Words, y: Words, z: Words, w: Words) -> tuple[Words, Words, Words, Words]:
    x = x + y * w
    y = y + z * x
    z = z + x * y
    return x, y, z, w + y * z
