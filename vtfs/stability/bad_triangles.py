"""Triangles that no rasteriser likes, around a light."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

Kind = Literal[
    "repeated vertices",
    "collinear",
    "light in plane",
    "light at a vertex",
    "vertex 1e-14 m from the light",
    "1e-30 m",
    "1e30 m",
]
KINDS: tuple[Kind, ...] = get_args(Kind)


def bad_triangles(kind: Kind, light_m: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """Corners `[n, 3, 3]`, some metres from the light, or of a size that float32 does not hold."""
    a, b, c = rng.normal(size=(3, n, 3)) * 1.5
    t, u = rng.uniform(-1, 1, (2, n, 1))
    if kind == "light in plane":  # up to rounding
        corners = np.stack([a, b, t * a + u * b], axis=1)
    elif kind == "collinear":
        corners = np.stack([a, b, a + t * (b - a)], axis=1)
    elif kind == "repeated vertices":
        corners = np.stack([a, b, np.where(t > 0, a, b)], axis=1)
    elif kind == "light at a vertex":
        corners = np.stack([a, b, np.zeros((n, 3))], axis=1)
    elif kind == "vertex 1e-14 m from the light":
        corners = np.stack([a, b, c * 1e-14], axis=1)
    else:
        scale = {"1e-30 m": 1e-30, "1e30 m": 1e30}[kind]
        corners = np.stack([a, b, c], axis=1) * scale + np.where(rng.random((n, 1, 1)) < 0.5, a[:, None], 0)
    return corners + light_m


def tilted_triangles(
    light_m: np.ndarray, middle_m: np.ndarray, tilt: float, width: float, rng: np.random.Generator
) -> np.ndarray:
    """Triangles of half a metre to two metres around given middles, `[n, 3, 3]`.

    **Arguments:**

    - `tilt`: sine of the angle between a triangle's plane and the line from the light: 1 faces it, 0 is edge-on.
    - `width`: over length.
    """
    n = len(middle_m)
    size = rng.uniform(0.25, 1, (n, 1))
    way = middle_m - light_m
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    along = np.cross(way, rng.normal(size=(n, 3)))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(way, along) * tilt + way * np.sqrt(max(0.0, 1 - tilt * tilt))
    along, across = along * size, across * size * width
    return np.stack([middle_m - along, middle_m + along, middle_m + across * rng.choice([-1, 1], (n, 1))], axis=1)
