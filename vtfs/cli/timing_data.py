"""Options of the commands that read timings, and the table that they name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vtfs.input_error import InputError

if TYPE_CHECKING:
    from tuning.formats.csv_table import CsvLayout
    from tuning.timing_table import TimingTable

_PANEL = "Data"

DataArgument = Annotated[
    Path,
    typer.Argument(
        metavar="DATA",
        help="Timings: measurements.jsonl, CSV, PresentMon or Tracy CSV, Kernel Tuner cache, T4, Extra-P JSONL.",
    ),
]
TimeOption = Annotated[
    str | None,
    typer.Option(
        "--time",
        help="The column of times (CSV, PresentMon), or Extra-P's metric.",
        metavar="COLUMN",
        show_default="the one whose name says so",
        rich_help_panel=_PANEL,
    ),
]
UnitOption = Annotated[
    str | None,
    typer.Option(
        "--unit",
        help="Of the times: ns, us, ms or s.",
        metavar="UNIT",
        show_default="what the column's name ends in, else ms",
        rich_help_panel=_PANEL,
    ),
]
MapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        help="What a CSV file's columns are, as TOML: time, unit, ignore, labels and a table named rename.",
        metavar="FILE",
        rich_help_panel=_PANEL,
    ),
]
IgnoreOption = Annotated[
    str | None,
    typer.Option("--ignore", help="Columns to leave out, comma-separated.", metavar="A,B", rich_help_panel=_PANEL),
]
WhereOption = Annotated[
    list[str] | None,
    typer.Option(
        "--where", help="Only rows that have this value. Repeatable.", metavar="COLUMN=VALUE", rich_help_panel=_PANEL
    ),
]
FormatOption = Annotated[
    str | None,
    typer.Option(
        "--format",
        help="csv, measurements, presentmon, tracy, kernel_tuner, t4 or extra_p.",
        metavar="NAME",
        show_default="recognised",
        rich_help_panel=_PANEL,
    ),
]


def parsed_layout(time: str | None, unit: str | None, map_file: Path | None, ignore: str | None) -> CsvLayout:
    """What the options and the TOML file say; the options come first."""
    from tuning.formats.csv_table import CsvLayout, read_layout

    ignored = tuple(name.strip() for name in (ignore or "").split(",") if name.strip())
    given = CsvLayout(time, unit, ignored)
    return given.over(read_layout(map_file)) if map_file else given


def chosen_rows(table: TimingTable, conditions: list[str] | None) -> TimingTable:
    """Those that meet every `--where`."""
    from tuning.formats.grouping import rows_where

    for condition in conditions or ():
        name, equals, value = condition.partition("=")
        if not equals or not name.strip():
            raise InputError(f"--where {condition}: must be COLUMN=VALUE, as technique=forward.")
        table = rows_where(table, name.strip(), value.strip())
    return table
