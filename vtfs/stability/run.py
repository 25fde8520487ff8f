"""Every method on every rung: the built-in ladders, and those on a user's scene before them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vtfs.device import device_name, versions
from vtfs.input_error import InputError
from vtfs.stability.ladder import Ladder
from vtfs.stability.light_ladders import light_ladders
from vtfs.stability.light_methods import LightCase, judge_lights
from vtfs.stability.record import FILE, Kind, RungResult, StabilityResult, Verdict, read_result, write_result
from vtfs.stability.shadow_ladders import N_EDGES, N_TRIANGLES, N_VERTICES, built_in_ladders
from vtfs.stability.shadow_methods import ShadowRunner, Shapes
from vtfs.stability.shadow_verdicts import judge_shadows
from vtfs.stability.stage import ShadowCase

if TYPE_CHECKING:
    from vtfs.stability.own_scene import OwnScene

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class _Job:
    """One rung that is to be run."""

    ladder: Ladder[Any]
    kind: Kind
    label: str
    judge: Callable[[], tuple[int, int, int, dict[str, Verdict]]]

    @property
    def place(self) -> tuple[str, str, str, str]:
        return self.kind, self.ladder.source, self.ladder.name, self.label


def run_stability(
    folder: Path,
    seed: int,
    own: OwnScene | None = None,
    resume: bool = False,
    progress: Progress = lambda what, share: None,
) -> StabilityResult:
    """Run all rungs and keep `stability.json` in a folder, written anew after each.

    **Arguments:**

    - `own`: a user's scene, whose ladders come first.
    - `resume`: rungs that the folder's file has are not run again.

    **Raises:** `InputError` where the folder cannot be written, or its file is of another scene, seed or version.
    """
    began = time.monotonic()
    jobs = list(_jobs(seed, own))
    result = StabilityResult(
        scene={"name": "built-in"} if own is None else own.description,
        seed=seed,
        device=device_name(),
        versions=versions(),
        planned=len(jobs),
        wall_s=0.0,
        rungs=(),
    )
    before = _earlier(folder, result) if resume else None
    done = {(r.kind, r.source, r.ladder, r.label): r for r in before.rungs} if before else {}
    earlier_s = before.wall_s if before else 0.0
    write_result(folder, result)
    for n, job in enumerate(jobs):
        progress(f"{job.ladder.title}: {job.label}", n / len(jobs))
        rung = done.get(job.place) or _run(job)
        wall_s = round(earlier_s + time.monotonic() - began, 1)
        result = replace(result, rungs=(*result.rungs, rung), wall_s=wall_s)
        if job.place not in done:
            write_result(folder, result)
    write_result(folder, result)
    return result


def _earlier(folder: Path, result: StabilityResult) -> StabilityResult | None:
    """The file of a run that this one goes on with.

    **Raises:** `InputError` where it is another run's.
    """
    if not (folder / FILE).exists():
        return None
    before = read_result(folder)
    for name in ("scene", "seed", "device", "versions", "planned"):
        if getattr(before, name) != getattr(result, name):
            raise InputError(
                f"{folder / FILE}: is of another `{name}` ({getattr(before, name)}); leave out --resume, or name "
                "another --out."
            )
    return before


def _jobs(seed: int, own: OwnScene | None) -> Iterator[_Job]:
    if own is not None:
        yield from _shadow_jobs(own.shadow_ladders(), ShadowRunner(None))
        yield from _light_jobs(own.light_ladders())
    shapes = Shapes(N_TRIANGLES, N_VERTICES, N_EDGES)
    yield from _shadow_jobs(built_in_ladders(seed), ShadowRunner(shapes))
    yield from _light_jobs(light_ladders(seed))


def _shadow_jobs(ladders: Iterable[Ladder[ShadowCase]], runner: ShadowRunner) -> Iterator[_Job]:
    for ladder in ladders:
        for rung in ladder.rungs:

            def judge(make=rung.make):
                found = judge_shadows(make(), runner)
                n = found.lit + found.shadowed
                verdicts = {
                    name: Verdict(
                        v.false_light + v.false_shadow,
                        v.near_edge + v.near_plane,
                        v.false_light,
                        v.false_shadow,
                        (v.false_light + v.false_shadow) / max(n, 1),
                        None,
                        v.refused,
                    )
                    for name, v in found.verdicts.items()
                }
                return n, found.lit, found.shadowed, verdicts

            yield _Job(ladder, "shadow", rung.label, judge)


def _light_jobs(ladders: Iterable[Ladder[LightCase]]) -> Iterator[_Job]:
    for ladder in ladders:
        for rung in ladder.rungs:

            def judge(make=rung.make):
                found = judge_lights(make())
                verdicts = {
                    name: Verdict(
                        wrong=v.missed,
                        share=v.missed / max(found.reaching, 1),
                        listed_ratio=v.listed / v.proven if v.proven else None,
                        refused=v.refused,
                    )
                    for name, v in found.verdicts.items()
                }
                return found.reaching, found.samples, 0, verdicts

            yield _Job(ladder, "light", rung.label, judge)


def _run(job: _Job) -> RungResult:
    failed = ""
    tested = lit = shadowed = 0
    verdicts: dict[str, Verdict] = {}
    try:
        tested, lit, shadowed, verdicts = job.judge()
    except InputError as error:
        failed = str(error)
    except MemoryError:
        failed = "the memory of this machine is full"
    return RungResult(
        job.ladder.name, job.ladder.title, job.ladder.source, job.kind, job.label, tested, lit, shadowed, verdicts,
        failed,
    )  # fmt: skip
