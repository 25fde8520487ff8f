"""A recommendation from frame times that were measured elsewhere: nothing is measured here, and nothing rendered.

The engineer counts a space (`vtfs count --space S.toml --out counts.csv`), times some of its configurations in their
engine, and fills in a column `time_ms`.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tuning.answers import answer_lines, answers
from tuning.budget_lines import sizes_within
from tuning.choose import Objective, time_interval_ms, time_ms
from tuning.imported_times import ImportedTimes
from tuning.label_groups import fit_groups, predict_groups
from tuning.measurement import Measurement
from tuning.record import append_measurement
from tuning.table_model import Prediction, TableModel
from tuning.timing_table import TimingTable
from tuning.transferable import of_our_program
from vtfs.configurations import Configuration, configuration
from vtfs.files import write_atomically
from vtfs.input_error import InputError
from vtfs.parameters import PARAMETERS, TECHNIQUES

_DROPPED = 8
"""Terms that a model does without and that are named, those that would help most first."""

_NEXT = 5
"""Configurations that are named as worth timing next."""


@dataclass(frozen=True)
class Estimate:
    """A configuration's time over the frames: measured, or what the model says of it with a 90 % interval."""

    configuration: Configuration
    time_ms: float
    interval_ms: tuple[float, float]
    extrapolated: bool


def tune_imported(
    imported: ImportedTimes, out: Path, objective: Objective, seed: int, command: str, scene_name: str | None = None
) -> dict[str, Any]:
    """Model the imported times and recommend; write `measurements.jsonl` and `result.json` as `tune` does.

    The best configuration is the fastest that was timed, unless the model is sure (its 90 % interval, inside the
    data) that one that was not timed is faster. Settings that change the image are not recommended: what error they
    make is not known here.

    **Returns:** the content of `result.json`.
    """
    started = time.perf_counter()
    measurements = {c: _measurement(imported, c, seed) for c in imported.repeats_ms}
    exact = [c for c in measurements if c.is_exact]
    if not exact:
        raise InputError(
            f"{imported.source}: only settings that change the image were timed; time one with gbuffer float32, "
            "light_cutoff 0 and approximate 0."
        )
    table = _table(imported)
    model = fit_groups(table, seed)
    with_settings = replace(table, columns=table.columns | _settings(_timed_rows(imported)))
    sizes = tuple(sizes_within(model))
    answered = answers(model, sizes, with_settings, seed)
    predicted = _predicted(imported, model, objective)
    fastest = min(exact, key=lambda c: time_ms(measurements[c], objective))
    fastest_ms = time_ms(measurements[fastest], objective)
    untimed = sorted((e for c, e in predicted.items() if c not in measurements), key=lambda e: e.time_ms)
    sure = [
        e
        for e in untimed
        if not e.extrapolated and e.interval_ms[1] < time_interval_ms(measurements[fastest], objective)[0]
    ]
    if sure:
        chosen = sure[0]
        best = _entry(chosen.configuration, chosen.time_ms, chosen.interval_ms) | {"timed": False}
    else:
        best = _timed_entry(measurements[fastest], objective)
    result: dict[str, Any] = {
        "schema": 1,
        "command": command,
        "claim": imported.claim if best["timed"] else f"predicted and not timed yet, {imported.claim}",
        "imported": {
            "file": imported.source,
            "timed": len(measurements),
            "untimed": len(imported.counts) - len(measurements),
        },
        "scene": {
            "name": scene_name or imported.scene,
            "triangles": None,
            "lights": _lights(imported),
            "frames": len(imported.frames),
            "key": imported.scene,
            "measured_frames": list(imported.frames),
        },
        "device": imported.device,
        "versions": {},
        "seed": seed,
        "objective": objective,
        "max_error": None,
        "space_size": len(imported.counts),
        "measured": len(measurements),
        "failed": 0,
        "stop_reason": "all times were imported",
        "best": best,
        "pareto": [_timed_entry(measurements[fastest], objective)],
        "not_measured": [],
        "next": [
            _entry(e.configuration, e.time_ms, e.interval_ms) | {"extrapolated": e.extrapolated}
            for e in untimed
            if e.interval_ms[0] < fastest_ms
        ][:_NEXT],
        "answers": answered,
        "answer_lines": [*(one.line for one in sizes), *answer_lines(answered)],
        "cost_models": _cost_models(model),
        "predictions": [_prediction(e, measurements, objective) for e in predicted.values()],
        "counts": {
            c.technique: {name: value for name, value in frames[0].items() if math.isfinite(value)}
            for c, frames in reversed(imported.counts.items())
            if frames[0]
        },
        "stages": {},
        "pictures": [],
    }
    result |= _against_defaults(measurements, best, objective)
    result |= {"compiled_programs": 0, "compile_s": 0.0, "wall_s": time.perf_counter() - started}
    for measurement in measurements.values():
        append_measurement(out / "measurements.jsonl", measurement)
    write_atomically(out / "result.json", json.dumps(result, indent=1, allow_nan=False).encode())
    return result


def _table(imported: ImportedTimes) -> TimingTable:
    """A row for each frame of each timed configuration: counts that another engine pays for too, else parameters.

    Settings that change the image change what an operation costs: they are not fitted, nor predicted.
    """
    rows = _timed_rows(imported)
    columns = _features(imported, rows)
    return TimingTable(
        columns, {"technique": tuple(c.technique for c, _ in rows)}, tuple(imported.repeats_ms[c][i] for c, i in rows)
    )


def _timed_rows(imported: ImportedTimes) -> list[tuple[Configuration, int]]:
    return [(c, i) for c in imported.repeats_ms if c.is_exact for i in range(len(imported.frames))]


def _features(imported: ImportedTimes, rows: Sequence[tuple[Configuration, int]]) -> dict[str, np.ndarray]:
    timed = [frame for c in imported.repeats_ms for frame in imported.counts[c]]
    names = list(dict.fromkeys(name for frame in timed for name in frame))
    names = [name for name in names if name not in of_our_program(names)]
    if names:
        return {name: np.array([imported.counts[c][i].get(name, math.nan) for c, i in rows]) for name in names}
    return _settings(rows)


def _settings(rows: Sequence[tuple[Configuration, int]]) -> dict[str, np.ndarray]:
    params = [name for name, parameter in PARAMETERS.items() if not isinstance(parameter.default, str)]
    return {name: np.array([float(c.params.get(name, math.nan)) for c, _ in rows]) for name in params}


def _predicted(imported: ImportedTimes, model: TableModel, objective: Objective) -> dict[Configuration, Estimate]:
    """Of every exact configuration of a technique that was timed."""
    known = {c.technique for c in imported.repeats_ms if c.is_exact}
    configs = [c for c in imported.counts if c.technique in known and c.is_exact]
    rows = [(c, i) for c in configs for i in range(len(imported.frames))]
    labels = {"technique": tuple(c.technique for c, _ in rows)}
    table = TimingTable(_features(imported, rows), labels, ((math.nan,),) * len(rows))
    made = predict_groups(model, table)
    n = len(imported.frames)
    return {c: _over_frames(c, made[n * k : n * (k + 1)], objective) for k, c in enumerate(configs)}


def _over_frames(config: Configuration, frames: Sequence[Prediction], objective: Objective) -> Estimate:
    """The slowest frame's prediction, or the mean of all; its interval is that of frames which err together."""
    ends = np.array([[p.time_ms, p.low_ms, p.high_ms] for p in frames])
    time, low, high = ends.max(axis=0) if objective == "max" else ends.mean(axis=0)
    # Of the slowest frame only those count that may be it.
    deciding = [p for p in frames if objective == "mean" or p.high_ms >= time]
    return Estimate(config, float(time), (float(low), float(high)), any(p.extrapolated for p in deciding))


def _measurement(imported: ImportedTimes, config: Configuration, seed: int) -> Measurement:
    counts = tuple(
        {name: int(value) for name, value in frame.items() if value.is_integer()} for frame in imported.counts[config]
    )
    return Measurement(
        technique=config.technique,
        params=config.params,
        scene_key=imported.scene,
        frames=imported.frames,
        seed=seed,
        outcome="timed",
        compile_s=math.nan,
        stages_ms={"frame": imported.repeats_ms[config]},
        counts=counts,
        error=None,
        error_p999=None,
        device=imported.device,
        versions={},
        load=math.nan,
        message=f"imported from {Path(imported.source).name}",
    )


def _against_defaults(
    measurements: Mapping[Configuration, Measurement], best: dict[str, Any], objective: Objective
) -> dict[str, Any]:
    """The defaults that were timed, and the gains over them: ratios of times, at their intervals' far ends."""
    defaults = {name: m for name in TECHNIQUES if (m := measurements.get(configuration(name))) is not None}
    roles: dict[str, Measurement | None] = {
        "default": defaults.get(best["technique"]),
        "fastest_default": min(defaults.values(), key=lambda m: time_ms(m, objective), default=None),
    }
    found: dict[str, Any] = {"gain": {}}
    for role, m in roles.items():
        found[role] = None if m is None else _timed_entry(m, objective)
        if m is not None:
            found["gain"][f"over_{role}"] = time_ms(m, objective) / best["time_ms"]
            if found[role]["time_ms_interval"] and best["time_ms_interval"]:
                (low, high), (best_low, best_high) = found[role]["time_ms_interval"], best["time_ms_interval"]
                found["gain"][f"over_{role}_interval"] = [low / best_high, high / best_low]
    return found


def _cost_models(model: TableModel) -> list[dict[str, Any]]:
    found = []
    for (technique,), one in model.models.items():
        coefficients = {
            "fixed_ms" if not term.factors else term.name: cost
            for term, cost in zip(one.law.terms, one.law.costs_ms, strict=True)
        }
        found.append(
            {
                "technique": technique,
                "stage": "frame",
                "text": one.law.text,
                "terms": [name for name in coefficients if name != "fixed_ms"],
                "dropped": [{"term": left.term, "loo_error": _finite(left.error)} for left in one.left_out[:_DROPPED]],
                "coefficients": coefficients,
                "loo_error": _finite(one.error),
                "constant_loo_error": _finite(one.constant_error),
                "n": one.n_rows,
            }
        )
    return found


def _prediction(
    estimate: Estimate, measurements: Mapping[Configuration, Measurement], objective: Objective
) -> dict[str, Any]:
    measured = measurements.get(estimate.configuration)
    return {
        "technique": estimate.configuration.technique,
        "params": estimate.configuration.params,
        "predicted_ms": estimate.time_ms,
        "low_ms": _finite(estimate.interval_ms[0]),
        "high_ms": _finite(estimate.interval_ms[1]),
        "extrapolated": estimate.extrapolated,
        "measured_ms": None if measured is None else time_ms(measured, objective),
    }


def _timed_entry(measurement: Measurement, objective: Objective) -> dict[str, Any]:
    # One repeat says nothing about its noise.
    is_repeated = all(len(repeats) > 1 for repeats in measurement.stages_ms["frame"])
    return _entry(
        configuration(measurement.technique, measurement.params),
        time_ms(measurement, objective),
        time_interval_ms(measurement, objective) if is_repeated else None,
    ) | {"timed": True}


def _entry(config: Configuration, ms: float, interval_ms: tuple[float, float] | None) -> dict[str, Any]:
    return {
        "technique": config.technique,
        "params": config.params,
        "time_ms": ms,
        "time_ms_interval": None if interval_ms is None else list(map(_finite, interval_ms)),
        "error": None,
    }


def _lights(imported: ImportedTimes) -> float | None:
    counts = next(iter(imported.counts.values()))[0]
    return counts.get("lights")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
