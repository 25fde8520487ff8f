"""`vtfs predict`: what a fitted model says of other rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from vtfs.cli.options import JsonOption, VerboseOption, check_file, set_log_level, write_json
from vtfs.cli.timing_data import FormatOption, IgnoreOption, MapOption, TimeOption, parsed_layout


def predict(
    model_file: Annotated[Path, typer.Argument(metavar="MODEL", help="What `vtfs fit --json` wrote.")],
    data: Annotated[
        Path, typer.Argument(metavar="DATA", help="Rows with the columns of the fitted table; times are not needed.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Write DATA here as CSV, with the predictions.", metavar="FILE")
    ] = None,
    time: TimeOption = None,
    map_file: MapOption = None,
    ignore: IgnoreOption = None,
    format_name: FormatOption = None,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Predict times, with 90 % intervals, in the order of the rows."""
    set_log_level(verbose)
    if out is not None:
        check_file("--out", out)
    layout = parsed_layout(time, None, map_file, ignore)
    from tuning.formats.bounded_text import read_json
    from tuning.formats.csv_table import read_features
    from tuning.formats.registry import read_table, recognised
    from tuning.label_groups import predict_groups
    from tuning.model_table import predictions_csv, predictions_json, print_predictions
    from tuning.table_model import TableModel

    model = TableModel.from_json(read_json(model_file))
    is_csv = (format_name or recognised(data)) == "csv"
    # What was text in the fitted table is text here, also where it looks like numbers.
    features = replace(layout, labels=(*layout.labels, *model.label_names))
    table = read_features(data, features) if is_csv else read_table(data, layout, format_name)
    predictions = predict_groups(model, table)
    if out is not None:
        from vtfs.files import write_atomically

        write_atomically(out, predictions_csv(table, predictions).encode())
    write_json(json_file, predictions_json(predictions))
    if json_file == "-":
        return
    if out is None and json_file is None:
        print_predictions(table, predictions)
    for target in filter(None, (out, json_file)):
        print(f"{len(predictions)} predictions: {target}")
