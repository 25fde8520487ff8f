"""`measurements.jsonl`: one measurement a line, only ever appended to, so that a kill loses no completed one."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_args

from tuning.measurement import Measurement, Outcome
from vtfs.input_error import InputError

SCHEMA = 1

T = TypeVar("T")


def append_measurement(path: Path | str, measurement: Measurement) -> None:
    """Add one line and make sure that it is on the disk; what a kill left of a line is cut off first.

    NaN and infinity are written as null.

    **Raises:** `InputError` where the file cannot be written or the disk is full; the file is then as long as before.
    """
    path = Path(path)
    line = _to_line(measurement)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a+b", buffering=0) as file:
            file.seek(0)
            content = file.read()
            _, torn = _split(content)
            length = len(content) - len(torn)
            if torn:
                file.truncate(length)
            try:
                # A last line that is complete but for its end of line was kept when reading, and is kept here.
                _write_all(file, line if not length or content[length - 1 : length] == b"\n" else b"\n" + line)
                os.fsync(file.fileno())
            except OSError:
                file.truncate(length)
                raise
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); free some space or choose another folder."
        ) from error


def read_measurements(path: Path | str) -> list[Measurement]:
    """Every measurement of the file, in order. A last line that was torn by a kill is left out.

    **Raises:** `InputError` for a file that cannot be read, and, with its number, for any other line that is no
    measurement or has an unknown schema.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give a measurements.jsonl.") from error
    lines, _ = _split(content)
    measurements = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            measurements.append(_from_line(line))
        except _DAMAGE as error:
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: line {number}: {reason}; remove that line or choose another folder.") from error
    return measurements


def _split(content: bytes) -> tuple[list[bytes], bytes]:
    """Complete lines, and what is left of a torn one (nothing, as a rule)."""
    *lines, last = content.split(b"\n")
    if not last:
        return lines, b""
    # No part of a JSON object but the whole is valid JSON: a line that lacks only its end can be told from a torn one.
    try:
        _loaded(last)
    except _DAMAGE:
        return lines, last
    return [*lines, last], b""


def _write_all(file: io.RawIOBase | io.FileIO, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def _to_line(measurement: Measurement) -> bytes:
    fields = {"schema": measurement.schema, **dataclasses.asdict(measurement)}
    # `default`: NumPy's integers are no Python ones.
    text = json.dumps(_without_nan(fields), allow_nan=False, default=lambda scalar: scalar.item())
    return text.encode() + b"\n"


def _without_nan(value: Any) -> Any:
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(inner) for inner in value]
    return value


_DAMAGE = (ValueError, KeyError, TypeError, OverflowError, RecursionError)


def _loaded(line: bytes) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    try:
        fields = json.loads(line.decode(), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({str(error) or 'nested too deeply'})") from error
    if not isinstance(fields, dict):
        raise ValueError("not a measurement")
    return fields


def _from_line(line: bytes) -> Measurement:
    """**Raises:** one of `_DAMAGE`, with the reason."""
    fields = _loaded(line)
    if fields.get("schema") != SCHEMA:
        raise ValueError(f"`schema` = {fields.get('schema')!r} is unknown, this version reads {SCHEMA}")
    known = {field.name: field for field in dataclasses.fields(Measurement)}
    for name in fields:
        if name not in known:
            raise ValueError(f"`{name}` is not a field of a measurement")
    values = {}
    for name, field in known.items():
        if name in fields:
            try:
                values[name] = _FIELDS[name](fields[name])
            except (ValueError, TypeError, OverflowError, AttributeError) as error:
                raise ValueError(f"`{name}`: {error}") from error
        elif field.default is dataclasses.MISSING:
            raise ValueError(f"`{name}` is missing")
    measurement = Measurement(**values)
    if measurement.outcome == "timed":
        _check_timed(measurement)
    return measurement


def _check_timed(measurement: Measurement) -> None:
    """What the fit and the report rely on."""
    n_frames = len(measurement.frames)
    frame_ms = measurement.stages_ms.get("frame", ())
    if not n_frames or len(frame_ms) != n_frames or not frame_ms[0] or len(measurement.counts) != n_frames:
        raise ValueError("`stages_ms.frame` and `counts` need an entry for each of `frames`, and times for the first")


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is not a text")
    return value


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{value!r} is not a whole number")
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{value!r} is not a number")
    return float(value)


def _number_or_nan(value: Any) -> float:
    return math.nan if value is None else _number(value)


def _number_or_none(value: Any) -> float | None:
    return None if value is None else _number(value)


def _setting(value: Any) -> int | float | str:
    if isinstance(value, str):
        return value
    return _whole(value) if isinstance(value, int) else _number(value)


def _outcome(value: Any) -> Outcome:
    if value not in get_args(Outcome):
        raise ValueError(f"{value!r} is not one of {', '.join(get_args(Outcome))}")
    return value


def _each(parse: Callable[[Any], T]) -> Callable[[Any], tuple[T, ...]]:
    def parse_all(value: Any) -> tuple[T, ...]:
        if not isinstance(value, list):
            raise ValueError(f"{value!r} is not a list")
        return tuple(parse(item) for item in value)

    return parse_all


def _keyed(parse: Callable[[Any], T]) -> Callable[[Any], dict[str, T]]:
    def parse_all(value: Any) -> dict[str, T]:
        if not isinstance(value, dict):
            raise ValueError(f"{value!r} is not an object")
        return {key: parse(item) for key, item in value.items()}

    return parse_all


_FIELDS: dict[str, Callable[[Any], Any]] = {
    "technique": _text,
    "params": _keyed(_setting),
    "scene_key": _text,
    "frames": _each(_whole),
    "seed": _whole,
    "outcome": _outcome,
    "compile_s": _number_or_nan,
    "stages_ms": _keyed(_each(_each(_number_or_nan))),
    "counts": _each(_keyed(_whole)),
    "error": _number_or_none,
    "error_p999": _number_or_none,
    "device": _text,
    "versions": _keyed(_text),
    "load": _number_or_nan,
    "message": _text,
    "schema": _whole,
}
