"""Is a light ever missed? Random small scenes through every technique, bounds and cull, against float64 brute force.

    PYTHONPATH=. python benchmarks/exactness.py --scenes 10000
    PYTHONPATH=. python benchmarks/exactness.py --only pitfalls

A light is missed where its window is above 0 at a sample, which also lies in its cone (of spots) and faces it (where
normals are used to cull), and the sample's list (or the light's pixels) lacks it. Counts only: a busy machine does not
matter. Scenes and lights are those of the tests, adversarial ones; with other seeds than theirs.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from tests import oracles
from tests.strategies import (
    LIGHT_KINDS,
    a_camera,
    adversarial_lights,
    lights_in_view,
    random_samples,
    samples_at,
    through,
)
from tests.strategies import surface_samples as smooth_samples
from vtfs.camera import Camera, Lens, Viewport
from vtfs.configurations import Configuration, configuration
from vtfs.frame import run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_sizes import NO_SIZES
from vtfs.input_error import InputError
from vtfs.light_volumes import LightPixels
from vtfs.lights import Lights, cone_cosines
from vtfs.parameters import Value
from vtfs.view_samples import ViewSamples

TREE: dict[str, Value] = {"branching": 8, "batch": 1024, "assigner": "published"}
GROUPS: dict[str, Value] = {"branching": 8, "batch": 1024, "assigner": "coarse_to_fine"}
CASES: tuple[tuple[str, dict[str, Value]], ...] = (
    ("deferred", {"batch": 1024}),
    ("deferred_stencil", {"batch": 1024}),
    ("tiled_forward", {"batch": 1024}),
    ("tiled_forward", {"batch": 1024, "cull": "screen_rect"}),
    ("tiled_deferred", {"batch": 1024}),
    ("tiled_deferred", {"batch": 1024, "cull": "planes"}),
    ("tiled_deferred", {"batch": 1024, "bounds": "explicit", "cull": "frustum", "normal_cones": "explicit"}),
    ("volume_tiled", {"batch": 1024}),
    ("volume_tiled", {"batch": 1024, "cull": "frustum"}),
    ("volume_tiled", {"batch": 1024, "assigner": "coarse_to_fine"}),
    ("volume_tiled_bvh", TREE),
    ("volume_tiled_bvh", {**TREE, "branching": 32, "bounds": "explicit"}),
    ("volume_tiled_bvh", {**TREE, "branching": 2, "cull": "frustum", "unique": "sort"}),
    ("volume_tiled_bvh", {**TREE, "bounds": "explicit", "cull": "screen_rect"}),
    ("volume_tiled_bvh", {**TREE, "bounds": "packed", "leaf_test": "box"}),
    ("volume_tiled_bvh", {**TREE, "bounds": "depth_range", "cull": "planes"}),
    ("volume_tiled_bvh", {**TREE, "normal_bins": 2}),
    ("volume_tiled_bvh", GROUPS),
    ("volume_tiled_bvh", {**GROUPS, "bounds": "explicit", "cull": "frustum"}),
    ("volume_tiled_bvh", {**GROUPS, "normal_bins": 2}),
)
"""Techniques that differ in what is rasterised make the same lists: `tiled_forward_prez` those of `tiled_deferred`,
`clustered_deferred` and `clustered_forward` those of `volume_tiled_bvh`; `forward` has none."""

TILES = (2, 3, 8, 16, 32, 256)
GRIDS: tuple[dict[str, Value], ...] = (
    *({"tile_px": tile, "depth_slices": slices} for tile in TILES for slices in (1, 24, 1024)),
    {"tile_px_x": 8, "tile_px_y": 3, "depth_slices": 24},
    {"grid": "5x3x24"},
    {"tile_px": 8, "depth_slices": 24, "depth_scheme": "linear"},
    {"tile_px": 8, "depth_slices": 24, "depth_scheme": "ndc"},
    {"tile_px": 16, "depth_slices": 0},
)
LENSES = (Lens(), Lens(), Lens(), Lens(shift_x=0.3, shift_y=-0.7), Lens(orthographic_height_m=7.5))
N_LIGHTS = 37


@dataclass
class Tally:
    """Of one case."""

    scenes: int = 0
    listed: int = 0
    reaching: int = 0
    missed: int = 0


def draw_scene(seed: int) -> tuple[ViewSamples, Lights]:
    """A camera of any kind, 561 samples and 37 lights, half of the scenes with spots."""
    rng = np.random.default_rng([2026, seed])
    near_m = float(rng.choice([1e-3, 0.1, 1.0]))
    far_m = near_m * float(rng.choice([1.001, 10.0, 10 ** rng.uniform(0.01, 5), math.inf]))
    eye_m = [(0.0, 0.0, 0.0), (1.0, -20.0, 3.0), (1e5, -3e4, 1e5)][rng.integers(3)]
    camera = a_camera(near_m=near_m, far_m=far_m, fov_y_deg=float(rng.uniform(2, 150)), eye_m=eye_m)
    is_smooth = rng.random() < 0.3 and near_m < 1 and far_m > 25
    make = smooth_samples if is_smooth else random_samples
    samples = through(make(camera, int(rng.integers(2**31))), LENSES[rng.integers(len(LENSES))])
    kinds = LIGHT_KINDS if rng.random() < 0.5 else (LIGHT_KINDS[rng.integers(len(LIGHT_KINDS))],)
    lights = adversarial_lights(samples, N_LIGHTS, kinds, int(rng.integers(2**31)))
    return samples, as_spots(samples, lights, rng) if rng.random() < 0.5 else lights


def as_spots(samples: ViewSamples, lights: Lights, rng: np.random.Generator) -> Lights:
    """Half angles of 0.25 to 90 degrees (cones of 0.5 to 180) whose edge passes just behind a sample; every fifth light
    stays a point."""
    seen = oracles.in_world_space(samples.camera, samples.position_m[samples.valid])
    if not len(seen):
        return lights
    to_sample = seen[rng.integers(len(seen), size=lights.n_lights)] - lights.position_m
    to_sample += 1e-9 * rng.normal(size=to_sample.shape)  # a light may be in the sample
    to_sample /= np.linalg.norm(to_sample, axis=1, keepdims=True)
    aside = np.cross(to_sample, rng.normal(size=to_sample.shape))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    half_deg = rng.choice([0.25, 0.5, 20.0, 45.0, 89.0, 90.0], lights.n_lights)
    angle = np.radians(half_deg)[:, None] * (1 - 10 ** rng.uniform(-4, -1, (lights.n_lights, 1)))
    cosines = np.array([cone_cosines(0.9 * half, half) for half in half_deg])
    point = np.arange(lights.n_lights) % 5 == 0
    return replace(
        lights,
        direction=np.cos(angle) * to_sample + np.sin(angle) * aside,
        cos_inner=np.where(point, -1.0, cosines[:, 0]),
        cos_outer=np.where(point, -2.0, cosines[:, 1]),
    )


def reaching(samples: ViewSamples, lights: Lights) -> tuple[np.ndarray, np.ndarray]:
    """Lights within range and cone of each valid sample, and those of them in front of its surface: `[valid, N]`."""
    position_m, normal = (a[samples.valid].astype(np.float64) for a in (samples.position_m, samples.normal))
    view_m = oracles.in_view_space(samples.camera, lights.position_m)
    direction = lights.direction @ samples.camera.view_from_world[:3, :3].T
    to_light = [view_m[None, :, c] - position_m[:, None, c] for c in range(3)]
    distance = np.sqrt(sum(t * t for t in to_light))
    # A window above 0 in float64: just inside the range it may be 0 by rounding, as in shading.
    ratio = np.minimum(distance / np.maximum(lights.range_m, 1e-30), 1)
    reaches = (lights.range_m > 0) & (np.maximum(0, 1 - ratio**4) > 0)
    along = -sum(t * direction[:, c] for c, t in enumerate(to_light))
    reaches &= ~lights.is_spot | (along > lights.cos_outer * distance)
    return reaches, reaches & (sum(t * normal[:, c, None] for c, t in enumerate(to_light)) > 0)


def listed_at(config: Configuration, inputs: FrameInputs) -> tuple[np.ndarray, int]:
    """The lights that each valid sample is shaded with, bool `[valid, N]`, and the pairs listed."""
    env, _ = run_stages(config, inputs, NO_SIZES, until="assign")
    lists, samples = env["assign"], inputs.samples
    if isinstance(lists, LightPixels):
        total = int(lists.total)
        light, run, mask = (np.asarray(c)[:total] for c in (lists.light, lists.run, lists.mask))
        covered = np.zeros((len(np.asarray(env["positions"].place)), 32, inputs.n_lights), bool)
        # A light has a run once, so that no place is written twice.
        covered[run, :, light] = (mask[:, None] >> np.arange(32, dtype=np.uint32)) & 1 == 1
        return as_image(covered, inputs.viewport)[samples.valid], total
    clusters = env["clusters"]
    count, index = np.asarray(lists.count), np.asarray(lists.index)
    table = np.zeros((len(count), inputs.n_lights), bool)
    table[np.repeat(np.arange(len(count)), count), index[: int(lists.total)]] = True
    cluster = np.asarray(clusters.block_cluster)[np.asarray(clusters.block_of_sample)]
    n_visible = env["positions"].n_visible_runs
    return table[as_image(cluster[:n_visible], inputs.viewport)[samples.valid]], int(lists.total)


run_pixels = functools.cache(oracles.run_pixels)  # a loop over pixels


def as_image(runs: np.ndarray, viewport: Viewport) -> np.ndarray:
    """`[runs, 32, ...]` to `[h, w, ...]`."""
    rows, columns = np.moveaxis(run_pixels(viewport), -1, 0)
    inside = (rows < viewport.height_px) & (columns < viewport.width_px)
    image = np.zeros((viewport.height_px, viewport.width_px, *runs.shape[2:]), runs.dtype)
    image[rows[inside], columns[inside]] = runs[: len(rows)][inside]
    return image


def check(
    tally: Tally, config: Configuration, inputs: FrameInputs, reaches: tuple[np.ndarray, np.ndarray], name: str
) -> None:
    listed, n_listed = listed_at(config, inputs)
    culls_by_normals = bool(config.params.get("normal_bins")) or config.params.get("normal_cones") == "explicit"
    missed = reaches[culls_by_normals] & ~listed
    tally.scenes += 1
    tally.listed += n_listed
    tally.reaching += int(reaches[False].sum())
    tally.missed += int(missed.sum())
    if missed.any():
        sample, light = np.argwhere(missed)[0]
        print(f"MISSED {missed.sum()}: {name}, {config}: valid sample {sample}, light {light}", flush=True)


def configured(case: tuple[str, dict[str, Value]], grid: Mapping[str, Value]) -> Configuration:
    technique, params = case
    if "deferred_stencil" in technique or technique == "deferred":
        return configuration(technique, params)
    if technique.startswith("tiled"):
        grid = {name: value for name, value in grid.items() if name.startswith("tile")} or {"grid": "5x3x1"}
    return configuration(technique, {**params, **grid})


def campaign(n_scenes: int, first: int, seconds: float) -> None:
    """All scenes, or as many as the time allows."""
    tallies: dict[str, Tally] = defaultdict(Tally)
    began, n_done = time.perf_counter(), 0
    for seed in range(first, first + n_scenes):
        samples, lights = draw_scene(seed)
        inputs, reaches = FrameInputs(samples, lights), reaching(samples, lights)
        # One case of each technique; the cases of a technique and the grids take turns.
        for technique, cases in itertools.groupby(CASES, key=lambda case: case[0]):
            own = list(cases)
            case, grid = own[seed % len(own)], GRIDS[(seed // 7) % len(GRIDS)]
            if grid.get("depth_slices") == 0 and samples.camera.fov_y_deg < 30:
                grid = GRIDS[0]  # cubic cells of a narrow view over a long range are too many
            config = configured(case, grid)
            label = " ".join([technique, *(f"{k}={v}" for k, v in case[1].items() if k != "batch")])
            check(tallies[label], config, inputs, reaches, f"scene {seed}")
        if (seed + 1 - first) % 500 == 0:
            missed = sum(t.missed for t in tallies.values())
            print(
                f"<!-- {seed + 1 - first} scenes, {time.perf_counter() - began:.0f} s, {missed} missed -->", flush=True
            )
        n_done = seed + 1 - first
        if time.perf_counter() - began > seconds:
            break
    report(f"{n_done:,} random scenes from {first}", tallies)


def report(title: str, tallies: dict[str, Tally]) -> None:
    print(f"\n### {title}\n\n| case | frames | pairs listed | (sample, light) pairs that reach | missed |")
    print("| --- | --- | --- | --- | --- |")
    for label, t in sorted(tallies.items()):
        print(f"| {label} | {t.scenes:,} | {t.listed:,} | {t.reaching:,} | {t.missed} |")


def pitfalls() -> None:
    tallies: dict[str, Tally] = defaultdict(Tally)
    every_tile_size(tallies)
    slice_planes(tallies)
    hard_lights(tallies)
    report("Pitfalls", tallies)
    for far_m in (0.1, 0.05, float("nan")):
        try:
            a_camera(near_m=0.1, far_m=far_m)
            print(f"\nnear = 0.1, far = {far_m}: ACCEPTED")
        except InputError as error:
            print(f'\nnear = 0.1, far = {far_m}: refused ("{error}")')


def every_tile_size(tallies: dict[str, Tally]) -> None:
    """Images whose sides no tile divides: the last tiles stick out. A few thousand samples, those of the last rows and
    columns among them, and lights that end just behind them."""
    rng = np.random.default_rng(1)
    for width_px, height_px in ((1366, 768), (1280, 720)):
        camera = a_camera(Viewport(width_px, height_px))
        valid = rng.random((height_px, width_px)) < 0.003
        valid[-1, ::7] = valid[::7, -1] = True
        depth_m = 0.1 * 1000 ** rng.random(valid.shape)
        samples = samples_at(camera, depth_m, valid, rng)
        lights = adversarial_lights(samples, N_LIGHTS, ("touching", "on_planes", "anywhere"), 1)
        inputs, reaches = FrameInputs(samples, lights), reaching(samples, lights)
        for tile_px in range(2, 257):
            for technique, params in (
                ("tiled_deferred", {}),
                ("volume_tiled_bvh", {"depth_slices": 24, **TREE}),
            ):
                config = configuration(technique, {"batch": 1024, **params, "tile_px": tile_px})
                check(
                    tallies[f"{width_px}x{height_px}, tiles of 2 to 256, {technique}"], config, inputs, reaches, "tiles"
                )


def slice_planes(tallies: dict[str, Tally]) -> None:
    """Samples on the planes between slices and one float32 beside them; lights that end just behind each."""
    for near_m, far_m in ((0.1, 100.0), (1e-3, 100.0), (1.0, 1.001)):
        camera = a_camera(Viewport(64, 40), near_m, far_m)
        for n_slices, scheme in itertools.product((1, 2, 3, 16, 24, 64, 255, 1024), ("self_similar", "linear", "ndc")):
            rng = np.random.default_rng(n_slices)
            share = rng.integers(0, n_slices + 1, (40, 64)) / n_slices
            planes = {
                "self_similar": near_m * (far_m / near_m) ** share,
                "linear": near_m + (far_m - near_m) * share,
                "ndc": 1 / (1 / near_m - (1 / near_m - 1 / far_m) * share),
            }[scheme].astype(np.float32)
            side = rng.integers(-1, 2, planes.shape)
            beside = np.where(side == 0, planes, np.nextafter(planes, np.where(side > 0, np.inf, 0).astype(np.float32)))
            depth_m = np.clip(beside, np.float32(near_m), np.float32(far_m)).astype(np.float64)
            samples = samples_at(camera, depth_m, np.ones(planes.shape, bool), rng)
            lights = adversarial_lights(samples, 200, ("touching",), n_slices)
            inputs, reaches = FrameInputs(samples, lights), reaching(samples, lights)
            for params in ({}, {"bounds": "depth_range"}, {"cull": "frustum"}):
                chosen = {"depth_slices": n_slices, "depth_scheme": scheme, "tile_px": 8, **TREE, **params}
                config = configuration("volume_tiled_bvh", chosen)
                check(tallies[f"slice planes, {scheme}"], config, inputs, reaches, f"near {near_m}, far {far_m}")


def hard_lights(tallies: dict[str, Tally]) -> None:
    """One kind of light at a time, perspective and orthographic, also as spots of 0.5 and 90 degrees."""
    angles = (None, 0.25, 45.0)
    for seed, (kind, lens, half_deg) in enumerate(itertools.product(LIGHT_KINDS, (Lens(), LENSES[-1]), angles)):
        rng = np.random.default_rng(seed)
        samples = through(random_samples(a_camera(), seed), lens)
        lights = adversarial_lights(samples, N_LIGHTS, (kind,), seed)
        if half_deg:
            seen = oracles.in_world_space(samples.camera, samples.position_m[samples.valid])
            to_sample = seen[rng.integers(len(seen), size=N_LIGHTS)] - lights.position_m + 1e-9
            cosines = cone_cosines(0.9 * half_deg, half_deg)
            lights = replace(
                lights,
                direction=to_sample / np.linalg.norm(to_sample, axis=1, keepdims=True),
                cos_inner=np.full(N_LIGHTS, cosines[0]),
                cos_outer=np.full(N_LIGHTS, cosines[1]),
            )
        inputs, reaches = FrameInputs(samples, lights), reaching(samples, lights)
        for case, grid in itertools.product(
            CASES, ({"tile_px": 8, "depth_slices": 24}, {"tile_px": 16, "depth_slices": 1})
        ):
            shape = "orthographic" if samples.camera.is_orthographic else "perspective"
            what = f"cones of {2 * half_deg} degrees" if half_deg else "points"
            check(
                tallies[f"{kind}, {what}, {shape}"], configured(case, grid), inputs, reaches, f"{kind} {what} {shape}"
            )


def frustum() -> None:
    """Pairs that each cull lists, over pairs whose sphere meets the cell, by float64 geometry."""
    rng = np.random.default_rng(0)
    camera: Camera = a_camera(Viewport(256, 144), 0.5, 50.0)
    totals: dict[str, int] = defaultdict(int)
    exact = 0
    for _ in range(8):
        samples = samples_at(camera, rng.uniform(1, 30, (144, 256)), rng.random((144, 256)) < 0.02, rng)
        seen = samples.position_m[samples.valid].astype(np.float64)
        position_m = seen[rng.integers(len(seen), size=200)] + rng.normal(size=(200, 3))
        lights = lights_in_view(camera, position_m, rng.uniform(0.3, 3, 200), rng)
        inputs = FrameInputs(samples, lights)
        for cull in ("screen_rect", "planes", "box", "frustum"):
            env, _ = run_stages(configuration("volume_tiled_bvh", {**TREE, "cull": cull}), inputs, until="assign")
            totals[cull] += int(env["assign"].total)
        key = np.asarray(env["clusters"].key)[: int(env["clusters"].n_clusters)]
        growth, _ = oracles.n_slices(camera, 32, 0, camera.far_m)
        px = 2 * camera.tan_half_y / 144
        for k, j, i in zip(key // 40, key // 8 % 5, key % 8, strict=True):
            left, right = (-camera.tan_half_x + min(32 * column, 256) * px for column in (i, i + 1))
            top, bottom = (camera.tan_half_y - min(32 * row, 144) * px for row in (j, j + 1))
            corners = oracles.cell_corners((left, right, bottom, top), *(0.5 * growth ** float(s) for s in (k, k + 1)))
            exact += int((oracles.distances_to_cell(position_m, corners) <= lights.range_m).sum())
    print(
        f"\n### Pairs over exact geometry, 8 scenes of 256x144, {exact:,} exact pairs\n\n| cull | pairs | over exact |"
    )
    print("| --- | --- | --- |")
    for cull, total in totals.items():
        print(f"| {cull} | {total:,} | {total / exact:.4f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end the campaign after so long")
    parser.add_argument("--only", default="campaign,pitfalls,frustum")
    asked = parser.parse_args()
    for name in asked.only.split(","):
        if name == "campaign":
            campaign(asked.scenes, asked.first, asked.seconds)
        else:
            {"pitfalls": pitfalls, "frustum": frustum}[name]()


if __name__ == "__main__":
    main()
