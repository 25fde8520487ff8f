"""Shadow masks against branching 2 to 64 and tiles of 2 to 32 pixels: time, tests and masks, on several scenes.

python -m benchmarks.shadow_tradeoff SCENE[,SCENE...] --out DIR [--scenes FOLDER] [--triangles 60000] [--size 1024]
    [--along 0] [--minutes 8] [--workers 1] [--only branching|tile_8|tile_32|trees] [--only-sizes]

SCENE is `clumps`, a built-in name, or FOLDER/SCENE.glb with SCENE.cameras.json beside it. Branching at tiles of 8,
tiles at 8 and at 32 children; and at 32 children, without feedback as in the paper, the full tree beside the compact
one (both with 512 slices, as cubic cells are too many) and two passes from either level. Each program runs from view
samples to mask, capacities known. Programs are compiled side by side for four fifths of the time; then, with nothing
beside, all are timed in turns, twice. A line of DIR/shadow-tradeoff-cpu.jsonl (or gpu) is a configuration; what is
there, on this device and at this size, is not run again. Capacities and counts, which no device changes, are lines of
DIR/shadow-sizes.jsonl: where that comes from another device, half as much is compiled; `--only-sizes` makes it alone.
Tables and charts: `python -m benchmarks.shadow_tradeoff_charts`.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import asdict, dataclass
from typing import Any

import jax
import numpy as np

from benchmarks.run_lines import RunLines, side_by_side, why
from benchmarks.shadow_cases import FULL_TREE_SLICES, Case, named_case, run_alone, scene_arguments, with_room
from benchmarks.shadows import embree, times_ms
from vtfs.device import device_name, keep_compiled_programs, versions
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.shadow_capacities import fitted_to_all, shadow_sizes, with_shadow_sizes
from vtfs.shadow_counts import shadow_counts
from vtfs.shadow_mask import CastersOnDevice, ShadowFrame, ShadowPlan, casters_on_device
from vtfs.shadow_programs import shadow_program
from vtfs.shadow_volumes.sample_tiles import KEY_BITS

BRANCHINGS, TILES = (8, 32, 4, 16, 2, 64), (4, 16, 2, 32)


@dataclass(frozen=True)
class Variant:
    """A technique and its plan; `group`: of `GROUPED`, the question that it answers.

    - `depth_slices`: 0: as many as make the cells cubic.
    """

    technique: str
    plan: ShadowPlan
    group: str
    depth_slices: int = 0

    @property
    def name(self) -> str:
        plan = self.plan
        tree = f" {plan.tree}" if plan.tree == "full" else ""
        passes = f" two passes from level {plan.level}" if plan.passes == 2 else ""
        feedback = "" if plan.feedback else " no feedback"
        slices = f" {self.depth_slices} slices" if self.depth_slices else ""
        return f"{self.technique} tile {plan.tile_px} b {plan.branching}{tree}{passes}{feedback}{slices}"


def _both(tile_px: int, branching: int, group: str) -> list[Variant]:
    return [
        Variant("cluster_hierarchy", ShadowPlan(tile_px, branching), group),
        Variant("ptsv", ShadowPlan(tile_px, branching, extra="silhouette"), group),
    ]


def _trees() -> list[Variant]:
    """As the paper has it, one change at a time. A full tree of a million samples fits with `FULL_TREE_SLICES`."""

    def of(depth_slices: int = 0, **changes: Any) -> Variant:
        return Variant("cluster_hierarchy", ShadowPlan(8, 32, feedback=False, **changes), "trees", depth_slices)

    sliced = of(FULL_TREE_SLICES), of(FULL_TREE_SLICES, tree="full")
    return [of(), *sliced, *(of(passes=2, level=level) for level in (1, 2))]


GROUPED = {
    "branching": [one for b in BRANCHINGS for one in _both(8, b, "branching")],
    "tile_8": [one for tile_px in TILES for one in _both(tile_px, 8, "tile_8")],
    "trees": _trees(),
    "tile_32": [one for tile_px in TILES for one in _both(tile_px, 32, "tile_32")],
}
"""The most telling first: what comes late may find no time left."""


@dataclass(frozen=True)
class Subject:
    """A view on the device, and what Embree says of it."""

    case: Case
    casters: CastersOnDevice
    rays: dict
    by_rays: np.ndarray


@dataclass(frozen=True)
class Ready:
    """A configuration that is compiled, with capacities that hold the view."""

    key: str
    subject: Subject
    variant: Variant
    frame: ShadowFrame
    depth_slices: int
    plan: ShadowPlan
    counts: dict
    program: Any
    seconds: float


def frame_of(subject: Subject, variant: Variant) -> tuple[ShadowFrame, int]:
    """The view for a variant, and its slices; 0: cubic cells."""
    tile_px, depth_slices = variant.plan.tile_px, variant.depth_slices
    try:
        return subject.case.frame(subject.casters, tile_px, depth_slices), depth_slices
    except InputError:  # cubic cells as narrow as such tiles are more than keys can tell apart
        return subject.case.frame(subject.casters, tile_px, 2**KEY_BITS), 2**KEY_BITS


def sizes_of(subject: Subject, variant: Variant, frame: ShadowFrame, one_at_once: threading.Lock) -> dict:
    """Capacities that hold the view, with loops and without, and counts; `one_at_once` holds what runs."""
    plan = with_room(variant.plan, subject.case.casters.n_triangles)
    run = run_alone(variant.technique, frame, one_at_once)
    looped, (sized,) = fitted_to_all(variant.technique, plan, [frame], False, run)
    unrolled, _ = fitted_to_all(variant.technique, looped, [frame], True, lambda *_: sized)
    plans = {"looped": shadow_sizes(looped), "unrolled": shadow_sizes(unrolled)}
    return plans | {"counts": shadow_counts(sized, frame, looped)}


def sized(subject: Subject, variant: Variant, frame: ShadowFrame, known: RunLines, one_at_once: threading.Lock) -> dict:
    """The line of `known` that has the sizes of a variant, made if it is not there."""
    key = f"{subject.case.name}: {variant.name}"
    found = known.known().get(key)
    if found is None:
        found = {"key": key, "sized_on": device_name(), **sizes_of(subject, variant, frame, one_at_once)}
        known.add(found)
    return found


def compiled(key: str, subject: Subject, variant: Variant, sizes: RunLines, one_at_once: threading.Lock) -> Ready:
    """Size and compile."""
    started = time.monotonic()
    frame, depth_slices = frame_of(subject, variant)
    found = sized(subject, variant, frame, sizes, one_at_once)
    plan = with_shadow_sizes(variant.plan, tuple(found["looped" if jax.default_backend() == "cpu" else "unrolled"]))
    with jax.enable_x64(True):
        program = shadow_program(variant.technique, plan).lower(frame).compile()
    seconds = time.monotonic() - started
    return Ready(key, subject, variant, frame, depth_slices, plan, found["counts"], program, seconds)


def line_of(ready: Ready, times: list[float], mask: np.ndarray, first: np.ndarray) -> dict:
    """A line of the file: `mask` is of the samples that receive shadow, `first` that of the scene's first variant."""
    case, variant = ready.subject.case, ready.variant
    return {
        "key": ready.key,
        "scene": case.name.split(" (")[0],
        "technique": variant.technique,
        "variant": variant.name,
        "group": variant.group,
        "params": asdict(variant.plan),
        "depth_slices": ready.depth_slices,
        "capacities": asdict(ready.plan),
        "device": device_name(),
        "versions": versions(),
        "load": os.getloadavg()[0],
        "triangles": case.casters.n_triangles,
        "embree": ready.subject.rays,
        "time_ms": float(np.median(times)),
        "times_ms": times,
        "prepared_s": ready.seconds,
        "shadowed": int(mask.sum()),
        "differs_from_first": int((mask != first).sum()),
        "differs_from_rays": int((mask != ready.subject.by_rays).sum()),
        "counts": ready.counts,
    }


def time_all(ready: list[Ready], seconds: float, lines: RunLines) -> None:
    """Time all configurations in turns, so that what changes meanwhile meets them all; of each its mask."""
    times: dict[str, list[float]] = {one.key: [] for one in ready}
    firsts: dict[str, np.ndarray] = {}
    for turn in range(2):
        for one in ready:
            try:
                with jax.enable_x64(True):
                    shadowed, overflowed = jax.block_until_ready(one.program(one.frame))
                    times[one.key] += times_ms(lambda one=one: one.program(one.frame), seconds, fewest=3)
            except Exception as error:  # one that fails is a line too, and the others go on
                lines.add({"key": one.key, "failed": why(error)})
                continue
            if bool(overflowed):
                lines.add({"key": one.key, "failed": "does not fit the capacities of DIR/shadow-sizes.jsonl"})
                continue
            if turn == 0:
                continue
            case = one.subject.case
            mask = from_runs(np.asarray(shadowed), case.samples.camera.viewport)[case.receives]
            line = line_of(one, times[one.key], mask, firsts.setdefault(case.name, mask))
            lines.add(line)
            print(
                f"{line['scene']:<16}{line['variant']:<62}{line['time_ms']:>9.2f} ms"
                f"{line['counts']['test_and_set'] / 1e6:>9.2f} M tests  "
                f"{line['differs_from_first']} unlike the first, {line['differs_from_rays']} unlike Embree",
                flush=True,
            )


def main() -> None:
    parser = scene_arguments(__doc__, minutes=8.0)
    parser.add_argument("--along", type=float, default=0.0)
    parser.add_argument("--only", choices=list(GROUPED))
    parser.add_argument("--only-sizes", action="store_true")
    given = parser.parse_args()
    started = time.monotonic()
    end = started + 60 * given.minutes
    keep_compiled_programs()
    backend = "cpu" if jax.default_backend() == "cpu" else "gpu"
    lines, sizes = RunLines(given.out / f"shadow-tradeoff-{backend}.jsonl"), RunLines(given.out / "shadow-sizes.jsonl")
    subjects = []
    for name in given.scene.split(","):
        case = named_case(name, given.scenes, given.triangles, given.along, given.size)
        rays, by_rays = embree(case)
        subjects.append(Subject(case, casters_on_device(case.casters), rays, by_rays))
        print(f"{case.name}: {len(by_rays):,} samples, {by_rays.mean():.1%} in shadow, Embree {rays}", flush=True)
    groups = [given.only] if given.only else list(GROUPED)
    planned = [
        (f"{subject.case.name}: {one.name}: {device_name()}", subject, one)
        for group in groups
        for one in GROUPED[group]
        for subject in subjects
    ]
    known = lines.known()
    tasks = [task for task in planned if task[0] not in known]
    print(f"{device_name()}: {len(tasks)} of {len(planned)} configurations to run", flush=True)
    ready: list[Ready] = []
    one_at_once = threading.Lock()

    def compile_one(task: tuple[str, Subject, Variant]) -> None:
        try:
            if given.only_sizes:
                _, subject, variant = task
                sized(subject, variant, frame_of(subject, variant)[0], sizes, one_at_once)
            else:
                ready.append(compiled(*task, sizes, one_at_once))
        except Exception as error:  # one that fails is a line too, and the others go on
            lines.add({"key": task[0], "failed": why(error)})
            print(f"{task[0]}: failed: {why(error)}", flush=True)

    side_by_side(tasks, given.workers, started + 0.8 * (end - started), compile_one)
    done = list(ready)
    left = end - time.monotonic()
    print(f"{len(done)} compiled after {time.monotonic() - started:.0f} s", flush=True)
    order = {key: k for k, (key, _, _) in enumerate(tasks)}
    time_all(sorted(done, key=lambda one: order[one.key]), min(1.0, 0.35 * left / max(1, len(done))), lines)
    missing = [key for key, _, _ in planned if key not in lines.known()]
    print(f"{len(missing)} have no line yet" + (": run again" if missing else ""), flush=True)
    os._exit(0)  # what still compiles is not waited for


if __name__ == "__main__":
    main()
