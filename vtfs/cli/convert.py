"""`vtfs convert`: timings for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vtfs.cli.timing_data import (
    DataArgument,
    FormatOption,
    IgnoreOption,
    MapOption,
    TimeOption,
    UnitOption,
    WhereOption,
    chosen_rows,
    parsed_layout,
)
from vtfs.input_error import InputError

_BY_SUFFIX = {".csv": "csv", ".jsonl": "extra_p"}


def convert(
    data: DataArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The file to write.")],
    to: Annotated[
        str | None,
        typer.Option(
            help="csv, t4, kernel_tuner or extra_p.", metavar="NAME", show_default="csv for .csv, extra_p for .jsonl"
        ),
    ] = None,
    time: TimeOption = None,
    unit: UnitOption = None,
    map_file: MapOption = None,
    ignore: IgnoreOption = None,
    where: WhereOption = None,
    format_name: FormatOption = None,
) -> None:
    """Write timings in another format, with every column and every repeat."""
    layout = parsed_layout(time, unit, map_file, ignore)
    from tuning.formats.registry import WRITERS, read_table

    target = to or _BY_SUFFIX.get(out.suffix.lower())
    if target not in WRITERS:
        raise InputError(f"--to {target or 'is missing'}: {out} can be one of {', '.join(WRITERS)}; say which.")
    table = chosen_rows(read_table(data, layout, format_name), where)
    WRITERS[target](out, table)
    skipped = f", {table.n_untimed} without a time left out" if table.n_untimed else ""
    print(f"{len(table)} rows{skipped}: {out} ({target})")
