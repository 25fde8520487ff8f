"""Which formats there are, which of them a file is in, and reading and writing by name."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

from tuning.formats.bounded_text import read_text
from tuning.formats.csv_table import CsvLayout, read_csv, write_csv
from tuning.formats.extra_p import read_extra_p, write_extra_p
from tuning.formats.grouping import without
from tuning.formats.kernel_tuner import read_kernel_tuner, write_kernel_tuner
from tuning.formats.measurements import read_measurements
from tuning.formats.presentmon import is_presentmon, read_presentmon
from tuning.formats.t4 import read_t4, write_t4
from tuning.formats.tracy import is_tracy, read_tracy
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

_READERS: dict[str, Callable[[Path, CsvLayout], TimingTable]] = {
    "csv": read_csv,
    "measurements": lambda path, _: read_measurements(path),
    "presentmon": lambda path, layout: read_presentmon(path, layout.time),
    "tracy": lambda path, _: read_tracy(path),
    "kernel_tuner": lambda path, _: read_kernel_tuner(path),
    "t4": lambda path, _: read_t4(path),
    "extra_p": lambda path, layout: read_extra_p(path, layout.time, layout.unit),
}

WRITERS: dict[str, Callable[[Path, TimingTable], None]] = {
    "csv": write_csv,
    "kernel_tuner": write_kernel_tuner,
    "t4": write_t4,
    "extra_p": write_extra_p,
}

FORMATS = tuple(_READERS)


def read_table(path: Path, layout: CsvLayout, format_name: str | None = None) -> TimingTable:
    """Read a file of timings, whose format is recognised unless it is named.

    Columns to be ignored are left out; rows that only they told apart are then repeats.

    **Raises:** `InputError` for an unknown format, and whatever its reader refuses.
    """
    name = format_name or recognised(path)
    if name not in _READERS:
        raise InputError(f"--format {name}: unknown; choose from {', '.join(_READERS)}.")
    table = _READERS[name](path, layout)
    return table if name == "csv" else without(table, layout.ignore)


def recognised(path: Path) -> str:
    """The format of a file, by how it starts.

    **Raises:** `InputError` for a file that cannot be read or is in none of the formats.
    """
    text = read_text(path).lstrip()
    if not text.startswith("{"):
        header = next(csv.reader([text.partition("\n")[0].strip()]), [])
        return "presentmon" if is_presentmon(header) else "tracy" if is_tracy(header) else "csv"
    first = text.partition("\n")[0]
    if first.rstrip().endswith("}") and '"stages_ms"' in first:
        return "measurements"
    if first.rstrip().endswith("}") and '"params"' in first and '"value"' in first:
        return "extra_p"
    for name, key in (("kernel_tuner", '"tune_params_keys"'), ("t4", '"results"')):
        if key in text:
            return name
    raise InputError(f"{path}: is JSON of no format known here; name one with --format: {', '.join(_READERS)}.")
