"""Every shadow mask is the same, and right: a pairwise set of variants on views and lights of scenes.

python -m benchmarks.shadow_exactness --out DIR SCENE[,SCENE...] [--triangles 20000] [--size 512] [--frames 3]
    [--lights 3] [--workers 1] [--minutes 10]

SCENE is a built-in name or a GLB file with NAME.cameras.json beside it. The variants hold every pair of values of the
parameters once or more. A view's masks are compared with one another; where they differ, where they differ from
Embree, and at 500 samples drawn at random, each with float64 brute force.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.shadow_cases import Case, read_case
from vtfs.device import device_name, keep_compiled_programs
from vtfs.files import write_atomically
from vtfs.gbuffer import from_runs
from vtfs.shadow_casters import ShadowLight
from vtfs.shadow_mask import CastersOnDevice, ShadowPlan, casters_on_device, facing_samples, shadow_frame
from vtfs.shadow_references import ShadowRays, brute_force, classify, view_points_m
from vtfs.shadow_techniques import fitted, run_program, shadow_grid

N_CHECKED, N_CLASSIFIED = 500, 400
LIGHTS = ((0.45, 0.8, 0.55), (0.2, 0.5, 0.3), (0.7, 0.95, 0.6))
VALUES = {
    "technique": ("cluster_hierarchy", "ptsv"),
    "tile_px": (8, 4, 16),
    "branching": (8, 32, 4),
    "bounds": ("explicit", "implicit"),
    "extra": ("vertex", "off", "silhouette"),
    "feedback": (True, False),
    "batch": (0, 2**14),
    "passes": (1, 2),
    "tree": ("compact", "full"),
}


def pairwise() -> list[dict]:
    """Choices that hold every pair of values: each takes the most pairs that none before holds."""
    names = list(VALUES)
    pairs = {
        ((a, x), (b, y)) for a, b in itertools.combinations(names, 2) for x in VALUES[a] for y in VALUES[b]
    }  # fmt: skip
    every = [dict(zip(names, values, strict=True)) for values in itertools.product(*VALUES.values())]
    chosen = []
    while pairs:
        held = [[pair for pair in itertools.combinations(choice.items(), 2) if pair in pairs] for choice in every]
        best = max(range(len(every)), key=lambda k: len(held[k]))
        chosen.append(every[best])
        pairs -= set(held[best])
    return chosen


def mask_of(choice: dict, case: Case, casters: CastersOnDevice) -> np.ndarray:
    """The mask of the samples that face the light."""
    plan = ShadowPlan(**{name: value for name, value in choice.items() if name != "technique"})
    grid = shadow_grid(case.samples, plan.tile_px)
    frame = shadow_frame(case.samples, casters, case.light, grid, case.bias_m, case.receives)
    plan = fitted(choice["technique"], plan, frame, unrolled=False)
    mask = run_program(choice["technique"], plan, frame)
    return from_runs(np.asarray(mask.shadowed), case.samples.camera.viewport)[case.receives]


def judged(case: Case, masks: list[np.ndarray]) -> dict[str, int]:
    """Samples of a view, and where the masks are not what brute force says."""
    points, eye = view_points_m(case.samples, case.receives), np.array(case.samples.camera.eye_m)
    by_rays = ShadowRays(case.casters).shadowed(points, case.light, case.bias_m, eye)
    unlike = np.any([mask != masks[0] for mask in masks], axis=0)
    asked = np.flatnonzero(unlike | (masks[0] != by_rays))[:N_CLASSIFIED]
    drawn = np.random.default_rng(0).choice(len(points), min(N_CHECKED, len(points)), replace=False)
    asked = np.union1d(asked, drawn)
    reference = brute_force(points[asked], case.casters, case.light, case.bias_m, eye)
    differs = np.any([mask[asked] != reference for mask in masks], axis=0)
    found = classify(points[asked], differs, case.casters, case.light, case.bias_m, eye)
    return {
        "samples": len(points),
        "shadowed": int(masks[0].sum()),
        "unlike_one_another": int(unlike.sum()),
        "unlike_embree": int((masks[0] != by_rays).sum()),
        "checked": len(asked),
        "near_edge": found.near_edge,
        "near_plane": found.near_plane,
        "errors": found.errors,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--triangles", type=int, default=20_000)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--lights", type=int, default=len(LIGHTS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=10.0)
    given = parser.parse_args()
    end = time.monotonic() + 60 * given.minutes
    keep_compiled_programs()
    choices = pairwise()
    print(f"{device_name()}: {len(choices)} variants", flush=True)
    views: list[dict] = []
    for scene in given.scenes.split(","):
        path = Path(scene)
        cameras = str(path.with_suffix(".cameras.json")) if path.suffix else None
        uploaded: CastersOnDevice | None = None
        for k, light in itertools.product(range(given.frames), LIGHTS[: given.lights]):
            if time.monotonic() > end:
                print(f"{path.stem}: no time left", flush=True)
                break
            case = read_case(scene, cameras, given.triangles, k / given.frames, given.size)
            low, high = case.casters.vertices_m.min(axis=0), case.casters.vertices_m.max(axis=0)
            placed = ShadowLight(tuple(low + (high - low) * np.array(light)))
            case = replace(case, light=placed, receives=facing_samples(case.samples, placed))
            casters = uploaded = uploaded or casters_on_device(case.casters)
            with ThreadPoolExecutor(given.workers) as pool:
                masks = list(pool.map(functools.partial(mask_of, case=case, casters=casters), choices))
            view = {"scene": case.name, "frame": k, "light": light, "variants": len(masks), **judged(case, masks)}
            views.append(view)
            print(" ".join(f"{name}={value}" for name, value in view.items()), flush=True)
            write_atomically(given.out / "shadow-exactness.json", json.dumps(views, indent=1).encode())


if __name__ == "__main__":
    main()
