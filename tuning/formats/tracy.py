"""Tracy's `tracy-csvexport`: zones as stages, from its summary, from each CPU zone (`-u`) and each GPU zone (`-g`)."""

from __future__ import annotations

from pathlib import Path

from tuning.formats.csv_sheet import Sheet, read_sheet
from tuning.formats.grouping import Value, as_time_ms, grouped
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

TIME_COLUMNS = ("exec_time_ns", "GPU execution time", "mean_ns")
"""Of `-u`, of `-g`, and of the summary; all nanoseconds."""


def is_tracy(header: list[str]) -> bool:
    return header[:2] == ["name", "src_file"] and any(name in header for name in TIME_COLUMNS)


def read_tracy(path: Path | str) -> TimingTable:
    """Read an export: a row for each zone (`stage` is its name, `source` its file and line).

    Every run of a zone is a repeat; of a summary only the mean is known. Plots, which `-p` adds, are no zones.

    **Raises:** `InputError` for a file that is no such CSV, and for a time that is negative or no number.
    """
    sheet = read_sheet(path)
    column = next((name for name in TIME_COLUMNS if name in sheet.columns), None)
    if column is None or "name" not in sheet.columns:
        raise InputError(f"{path}: has none of {', '.join(TIME_COLUMNS)}; export zones with tracy-csvexport, -u or -g.")
    kept = [row for row, cell in enumerate(sheet.columns[column]) if cell.strip()]
    if not kept:
        raise InputError(f"{path}: no zone has a time in `{column}`; export zones with tracy-csvexport, -u or -g.")
    labels: dict[str, list[Value]] = {
        "stage": [sheet.columns["name"][row] for row in kept],
        "source": [_source(sheet, row) for row in kept],
    }
    times_ms = [(as_time_ms(sheet.number(row, column), sheet.at(row, column), "ns"),) for row in kept]
    return grouped(labels, times_ms)


def _source(sheet: Sheet, row: int) -> str:
    parts = [sheet.columns[name][row] for name in ("src_file", "src_line") if name in sheet.columns]
    return ":".join(part for part in parts if part)
