"""Fits and predictions of tables whose rows do not all have the same columns, as techniques with and without tiles."""

from __future__ import annotations

import numpy as np

from tuning.table_model import Prediction, TableModel, fit_table
from tuning.timing_table import TimingTable


def fit_groups(table: TimingTable, seed: int = 0) -> TableModel:
    """`fit_table`, also where a column is empty in all rows of a combination of labels (stages aside): it is left out
    there.

    **Raises:** `InputError` as `fit_table`; so for a column that only some rows of a combination have.
    """
    if not any(np.isnan(column).any() for column in table.columns.values()):
        return fit_table(table, seed)
    # Stages stay together: a frame may be modelled as their sum.
    apart = {name: label for name, label in table.labels.items() if name != "stage"}
    parts = [
        fit_table(
            TimingTable(
                _present(table.columns, rows),
                {name: tuple(label[row] for row in rows) for name, label in table.labels.items()},
                tuple(table.repeats_ms[row] for row in rows),
            ),
            seed,
        )
        for rows in _rows_by_label(apart, len(table))
    ]
    return TableModel(
        tuple(table.labels),
        {key: one for part in parts for key, one in part.models.items()},
        {key: one for part in parts for key, one in part.sums.items()},
    )


def predict_groups(model: TableModel, table: TimingTable) -> tuple[Prediction, ...]:
    """One prediction a row, in order; times are not looked at.

    A label that is missing is taken for the one that all models have, if they do.

    **Raises:** `InputError` as `TableModel.predict`.
    """
    known: dict[str, tuple[str, ...]] = {}
    for index, name in enumerate(model.label_names):
        values = {key[index] for key in model.models}
        if name in table.labels:
            known[name] = table.labels[name]
        elif len(values) == 1:
            known[name] = (*values,) * len(table)
    predictions: dict[int, Prediction] = {}
    for rows in _rows_by_label(known, len(table)):
        columns = _present(table.columns, rows) or {"": np.zeros(len(rows))}
        labels = {name: tuple(label[row] for row in rows) for name, label in known.items()}
        predictions |= zip(rows, model.predict(columns, labels), strict=True)
    return tuple(predictions[row] for row in range(len(table)))


def _present(columns: dict[str, np.ndarray], rows: list[int]) -> dict[str, np.ndarray]:
    own = {name: column[rows] for name, column in columns.items()}
    return {name: column for name, column in own.items() if not np.isnan(column).all()}


def _rows_by_label(labels: dict[str, tuple[str, ...]], n_rows: int) -> list[list[int]]:
    groups: dict[tuple[str, ...], list[int]] = {}
    for row in range(n_rows):
        groups.setdefault(tuple(label[row] for label in labels.values()), []).append(row)
    return list(groups.values())
