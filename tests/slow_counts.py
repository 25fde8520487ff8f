"""Counts of a frame from their definitions, in float64 NumPy: no grid, clusters or lists of the code under test."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def slow_counts(
    camera: Any, position_m: np.ndarray, valid: np.ndarray, light_m: np.ndarray, range_m: np.ndarray,
    tile_px: int, depth_slices: int | None,
) -> dict[str, int]:  # fmt: skip
    """What tiled shading (`depth_slices` None) or clustered shading (0: cubic cells) does.

    A cell is the rays through a tile's corners cut by two depths: those of its samples where it is a tile, those of
    its slice where it is a cluster. A light is listed where its sphere touches the cell's box.

    **Arguments:**

    - `camera`: only what it was made of is read: eye, target, up, field of view, near, far, size.
    - `position_m`: `[h, w, 3]`, view space; `light_m`: `[N, 3]`, world space.
    """
    height, width = valid.shape
    top = math.tan(math.radians(camera.fov_y_deg) / 2)
    right = top * width / height
    row, column = np.nonzero(valid)
    depth_m = -position_m[row, column, 2].astype(np.float64)
    i, j = column // tile_px, row // tile_px
    n_columns, n_rows = math.ceil(width / tile_px), math.ceil(height / tile_px)
    k = np.zeros(len(depth_m), np.int64)
    growth, n_slices = 1.0, 1
    if depth_slices is not None:
        far_m = camera.far_m if math.isfinite(camera.far_m) else depth_m.max()
        ratio = far_m / camera.near_m
        if depth_slices:
            growth, n_slices = ratio ** (1 / depth_slices), depth_slices
        else:
            growth = 1 + 2 * top / n_rows
            n_slices = math.ceil(math.log(ratio) / math.log(growth))
        k = np.clip(np.floor(np.log(depth_m / camera.near_m) / np.log(growth)).astype(np.int64), 0, n_slices - 1)

    cell, of_cell = np.unique(np.stack([k, j, i], axis=1), axis=0, return_inverse=True)
    n_samples = np.bincount(of_cell.ravel(), minlength=len(cell))
    if depth_slices is None:
        near_m, far_m = np.full(len(cell), np.inf), np.zeros(len(cell))
        np.minimum.at(near_m, of_cell.ravel(), depth_m)
        np.maximum.at(far_m, of_cell.ravel(), depth_m)
    else:
        near_m, far_m = camera.near_m * growth ** cell[:, 0], camera.near_m * growth ** (cell[:, 0] + 1)
    low, high = np.full((len(cell), 3), np.inf), np.full((len(cell), 3), -np.inf)
    for right_side in (0, 1):
        for bottom_side in (0, 1):
            x = (2 * np.minimum((cell[:, 2] + right_side) * tile_px, width) / width - 1) * right
            y = (1 - 2 * np.minimum((cell[:, 1] + bottom_side) * tile_px, height) / height) * top
            for d in (near_m, far_m):
                corner = np.stack([x * d, y * d, -d], axis=1)
                low, high = np.minimum(low, corner), np.maximum(high, corner)

    length = np.zeros(len(cell), np.int64)
    for centre, radius in zip(_in_view(camera, light_m), range_m, strict=True):
        outside = np.maximum(np.maximum(low - centre, centre - high), 0)
        length += ((outside**2).sum(axis=1) <= radius**2) & (radius > 0)
    return {
        "samples": len(depth_m),
        "cells_total": n_columns * n_rows * n_slices,
        "clusters_occupied": len(cell),
        "light_cluster_pairs": int(length.sum()),
        "longest_list": int(length.max(initial=0)),
        "lighting_computations": int((length * n_samples).sum()),
    }


def _in_view(camera: Any, point_m: np.ndarray) -> np.ndarray:
    """Right-handed, looking down -z, y up."""
    eye, target, up = (np.asarray(vector, np.float64) for vector in (camera.eye_m, camera.target_m, camera.up))
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return (point_m - eye) @ np.stack([right, np.cross(back, right), back]).T
