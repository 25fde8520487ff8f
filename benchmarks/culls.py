"""How many lights do the culls and bounds list in vain? Pairs listed over pairs of exact geometry, and over those that
a sample proves. Counts only, so a busy machine does not matter.

    python benchmarks/culls.py --scene atrium --lights 1000 --size 1280x720 --tile-px 32
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from vtfs.camera import Viewport
from vtfs.configurations import Configuration, configuration
from vtfs.false_positives import ListedPairs, listed_pairs
from vtfs.frame import run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.parameters import Value
from vtfs.scene_setup import SceneOptions, set_up

CULLS = ("planes", "screen_rect", "frustum")
BOUNDS = ("explicit", "packed", "depth_range")
CLUSTERED: tuple[dict[str, Value], ...] = (
    {},
    *({"cull": cull} for cull in CULLS),
    *({"bounds": bounds} for bounds in BOUNDS),
    *({"bounds": bounds, "cull": "frustum"} for bounds in BOUNDS),
    {"leaf_test": "box"},
    {"normal_bins": 3},
    {"normal_bins": 3, "normal_cones": "explicit", "bounds": "explicit"},
    {"depth_slices": 24, "depth_scheme": "linear"},
    {"depth_slices": 24, "depth_scheme": "ndc"},
    {"grid": "16x9x24"},
)
TILED: tuple[dict[str, Value], ...] = (
    {},
    *({"cull": cull} for cull in CULLS),
    {"bounds": "explicit"},
    {"normal_cones": "explicit"},
)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", default="atrium")
    parser.add_argument("--lights", default="1000")
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--tile-px", type=int, default=32)
    parser.add_argument("--frame", type=int, default=0)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    setup = set_up(SceneOptions(options.scene, lights=options.lights, viewport=Viewport(width, height)))
    inputs = FrameInputs(setup.samples(options.frame), setup.lights)
    print("technique and parameters, clusters, pairs, over exact geometry, over reaching")
    for technique, rows in (("volume_tiled_bvh", CLUSTERED), ("tiled_deferred", TILED)):
        for params in rows:
            tile = {} if "grid" in params else {"tile_px": options.tile_px}
            show(configuration(technique, tile | params), inputs, technique == "tiled_deferred")


def show(config: Configuration, inputs: FrameInputs, is_tiled: bool) -> None:
    env, _ = run_stages(config, inputs, until="assign")
    found = listed_pairs(env["positions"], env["clusters"], env["assign"], inputs.lights)
    implicit = config["bounds"] in ("implicit", "frustum") and config["normal_bins"] == 0
    exact = exact_pairs(config, inputs, env, found) if implicit and config["cull"] == "box" and not is_tiled else None
    over_exact = f"{found.listed / exact:6.3f} of {exact:,}" if exact else "     -"
    n_clusters = int(env["clusters"].n_clusters)
    print(f"{config!s:75s} {n_clusters:7,} {found.listed:9,} {over_exact} {found.ratio:6.3f}", flush=True)


def exact_pairs(config: Configuration, inputs: FrameInputs, env: dict, found: ListedPairs) -> int:
    """Pairs whose sphere meets the cell, in float64: the least distance over depths, by ternary search."""
    clusters, lists, grid, camera = env["clusters"], env["assign"], env["grid"], inputs.camera
    viewport, n = camera.viewport, int(clusters.n_clusters)
    key = np.repeat(np.asarray(clusters.key)[:n], np.asarray(lists.count)[:n])
    light = np.asarray(inputs.lights.row, np.float64)[np.asarray(lists.index)[: found.listed]]
    columns, rows = (int(side) for side in grid.tiles(viewport))
    i, j, k = key % columns, key // columns % rows, key // (columns * rows)
    tile_x, tile_y = int(grid.tile_px_x), int(grid.tile_px_y)
    px = 2 * camera.tan_half_y / viewport.height_px
    left = camera.slope_left + i * tile_x * px
    right = camera.slope_left + np.minimum((i + 1) * tile_x, viewport.width_px) * px
    top = camera.slope_top - j * tile_y * px
    bottom = camera.slope_top - np.minimum((j + 1) * tile_y, viewport.height_px) * px
    near_m, far_m = slice_planes_m(config, inputs, int(grid.depth_slices), rows, k)

    def distance2(d: np.ndarray) -> np.ndarray:
        dx = np.maximum(np.maximum(left * d - light[:, 0], light[:, 0] - right * d), 0)
        dy = np.maximum(np.maximum(bottom * d - light[:, 1], light[:, 1] - top * d), 0)
        return dx**2 + dy**2 + (d + light[:, 2]) ** 2

    low, high = near_m, far_m
    for _ in range(60):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        nearer = distance2(a) < distance2(b)
        low, high = np.where(nearer, low, a), np.where(nearer, b, high)
    return int((distance2((low + high) / 2) <= light[:, 7] ** 2).sum())


def slice_planes_m(
    config: Configuration, inputs: FrameInputs, n_slices: int, rows: int, k: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    near_m = inputs.camera.near_m
    far_m = inputs.camera.far_m if math.isfinite(inputs.camera.far_m) else inputs.deepest_m
    if config["depth_scheme"] == "linear":
        return tuple(near_m + (far_m - near_m) * s / n_slices for s in (k, k + 1))  # type: ignore[return-value]
    if config["depth_scheme"] == "ndc":
        return tuple(1 / (1 / near_m - (1 / near_m - 1 / far_m) * s / n_slices) for s in (k, k + 1))  # type: ignore[return-value]
    is_cubic = config["depth_slices"] == 0 and config["grid"] == "off"
    growth = 1 + 2 * inputs.camera.tan_half_y / rows if is_cubic else (far_m / near_m) ** (1 / n_slices)
    return near_m * growth ** k.astype(float), near_m * growth ** (k + 1.0)


if __name__ == "__main__":
    main()
