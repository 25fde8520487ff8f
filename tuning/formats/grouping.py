"""Rows of any file as a `TimingTable`: which columns are numbers, and which rows are repeats of one another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

Value = float | str | None
"""A cell: a number, a text, or nothing."""

MS_PER = {"ns": 1e-6, "us": 1e-3, "ms": 1.0, "s": 1e3}


def as_number(value: object, where: str) -> float:
    """A finite float.

    **Raises:** `InputError` that starts with `where`.
    """
    if isinstance(value, int | float):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    raise InputError(f"{where} = {_shown(value)}: is not a number; correct it, or leave the column out (--ignore).")


def as_time_ms(value: object, where: str, unit: str = "ms") -> float:
    """Milliseconds, finite and not negative.

    **Raises:** `InputError` that starts with `where`.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} = {_shown(value)}: is not a time; write a number, or nothing where none was taken.")
    if not math.isfinite(value) or value < 0:
        raise InputError(f"{where} = {value:g}: a time is finite and not negative; correct it or remove the row.")
    return float(value) * MS_PER[unit]


def as_values(records: Sequence[Mapping[str, Any]], where: str) -> dict[str, list[Value]]:
    """Columns of JSON objects, in the order in which their names appear; `None` where an object has none.

    **Raises:** `InputError` where a column holds both numbers and texts, or anything else, with the record's place.
    """
    names = dict.fromkeys(name for record in records for name in record)
    columns: dict[str, list[Value]] = {}
    for name in names:
        column: list[Value] = []
        kinds: dict[type, object] = {}
        for index, record in enumerate(records):
            value = record.get(name)
            if value is not None and not isinstance(value, str):
                value = as_number(value, f"{where}: `{name}`, entry {index + 1}")
            if value is not None:
                kinds.setdefault(type(value), value)
            column.append(value)
        if len(kinds) > 1:
            raise InputError(
                f"{where}: `{name}` holds numbers ({kinds[float]:g}) and texts ({_shown(kinds[str])}); make them all "
                "the same, or leave it out (--ignore)."
            )
        columns[name] = column
    return columns


def grouped(
    columns: Mapping[str, Sequence[Value]],
    repeats_ms: Sequence[Sequence[float]],
    compile_ms: Sequence[float] | None = None,
    n_untimed: int = 0,
) -> TimingTable:
    """A row for each distinct combination of values, in the order of first appearance; others are its repeats.

    **Arguments:**

    - `columns`: of numbers or of texts each, `None` where there is none; a column of nothing at all is one of NaN.
    - `repeats_ms`: of each given row, at least one.
    - `compile_ms`: of each given row; of repeats the first.
    """
    first: dict[tuple[Value, ...], int] = {}
    merged: list[list[float]] = []
    kept: list[int] = []
    keys = zip(*columns.values(), strict=True) if columns else (() for _ in repeats_ms)
    for index, (key, times) in enumerate(zip(keys, repeats_ms, strict=True)):
        place = first.setdefault(key, len(merged))
        if place == len(merged):
            merged.append([])
            kept.append(index)
        merged[place].extend(times)
    numbers, labels = {}, {}
    for name, column in columns.items():
        if any(isinstance(value, str) for value in column):
            labels[name] = tuple(str(column[index] or "") for index in kept)
        else:
            values = (column[index] for index in kept)
            numbers[name] = np.array([math.nan if value is None else value for value in values], float)
    compiled = None if compile_ms is None else tuple(compile_ms[index] for index in kept)
    return TimingTable(numbers, labels, tuple(map(tuple, merged)), compiled, n_untimed)


def cells(table: TimingTable) -> dict[str, list[Value]]:
    """The columns and labels of a table as `grouped` takes them."""
    numbers = {
        name: [None if math.isnan(value) else value for value in column.tolist()]
        for name, column in table.columns.items()
    }
    return numbers | {name: list(column) for name, column in table.labels.items()}


def without(table: TimingTable, names: Sequence[str]) -> TimingTable:
    """Some columns left out: rows that only they told apart become repeats.

    **Raises:** `InputError` for a column that there is not.
    """
    columns = cells(table)
    for name in names:
        if name not in columns:
            raise InputError(f"--ignore {name}: there is no such column; there are {', '.join(columns) or 'none'}.")
        del columns[name]
    return grouped(columns, table.repeats_ms, table.compile_ms, table.n_untimed)


def rows_where(table: TimingTable, name: str, value: str) -> TimingTable:
    """Only the rows whose column holds `value`.

    **Raises:** `InputError` for a column that there is not, and where no row is left.
    """
    columns = cells(table)
    if name not in columns:
        raise InputError(f"--where {name}={value}: there is no such column; there are {', '.join(columns) or 'none'}.")
    column = columns[name]
    wanted: Value = value
    if name in table.columns:
        try:
            wanted = float(value)
        except ValueError:
            raise InputError(f"--where {name}={value}: `{name}` holds numbers; write one.") from None
    kept = [index for index, held in enumerate(column) if held == wanted]
    if not kept:
        held = ", ".join(dict.fromkeys(str(plain(held)) for held in column if held is not None))
        raise InputError(f"--where {name}={value}: no row has that; there are {held[:200] or 'no values'}.")
    return TimingTable(
        {other: held[kept] for other, held in table.columns.items()},
        {other: tuple(held[index] for index in kept) for other, held in table.labels.items()},
        tuple(table.repeats_ms[index] for index in kept),
        None if table.compile_ms is None else tuple(table.compile_ms[index] for index in kept),
        table.n_untimed,
    )


def plain(value: Value) -> int | float | str | None:
    """A whole number without its point, and everything else as it is: how cells are written."""
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:36]} ..."
