"""Extra-P's JSON Lines: one measurement a line, numbers as parameters, everything else in the call path."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from tuning.formats.bounded_text import json_object, read_text
from tuning.formats.csv_table import unit_of
from tuning.formats.grouping import as_time_ms, as_values, grouped, plain
from tuning.timing_table import TimingTable
from vtfs.files import write_atomically
from vtfs.input_error import InputError

_METRIC = "time_ms"
_DEFAULT_METRIC = "time"


def read_extra_p(path: Path | str, metric: str | None = None, unit: str | None = None) -> TimingTable:
    """Read lines of `params`, `value` (one, or a list of repeats), and perhaps `callpath` and `metric`.

    A call path of `name=value` parts, as `write_extra_p` makes it, becomes labels; any other one is the label
    `callpath`.

    **Arguments:**

    - `metric`: of which the values are times; `None`: the only one.
    - `unit`: of the times; `None`: what the metric's name ends in, else ms.

    **Raises:** `InputError` that names the line and the field, and where several metrics are there to choose from.
    """
    lines = [(n, line) for n, line in enumerate(read_text(path).split("\n"), start=1) if line.strip()]
    entries = [(f"{path}: line {n}", json_object(line, f"{path}: line {n}")) for n, line in lines]
    metrics = dict.fromkeys(str(entry.get("metric", _DEFAULT_METRIC)) for _, entry in entries)
    if metric is None and len(metrics) > 1:
        raise InputError(f"{path}: holds the metrics {', '.join(metrics)}; say with --time which is the time.")
    wanted = metric if metric is not None else next(iter(metrics))
    if wanted not in metrics:
        raise InputError(f"{path}: has no metric `{wanted}`; it has {', '.join(metrics)}.")
    unit = unit or unit_of(wanted) or "ms"
    records: list[dict[str, Any]] = []
    repeats_ms: list[tuple[float, ...]] = []
    for where, entry in entries:
        if str(entry.get("metric", _DEFAULT_METRIC)) != wanted:
            continue
        params = entry.get("params")
        if not isinstance(params, dict):
            raise InputError(f"{where}: `params` is missing; it must be an object of numbers.")
        value = entry.get("value")
        values = value if isinstance(value, list) and value else [value]
        repeats_ms.append(tuple(as_time_ms(each, f"{where}: `value`", unit) for each in values))
        records.append({**params, **_labels(entry.get("callpath"))})
    return grouped(as_values(records, str(path)), repeats_ms)


def write_extra_p(path: Path | str, table: TimingTable) -> None:
    """Write a line for each row, its repeats as the list `value`; labels as the call path `name=value->name=value`.

    Extra-P itself (4.2.5) reads only files in which every call path was measured at every point.

    **Raises:** `InputError` where a row has no number in a column, as Extra-P needs all parameters in all lines, or
    the file cannot be written.
    """
    for name, column in table.columns.items():
        if any(map(math.isnan, column.tolist())):
            raise InputError(f"{path}: `{name}` is empty in some rows, which Extra-P cannot read; drop it (--ignore).")
    lines = []
    for row, repeats in enumerate(table.repeats_ms):
        entry: dict[str, object] = {
            "params": {name: plain(float(column[row])) for name, column in table.columns.items()}
        }
        if table.labels:
            parts = (f"{quote(name, '')}={quote(label[row], ' ')}" for name, label in table.labels.items())
            entry["callpath"] = "->".join(parts)
        lines.append(json.dumps({**entry, "metric": _METRIC, "value": list(repeats)}, allow_nan=False))
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _labels(callpath: object) -> dict[str, str]:
    if callpath is None:
        return {}
    parts = [part.partition("=") for part in str(callpath).split("->")]
    if all(name and equals for name, equals, _ in parts):
        return {unquote(name): unquote(value) for name, _, value in parts}
    return {"callpath": str(callpath)}
