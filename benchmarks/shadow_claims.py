"""What the papers of 2011 and 2014 say of their shadow algorithms, counted again.

python -m benchmarks.shadow_claims SCENE[,SCENE...] --out DIR [--scenes FOLDER] [--triangles 60000] [--frames 8]
    [--size 1024] [--large 4096] [--minutes 20] [--workers 1] [--times]

SCENE is a built-in name, or FOLDER/SCENE.glb with SCENE.cameras.json beside it. Counts alone: they are the same on
every device; `--times` is of clusters on the frames of the path alone, one program for all, in turns. Growth is from
`size` to `large`; the papers' is from 1024 to 4096 squared, 16 times the samples. Tiles of 8 pixels and 32 children, as
the papers; the stencil's own counts do not depend on tiles, which are of 16 at `large`. Frames lie evenly on the path;
all but the last claims are of the first one. A count is a line of DIR/shadow-claims-SCENE-SIZE.jsonl, written as it is
known and not counted again by the next call; one that failed says why. DIR/shadow-claims-SCENE-SIZE.md is the table of
what is known.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
import time
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace

import jax
import numpy as np

from benchmarks.run_lines import RunLines, side_by_side, why
from benchmarks.shadow_cases import FULL_TREE_SLICES, Case, named_case, run_alone, scene_arguments, with_room
from benchmarks.shadows import times_ms
from vtfs.device import device_name, keep_compiled_programs
from vtfs.files import write_atomically
from vtfs.shadow_capacities import fitted_to_all
from vtfs.shadow_casters import FrontFaces
from vtfs.shadow_counts import shadow_counts
from vtfs.shadow_mask import ShadowPlan, casters_on_device
from vtfs.shadow_programs import shadow_program

PAPER = ShadowPlan(tile_px=8, branching=32, feedback=False)
SILHOUETTE, NO_PLANES = replace(PAPER, extra="silhouette"), replace(PAPER, extra="off")
IMPLICIT, FEEDBACK = replace(PAPER, bounds="implicit"), replace(PAPER, feedback=True)
TWO_PASSES, FULL = replace(PAPER, passes=2), replace(PAPER, tree="full")
LARGE_TILES = replace(PAPER, tile_px=16)

TIMED = {"32 children, no feedback": PAPER, "8 children, feedback": replace(FEEDBACK, branching=8)}


@dataclass(frozen=True)
class Run:
    """One technique on one case: `first`, `large` or a share of the path, `1/8`; `front_faces` as in `shadow_frame`.

    - `depth_slices`: 0: as many as make the cells cubic.
    """

    technique: str
    plan: ShadowPlan
    case: str = "first"
    front_faces: FrontFaces = "cast"
    depth_slices: int = 0

    @property
    def key(self) -> str:
        default = FEEDBACK
        plan = [f"{k}={v}" for k, v in vars(self.plan).items() if v != getattr(default, k)]
        culled = ["culled"] if self.front_faces == "culled" else []
        slices = [f"{self.depth_slices} slices"] if self.depth_slices else []
        return " ".join([self.technique, *plan, self.case, *culled, *slices])


@dataclass(frozen=True)
class Claim:
    """A ratio of `over` by `under`; without `under`, a number of `over` itself.

    - `count`: what is compared; `low`, `high`: what the paper says.
    """

    text: str
    over: Run
    under: Run | None
    low: float
    high: float
    count: str = "test_and_set"


Z_PASS, Z_FAIL = Run("z_pass", PAPER), Run("z_fail", PAPER)
PTSV, CLUSTERS = Run("ptsv", SILHOUETTE), Run("cluster_hierarchy", PAPER)
COMPACT, IN_FULL = (Run("cluster_hierarchy", plan, depth_slices=FULL_TREE_SLICES) for plan in (PAPER, FULL))


def of(run: Run, **changes) -> Run:
    return replace(run, **changes)


ON_LARGE = of(Z_PASS, plan=LARGE_TILES, case="large"), of(PTSV, case="large"), of(CLUSTERS, case="large")
Z_LARGE, PTSV_LARGE, CLUSTERS_LARGE = ON_LARGE

CLAIMS = (
    Claim("`ptsv`: fewer test-and-set than z_pass (2011: 19.7 M to 1.2 M, 10 in the abstract)", Z_PASS, PTSV, 10, 17),
    Claim("the same, 16 times the samples", Z_LARGE, PTSV_LARGE, 10, np.inf),
    Claim("z_pass over z_fail (2011: 19.7 M to 18.3 M)", Z_PASS, Z_FAIL, 1.0, 1.2),
    Claim("`ptsv` over clusters, explicit bounds (2014, Sec. 2.1: more than 2)", PTSV, CLUSTERS, 2, np.inf),
    Claim("the same, sample tests alone", PTSV, CLUSTERS, 2, np.inf, "sample_tests"),
    Claim("`ptsv`: front-face culling (2011: 2.2)", PTSV, of(PTSV, front_faces="culled"), 2, 2.4),
    Claim("clusters: front-face culling", CLUSTERS, of(CLUSTERS, front_faces="culled"), 2, 2.4),
    Claim("z_pass: growth with 16 times the samples (2011: 16)", Z_LARGE, Z_PASS, 15, 17),
    Claim("`ptsv`: growth with 16 times the samples (2011: 2 to 4)", PTSV_LARGE, PTSV, 2, 4),
    Claim("clusters: growth with 16 times the samples (2 to 4)", CLUSTERS_LARGE, CLUSTERS, 2, 4),
    Claim("clusters: their number at 1024 squared (2014: at most 52,000)", CLUSTERS, None, 0, 52_000, "items"),
    Claim("clusters: work of the 1,024 largest triangles over the average (2014: 10)", CLUSTERS, None, 8, 12, "work"),
    Claim("clusters: implicit over explicit bounds (more)", of(CLUSTERS, plan=IMPLICIT), CLUSTERS, 1, np.inf),
    Claim("clusters: without extra planes (more)", of(CLUSTERS, plan=NO_PLANES), CLUSTERS, 1, np.inf),
    Claim("`ptsv`: without silhouette planes (more)", of(PTSV, plan=NO_PLANES), PTSV, 1, np.inf),
    Claim("clusters: two passes over one, tests (the same)", of(CLUSTERS, plan=TWO_PASSES), CLUSTERS, 0.99, 1.01),
    Claim("clusters: full tree over compact, tests (about the same)", IN_FULL, COMPACT, 0.5, 1.5),
    Claim("clusters: without feedback over with it (ours)", CLUSTERS, of(CLUSTERS, plan=FEEDBACK), 1, np.inf),
)  # fmt: skip


def counted(run: Run, case: Case, one_at_once: threading.Lock) -> dict[str, float]:
    """Counts of a run; `one_at_once` holds what runs on the device."""
    plan = run.plan
    frame = case.frame(casters_on_device(case.casters), plan.tile_px, run.depth_slices, run.front_faces)
    plan = with_room(plan, case.casters.n_triangles, times=2)
    if jax.default_backend() != "cpu" and run.technique in ("z_pass", "z_fail"):
        plan = replace(plan, leaf_groups=4 * plan.leaf_groups)

    run_it = run_alone(run.technique, frame, one_at_once)
    plan, (mask,) = fitted_to_all(run.technique, plan, [frame], unrolled=False, run=run_it)
    counts = shadow_counts(mask, frame, plan)
    tests = counts["node_tests"] + counts["sample_tests"]
    average = tests / max(counts["casters"], 1)
    work = counts["tests_of_largest"] / min(1_024, max(counts["casters"], 1)) / max(average, 1e-9)
    return {**counts, "work": work}


def table(scene: str, known: Mapping[Hashable, dict], n_frames: int, failed: dict[str, str]) -> str:
    """What is claimed and what was counted, in Markdown."""
    rows = [f"{scene}", "", "| claim | papers | here | counts | |", "| --- | --- | --- | --- | --- |"]
    for claim in CLAIMS:
        parts = [claim.over, *([claim.under] if claim.under else [])]
        if missing := [run.key for run in parts if run.key not in known]:
            why_not = "; ".join(failed.get(key, "not counted yet") for key in missing)
            rows.append(f"| {claim.text} | {_range(claim)} | | | {why_not} |")
            continue
        values = [known[run.key]["counts"][claim.count] for run in parts]
        value = values[0] / max(values[1], 1) if len(values) == 2 else values[0]
        verdict = "agrees" if claim.low <= value <= claim.high else "differs"
        each = ", ".join(f"{v:,.0f}" for v in values) if len(values) == 2 else ""
        rows.append(f"| {claim.text} | {_range(claim)} | {value:,.2f} | {each} | {verdict} |")
    of_frames = [known[run.key]["counts"]["test_and_set"] for run in path_runs(n_frames) if run.key in known]
    if of_frames:
        value = max(of_frames) / float(np.median(of_frames))
        text = f"clusters: frame with most tests over the median, {len(of_frames)} frames (time up to 7)"
        each = f"{max(of_frames):,}, {np.median(of_frames):,.0f}"
        rows.append(f"| {text} | 1 to 7 | {value:,.2f} | {each} | {'agrees' if value <= 7 else 'differs'} |")
    rows += [_row_of_times(line) for key, line in known.items() if str(key).startswith("times ")]
    return "\n".join(rows) + "\n"


def _row_of_times(line: dict) -> str:
    lowest = [float(np.percentile(ms, 10)) for ms in line["times_ms"]]
    most, middle = max(lowest), float(np.median(lowest))
    text = f"clusters: slowest frame over the median, {line['plan']}, {len(lowest)} frames, {line['device']}"
    agrees = "agrees" if most / middle <= 7 else "differs"
    return f"| {text} | 1 to 7 | {most / middle:,.2f} | {most:.1f}, {middle:.1f} ms | {agrees} |"


def path_times_ms(plan: ShadowPlan, cases: list[Case], turns: int = 5) -> list[list[float]]:
    """Times of each frame, from view samples to mask: one program, with capacities that hold all of them, in turns."""
    casters = casters_on_device(cases[0].casters)
    frames = [one.frame(casters, plan.tile_px) for one in cases]
    plan, _ = fitted_to_all("cluster_hierarchy", with_room(plan, cases[0].casters.n_triangles), frames)
    times: list[list[float]] = [[] for _ in frames]
    with jax.enable_x64(True):
        program = shadow_program("cluster_hierarchy", plan).lower(frames[0]).compile()
        for _, (own, frame) in itertools.product(range(turns), enumerate(frames)):
            times[own] += times_ms(lambda frame=frame: program(frame), 0.2, fewest=2)
    return times


def _range(claim: Claim) -> str:
    return f"{claim.low:,g} to {claim.high:,g}" if claim.high < np.inf else f"over {claim.low:g}"


def path_runs(n_frames: int) -> list[Run]:
    """The clusters on frames spread evenly over the path."""
    return [CLUSTERS, *(of(CLUSTERS, case=f"{k}/{n_frames}") for k in range(1, n_frames))]


def main() -> None:
    parser = scene_arguments(__doc__, minutes=20.0)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--large", type=int, default=4096)
    parser.add_argument("--times", action="store_true")
    given = parser.parse_args()
    end = time.monotonic() + 60 * given.minutes
    keep_compiled_programs()
    scenes = given.scene.split(",")
    lines = {scene: RunLines(given.out / f"shadow-claims-{scene}-{given.size}.jsonl") for scene in scenes}
    known = {scene: lines[scene].known() for scene in scenes}
    tracing, one_at_once = threading.Lock(), threading.Lock()

    @functools.cache
    def traced(scene: str, name: str) -> Case:
        share = int(name.split("/")[0]) / given.frames if "/" in name else 0.0
        size = given.large if name == "large" else given.size
        return named_case(scene, given.scenes, given.triangles, share, size)

    def case_of(scene: str, name: str) -> Case:
        with tracing:
            return traced(scene, name)

    runs = [run for claim in CLAIMS for run in (claim.over, claim.under) if run]
    # What compiles least comes first: on the path nothing does after the first frame.
    runs = sorted(dict.fromkeys(runs + path_runs(given.frames)), key=lambda run: run.case == "large")
    tasks = [(scene, run) for run in runs for scene in scenes if run.key not in known[scene]]
    print(f"{device_name()}: {len(tasks)} counts to make", flush=True)

    def count(task: tuple[str, Run]) -> None:
        scene, run = task
        try:
            case = case_of(scene, run.case)
            started = time.monotonic()
            counts = counted(run, case, one_at_once)
            found = f"{counts['test_and_set']:,} tests, {time.monotonic() - started:.0f} s"
            line = {"key": run.key, "case": case.name, "device": device_name(), "counts": counts}
        except Exception as error:  # one that fails is a line too, and the others go on
            found = why(error)
            line = {"key": run.key, "failed": found}
        lines[scene].add(line)
        print(f"{scene}: {run.key}: {found}", flush=True)

    def time_path(scene: str) -> None:
        for name, plan in TIMED.items():
            key = f"times {name} {given.frames} {device_name()}"
            if key not in known[scene]:
                times = path_times_ms(plan, [case_of(scene, run.case) for run in path_runs(given.frames)])
                lines[scene].add({"key": key, "plan": name, "device": device_name(), "times_ms": times})

    if given.times:
        for scene in scenes:
            time_path(scene)
    else:
        side_by_side(tasks, given.workers, end, count)
    for scene in scenes:
        failed = {line["key"]: line["failed"] for line in lines[scene].lines if "failed" in line}
        text = table(scene, lines[scene].known(), given.frames, failed)
        write_atomically(given.out / f"shadow-claims-{scene}-{given.size}.md", text.encode())
        print(text, flush=True)
    os._exit(0)  # what still compiles is not waited for


if __name__ == "__main__":
    main()
