"""Our own `measurements.jsonl` as a table: a row for each stage of each frame of each configuration."""

from __future__ import annotations

import math
from pathlib import Path

from tuning.formats.grouping import Value, grouped
from tuning.record import read_measurements as read_record
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError


def read_measurements(path: Path | str) -> TimingTable:
    """Read a run's record: parameters and counts as columns (or labels), `technique`, `stage`, `scene` and `device`
    as labels, `frame` as a column. Configurations that failed are left out and counted.

    **Raises:** `InputError` for a damaged line, with its number, and where nothing was timed.
    """
    records: list[dict[str, Value]] = []
    repeats_ms: list[tuple[float, ...]] = []
    compile_ms: list[float] = []
    n_untimed = 0
    measurements = read_record(path)
    # What one configuration of a technique counts and another does not is of a level that its tree does not have: 0.
    counted: dict[str, dict[str, float]] = {}
    for measurement in measurements:
        for counts in measurement.counts:
            counted.setdefault(measurement.technique, {}).update(dict.fromkeys(counts, 0.0))
    for measurement in measurements:
        if measurement.outcome != "timed":
            n_untimed += 1
            continue
        labels: dict[str, Value] = {
            "technique": measurement.technique,
            "scene": measurement.scene_key,
            "device": measurement.device,
        }
        params: dict[str, Value] = {
            name: value if isinstance(value, str) else float(value) for name, value in measurement.params.items()
        }
        for stage, frames in measurement.stages_ms.items():
            for frame, counts, repeats in zip(measurement.frames, measurement.counts, frames, strict=False):
                finite = tuple(ms for ms in repeats if math.isfinite(ms))
                if finite:
                    own = counted[measurement.technique] | {name: float(count) for name, count in counts.items()}
                    records.append({**labels, "stage": stage, **params, "frame": float(frame), **own})
                    repeats_ms.append(finite)
                    compile_ms.append(1e3 * measurement.compile_s if math.isfinite(measurement.compile_s) else 0.0)
    if not records:
        raise InputError(f"{path}: holds no configuration that was timed; measure some with vtfs tune.")
    names = dict.fromkeys(name for record in records for name in record)
    columns = {name: [record.get(name) for record in records] for name in names}
    return grouped(columns, repeats_ms, compile_ms if any(compile_ms) else None, n_untimed)
