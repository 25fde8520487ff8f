"""Every shadow mask is right, sample by sample: a campaign over scenes, frames, lights and variants.

python -m benchmarks.shadow_exactness SCENE[,SCENE...] --out DIR [--scenes FOLDER] [--variants pairwise]
    [--size 1280x720] [--triangles N] [--frames 3] [--lights 3] [--workers 16] [--at-once 1] [--minutes 8] [--spheres]

SCENE is a built-in name, or FOLDER/SCENE.glb with SCENE.cameras.json beside it. All samples that face the light are
compared with float64 rays against all triangles (`benchmarks.device_rays`), and what differs is classified in NumPy
(`is_excused`).
`--variants every` is each value of each parameter and each pair of values. `--size`: that of the cameras unless given.

Threads compile one variant each and take it through the scenes of its number of triangles, a frame at a time. Each line
of DIR/shadow-exactness.jsonl is a variant on one view, written as it is known; a run goes on from what is there.
`--spheres` first tests closed spheres (`benchmarks.closed_sphere`).
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import os
import queue
import threading
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.closed_sphere import all_spheres
from benchmarks.run_lines import RunLines
from benchmarks.shadow_cases import with_room
from benchmarks.shadow_variants import Variant, one_at_a_time, pairwise, unrolled, variant
from benchmarks.shadow_views import LIGHTS, Subject, View
from vtfs.camera import Viewport
from vtfs.device import device_name, keep_compiled_programs, versions
from vtfs.files import write_atomically
from vtfs.gbuffer import from_runs
from vtfs.shadow_capacities import fitted_to_all, shadow_sizes
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_programs import counting_program

log = logging.getLogger("benchmarks.shadow_exactness")


@dataclass
class Walker:
    """One variant for one number of triangles: its program, with capacities that grow where a view needs more."""

    variant: Variant
    n_padded: int
    at_once: threading.Semaphore
    plan: ShadowPlan = field(init=False)
    compiled: dict[ShadowPlan, Any] = field(default_factory=dict)
    compile_s: float = 0.0

    def __post_init__(self) -> None:
        self.plan = with_room(self.variant.plan, self.n_padded)

    def mask(self, view: View) -> np.ndarray:
        """The mask of a view, bool `[h, w]`."""
        frame = view.shadow_frame(self.plan.tile_px, self.variant.depth_slices, self.variant.front_faces)
        unrolled = self.variant.unrolled
        fits, (mask,) = fitted_to_all(
            self.variant.technique, self.plan, [frame], unrolled, run=lambda plan, _: self._run(plan, frame)
        )
        if unrolled:
            mask = self._run(fits, frame)
            assert not bool(mask.overflowed)
        else:
            self.plan = fits
        return from_runs(np.asarray(mask.shadowed), view.samples.camera.viewport)

    def _run(self, plan: ShadowPlan, frame: ShadowFrame) -> ShadowMask:
        with jax.enable_x64(True):
            if plan not in self.compiled:
                started = time.monotonic()
                self.compiled[plan] = counting_program(self.variant.technique, plan).lower(frame).compile()
                self.compile_s += time.monotonic() - started
            with self.at_once:
                return jax.block_until_ready(self.compiled[plan](frame))


def key_of(line: dict) -> tuple:
    """A line is a variant on one view."""
    return line["scene"], line["frame"], line["light"], line["variant"]


@dataclass(frozen=True)
class Campaign:
    """What all threads share."""

    subjects: list[Subject]
    n_frames: int
    n_lights: int
    results: RunLines
    end: float
    about: dict[str, str]

    def work(self, rounds: queue.PriorityQueue) -> None:
        """Take walkers through their scenes, a frame at a time, until nothing or no time is left."""
        while True:
            try:
                frame, order, walker = rounds.get_nowait()
            except queue.Empty:
                return
            if not self.one_round(frame % self.n_frames, walker):
                return
            if frame + 1 < self.n_frames:
                rounds.put((frame + 1, order, walker))

    def one_round(self, frame: int, walker: Walker) -> bool:
        """All lights and scenes of one frame; false where time is over."""
        subjects = [subject for subject in self.subjects if subject.n_padded == walker.n_padded]
        n_lights = 1 if walker.variant.unrolled else self.n_lights
        for light, subject in itertools.product(LIGHTS[:n_lights], subjects):
            if time.monotonic() > self.end:
                return False
            key = (subject.name, frame, light, walker.variant.name)
            if key in self.results.known():
                continue
            line = dict(zip(("scene", "frame", "light", "variant"), key, strict=True)) | self.about
            try:
                view = subject.view(frame, self.n_frames, light)
                judged = view.judged(walker.mask(view), walker.variant.front_faces)
                height, width = view.receives.shape
                line |= {"size": f"{width}x{height}", "triangles": subject.casters.n_triangles} | judged
                line |= {"compile_s": round(walker.compile_s, 1), "capacities": shadow_sizes(walker.plan)}
            except Exception as error:  # one that fails is a line too, and the others go on
                log.debug("%s", traceback.format_exc())
                line |= {"failed": f"{type(error).__name__}: {error}"[:300]}
            self.results.add(line)
            print(" ".join(f"{k}={v}" for k, v in line.items() if k not in ("device", "jax")), flush=True)
        return True


def total(lines: list[dict]) -> dict[str, Any]:
    """Over all lines: what was compared, and the worst share of the bands of any line."""
    judged = _judged(lines)
    known = {key_of(line) for line in judged}
    names = (
        "samples", "shadowed", "by_itself", "differs", "own_plane", "near_edge", "near_plane", "errors",
        "not_classified",
    )  # fmt: skip
    worst = max(judged, key=in_bands, default=None)
    return {
        "masks": len(judged),
        "failed": len({key_of(line) for line in lines} - known),
        "scenes": len({line["scene"] for line in judged}),
        "views": len({(line["scene"], line["frame"], line["light"]) for line in judged}),
        "variants": len({line["variant"] for line in judged}),
        **{name: sum(line[name] for line in judged) for name in names},
        "most_in_bands": in_bands(worst) if worst else 0.0,
        "most_in_bands_at": key_of(worst) if worst else None,
    }


def _judged(lines: list[dict]) -> list[dict]:
    return list({key_of(line): line for line in lines if "failed" not in line}.values())


def table(lines: list[dict]) -> str:
    """A row a scene, in Markdown; samples are those of all masks together."""
    head = ("scene", "triangles", "views", "masks", "samples, all masks", "in shadow", "differ", "near an edge")
    head = (*head, "near a plane, their own", "most in bands", "errors")
    rows = [_row(head), "| --- " * len(head) + "|"]
    for scene in dict.fromkeys(line["scene"] for line in _judged(lines)):
        own = [line for line in _judged(lines) if line["scene"] == scene]
        found = total(own)
        cells = (
            scene, f"{own[0]['triangles']:,}", found["views"], found["masks"], f"{found['samples']:,}",
            f"{found['shadowed'] / max(1, found['samples']):.0%}", f"{found['differs']:,}", f"{found['near_edge']:,}",
            f"{found['near_plane']:,}, {found['own_plane']:,}", f"{found['most_in_bands']:.4%}",
            found["errors"] + found["not_classified"],
        )  # fmt: skip
        rows.append(_row(cells))
    return "\n".join(rows)


def _row(cells: tuple) -> str:
    return "| " + " | ".join(map(str, cells)) + " |"


def in_bands(line: dict) -> float:
    """The share of the samples of a line in the bands."""
    return (line["near_edge"] + line["near_plane"] + line["own_plane"]) / max(1, line["samples"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--variants", choices=("pairwise", "every"), default="pairwise")
    parser.add_argument("--size")
    parser.add_argument("--triangles", type=int)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--lights", type=int, default=len(LIGHTS))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--spheres", action="store_true")
    given = parser.parse_args()
    end = time.monotonic() + 60 * given.minutes
    keep_compiled_programs()
    if given.spheres:
        spheres = all_spheres()
        about = {"device": device_name(), "versions": versions(), "spheres": spheres}
        write_atomically(given.out / "closed-spheres.json", json.dumps(about, indent=1).encode())
        for line in spheres:
            print(" ".join(f"{name}={value}" for name, value in line.items()), flush=True)
    viewport = Viewport(*map(int, given.size.split("x"))) if given.size else None
    subjects = [Subject(name, given.scenes, viewport, given.triangles) for name in given.scene.split(",")]
    choices = pairwise() + (one_at_a_time() if given.variants == "every" else [])
    at_once, rounds = threading.Semaphore(given.at_once), queue.PriorityQueue()
    sizes = sorted({subject.n_padded for subject in subjects})
    looped = {(one.name, size): one for choice in choices for size in sizes for one in [variant(choice, size)]}
    timed = [(size, one) for size in sizes for one in unrolled(size)]
    for order, ((_, size), one) in enumerate(looped.items()):
        rounds.put((0, order, Walker(one, size, at_once)))
    for order, (size, one) in enumerate(timed):  # each view compiles: after all the others, on the first view
        rounds.put((given.frames, order, Walker(one, size, at_once)))
    n_views = given.frames * min(given.lights, len(LIGHTS))
    n_masks = sum(subject.n_padded == size for _, size in looped for subject in subjects) * n_views
    n_masks += 2 * len(subjects)
    print(f"{device_name()}: {len(looped)} programs, {len(timed)} unrolled, {n_masks:,} masks", flush=True)
    about = {"device": device_name(), "jax": jax.__version__}
    results = RunLines(given.out / "shadow-exactness.jsonl", key_of)
    campaign = Campaign(subjects, given.frames, given.lights, results, end, about)
    threads = [threading.Thread(target=campaign.work, args=(rounds,), daemon=True) for _ in range(given.workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()) + 5)
    print(json.dumps({"planned": n_masks, **total(list(results.lines))}, indent=1), flush=True)
    print(table(list(results.lines)), flush=True)
    os._exit(0)  # what still compiles is not waited for


if __name__ == "__main__":
    main()
