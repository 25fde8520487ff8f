"""The main job: from a scene to measurements, models, a recommendation and the pictures of its report."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tuning.answers import answer_lines
from tuning.budget import Budget
from tuning.choose import Objective, is_timed, median_interval, time_interval_ms, time_ms
from tuning.compiles import watch_compiles
from tuning.features import main_work
from tuning.measurement import Measurement
from tuning.run_pictures import draw
from tuning.search_answers import search_answers
from tuning.search_run import Progress
from tuning.shadow_check import one_blending
from tuning.space import Space, default_space
from tuning.sweep import SearchResult, search
from tuning.workload import ScenePath, SceneWorkload, busiest_frames, cached_counts
from vtfs.configurations import Configuration, configuration
from vtfs.device import versions
from vtfs.files import write_atomically
from vtfs.scene_setup import SceneSetup
from vtfs.technique_names import casts_shadows

DEFAULT_BUDGET = Budget(seconds=40.0)
"""On two CPU cores a frame costs half a second: a dozen configurations, and a minute for the whole command."""
DEFAULT_CONFIGURATION = configuration("tiled_deferred")
DEFAULT_SHADOWS = configuration("cluster_hierarchy")

CLAIM = "for this JAX implementation on this device; nothing is rasterised: frame times start at view samples"


@dataclass(frozen=True)
class TuneOptions:
    """What `vtfs tune` is asked to do. `keep`: techniques that the user named, measured however slow they look."""

    out: Path
    techniques: tuple[str, ...]
    keep: Collection[str]
    space: Space | None
    budget: Budget
    objective: Objective
    max_error: float | None
    seed: int
    command: str


def tune(
    setup: SceneSetup, options: TuneOptions, tell: Callable[[str], None], progress: Callable[[Progress], None]
) -> dict[str, Any]:
    """Count, measure, model, search; write `result.json`, `measurements.jsonl` and the pictures.

    **Arguments:**

    - `tell`: is told what is being done now.

    **Returns:** the content of `result.json`.
    """
    started, compiles = time.perf_counter(), watch_compiles()
    casts = casts_shadows(options.techniques)
    shadow_scene = setup.shadow_scene if casts else None
    n_samples = setup.cameras.viewport.width_px * setup.cameras.viewport.height_px
    cannot = {}
    if shadow_scene is not None and not options.space:
        # Of a group those are left out that cannot cast this scene's shadows; one that was named is refused.
        cannot = shadow_scene.cannot_cast(name for name in options.techniques if name not in options.keep)
    space = options.space or default_space([name for name in options.techniques if name not in cannot], n_samples)
    if shadow_scene is not None:
        one_blending(space.configurations(), shadow_scene)
    tell("tracing view samples and counting the frames of the path")
    frames = choose_frames(setup, DEFAULT_SHADOWS if casts else DEFAULT_CONFIGURATION)
    samples = tuple(setup.samples(f) for f in frames)
    workload = SceneWorkload(
        ScenePath(setup.key, frames, samples, setup.lights, options.seed, shadow_scene),
        compiles,
        options.objective,
    )
    tell("measuring")
    found = search(
        space,
        workload,
        options.out / "measurements.jsonl",
        options.budget,
        options.objective,
        options.max_error,
        options.seed,
        progress,
        options.keep,
    )
    tell("comparing the best with the defaults, in turns")
    gain, times = _duel(workload, found, options.objective)
    tell("drawing")
    drawn = draw(workload, found, options.out / "pictures")
    compared = [m for m in found.measurements if is_timed(m)]
    # Settings that change the image are tried around the best one, and are none of the space.
    tried = (configuration(m.technique, m.params) for m in found.measurements)
    result = {
        "schema": 1,
        "command": options.command,
        "claim": CLAIM,
        "kind": "shadows" if casts else "lights",
        "scene": {
            "name": setup.name,
            "triangles": setup.n_triangles,
            "lights": setup.lights.n_lights,
            "frames": setup.n_frames,
            "key": setup.key,
            "viewport": [setup.cameras.viewport.width_px, setup.cameras.viewport.height_px],
            "measured_frames": list(frames),
            **({"shadow_lights": workload.n_shadow_lights} if casts else {}),
        },
        "device": workload.device,
        "versions": versions(),
        "seed": options.seed,
        "objective": options.objective,
        "max_error": options.max_error,
        "space_size": len({*space.configurations(), *tried}),
        "measured": len(compared),
        "failed": len(found.measurements) - len(compared),
        "stop_reason": found.stop_reason,
        "default": times.get("default"),
        "fastest_default": times.get("fastest_default"),
        "best": times["best"],
        "gain": gain,
        "pareto": [_timed(m, options.objective) | {"error": m.error, "error_p999": m.error_p999} for m in found.pareto],
        "not_measured": [
            {"technique": name, "reason": reason}
            for name, reason in (cannot | found.not_measured | found.not_explored).items()
        ],
        "answers": (answered := search_answers(found, options.objective, options.seed)),
        "answer_lines": list(answer_lines(answered)),
        "cost_models": [model.as_json() for stages in found.models.values() for model in stages.values()],
        "predictions": [
            {
                "technique": p.configuration.technique,
                "params": p.configuration.params,
                "predicted_ms": p.predicted_ms,
                "low_ms": p.low_ms,
                "high_ms": p.high_ms,
                "measured_ms": p.measured_ms,
            }
            for p in found.predictions
        ],
        "counts": {
            name: dict(counts[0]) for name in space.techniques if (counts := workload.counts(space.default(name)))
        },
        "stages": _stages(found, options.objective),
        **drawn.as_json(),
    }
    result |= {
        "compiled_programs": compiles.programs,
        "compile_s": compiles.seconds,
        "wall_s": time.perf_counter() - started,
    }
    write_atomically(options.out / "result.json", json.dumps(result, indent=1, allow_nan=False).encode())
    return result


def choose_frames(setup: SceneSetup, config: Configuration = DEFAULT_CONFIGURATION) -> tuple[int, ...]:
    """The frames with the most, the median and the least work under a configuration, of at most 12 evenly spaced
    ones."""
    work = {}
    for frame in setup.counted_frames:
        counts = cached_counts(config, setup.key, frame, functools.partial(setup.inputs, frame))
        work[frame] = main_work(counts.technique)
    return busiest_frames(work)


def _config(measurement: Measurement) -> Configuration:
    return configuration(measurement.technique, measurement.params)


def _timed(measurement: Measurement, objective: Objective) -> dict[str, Any]:
    return {
        "technique": measurement.technique,
        "params": measurement.params,
        "time_ms": time_ms(measurement, objective),
        "time_ms_interval": list(time_interval_ms(measurement, objective)),
    }


def _duel(
    workload: SceneWorkload, found: SearchResult, objective: Objective
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The best against the defaults, in turns on the best's slowest frame, so that drift meets all of them.

    Gains are ratios of one turn's times: their median and its 95 % interval.
    """
    roles = {"best": found.best, "default": found.default, "fastest_default": found.fastest_default}
    present = {role: m for role, m in roles.items() if m is not None}
    times = {role: _timed(m, objective) | {"error": m.error} for role, m in present.items()}
    distinct = list(dict.fromkeys(_config(m) for m in present.values()))
    best_frames = found.best.stages_ms["frame"]
    slowest = int(np.argmax([np.median(repeats) if repeats else 0.0 for repeats in best_frames]))
    taken = dict(zip(distinct, workload.duel_ms(distinct, slowest), strict=True))
    best = np.array(taken[_config(found.best)])
    gain: dict[str, Any] = {"frame": workload.frames[slowest], "turns": len(best)}
    for role in ("default", "fastest_default"):
        if role in present:
            ratios = np.array(taken[_config(present[role])]) / best
            gain[f"over_{role}"] = float(np.median(ratios))
            gain[f"over_{role}_interval"] = list(median_interval(ratios.tolist()))
    return gain, times


def _stages(found: SearchResult, objective: Objective) -> dict[str, dict[str, float]]:
    """Of the fastest exact configuration of each technique, the medians on the frame with the most work."""
    stages: dict[str, dict[str, float]] = {}
    fastest: dict[str, Measurement] = {}
    for m in found.measurements:
        if is_timed(m) and _config(m).is_exact:
            fastest[m.technique] = min(fastest.get(m.technique, m), m, key=lambda m: time_ms(m, objective))
    for technique, m in fastest.items():
        stages[technique] = {name: float(np.median(frames[0])) for name, frames in m.stages_ms.items()}
    return stages
