"""Fitted models and predictions as tables to read, as CSV and as JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import stdtrit

from tuning.formats.grouping import cells, plain
from tuning.table_model import Prediction, TableModel
from tuning.time_model import COVERAGE, TimeModel
from tuning.timing_table import TimingTable

_MOST_LEFT_OUT = 3
_MOST_MESSAGES = 5
_MOST_PREDICTIONS = 40


def cost_intervals_ms(model: TimeModel) -> list[tuple[float, float]]:
    """90 % intervals of the costs of the chosen law, from the covariance of their logarithms."""
    chosen = model.laws[0]
    spread = np.sqrt(np.maximum(np.diag(chosen.covariance), 0))
    factors = np.exp(float(stdtrit(model.degrees_of_freedom, (1 + COVERAGE) / 2)) * spread)
    return [(cost / f, cost * f) for cost, f in zip(chosen.law.costs_ms, factors.tolist(), strict=True)]


def print_models(model: TableModel) -> None:
    """A line a term, with its cost and its interval; beside the first, the error and what was left out."""
    from rich.console import Console
    from rich.table import Table

    values = {name: {key[i] for key in model.models} for i, name in enumerate(model.label_names)}
    same = [f"{name} {next(iter(held))}" for name, held in values.items() if len(held) == 1]
    if same:
        print(", ".join(same))
    table = Table(box=None, pad_edge=False)
    varying = [i for i, name in enumerate(model.label_names) if len(values[name]) > 1]
    for i in varying:
        table.add_column(model.label_names[i])
    for title in ("ms", "90 % interval"):
        table.add_column(title, justify="right")
    table.add_column("for each")
    for title in ("error", "of a constant", "rows"):
        table.add_column(title, justify="right")
    table.add_column("left out (its error)")
    messages: dict[str, None] = {}
    for key, one in model.models.items():
        messages |= dict.fromkeys(one.messages)
        first = [_percent(one.error), _percent(one.constant_error), str(one.n_rows), _left_out(one)]
        label = [key[i] for i in varying]
        for term, cost, (low, high), side in zip(
            one.law.terms, one.law.costs_ms, cost_intervals_ms(one), one.law.sides, strict=True
        ):
            each = ("(fixed)" if not term.factors else term.name) + (" (beside the others)" if side else "")
            table.add_row(*label, f"{cost:.4g}", f"{low:.4g} to {high:.4g}", each, *first)
            label, first = [""] * len(label), [""] * len(first)
    console = Console()
    (console if console.is_terminal else Console(width=200)).print(table)
    print("error: mean error of rows that were left out of the fit, relative")
    for message in list(messages)[:_MOST_MESSAGES]:
        print(f"note: {message}")
    if len(messages) > _MOST_MESSAGES:
        print(f"{len(messages) - _MOST_MESSAGES} more notes: --json FILE holds all")


def predictions_json(predictions: Sequence[Prediction]) -> dict[str, list[dict[str, Any]]]:
    """Milliseconds, in the order of the rows; an end that is not finite is null."""
    return {
        "predictions": [
            {"time_ms": p.time_ms, "low": _finite(p.low_ms), "high": _finite(p.high_ms), "extrapolated": p.extrapolated}
            for p in predictions
        ]
    }


def predictions_csv(table: TimingTable, predictions: Sequence[Prediction]) -> str:
    """The rows of the table with `predicted_ms`, `low_ms`, `high_ms` and `extrapolated` (0 or 1)."""
    columns = cells(table)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*columns, "predicted_ms", "low_ms", "high_ms", "extrapolated"])
    for row, p in enumerate(predictions):
        own = [plain(column[row]) for column in columns.values()]
        writer.writerow([*own, p.time_ms, _finite(p.low_ms), _finite(p.high_ms), int(p.extrapolated)])
    return text.getvalue()


def print_predictions(table: TimingTable, predictions: Sequence[Prediction]) -> None:
    """The first rows of it."""
    from rich.console import Console
    from rich.table import Table

    columns = {name: column for name, column in cells(table).items() if len(set(column)) > 1}
    shown = Table(box=None, pad_edge=False)
    for name in columns:
        shown.add_column(name, justify="right")
    for title in ("ms", "90 % interval", ""):
        shown.add_column(title, justify="right")
    for row, p in enumerate(predictions[:_MOST_PREDICTIONS]):
        own = ["" if column[row] is None else str(plain(column[row])) for column in columns.values()]
        far = "extrapolated" if p.extrapolated else ""
        shown.add_row(*own, f"{p.time_ms:.4g}", f"{p.low_ms:.4g} to {p.high_ms:.4g}", far)
    console = Console()
    (console if console.is_terminal else Console(width=200)).print(shown)
    if len(predictions) > _MOST_PREDICTIONS:
        print(f"... {len(predictions) - _MOST_PREDICTIONS} more: --out FILE.csv or --json FILE writes all")


def _left_out(model: TimeModel) -> str:
    named = [f"{one.term} ({_percent(one.error)})" for one in model.left_out[:_MOST_LEFT_OUT]]
    more = len(model.left_out) - len(named)
    return ", ".join([*named, f"{more} more"] if more > 0 else named)


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if math.isfinite(share) else "unknown"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
