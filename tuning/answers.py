"""What the models of a table say to the questions of `questions.py`: records for JSON, and lines to read."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from tuning.budget_lines import SizesWithin, asked_sizes, frame_keys, is_size
from tuning.family import LIGHTS, TILES
from tuning.questions import BUDGETS_MS, Answer, best_configuration, crossover, sensitivities
from tuning.table_model import FRAME, TableModel
from tuning.time_model import Influence, TimeModel
from tuning.timing_table import TimingTable
from vtfs.parameters import PARAMETERS

_MOST_LINES = 8
_MOST_SLOPES = 3
_MOST_IN_A_ROW = 4
_LEAST_SLOPE = 0.01

Answers = dict[str, list[dict[str, Any]]]


def answers(model: TableModel, sizes: Sequence[SizesWithin], table: TimingTable, seed: int = 0) -> Answers:
    """Records under `within`, `crossovers`, `matters`, `best` and `influential`; sizes that do not exist are null.

    **Arguments:**

    - `sizes`: `sizes_within(model)`.
    - `table`: what the models were fitted to, and the parameters of its rows, also those that explain nothing.
    """
    rows = {key: _rows(model, table, key) for key in frame_keys(model)}
    return {
        "within": [
            {"labels": _labels(model, one.key), "column": one.column, "budget_ms": budget_ms, **_answer(found)}
            for one in sizes
            for budget_ms, found in zip(BUDGETS_MS, one.within, strict=True)
        ],
        "crossovers": list(_crossovers(model, table, rows, seed)),
        "matters": list(_matters(model, table, rows)),
        "best": list(_best(model, table, rows, seed)),
        "influential": [
            {"labels": _labels(model, part), "row": _telling(model.models[part], one), "slope": one.slope}
            for key in rows
            for part in model.sums.get(key, (key,))
            if model.models[part].n_rows > 1
            for one in model.models[part].influential
        ],
    }


def answer_lines(found: Answers) -> Iterator[str]:
    """Each kind of answer under a heading, at most eight lines of it; `sizes_within` has lines of its own.

    Labels are named where they tell records apart.
    """
    crossing = [one for one in found["crossovers"] if one["value"] is not None]
    moving = sorted(
        (one for one in found["influential"] if one["slope"] >= _LEAST_SLOPE), key=lambda one: -one["slope"]
    )
    known: dict[str, set[str]] = {}
    for one in itertools.chain(*found.values()):
        for side in ("labels", "first", "second"):
            for name, value in one.get(side, {}).items():
                known.setdefault(name, set()).add(value)
    telling = {name for name, values in known.items() if len(values) > 1}
    for title, records, line in (
        ("Where another becomes faster:", crossing, _crossing),
        ("What matters (a time grows by so many % where a column does by 1 %):", found["matters"], _mattering),
        ("Predicted best:", found["best"], _choice),
        ("Rows that move predictions most (1 % longer, and all times are so many % longer):", moving, _moving),
    ):
        if records:
            yield title
            yield from (f"  {line(one, telling)}" for one in records[:_MOST_LINES])
            if len(records) > _MOST_LINES:
                yield f"  {len(records) - _MOST_LINES} more: --json FILE holds all"


def _rows(model: TableModel, table: TimingTable, key: tuple[str, ...]) -> np.ndarray:
    matches = np.ones(len(table), bool)
    for name, value in zip(model.label_names, key, strict=True):
        matches &= np.array(table.labels[name]) == value
    return np.flatnonzero(matches)


def _labels(model: TableModel, key: tuple[str, ...]) -> dict[str, str]:
    return dict(zip(model.label_names, key, strict=True))


def _answer(found: Answer) -> dict[str, Any]:
    return {
        "value": _finite(found.value),
        "low": _finite(found.low),
        "high": _finite(found.high),
        "probability": found.probability,
        "extrapolated": found.extrapolated,
    }


def _crossovers(
    model: TableModel, table: TimingTable, rows: Mapping[tuple[str, ...], np.ndarray], seed: int
) -> Iterator[dict[str, Any]]:
    """Of every two frames that differ in one label (the technique, where there is one) and grow with one same size."""
    for first, second in itertools.combinations(rows, 2):
        differ = [name for name, a, b in zip(model.label_names, first, second, strict=True) if a != b]
        if len(differ) != 1 or ("technique" in model.label_names and differ != ["technique"]):
            continue
        parts = model.parts(first), model.parts(second)
        columns = {name for part in (*parts[0], *parts[1]) for name in part.columns}
        if len(columns) != 1 or not is_size(column := next(iter(columns))):
            continue
        fitted = [table.columns[column][rows[key]] for key in (first, second)]
        low, high = asked_sizes(np.array([max(own.min() for own in fitted), min(own.max() for own in fitted)]))
        if not low < high:
            continue
        found = crossover(*parts, column, low, high, {}, seed)
        yield {
            "first": _labels(model, first),
            "second": _labels(model, second),
            "column": column,
            "from": low,
            "to": high,
            **_answer(found),
        }


def _matters(
    model: TableModel, table: TimingTable, rows: Mapping[tuple[str, ...], np.ndarray]
) -> Iterator[dict[str, Any]]:
    """At the row whose time is the median."""
    times_ms = table.median_ms
    for key, own in rows.items():
        row = own[np.argsort(times_ms[own], kind="stable")[len(own) // 2]]
        names = dict.fromkeys(name for part in model.parts(key) for name in part.columns)
        at = {name: float(table.columns[name][row]) for name in names}
        slopes = sensitivities(model.parts(key), at)
        if slopes:
            ordered = dict(sorted(slopes.items(), key=lambda item: -abs(item[1])))
            yield {"labels": _labels(model, key), "at": at, "slopes": ordered}


def _best(
    model: TableModel, table: TimingTable, rows: Mapping[tuple[str, ...], np.ndarray], seed: int
) -> Iterator[dict[str, Any]]:
    """Where the rows are settings of one job: parameters vary, and no size does."""
    for key, own in rows.items():
        columns = {name: column[own] for name, column in table.columns.items() if not np.isnan(column[own]).any()}
        varying = [name for name, column in columns.items() if np.ptp(column) > 0]
        settings = [name for name in varying if name in PARAMETERS or name in TILES]
        counted = "lighting_computations" in columns or "samples" in columns
        if not settings or any(name in LIGHTS or not (counted or name in settings) for name in varying):
            continue
        values = np.column_stack([columns[name] for name in settings])
        distinct, configuration, n_rows = np.unique(values, axis=0, return_inverse=True, return_counts=True)
        if len(distinct) < 2 or np.ptp(n_rows) > 0:
            continue  # of frames that not all were timed on, none can be compared
        if not any(part.columns for part in model.parts(key)):
            continue  # a constant prefers nothing
        found = best_configuration(model.parts(key), columns, seed, configuration.ravel())
        yield {
            "labels": _labels(model, key),
            "params": dict(zip(settings, map(float, distinct[found.row]), strict=True)),
            "time_ms": found.time_ms,
            "expected_regret": found.expected_regret,
            "worst_regret": found.worst_regret,
            "of": len(distinct),
        }


def _telling(model: TimeModel, row: Influence) -> dict[str, float]:
    """What the law depends on; of a constant, all columns."""
    return {name: row.columns[name] for name in model.columns if name in row.columns} or row.columns


def _crossing(one: Mapping[str, Any], telling: Collection[str]) -> str:
    differ = next(name for name in one["first"] if one["first"][name] != one["second"][name])
    shared = {name: value for name, value in one["first"].items() if name != differ}
    # The chosen law may cross where no other plausible one does.
    interval = "no interval" if one["low"] is None else f"{one['low']:,.4g} to {one['high']:,.4g}"
    far = ", extrapolated" if one["extrapolated"] else ""
    return (
        f"{_named(shared, telling)}{one['first'][differ]} and {one['second'][differ]} at {one['value']:,.4g} "
        f"{one['column']} ({interval}{far}; in {one['probability']:.0%} of plausible models)"
    )


def _mattering(one: Mapping[str, Any], telling: Collection[str]) -> str:
    told = [f"{name} {slope:+.2f}" for name, slope in one["slopes"].items() if abs(slope) >= _LEAST_SLOPE]
    at = ", ".join(f"{name} {_text(one['at'][name])}" for name in one["slopes"])
    return f"{_named(one['labels'], telling)}{', '.join(told[:_MOST_SLOPES]) or 'nothing'} (at {at})"


def _choice(one: Mapping[str, Any], telling: Collection[str]) -> str:
    params = ", ".join(f"{name} {_text(value)}" for name, value in one["params"].items())
    return (
        f"{_named(one['labels'], telling)}{params} (of {one['of']} settings), {one['time_ms']:.4g} ms; if the model is "
        f"wrong, {one['expected_regret']:.1%} slower than the fastest in the mean, up to {one['worst_regret']:.1%} in "
        "95 % of cases"
    )


def _moving(one: Mapping[str, Any], telling: Collection[str]) -> str:
    row = ", ".join(f"{name} {_text(value)}" for name, value in list(one["row"].items())[:_MOST_IN_A_ROW])
    return f"{_named(one['labels'], telling)}{row} ({one['slope']:.2f})"


def _named(labels: Mapping[str, str], telling: Collection[str]) -> str:
    told = [v for name, v in labels.items() if name in telling and v and (name, v) != ("stage", FRAME)]
    return f"{', '.join(told)}: " if told else ""


def _text(value: object) -> str:
    return f"{value:,.6g}" if isinstance(value, int | float) else str(value)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
