"""CSV from anywhere: columns that are not the time are features, parameters or labels."""

from __future__ import annotations

import csv
import io
import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tuning.formats.bounded_text import read_text
from tuning.formats.csv_sheet import Sheet, read_sheet
from tuning.formats.grouping import MS_PER, Value, as_time_ms, cells, grouped, plain
from tuning.timing_table import TimingTable
from vtfs.files import write_atomically
from vtfs.input_error import InputError

TIME_MS = "time_ms"
"""The column of times in the CSV files written here."""

COMPILE_MS = "compile_ms"

_TIME_NAMES = ("", "time", "frametime", "frame", "gputime", "gpu", "duration", "elapsed", "mean", "median")
"""What is left of a name of the time without its unit."""

_UNIT_SUFFIX = re.compile(r"(?:^|[ _.(\[])(milliseconds|microseconds|nanoseconds|seconds|ns|us|µs|ms|s|sec)[)\]]?$")
_UNITS = {
    "milliseconds": "ms",
    "microseconds": "us",
    "nanoseconds": "ns",
    "seconds": "s",
    "sec": "s",
    "µs": "us",
} | {unit: unit for unit in MS_PER}


@dataclass(frozen=True)
class CsvLayout:
    """What a CSV file's columns are.

    - `time`: the column of times; `None`: the one whose name says so, as `time_ms`, `frame_us`, `ms`.
    - `unit`: `ms`, `us`, `ns` or `s`; `None`: what the name ends in, else ms.
    - `ignore`: columns to leave out. `labels`: columns of text even where they look like numbers.
    - `rename`: the file's name of a column, and ours.
    """

    time: str | None = None
    unit: str | None = None
    ignore: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()
    rename: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        if self.unit is not None and self.unit not in MS_PER:
            raise InputError(f"--unit {self.unit}: must be one of {', '.join(MS_PER)}.")

    def over(self, other: CsvLayout) -> CsvLayout:
        """This one, and where it says nothing, `other`."""
        return CsvLayout(
            self.time or other.time,
            self.unit or (other.unit if self.time in (None, other.time) else None),
            (*other.ignore, *self.ignore),
            (*other.labels, *self.labels),
            {**other.rename, **self.rename},
        )


def read_layout(path: Path | str) -> CsvLayout:
    """A layout from TOML: `time`, `unit`, `ignore`, `labels` and a table `[rename]`.

    **Raises:** `InputError` that names the key.
    """
    try:
        given = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not TOML ({error}); correct it there.") from error
    known: dict[str, Any] = {}
    for key, value in given.items():
        if key in ("time", "unit"):
            is_right, right = isinstance(value, str), "a text"
        elif key in ("ignore", "labels"):
            is_right = isinstance(value, list) and all(isinstance(name, str) for name in value)
            right = "a list of column names"
        elif key == "rename":
            is_right = isinstance(value, dict) and all(isinstance(name, str) for name in value.values())
            right = 'a table of names, as TileSize = "tile_px"'
        else:
            raise InputError(f"{path}: `{key}`: unknown; there are time, unit, ignore, labels and [rename].")
        if not is_right:
            raise InputError(f"{path}: `{key}` = {value!r}: must be {right}.")
        known[key] = tuple(value) if isinstance(value, list) else value
    return CsvLayout(**known)


def read_csv(path: Path | str, layout: CsvLayout | None = None) -> TimingTable:
    """Read one row a frame, or a repeat: rows that agree in all but the time are repeats.

    A row with an empty time was not timed: it is left out and counted.

    **Raises:** `InputError` for a file that is no CSV, a missing time column, a text in a column of numbers, and a
    time that is negative or not finite.
    """
    sheet, layout = arranged(read_sheet(path), layout or CsvLayout())
    times_ms = sheet_times_ms(sheet, layout)
    timed = [row for row, time in enumerate(times_ms) if time is not None]
    if not timed:
        raise InputError(f"{path}: no row has a time in `{time_column(sheet, layout)}`; fill in some.")
    columns, labels = feature_cells(sheet, layout)
    compile_ms = columns.pop(COMPILE_MS, None)
    taken = {name: [column[row] for row in timed] for name, column in {**columns, **labels}.items()}
    known = compile_ms is not None and all(compile_ms[row] is not None for row in timed)
    return grouped(
        {name: taken[name] for name in sheet.columns if name in taken},
        [(time,) for time in times_ms if time is not None],
        [float(compile_ms[row] or 0) for row in timed] if known and compile_ms is not None else None,
        len(sheet) - len(timed),
    )


def read_features(path: Path | str, layout: CsvLayout | None = None) -> TimingTable:
    """Every row of the file by itself, in order, with NaN for the time: what a model is asked about.

    A time column may be there; it is no feature.

    **Raises:** `InputError` as `read_csv`, but for times.
    """
    sheet, given = read_sheet(path), layout or CsvLayout()
    there = {*sheet.columns, *given.rename.values()}
    given = replace(
        given,
        ignore=tuple(name for name in given.ignore if name in there),
        labels=tuple(name for name in given.labels if name in there),
        rename={name: ours for name, ours in given.rename.items() if name in sheet.columns},
    )
    sheet, layout = arranged(sheet, given)
    columns, labels = feature_cells(sheet, layout)
    columns.pop(COMPILE_MS, None)
    numbers = {
        name: np.array([math.nan if value is None else value for value in column], float)
        for name, column in columns.items()
    }
    return TimingTable(
        numbers, {name: tuple(map(str, column)) for name, column in labels.items()}, ((math.nan,),) * len(sheet)
    )


def arranged(sheet: Sheet, layout: CsvLayout) -> tuple[Sheet, CsvLayout]:
    """The sheet with our names and without what is to be ignored; the layout in our names.

    **Raises:** `InputError` where the layout names a column, other than the time, that there is not.
    """
    for name in layout.rename:
        sheet.column(name)
    ours = {name: layout.rename.get(name, name) for name in sheet.columns}
    if len(set(ours.values())) < len(ours):
        raise InputError(f"{sheet.path}: [rename] gives two columns one name; choose another.")
    # A column may be named as the file has it or as we have it.
    for name in (*layout.ignore, *layout.labels):
        if name not in ours.values():
            sheet.column(name)
    ignored = {ours.get(name, name) for name in layout.ignore}
    columns = {ours[name]: column for name, column in sheet.columns.items() if ours[name] not in ignored}
    in_ours = CsvLayout(
        time=layout.time and ours.get(layout.time, layout.time),
        unit=layout.unit or (unit_of(layout.time) if layout.time else None),
        labels=tuple(ours.get(name, name) for name in layout.labels),
    )
    return replace(sheet, columns=columns), in_ours


def feature_cells(sheet: Sheet, layout: CsvLayout) -> tuple[dict[str, list[Value]], dict[str, list[Value]]]:
    """What is not the time: columns of numbers, and columns of texts."""
    time = layout.time or _apparent_time(sheet)
    numbers: dict[str, list[Value]] = {}
    labels: dict[str, list[Value]] = {}
    for name in sheet.columns:
        if name == time:
            continue
        values = sheet.values(name, as_text=name in layout.labels)
        is_text = any(isinstance(value, str) for value in values)
        (labels if is_text else numbers)[name] = values
    return numbers, labels


def sheet_times_ms(sheet: Sheet, layout: CsvLayout) -> list[float | None]:
    """The times of an arranged sheet; `None` where the cell is empty.

    **Raises:** `InputError` for a missing column, a text, and a time that is negative or not finite.
    """
    name = time_column(sheet, layout)
    unit = layout.unit or unit_of(name) or "ms"
    times: list[float | None] = []
    for row, cell in enumerate(sheet.columns[name]):
        stripped = cell.strip()
        try:
            value: object = float(stripped)
        except ValueError:
            value = stripped
        times.append(as_time_ms(value, sheet.at(row, name), unit) if stripped else None)
    return times


def time_column(sheet: Sheet, layout: CsvLayout) -> str:
    """The column of times: the layout's, or the one whose name says so.

    **Raises:** `InputError` where there is none, or more than one.
    """
    if layout.time is not None:
        sheet.column(layout.time)
        return layout.time
    found = _apparent_time(sheet)
    if found is None:
        raise InputError(
            f"{sheet.path}: which column is the time? Name it `{TIME_MS}`, or say it with --time: "
            f"{', '.join(sheet.columns)}."
        )
    return found


def unit_of(name: str) -> str | None:
    """The unit that a column's name ends in, as in `frame_us`, `GPU (ms)` or `ns`."""
    match = _UNIT_SUFFIX.search(name.lower())
    return _UNITS[match[1]] if match else None


def write_csv(path: Path | str, table: TimingTable) -> None:
    """One line a repeat: columns, labels, and the time in `time_ms`. Empty where a row has no value.

    **Raises:** `InputError` where a column already has the name of the time, or the file cannot be written.
    """
    columns = cells(table)
    extra = [TIME_MS] if table.compile_ms is None else [COMPILE_MS, TIME_MS]
    for name in extra:
        if name in columns:
            raise InputError(f"{path}: a column is called `{name}`, as the times are here; rename it.")
    text = io.StringIO(newline="")
    # A lone carriage return ends a line when read, and Python 3.11 does not quote it by itself.
    has_returns = any("\r" in cell for column in table.labels.values() for cell in column)
    quoting = csv.QUOTE_NONNUMERIC if has_returns else csv.QUOTE_MINIMAL
    writer = csv.writer(text, lineterminator="\n", quoting=quoting)
    writer.writerow([*columns, *extra])
    for row, repeats in enumerate(table.repeats_ms):
        values = [column[row] for column in columns.values()]
        if table.compile_ms is not None:
            values.append(table.compile_ms[row])
        shown = [plain(value) for value in values]
        for time in repeats:
            writer.writerow([*shown, plain(time)])
    write_atomically(path, text.getvalue().encode())


def _apparent_time(sheet: Sheet) -> str | None:
    """The one column whose name says that it holds times; else the one that has a unit of time."""
    if TIME_MS in sheet.columns:
        return TIME_MS
    for says_time in (_is_called_time, unit_of):
        found = [name for name in sheet.columns if name != COMPILE_MS and says_time(name)]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def _is_called_time(name: str) -> bool:
    match = _UNIT_SUFFIX.search(name.lower())
    stem = re.sub(r"[^a-z]", "", name.lower()[: match.start()] if match else name.lower())
    return stem in _TIME_NAMES if match else stem in ("time", "frametime", "gputime")
