"""T4, the open autotuning results format 1.0.0 (github.com/odgaard/TuningSchema), as Kernel Tuner writes it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tuning.formats.bounded_text import read_json
from tuning.formats.grouping import MS_PER, as_number, as_time_ms, as_values, cells, grouped, plain
from tuning.timing_table import TimingTable
from vtfs.files import write_atomically
from vtfs.input_error import InputError

VERSION = "1.0.0"

_UNITS = {"milliseconds": "ms", "microseconds": "us", "nanoseconds": "ns", "seconds": "s", "": "ms"}
_OBJECTIVE = "time"


def read_t4(path: Path | str) -> TimingTable:
    """Read results: the configuration as columns and labels, `times.runtimes` as repeats.

    Where there are no runtimes, the measurement of the first objective is the time. Results that are not `correct`
    are left out and counted.

    **Raises:** `InputError` that names the result and the field.
    """
    content = read_json(path)
    results = content.get("results")
    if not isinstance(results, list):
        raise InputError(f"{path}: `results` is no list; it must be one of T4's result objects.")
    version = content.get("schema_version", VERSION)
    if not isinstance(version, str) or not version.startswith("1."):
        raise InputError(f"{path}: `schema_version` = {version!r}: is unknown; this version of vtfs reads 1.x.x.")
    unit = _unit(_record(content, "metadata").get("timeunit", ""), f"{path}: `metadata.timeunit`")
    configurations: list[dict[str, Any]] = []
    repeats_ms: list[tuple[float, ...]] = []
    compile_ms: list[float] = []
    for index, result in enumerate(results):
        where = f"{path}: `results[{index}]`"
        if not isinstance(result, dict) or not isinstance(result.get("configuration"), dict):
            raise InputError(f"{where}: has no `configuration`; it must be an object of parameters.")
        if result.get("invalidity", "correct") != "correct":
            continue
        times = _record(result, "times")
        configurations.append(result["configuration"])
        repeats_ms.append(_repeats_ms(result, times, unit, where))
        compiling = times.get("compilation", times.get("compilation_time")) or 0.0
        compile_ms.append(as_number(compiling, f"{where}: `times.compilation`") * MS_PER[unit])
    if not configurations:
        raise InputError(f"{path}: holds no correct result with a time; it must hold one.")
    columns = as_values(configurations, str(path))
    n_untimed = len(results) - len(configurations)
    return grouped(columns, repeats_ms, compile_ms if any(compile_ms) else None, n_untimed)


def write_t4(path: Path | str, table: TimingTable) -> None:
    """Write results, a configuration being all columns and labels of a row.

    A compile time that is not known is written as 0, as a reader expects the field.

    **Raises:** `InputError` where the file cannot be written.
    """
    columns = cells(table)
    results = []
    for row, repeats in enumerate(table.repeats_ms):
        results.append(
            {
                "configuration": {name: plain(column[row]) for name, column in columns.items()},
                "times": {
                    "compilation": 0.0 if table.compile_ms is None else table.compile_ms[row],
                    "benchmark": sum(repeats),
                    "framework": 0.0,
                    "search_algorithm": 0.0,
                    "validation": 0.0,
                    "runtimes": list(repeats),
                },
                "invalidity": "correct",
                "correctness": 1,
                "measurements": [{"name": _OBJECTIVE, "value": sum(repeats) / len(repeats), "unit": "ms"}],
                "objectives": [_OBJECTIVE],
            }
        )
    content = {"schema_version": VERSION, "metadata": {"timeunit": "milliseconds"}, "results": results}
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False).encode())


def _repeats_ms(result: dict[str, Any], times: dict[str, Any], unit: str, where: str) -> tuple[float, ...]:
    runtimes = times.get("runtimes")
    if isinstance(runtimes, list) and runtimes:
        return tuple(as_time_ms(time, f"{where}: `times.runtimes`", unit) for time in runtimes)
    objectives = result.get("objectives")
    objective = objectives[0] if isinstance(objectives, list) and objectives else _OBJECTIVE
    measurements = result.get("measurements")
    for entry in measurements if isinstance(measurements, list) else ():
        if isinstance(entry, dict) and entry.get("name") == objective:
            value, at = entry.get("value"), f"{where}: measurement `{objective}`"
            own = _unit(entry["unit"], f"{at}: `unit`") if entry.get("unit") else unit
            values = value if isinstance(value, list) and value else [value]
            return tuple(as_time_ms(time, at, own) for time in values)
    raise InputError(f"{where}: has neither `times.runtimes` nor a measurement `{objective}`; it must have one.")


def _unit(name: object, where: str) -> str:
    unit = _UNITS.get(name, name) if isinstance(name, str) else None
    if unit not in MS_PER:
        raise InputError(f"{where} = {name!r}: is no unit of time; it must be one of {', '.join(_UNITS)[:-2]}.")
    return unit


def _record(content: dict[str, Any], key: str) -> dict[str, Any]:
    value = content.get(key)
    return value if isinstance(value, dict) else {}
