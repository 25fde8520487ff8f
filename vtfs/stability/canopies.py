"""Meshes that are aimed at samples: their vertices lie exactly on the lines from a light to what pixels see.

So a sample lies on an edge or a vertex of the mesh as the light sees it, which chance would never do. The mesh hangs
near the light, outside of the view.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vtfs.shadow_casters import Casters
from vtfs.stability.stage import Stage, seen

_SHARE = 0.15
"""Of the way from the light to the floor at which the mesh hangs."""

_TOP_PX, _BOTTOM_PX, _LEFT_PX, _RIGHT_PX = 44, 60, 8, 56
"""Of the default stage: pixels that see the floor, and nothing on it. The mesh hides the light from them."""


def under_lattice(stage: Stage, miss_rad: float, rng: np.random.Generator) -> Stage:
    """The stage below a mesh with a vertex for every second pixel of every second row.

    **Arguments:**

    - `miss_rad`: angle, at the light, between a sample and the vertex that is aimed at it.
    """
    columns = np.arange(_LEFT_PX, _RIGHT_PX + 1, 2)
    lines = []
    for row in range(_TOP_PX, _BOTTOM_PX + 1, 2):
        at = _aimed(stage, row, columns)
        way = at - np.array(stage.light.position_m)
        beside = np.cross(way, rng.normal(size=way.shape))
        lines.append(
            at
            + miss_rad
            * beside
            / np.linalg.norm(beside, axis=1, keepdims=True)
            * np.linalg.norm(way, axis=1, keepdims=True)
        )
    return _under(stage, _bands([(line, line) for line in lines]))


def under_t_junctions(stage: Stage, n_between: int) -> Stage:
    """The stage below two bands of triangles; on the row where they meet one of them has `n_between` vertices on each
    edge of the other, up to rounding."""
    coarse = np.arange(_LEFT_PX, _RIGHT_PX + 1, 8)
    middle_px = (_TOP_PX + _BOTTOM_PX) // 2
    top, middle, bottom = (_aimed(stage, row, coarse) for row in (_TOP_PX, middle_px, _BOTTOM_PX))
    fine = [middle[:1]]
    for a, b, column in zip(middle[:-1], middle[1:], coarse[:-1], strict=True):
        between = column + np.arange(1, n_between + 1) * (8 // (n_between + 1))
        target = _aimed(stage, middle_px, between) if n_between else np.zeros((0, 3))
        share = (target - a) @ (b - a) / ((b - a) @ (b - a))
        fine += [a + share[:, None] * (b - a), b[None]]
    return _under(stage, _bands([(top, top), (middle, np.concatenate(fine)), (bottom, bottom)]))


def _under(stage: Stage, mesh: Casters) -> Stage:
    """Tested are the pixels whose light only the inside of the mesh stops."""
    inside = slice(_TOP_PX + 1, _BOTTOM_PX), slice(_LEFT_PX + 1, _RIGHT_PX)
    return replace(stage.with_mesh(mesh.vertices_m, mesh.triangles), tested_px=inside)


def _aimed(stage: Stage, row_px: int, columns_px: np.ndarray) -> np.ndarray:
    """Points on the lines from the light to the samples of a row of pixels, as rounded to float32; `[n, 3]`."""
    samples = seen(stage.camera, stage.casters)
    position = samples.position_m[row_px, columns_px].astype(np.float64)
    at = position @ stage.camera.view_from_world[:3, :3] + np.array(stage.camera.eye_m)
    light_m = np.array(stage.light.position_m)
    return light_m + _SHARE * (at - light_m)


def _bands(polylines: Sequence[tuple[np.ndarray, np.ndarray]]) -> Casters:
    """Triangles between consecutive rows, which share vertices where both sides of a row are the same.

    **Arguments:**

    - `polylines`: of each row, top to bottom, the vertices that the band above it uses, and the band below it.
    """
    vertices: list[np.ndarray] = []
    numbers: list[tuple[np.ndarray, np.ndarray]] = []
    n = 0
    for above, below in polylines:
        first = n + np.arange(len(above))
        vertices.append(above)
        n += len(above)
        second = first
        if below is not above:
            second = n + np.arange(len(below))
            vertices.append(below)
            n += len(below)
        numbers.append((first, second))
    at = np.concatenate(vertices)
    triangles = []
    for (_, top), (bottom, _) in itertools.pairwise(numbers):
        i = j = 0
        while i + 1 < len(top) or j + 1 < len(bottom):
            # The side that is behind goes on.
            if j + 1 == len(bottom) or (i + 1 < len(top) and (i + 1) * (len(bottom) - 1) <= (j + 1) * (len(top) - 1)):
                triangles.append((top[i], bottom[j], top[i + 1]))
                i += 1
            else:
                triangles.append((top[i], bottom[j], bottom[j + 1]))
                j += 1
    return Casters(at, np.array(triangles, np.int32))
