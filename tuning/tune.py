"""The main job: from a scene to measurements, models, a recommendation and the pictures of its report."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tuning.choose import Objective, is_timed, median_interval, time_interval_ms, time_ms
from tuning.compiles import watch_compiles
from tuning.features import main_work
from tuning.measurement import Measurement
from tuning.space import Space, default_space
from tuning.sweep import Budget, Progress, SearchResult, search
from tuning.workload import ScenePath, SceneWorkload, busiest_frames, cached_counts
from vtfs.device import versions
from vtfs.files import write_atomically
from vtfs.frame import FrameInputs
from vtfs.image import exposure, heat_map, tone_map, write_png
from vtfs.input_error import InputError
from vtfs.parameters import SHADOW_NAMES, SHADOW_REFERENCES, Configuration, configuration, is_exact
from vtfs.scene_setup import SceneSetup
from vtfs.shadow_maps import ShadowMaps

DEFAULT_BUDGET = Budget(seconds=90.0)
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
    tell("tracing view samples and counting the frames of the path")
    casts = casts_shadows(options.techniques)
    frames = choose_frames(setup, DEFAULT_SHADOWS if casts else DEFAULT_CONFIGURATION)
    samples = tuple(setup.samples(f) for f in frames)
    workload = SceneWorkload(
        ScenePath(setup.key, frames, samples, setup.lights, options.seed, setup.shadow_scene if casts else None),
        compiles,
        options.objective,
    )
    n_samples = setup.cameras.viewport.width_px * setup.cameras.viewport.height_px
    space = options.space or default_space(options.techniques, n_samples)
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
    pictures = _pictures(workload, found, options.out / "pictures")
    compared = [m for m in found.measurements if is_timed(m)]
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
        "space_size": len(space.configurations()),
        "measured": len(compared),
        "failed": len(found.measurements) - len(compared),
        "stop_reason": found.stop_reason,
        "default": times.get("default"),
        "fastest_default": times.get("fastest_default"),
        "best": times["best"],
        "gain": gain,
        "pareto": [_timed(m, options.objective) | {"error": m.error, "error_p999": m.error_p999} for m in found.pareto],
        "not_measured": [
            {"technique": name, "reason": reason} for name, reason in (found.not_measured | found.not_explored).items()
        ],
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
            name: dict(counts[0]) for name in space.techniques if (counts := workload.counts(configuration(name)))
        },
        "stages": _stages(found, options.objective),
        "pictures": pictures,
        **({"heat_scale": {"scale": "log"}} if casts else {}),
    }
    result |= {
        "compiled_programs": compiles.programs,
        "compile_s": compiles.seconds,
        "wall_s": time.perf_counter() - started,
    }
    write_atomically(options.out / "result.json", json.dumps(result, indent=1, allow_nan=False).encode())
    return result


def casts_shadows(techniques: Sequence[str]) -> bool:
    """Do the techniques cast shadows?

    **Raises:** `InputError` where some do and others do not, and for references, which run on the host.
    """
    casting = [name for name in techniques if name in SHADOW_NAMES]
    references = [name for name in casting if name in SHADOW_REFERENCES]
    if references:
        raise InputError(
            f"--techniques {references[0]}: is what others are checked against and is not timed; leave it out."
        )
    if casting and len(casting) < len(techniques):
        other = next(name for name in techniques if name not in casting)
        raise InputError(
            f"--techniques {casting[0]},{other}: one casts shadows, the other does not, so that their times cannot be "
            "compared; tune one kind at a time."
        )
    return bool(casting)


def choose_frames(setup: SceneSetup, config: Configuration = DEFAULT_CONFIGURATION) -> tuple[int, ...]:
    """The frames with the most, the median and the least work under a configuration, of at most 12 evenly spaced
    ones."""
    work = {}
    for frame in setup.counted_frames:
        counts = cached_counts(config, setup.key, frame, functools.partial(_inputs, setup, frame))
        work[frame] = main_work(counts.technique)
    return busiest_frames(work)


def _inputs(setup: SceneSetup, frame: int) -> FrameInputs:
    return setup.inputs(frame)


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
        if is_timed(m) and is_exact(_config(m)):
            fastest[m.technique] = min(fastest.get(m.technique, m), m, key=lambda m: time_ms(m, objective))
    for technique, m in fastest.items():
        stages[technique] = {name: float(np.median(frames[0])) for name, frames in m.stages_ms.items()}
    return stages


def _pictures(workload: SceneWorkload, found: SearchResult, folder: Path) -> list[dict[str, Any]]:
    """The best configuration's image, and heat maps of the work on one scale."""
    valid = workload.valid()
    best = _config(found.best)
    image = workload.image(best)
    write_png(folder / "frame.png", tone_map(image, exposure(image, valid)))
    frame, casts = workload.frames[0], best.technique in SHADOW_NAMES
    unit = "triangles tested against a pixel's tile or cluster" if casts else "lighting computations per pixel"
    pictures: list[dict[str, Any]] = [
        {
            "file": "frame.png",
            "kind": "frame",
            "technique": found.best.technique,
            "caption": f"Frame {frame}, the one with the most {'tests' if casts else 'lighting computations'}, "
            f"as {found.best.technique} renders it.",
        }
    ]
    fastest: dict[str, Configuration] = {}
    for m in sorted(filter(is_timed, found.measurements), key=lambda m: time_ms(m, "max")):
        if is_exact(_config(m)):
            fastest.setdefault(m.technique, _config(m))
    if casts:
        maps = {technique: workload.shadow_maps(config) for technique, config in fastest.items()}
        pictures.append(_shadow_picture(folder, best, maps[best.technique]))
        work = {technique: own.tests for technique, own in maps.items()}
    else:
        work = {technique: workload.list_lengths(config) for technique, config in fastest.items()}
    scaled = {technique: own for technique, own in work.items() if technique != "forward"} or work
    largest = max((int(own.max(initial=0)) for own in scaled.values()), default=0)
    for technique, own in work.items():
        name = f"heat_{technique}.png"
        # A volume may cross a thousand tiles, or one: only logarithms show both.
        shown, top = (_log(own), int(_log(np.array(largest)))) if casts else (own, largest)
        write_png(folder / name, heat_map(shown, top, valid))
        pictures.append(
            {
                "file": name,
                "kind": "heat_map",
                "technique": technique,
                "caption": f"{unit[0].upper()}{unit[1:]}, {fastest[technique]}.",
                "unit": unit,
                "max_count": int(own.max(initial=0)),
                "mean_count": float(own[valid].mean()) if valid.any() else 0.0,
                "scale_max": largest,
            }
        )
    return pictures


def _log(counts: np.ndarray) -> np.ndarray:
    """Thousandths of log(1 + count), whole."""
    return np.round(1000 * np.log1p(counts)).astype(np.int64)


def _shadow_picture(folder: Path, best: Configuration, maps: ShadowMaps) -> dict[str, Any]:
    """What share of the lights that would light it each pixel lies in the shadow of."""
    lit = maps.lit > 0
    share = np.where(lit, maps.shadowed / np.maximum(maps.lit, 1), 0)
    write_png(folder / "shadows.png", heat_map((1000 * (1 - share)).astype(np.int64), 1000, lit))
    return {
        "file": "shadows.png",
        "kind": "shadows",
        "technique": best.technique,
        "caption": f"Shadows that {best.technique} found: dark in the shadow of all lights that cast and would light "
        f"the pixel, bright in that of none; {maps.shadowed.sum() / max(int(maps.lit.sum()), 1):.1%} in shadow.",
    }
