"""What the papers of 2011 and 2014 say of their shadow algorithms, counted again.

python -m benchmarks.shadow_claims --out DIR [--scene BUILT_IN|FILE] [--triangles 60000] [--cameras FILE]
    [--frames 3] [--size 1024] [--small 256] [--minutes 20] [--workers 1]

Counts alone: they are the same on every device. Growth is from `small` to `size`; the papers' is from 1024 to 4096
squared, 16 times the samples too. Tiles of 8 pixels and 32 children, as the papers. Frames lie evenly on the path; all
but the last claim are of the first one. What finds no time left is a line of the table too.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.shadow_cases import Case, read_case
from vtfs.device import keep_compiled_programs
from vtfs.files import write_atomically
from vtfs.shadow_casters import FrontFaces
from vtfs.shadow_mask import ShadowPlan
from vtfs.shadow_techniques import cast_shadows

PAPER = ShadowPlan(tile_px=8, branching=32, feedback=False)
SILHOUETTE, NO_PLANES = replace(PAPER, extra="silhouette"), replace(PAPER, extra="off")
IMPLICIT, FEEDBACK = replace(PAPER, bounds="implicit"), replace(PAPER, feedback=True)
TWO_PASSES, FULL = replace(PAPER, passes=2), replace(PAPER, tree="full")


@dataclass(frozen=True)
class Run:
    """One technique on one case; `front_faces` as in `shadow_frame`."""

    technique: str
    plan: ShadowPlan
    case: str = "first"
    front_faces: FrontFaces = "cast"


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


def of(run: Run, **changes) -> Run:
    return replace(run, **changes)


CLAIMS = (
    Claim("ptsv: fewer test-and-set than z_pass (2011: 19.7 M to 1.2 M, 10 in the abstract)", Z_PASS, PTSV, 10, 17),
    Claim("clusters, explicit bounds: fewer than ptsv (2014, Sec. 2.1: more than 2)", PTSV, CLUSTERS, 2, np.inf),
    Claim("clusters: front-face culling (2011, of ptsv: 2.2)", CLUSTERS, of(CLUSTERS, front_faces="culled"), 2, 2.4),
    Claim("ptsv: front-face culling (2011: 2.2)", PTSV, of(PTSV, front_faces="culled"), 2, 2.4),
    Claim("ptsv: growth with 16 times the samples (2011: 2 to 4)", PTSV, of(PTSV, case="small"), 2, 4),
    Claim("z_pass: growth with 16 times the samples (2011: 16)", Z_PASS, of(Z_PASS, case="small"), 15, 17),
    Claim("clusters: growth with 16 times the samples", CLUSTERS, of(CLUSTERS, case="small"), 2, 4),
    Claim("clusters: their number at 1024 squared (2014: at most 52,000)", CLUSTERS, None, 0, 52_000, "items"),
    Claim("clusters: work of the 1,024 largest triangles over the average (2014: 10)", CLUSTERS, None, 8, 12, "work"),
    Claim("z_fail: fewer than z_pass (2011: 19.7 M to 18.3 M)", Z_PASS, Z_FAIL, 1.0, 1.2),
    Claim("clusters: implicit over explicit bounds", of(CLUSTERS, plan=IMPLICIT), CLUSTERS, 1, 2),
    Claim("clusters: without extra planes", of(CLUSTERS, plan=NO_PLANES), CLUSTERS, 1, 2),
    Claim("ptsv: without silhouette planes", of(PTSV, plan=NO_PLANES), PTSV, 1, 2),
    Claim("clusters: two passes over one, tests", of(CLUSTERS, plan=TWO_PASSES), CLUSTERS, 0.99, 1.01),
    Claim("clusters: full tree over compact, tests", of(CLUSTERS, plan=FULL), CLUSTERS, 0.5, 1.5),
    Claim("clusters: without feedback over with it (ours)", CLUSTERS, of(CLUSTERS, plan=FEEDBACK), 1, 4),
)  # fmt: skip


def counted(run: Run, cases: dict[str, Case]) -> dict[str, float]:
    case = cases[run.case]
    found = cast_shadows(
        run.technique, run.plan, case.samples, case.casters, case.light,
        front_faces=run.front_faces, receives=case.receives, bias_m=case.bias_m,
    )  # fmt: skip
    counts = dict(found.counts)
    tests = counts["node_tests"] + counts["sample_tests"]
    average = tests / max(counts["casters"], 1)
    return counts | {"work": counts["tests_of_largest"] / min(1_024, max(counts["casters"], 1)) / max(average, 1e-9)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="grove")
    parser.add_argument("--triangles", type=int, default=60_000)
    parser.add_argument("--cameras")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--small", type=int, default=256)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    end = time.monotonic() + 60 * given.minutes
    keep_compiled_programs()

    def case_of(share: float, size: int) -> Case:
        return read_case(given.scene, given.cameras, given.triangles, share, size)

    cases = {"first": case_of(0.0, given.size), "small": case_of(0.0, given.small)}
    shares = {f"{k} of {given.frames}": k / given.frames for k in range(1, given.frames)}
    cases |= {name: case_of(share, given.size) for name, share in shares.items()}
    on_path = [CLUSTERS, *(of(CLUSTERS, case=name) for name in shares)]
    runs = [*dict.fromkeys(run for claim in CLAIMS for run in (claim.over, claim.under) if run), *on_path[1:]]
    record: dict = {"scene": cases["first"].name, "claims": [], "runs": []}
    out = given.out / f"shadow-claims-{cases['first'].name.split(' (')[0].replace(' ', '-')}.json"
    print(f"{record['scene']}: {int(cases['first'].receives.sum()):,} samples", flush=True)

    def count_in_time(run: Run) -> dict[str, float] | None:
        return counted(run, cases) if time.monotonic() < end else None

    # Most of the time is the compiler's, and it runs side by side.
    with ThreadPoolExecutor(given.workers) as pool:
        counts = dict(zip(runs, pool.map(count_in_time, runs), strict=True))
    record["runs"] = [{"run": str(run), "counts": found} for run, found in counts.items()]

    def report(text: str, value: float | None, low: float, high: float) -> None:
        verdict = "no time left" if value is None else "agrees" if low <= value <= high else "differs"
        record["claims"].append({"claim": text, "value": value, "low": low, "high": high, "verdict": verdict})
        print(f"{text:<88}{'' if value is None else f'{value:>12,.2f}'}  {verdict}", flush=True)

    for claim in CLAIMS:
        over, under = counts[claim.over], None if claim.under is None else counts[claim.under]
        known = over is not None and (claim.under is None or under is not None)
        value = over[claim.count] / max(under[claim.count] if under else 1.0, 1.0) if over and known else None
        report(claim.text, value, claim.low, claim.high)
    of_frames = [found["test_and_set"] for run in on_path if (found := counts[run])]
    value = max(of_frames) / float(np.median(of_frames)) if len(of_frames) == given.frames else None
    report("clusters: frame with most tests over the median (other measurements: time up to 7)", value, 1, 7)
    write_atomically(out, json.dumps(record, indent=1).encode())
    print(out)


if __name__ == "__main__":
    main()
