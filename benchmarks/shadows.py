"""Shadow techniques against branching, tile size and Embree: time, tests and errors of every variant.

python -m benchmarks.shadows --out DIR [--scene clumps|BUILT_IN|FILE] [--triangles 60000]
    [--cameras FILE] [--along 0] [--size 1024] [--minutes 8] [--variants cross|all|quick] [--workers 1] [--kernels]

One process; `workers` threads compile. With warp-lang 1.19 installed and a GPU, its shadow rays run beside. A
configuration that fails, or for which no time is left, is a line of the table too. Each program runs
from view samples to mask: clusters, hierarchy, planes, walk and merge; vertices, triangles and samples are on the
device, nothing else is made before. Errors are samples outside the bands of `shadow_references.classify`, on at most
2,000 samples drawn at random and on all that differ from Embree. `--kernels` also says where each one's time goes.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.kernels import Kernels, kernels_of, table
from benchmarks.shadow_cases import Case, read_case
from vtfs.device import device_name, keep_compiled_programs, versions
from vtfs.files import write_atomically
from vtfs.gbuffer import from_runs
from vtfs.shadow_capacities import fitted
from vtfs.shadow_counts import shadow_counts
from vtfs.shadow_mask import CastersOnDevice, ShadowFrame, ShadowMask, ShadowPlan, casters_on_device
from vtfs.shadow_programs import run_program, shadow_program
from vtfs.shadow_references import ShadowRays, brute_force, classify, view_points_m

N_CHECKED, N_CLASSIFIED = 2_000, 400
BRANCHINGS, TILES = (8, 32, 4, 16, 2, 64), (8, 16, 4, 32, 2)


def variants(which: str) -> Iterator[tuple[str, ShadowPlan]]:
    """The most telling first: what comes late may find no time left."""
    yield "cluster_hierarchy", ShadowPlan(8, 8)
    yield "ptsv", ShadowPlan(8, 8, extra="silhouette")
    yield "cluster_hierarchy", ShadowPlan(8, 16)
    yield "ptsv", ShadowPlan(8, 16, extra="silhouette")
    yield "cluster_hierarchy", ShadowPlan(8, 32)
    yield "ptsv", ShadowPlan(8, 32, extra="silhouette")
    if which == "quick":
        return
    yield "cluster_hierarchy", ShadowPlan(8, 8, extra="off")
    yield "cluster_hierarchy", ShadowPlan(8, 8, feedback=False)
    yield "cluster_hierarchy", ShadowPlan(8, 8, bounds="implicit")
    yield "cluster_hierarchy", ShadowPlan(8, 8, passes=2)
    yield "cluster_hierarchy", ShadowPlan(8, 8, tree="full")
    crossed = [(8, b) for b in BRANCHINGS if b not in (8, 16, 32)] + [(tile_px, 8) for tile_px in TILES if tile_px != 8]
    rest = [(tile_px, b) for tile_px in TILES for b in BRANCHINGS if tile_px != 8 and b != 8]
    for tile_px, branching in crossed + (rest if which == "all" else []):
        yield "cluster_hierarchy", ShadowPlan(tile_px, branching)
        yield "ptsv", ShadowPlan(tile_px, branching, extra="silhouette")


def times_ms(run, seconds: float = 1.0, fewest: int = 5) -> list[float]:
    times, end = [], time.perf_counter() + seconds
    while len(times) < fewest or (time.perf_counter() < end and len(times) < 50):
        started = time.perf_counter()
        jax.block_until_ready(run())
        times.append(1e3 * (time.perf_counter() - started))
    return times


def embree(case: Case) -> tuple[dict, np.ndarray]:
    """Shadow rays of the same samples on all cores, build included, and their answers."""
    points = view_points_m(case.samples, case.receives)
    eye = np.array(case.samples.camera.eye_m)
    started = time.perf_counter()
    rays = ShadowRays(case.casters)
    build_ms = 1e3 * (time.perf_counter() - started)
    answers = rays.shadowed(points, case.light, case.bias_m, eye)
    times = times_ms(lambda: rays.shadowed(points, case.light, case.bias_m, eye))
    return {"build_ms": build_ms, "query_ms": float(np.median(times)), "rays": len(points)}, answers


@dataclass(frozen=True)
class Prepared:
    """A configuration with capacities that fit, counted and compiled."""

    plan: ShadowPlan
    frame: ShadowFrame
    counted: ShadowMask
    program: Any
    seconds: float


def prepare(case: Case, casters: CastersOnDevice, technique: str, plan: ShadowPlan) -> Prepared:
    started = time.perf_counter()
    frame = case.frame(casters, plan.tile_px)
    plan = fitted(technique, plan, frame)
    counted = run_program(technique, plan, frame)
    with jax.enable_x64(True):
        program = shadow_program(technique, plan).lower(frame).compile()
    return Prepared(plan, frame, counted, program, time.perf_counter() - started)


def measure(case: Case, ready: Prepared, by_rays: np.ndarray, with_kernels: bool) -> dict:
    """Time, counts and errors of one configuration; and where its time goes."""
    with jax.enable_x64(True):
        shadowed, overflowed = jax.block_until_ready(ready.program(ready.frame))
        times = times_ms(lambda: ready.program(ready.frame))
    assert not bool(overflowed)
    mask = from_runs(np.asarray(shadowed), case.samples.camera.viewport)[case.receives]
    points, eye = view_points_m(case.samples, case.receives), np.array(case.samples.camera.eye_m)
    rng = np.random.default_rng(0)
    some = np.sort(rng.choice(len(points), min(N_CHECKED, len(points)), replace=False))
    differs = np.flatnonzero(mask != by_rays)
    some = np.union1d(some, differs[:N_CLASSIFIED])
    reference = brute_force(points[some], case.casters, case.light, case.bias_m, eye)
    found = classify(points[some], mask[some] != reference, case.casters, case.light, case.bias_m, eye)
    return {
        "outcome": "timed",
        "time_ms": float(np.median(times)),
        "times_ms": times,
        "prepared_s": ready.seconds,
        "differ_from_rays": len(differs),
        "checked": len(some),
        "near_edge": found.near_edge,
        "near_plane": found.near_plane,
        "errors": found.errors,
        "counts": shadow_counts(ready.counted, ready.frame, ready.plan),
        "capacities": asdict(ready.plan),
        **({"kernels": asdict(_kernels(ready))} if with_kernels else {}),
    }


def _kernels(ready: Prepared) -> Kernels:
    with jax.enable_x64(True):
        return kernels_of(ready.program, lambda: ready.program(ready.frame))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="clumps")
    parser.add_argument("--triangles", type=int, default=60_000)
    parser.add_argument("--cameras")
    parser.add_argument("--along", type=float, default=0.0)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--variants", choices=("cross", "all", "quick"), default="cross")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--kernels", action="store_true")
    arguments = parser.parse_args()
    end = time.monotonic() + 60 * arguments.minutes
    keep_compiled_programs()
    case = read_case(arguments.scene, arguments.cameras, arguments.triangles, arguments.along, arguments.size)
    rays, by_rays = embree(case)
    record = {"scene": case.name, "device": device_name(), "versions": versions(), "embree": rays, "results": []}
    print(f"{case.name}, {device_name()}: {rays['rays']:,} samples, {by_rays.mean():.1%} in shadow", flush=True)
    print(f"embree robust: build {rays['build_ms']:.1f} ms, rays {rays['query_ms']:.1f} ms")
    if importlib.util.find_spec("warp"):
        from benchmarks.peers.warp_shadows import warp_rays

        record["warp"] = warp_rays(case, by_rays)
        print(f"warp: {record['warp']}", flush=True)
    casters = casters_on_device(case.casters)
    chosen = list(variants(arguments.variants))
    results: list[dict] = [{"technique": technique, "plan": asdict(plan)} for technique, plan in chosen]
    # Programs are compiled side by side, and timed when nothing else runs.
    with ThreadPoolExecutor(arguments.workers) as pool:
        jobs = [pool.submit(prepare, case, casters, *variant) for variant in chosen]
        wait(jobs, timeout=max(0.8 * (end - time.monotonic()), 1.0))
        for job in jobs:
            job.cancel()
        wait([job for job in jobs if not job.cancelled()])
    out = arguments.out / f"shadows-{case.name.split(' (')[0].replace(' ', '-')}.json"
    print(
        f"{'technique':<18}{'tile':>5}{'b':>4}  {'variant':<28}{'ms':>9}{'M tests':>9}{'M node':>8}"
        f"{'errors':>7}{'bands':>6}"
    )
    for (technique, plan), job, result in zip(chosen, jobs, results, strict=True):
        bounds = "depths" if technique == "ptsv" else plan.bounds
        trees = f"{'' if plan.tree == 'compact' else 'full '}{'' if plan.passes == 1 else 'two passes '}"
        label = f"{bounds} {plan.extra} {trees}{'' if plan.feedback else 'no feedback'}"
        head = f"{technique:<18}{plan.tile_px:>5}{plan.branching:>4}  {label:<28}"
        if job.cancelled() or time.monotonic() > end:
            result |= {"outcome": "no time left"}
            print(f"{head}no time left", flush=True)
        else:
            try:
                result |= measure(case, job.result(), by_rays, arguments.kernels)
                counts = result["counts"]
                print(
                    f"{head}{result['time_ms']:>9.2f}{counts['test_and_set'] / 1e6:>9.2f}"
                    f"{counts['node_tests'] / 1e6:>8.2f}"
                    f"{result['errors']:>7}{result['near_edge'] + result['near_plane']:>6}",
                    flush=True,
                )
                if arguments.kernels:
                    print(table(Kernels(**result["kernels"])), flush=True)
            except Exception as error:  # a configuration that fails is a result
                result |= {
                    "outcome": "failed",
                    "error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
                }
                print(f"{head}failed: {result['error'][:90]}", flush=True)
        record["results"].append(result)
        write_atomically(out, json.dumps(record, indent=1).encode())
    print(out)


if __name__ == "__main__":
    main()
