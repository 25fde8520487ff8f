"""The experiments of the many-light papers, re-run on a scene of your own or a built-in one.

    python benchmarks/papers.py [SCENE] [--size 1280x720] [--frames 5] [--only ramp,sizes,...] [--out DIR]
    python benchmarks/papers.py atrium --size 1920x1080 --only assignment,volume --lights-up-to 7000000 --seconds 140 \\
        --out papers                                                                   # the last two on a GPU

- `clusters`: lighting computations of tiled and clustered shading over the camera path, with alpha-masked geometry and
  without it (Olsson et al. 2012, Fig. 12), with explicit bounds, and with cones of normals besides.
- `assignment`: lists from 32 to 1,048,576 lights, tiled and clustered, the tree's build included (2012, table 2).
- `ramp`: frame times for 0 to 924 small lights and where techniques cross (Olsson and Assarsson 2011, Fig. 4).
- `sizes`: 11 large against 924 small lights, and the bytes of 16- and 32-bit G-buffers (2011, tables 2 and 3).
- `volume`: volume tiled shading with and without tree, the lights in a constant volume or at one light a cubic metre
  (van Oosten 2017, tables 10.5 to 10.9).

Prints Markdown tables, and writes them with `--out` as `papers_NAME.md` after each row. Times are of fused frames from
view samples; nothing is rasterised. With `--seconds`, rows that would begin later are left out.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np

from vtfs.camera import Viewport
from vtfs.configurations import configuration
from vtfs.device import device_name
from vtfs.files import write_atomically
from vtfs.frame import frame_program, planned, run_stages, stage_program
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_sizes import CapacityError
from vtfs.lights import Lights, point_lights, scatter_lights
from vtfs.scene_setup import SceneOptions, SceneSetup, set_up
from vtfs.techniques import REGISTRY
from vtfs.view_samples import ViewSamples, trace_view_samples

REPEATS = 7
CAP_S = 3.0


@dataclass
class Sheet:
    """What is printed, and written again after each row: a run that is cut off leaves what it has."""

    path: Path | None
    ends_s: float
    lines: list[str] = field(default_factory=list)

    def say(self, line: str) -> None:
        print(line, flush=True)
        self.lines.append(line)
        if self.path:
            write_atomically(self.path, ("\n".join(self.lines) + "\n").encode())

    @property
    def is_over(self) -> bool:
        return time.perf_counter() > self.ends_s

    def table(self, title: str, header: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
        """Rows may be made while they are written."""

        def text(cell: object) -> str:
            if isinstance(cell, float):
                return "failed" if np.isnan(cell) else f"{cell:.2f}"
            return f"{cell:,}" if isinstance(cell, int) else str(cell)

        names = list(header)
        self.say(f"\n### {title}\n\n| {' | '.join(names)} |\n|{' --- |' * len(names)}")
        for row in rows:
            self.say(f"| {' | '.join(map(text, row))} |")
            if self.is_over:
                self.say("\nThe time was over.")
                return


def frame_ms(technique: str, params: Mapping[str, object], inputs: FrameInputs) -> float:
    """Median of the fused frame; NaN where it fails or is over the cap's ten times."""
    config = configuration(technique, params)
    try:
        sizes = run_stages(config, inputs, until="assign")[1] if technique != "forward" else None
        plan = planned(config, sizes) if sizes else planned(config, count(config, inputs)[0].sizes)
        program, arguments = frame_program(technique, plan, inputs.has_transparent), inputs.environment(config)
        return median_ms(lambda: program(arguments))
    except (CapacityError, MemoryError, jax.errors.JaxRuntimeError) as error:
        print(f"<!-- {config}: {str(error).splitlines()[0][:120]} -->")
        return float("nan")


def median_ms(run: Callable[[], object]) -> float:
    jax.block_until_ready(run())
    times: list[float] = []
    started = time.perf_counter()
    while len(times) < REPEATS and (len(times) < 3 or time.perf_counter() - started < CAP_S):
        began = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - began)
    return float(np.median(times)) * 1e3


def lists_ms(technique: str, params: Mapping[str, object], inputs: FrameInputs) -> float:
    """Of all stages from the lights to the lists, one after the other; NaN where they do not fit."""
    config = configuration(technique, params)
    try:
        env, sizes = run_stages(config, inputs, until="assign")
    except (CapacityError, MemoryError, jax.errors.JaxRuntimeError) as error:
        print(f"<!-- {config}: {str(error).splitlines()[0][:120]} -->")
        return float("nan")
    plan, total = planned(config, sizes), 0.0
    for stage in REGISTRY[technique].stages_of(plan, inputs.has_transparent):
        if stage.name in ("reduce", "morton", "sort", "build_tree", "assign"):
            program = stage_program(stage, stage.narrowed(plan))
            total += median_ms(lambda program=program, stage=stage: program(*(env[name] for name in stage.needs)))
    return total


def counts_of(technique: str, params: Mapping[str, object], inputs: FrameInputs) -> dict[str, int]:
    return count(configuration(technique, params), inputs)[0].technique


def without_masks(setup: SceneSetup, frame: int) -> ViewSamples | None:
    """The same view without alpha-masked triangles; None where the scene has none."""
    from dataclasses import replace

    scene = setup.scene
    if scene is None:
        return None
    kept = np.array([material.alpha_mode != "mask" for material in scene.materials])[scene.material_index]
    if kept.all():
        return None
    fewer = replace(scene, triangles=scene.triangles[kept], material_index=scene.material_index[kept])
    return trace_view_samples(fewer, setup.cameras.camera(frame))


def clusters(setup: SceneSetup, frames: list[int], sheet: Sheet) -> None:
    normals = {"bounds": "explicit", "normal_bins": 3, "normal_cones": "explicit"}

    def rows() -> Iterator[tuple[object, ...]]:
        for frame in frames:
            views = {"all": setup.samples(frame), "no masked": without_masks(setup, frame)}
            for name, samples in views.items():
                if samples is None:
                    continue
                inputs = FrameInputs(samples, setup.lights)
                tiled = counts_of("tiled_deferred", {}, inputs)["lighting_computations"]
                implicit, explicit, cones = (
                    counts_of("clustered_forward", params, inputs) for params in ({}, {"bounds": "explicit"}, normals)
                )
                own = implicit["lighting_computations"]
                computations = (found["lighting_computations"] for found in (explicit, cones))
                pairs = (found["light_cluster_pairs"] for found in (implicit, explicit, cones))
                yield frame, name, tiled, own, tiled / max(own, 1), *computations, *pairs

    sheet.table(
        "Lighting computations, tiled and clustered (2012, Fig. 12)",
        ("frame", "geometry", "tiled", "clustered", "tiled / clustered", "explicit", "explicit, normals", "pairs",
         "pairs, explicit", "pairs, explicit, normals"),
        rows(),
    )  # fmt: skip


ASSIGNED = (32, 1024, 32_768, 1_048_576)


def assignment(setup: SceneSetup, frames: list[int], sheet: Sheet) -> None:
    samples = setup.samples(frames[0])
    visible = samples.world_positions_m()[::997]

    def rows() -> Iterator[tuple[object, ...]]:
        for n_lights in ASSIGNED:
            inputs = FrameInputs(samples, scatter_lights(setup.bounds_m, n_lights, 0, visible, 20))
            tree = lists_ms("clustered_forward", {"assigner": "published"}, inputs)
            groups = lists_ms("clustered_forward", {"assigner": "coarse_to_fine"}, inputs)
            tiled = lists_ms("tiled_deferred", {"assigner": "published"}, inputs)
            yield n_lights, counts_of("clustered_forward", {}, inputs)["light_cluster_pairs"], tree, groups, tiled

    sheet.table(
        "Light assignment in ms, 20 lights at the median sample whatever their number (2012, table 2)",
        ("lights", "clustered pairs", "clustered, tree", "clustered, groups", "tiled, brute force"),
        rows(),
    )


RAMP = (0, 77, 154, 308, 462, 616, 770, 924)
RAMP_TECHNIQUES = ("forward", "deferred", "deferred_stencil", "tiled_deferred", "clustered_forward")


def ramp(setup: SceneSetup, frames: list[int], sheet: Sheet) -> None:
    samples = setup.samples(frames[0])
    small = small_lights(setup, RAMP[-1])
    times: dict[str, list[float]] = {technique: [] for technique in RAMP_TECHNIQUES}
    for n_lights in RAMP:
        inputs = FrameInputs(samples, dimmed(small, n_lights))
        for technique in RAMP_TECHNIQUES:
            # Forward shading pays for a light that reaches nothing, too.
            own = FrameInputs(samples, first(small, n_lights)) if technique == "forward" else inputs
            times[technique].append(frame_ms(technique, {}, own))
    rows = [(n, *(times[technique][i] for technique in RAMP_TECHNIQUES)) for i, n in enumerate(RAMP)]
    sheet.table(
        "Frame time in ms against the number of small lights (2011, Fig. 4)", ("lights", *RAMP_TECHNIQUES), rows
    )
    for a in RAMP_TECHNIQUES:
        for b in RAMP_TECHNIQUES:
            crossing = crossover(np.array(times[a]), np.array(times[b]))
            if crossing is not None:
                sheet.say(f"\n`{b}` becomes faster than `{a}` at about {crossing:.0f} lights.")


def crossover(a_ms: np.ndarray, b_ms: np.ndarray) -> float | None:
    """Where `b` first becomes faster than `a`, interpolated."""
    difference = a_ms - b_ms
    for i in range(len(RAMP) - 1):
        if difference[i] <= 0 < difference[i + 1]:
            share = -difference[i] / (difference[i + 1] - difference[i])
            return RAMP[i] + share * (RAMP[i + 1] - RAMP[i])
    return None


def sizes(setup: SceneSetup, frames: list[int], sheet: Sheet) -> None:
    few = scatter_lights(setup.bounds_m, 11, 0, setup.samples(frames[0]).world_positions_m()[::97], 8)
    rows = []
    for name, lights in (("11 large", few), ("924 small", small_lights(setup, 924))):
        inputs = FrameInputs(setup.samples(frames[0]), lights)
        for technique in ("deferred", "deferred_stencil", "tiled_forward_prez", "tiled_deferred"):
            counts = counts_of(technique, {}, inputs)
            rows.append(
                (name, technique, counts["lighting_computations"], counts["bytes_gbuffer_16"] / 1e6,
                 counts["bytes_gbuffer_32"] / 1e6, frame_ms(technique, {"gbuffer": "float16"}, inputs),
                 frame_ms(technique, {}, inputs))
            )  # fmt: skip
    sheet.table(
        "Few large lights, many small ones (2011, tables 2 and 3)",
        ("lights", "technique", "lighting computations", "MB, 16 bits", "MB, 32 bits", "ms, float16", "ms, float32"),
        rows,
    )


VOLUMES = (1024, 16_384, 65_536, 262_144, 1_048_576, 4_000_000, 7_000_000)


def volume(setup: SceneSetup, frames: list[int], sheet: Sheet, up_to: int) -> None:
    samples = setup.samples(frames[0])
    visible = samples.world_positions_m()[::997]
    base = scatter_lights(setup.bounds_m, 65_536, 0, visible, 20)

    def rows() -> Iterator[tuple[object, ...]]:
        for n_lights in VOLUMES:
            for density in ("fixed", "constant"):
                if n_lights > up_to:
                    continue
                lights = scatter_lights(setup.bounds_m, n_lights, 0, visible, 20, density)
                if density == "constant":  # the papers' lights keep their size: lists grow with their number
                    lights = point_lights(lights.position_m, np.full(n_lights, base.range_m[0]), lights.colour)
                inputs = FrameInputs(samples, lights)
                # More than 2^28 (cluster, light) tests are not worth the wait.
                brute = lists_ms("volume_tiled", {}, inputs) if n_lights <= 65_536 else "-"
                tree = lists_ms("volume_tiled_bvh", {}, inputs)
                if np.isnan(tree):
                    yield density, n_lights, "failed", brute, tree, tree
                    continue
                pairs = counts_of("volume_tiled_bvh", {}, inputs)["light_cluster_pairs"]
                yield density, n_lights, pairs, brute, tree, frame_ms("volume_tiled_bvh", {}, inputs)

    sheet.table(
        "Volume tiled shading in ms (2017, tables 10.5 to 10.9)",
        ("volume", "lights", "pairs", "lists, brute force", "lists, tree and its build", "frame, tree"),
        rows(),
    )


def small_lights(setup: SceneSetup, n_lights: int) -> Lights:
    visible = np.concatenate([setup.samples(frame).world_positions_m()[::997] for frame in setup.counted_frames[:3]])
    return scatter_lights(setup.bounds_m, n_lights, 0, visible, 10)


def dimmed(lights: Lights, n_lights: int) -> Lights:
    """Only the first ones reach anything: the same shapes, and so the same programs, for any number."""
    range_m = np.where(np.arange(lights.n_lights) < n_lights, lights.range_m, 0.0)
    return point_lights(lights.position_m, range_m, lights.colour)


def first(lights: Lights, n_lights: int) -> Lights:
    return point_lights(lights.position_m[:n_lights], lights.range_m[:n_lights], lights.colour[:n_lights])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--lights", default=None)
    parser.add_argument("--only", default="clusters,assignment,ramp,sizes,volume")
    parser.add_argument("--lights-up-to", type=int, default=1_048_576)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    started = time.perf_counter()
    if asked.out:
        asked.out.mkdir(parents=True, exist_ok=True)
    width_px, height_px = (int(part) for part in asked.size.split("x"))
    setup = set_up(SceneOptions(asked.scene, lights=asked.lights, viewport=Viewport(width_px, height_px)))
    frames = [int(f) for f in np.linspace(0, setup.n_frames - 1, asked.frames).round()]
    path = asked.out / f"papers_{setup.name}.md" if asked.out else None
    sheet = Sheet(path, started + asked.seconds)
    sheet.say(f"## {setup.name}, {setup.n_triangles:,} triangles, {asked.size}, {device_name()}")
    for name in asked.only.split(","):
        if sheet.is_over:
            return
        if name == "volume":
            volume(setup, frames, sheet, asked.lights_up_to)
        else:
            {"clusters": clusters, "assignment": assignment, "ramp": ramp, "sizes": sizes}[name](setup, frames, sheet)


if __name__ == "__main__":
    main()
