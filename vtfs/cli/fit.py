"""`vtfs fit`: cost models of any table of times."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vtfs.cli.options import JsonOption, VerboseOption, set_log_level, write_json
from vtfs.cli.status import Status
from vtfs.cli.timing_data import (
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


def fit(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DATA]",
            help="Timings: measurements.jsonl, CSV, PresentMon or Tracy CSV, Kernel Tuner cache, T4, Extra-P JSONL. "
            "Default: --published van_oosten_2017.",
        ),
    ] = None,
    published: Annotated[
        str | None,
        typer.Option(
            help="A paper's tables instead of DATA: van_oosten_2017, olsson_2011 or olsson_2012.", metavar="NAME"
        ),
    ] = None,
    time: TimeOption = None,
    unit: UnitOption = None,
    map_file: MapOption = None,
    ignore: IgnoreOption = None,
    where: WhereOption = None,
    format_name: FormatOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything that is random.")] = 0,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Fit cost models: for each combination of labels the smallest law that the times support."""
    set_log_level(verbose)
    if data is not None and published is not None:
        raise InputError(f"--published {published}: goes without DATA ({data}); leave one of them out.")
    layout = parsed_layout(time, unit, map_file, ignore)
    from tuning.answers import answer_lines, answers
    from tuning.budget_lines import sizes_within
    from tuning.formats.grouping import without
    from tuning.formats.registry import read_table
    from tuning.label_groups import fit_groups
    from tuning.published.tables import DEFAULT, read_published
    from tuning.transferable import explaining_columns
    from vtfs.device import keep_compiled_programs

    notes = []
    if data is None:
        source = published or DEFAULT
        whole = table = without(read_published(source), layout.ignore)
    else:
        source = str(data)
        whole = read_table(data, layout, format_name)
        table, left_out = explaining_columns(whole)
        if left_out:
            notes.append(f"Not taken for features: {', '.join(left_out)}.")
    if table.n_untimed:
        notes.append(
            f"{table.n_untimed} {'row has' if table.n_untimed == 1 else 'rows have'} no time, and were skipped."
        )
    table, whole = chosen_rows(table, where), chosen_rows(whole, where)
    keep_compiled_programs()
    with Status() as status:
        status.say(f"fitting {len(table)} rows")
        model = fit_groups(table, seed)
        status.say("asking what the models say")
        sizes = tuple(sizes_within(model))
        found = answers(model, sizes, whole, seed)
    write_json(json_file, model.as_json() | {"fitted_to": source, "answers": found})
    if json_file == "-":
        return
    from tuning.model_table import print_models

    print(f"{source}: {len(table)} rows, {len(model.models)} {'model' if len(model.models) == 1 else 'models'}")
    for note in notes:
        print(note)
    print_models(model)
    for line in (*(one.line for one in sizes), *answer_lines(found)):
        print(line)
    if json_file:
        print(f"Model: {json_file}")
