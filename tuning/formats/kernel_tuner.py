"""Kernel Tuner's cache: every configuration of a tuning run as JSON, with all its repeats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tuning.formats.bounded_text import json_object, read_text
from tuning.formats.grouping import Value, as_number, as_time_ms, as_values, cells, grouped, plain
from tuning.timing_table import TimingTable
from vtfs.files import write_atomically
from vtfs.input_error import InputError

_OF_RUN = {"device": "device_name", "kernel": "kernel_name"}
"""Labels that are one for the whole cache."""


def read_kernel_tuner(path: Path | str) -> TimingTable:
    """Read a cache, plain or gzip; one that Kernel Tuner still has open, without its last brackets, too.

    Parameters become columns where they are numbers and labels where they are texts; `device` and `kernel` are
    labels. What else was recorded (GFLOP/s, say) comes from the time, so it is no feature. Configurations that
    failed are left out and counted.

    **Raises:** `InputError` that names the configuration and the field.
    """
    content = json_object(_closed(read_text(path)), str(path))
    cache, names = content.get("cache"), content.get("tune_params_keys")
    if not isinstance(cache, dict) or not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{path}: needs a list `tune_params_keys` and an object `cache`; give a cache of Kernel Tuner."
        )
    params: list[dict[str, Any]] = []
    repeats_ms: list[tuple[float, ...]] = []
    compile_ms: list[float] = []
    for key, entry in cache.items():
        where = f"{path}: `cache[{key[:60]!r}]`"
        if not isinstance(entry, dict):
            raise InputError(f"{where}: is no object; it must hold the parameters and the time.")
        if isinstance(entry.get("time"), str) or "__error__" in entry:
            continue
        missing = next((name for name in names if name not in entry), None)
        if missing is not None:
            raise InputError(f"{where}: `{missing}` is missing; every configuration has all of tune_params_keys.")
        params.append({name: entry[name] for name in names})
        repeats_ms.append(_repeats_ms(entry, where))
        compile_ms.append(as_number(entry.get("compile_time") or 0.0, f"{where}: `compile_time`"))
    if not params:
        raise InputError(f"{path}: holds no configuration that was timed; tune some first.")
    columns = as_values(params, str(path))
    for label, field in _OF_RUN.items():
        if label not in columns and isinstance(content.get(field), str):
            columns[label] = [content[field]] * len(params)
    return grouped(columns, repeats_ms, compile_ms if any(compile_ms) else None, len(cache) - len(params))


def write_kernel_tuner(path: Path | str, table: TimingTable) -> None:
    """Write a cache: `device` and `kernel` for the whole run where all rows have the same, else as parameters.

    A compile time that is not known is written as 0, as a reader expects the field.

    **Raises:** `InputError` where a column has the name of a field, or the file cannot be written.
    """
    columns = cells(table)
    of_run: dict[str, Value] = {}
    for label in _OF_RUN:
        if len(set(table.labels.get(label, ()))) == 1:
            of_run[label] = columns.pop(label)[0]
    reserved = {"time", "times", "compile_time", "__error__"} & columns.keys()
    if reserved:
        raise InputError(f"{path}: a column is called `{min(reserved)}`, as a field of the cache is; rename it.")
    cache: dict[str, dict[str, object]] = {}
    for row, repeats in enumerate(table.repeats_ms):
        entry: dict[str, object] = {name: plain(column[row]) for name, column in columns.items()}
        # Texts may hold commas; JSON's quotes keep two keys apart then.
        key = ",".join(json.dumps(v) if isinstance(v, str) and {",", '"'} & set(v) else str(v) for v in entry.values())
        entry |= {
            "time": sum(repeats) / len(repeats),
            "times": list(repeats),
            "compile_time": 0.0 if table.compile_ms is None else table.compile_ms[row],
            "verification_time": 0,
            "benchmark_time": 0,
            "strategy_time": 0,
            "framework_time": 0,
        }
        cache[key] = entry
    content = {
        "device_name": of_run.get("device"),
        "kernel_name": of_run.get("kernel"),
        "problem_size": "",
        "tune_params_keys": list(columns),
        "tune_params": {
            name: list(dict.fromkeys(plain(value) for value in column)) for name, column in columns.items()
        },
        "objective": "time",
        "cache": cache,
    }
    write_atomically(path, json.dumps(content, indent=1, allow_nan=False).encode())


def _repeats_ms(entry: dict[str, Any], where: str) -> tuple[float, ...]:
    times = entry.get("times")
    if times is None:
        times = [entry.get("time")]
    if not isinstance(times, list) or not times:
        raise InputError(f"{where}: `times` is no list of times; it must hold at least one.")
    return tuple(as_time_ms(time, f"{where}: `time`") for time in times)


def _closed(text: str) -> str:
    """The text of a cache that is still being written, closed as Kernel Tuner closes it."""
    stripped = text.rstrip()
    if not stripped.endswith(","):
        return text
    return stripped[:-1] + "}}"
