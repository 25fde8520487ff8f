"""Models of a whole table of times: one for each technique and stage, to and from JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tuning.fit_law import fit_law
from tuning.time_model import Prediction, TimeModel
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

SCHEMA = 1

__all__ = ["Prediction", "TableModel", "fit_table"]


@dataclass(frozen=True)
class TableModel:
    """One model for each combination of labels.

    - `label_names`: in the order of the keys of `models`; none where the table has no labels.
    """

    label_names: tuple[str, ...]
    models: dict[tuple[str, ...], TimeModel]

    def predict(
        self, table_columns: Mapping[str, np.ndarray], labels: Mapping[str, tuple[str, ...]]
    ) -> tuple[Prediction, ...]:
        """One prediction a row.

        **Arguments:** as in a `TimingTable`; columns and labels that the models do not depend on are not looked at.

        **Raises:** `InputError` where a column or a label is missing, not a number, or was not in the fitted table.
        """
        n_rows = _n_rows(table_columns, labels)
        predictions: dict[int, Prediction] = {}
        for key, rows in _rows_by_label(self.label_names, labels, n_rows).items():
            model = self._model(key)
            columns = {name: _numbers(table_columns, name)[rows] for name in model.columns}
            # A constant needs no column, but as many predictions as there are rows.
            columns = columns or {"": np.zeros(len(rows))}
            predictions |= zip(rows.tolist(), model.predict(columns), strict=True)
        return tuple(predictions[row] for row in range(n_rows))

    def as_json(self) -> dict[str, object]:
        return {
            "schema": SCHEMA,
            "labels": list(self.label_names),
            "models": [
                {"labels": dict(zip(self.label_names, key, strict=True))} | model.as_json()
                for key, model in self.models.items()
            ],
        }

    @classmethod
    def from_json(cls, entry: Mapping[str, object]) -> TableModel:
        """**Raises:** `InputError` where this is no model that `as_json` made."""
        if not isinstance(entry, Mapping) or entry.get("schema") != SCHEMA:
            raise InputError(f"model: not a model of schema {SCHEMA}; write it with `vtfs fit`.")
        try:
            names = tuple(map(str, entry["labels"]))  # type: ignore[arg-type]
            models = {
                tuple(str(one["labels"][name]) for name in names): TimeModel.from_json(one)
                for one in entry["models"]  # type: ignore[union-attr]
            }
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"model: a field is missing or wrong ({error!r}); write it again with `vtfs fit`."
            ) from None
        if not models:
            raise InputError("model: it is empty; write it again with `vtfs fit`.")
        return cls(names, models)

    def _model(self, key: tuple[str, ...]) -> TimeModel:
        if key in self.models:
            return self.models[key]
        wanted = ", ".join(f"{name} `{value}`" for name, value in zip(self.label_names, key, strict=True))
        known = "; ".join(", ".join(other) for other in self.models)
        raise InputError(f"{wanted}: the model was not fitted to it; it knows {known}.")


def fit_table(table: TimingTable, seed: int = 0) -> TableModel:
    """The smallest models that the table supports, one for each combination of labels.

    **Raises:** `InputError` for times that are not positive numbers, for columns that are not numbers and for a table
    without rows.
    """
    if not len(table):
        raise InputError("table: it has no rows; give at least one time.")
    _check_times(table)
    columns = {name: _numbers(table.columns, name) for name in table.columns}
    label_names = tuple(table.labels)
    models: dict[tuple[str, ...], TimeModel] = {}
    for key, rows in _rows_by_label(label_names, table.labels, len(table)).items():
        stage = dict(zip(label_names, key, strict=True)).get("stage")
        own = {name: column[rows] for name, column in columns.items()}
        models[key] = fit_law(own, [table.repeats_ms[row] for row in rows], stage, seed)
    return TableModel(label_names, models)


def _check_times(table: TimingTable) -> None:
    for row, repeats in enumerate(table.repeats_ms):
        if not repeats:
            raise InputError(f"row {row + 1}: it has no time; drop the row or give one.")
        for time_ms in repeats:
            if not (np.isfinite(time_ms) and time_ms > 0):
                raise InputError(
                    f"row {row + 1}: time {time_ms} ms; must be a positive number, drop rows that were not measured."
                )


def _numbers(columns: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    if name not in columns:
        raise InputError(f"column `{name}`: missing; the model depends on it, add it to the table.")
    column = np.asarray(columns[name], float)
    bad = np.flatnonzero(~np.isfinite(column))
    if len(bad):
        raise InputError(f"column `{name}`, row {bad[0] + 1}: {column[bad[0]]} is not a number; correct or ignore it.")
    return column


def _n_rows(columns: Mapping[str, np.ndarray], labels: Mapping[str, tuple[str, ...]]) -> int:
    lengths = {len(column) for column in (*columns.values(), *labels.values())}
    if len(lengths) != 1:
        raise InputError("table: its columns differ in length, or there are none; give one value a row.")
    return lengths.pop()


def _rows_by_label(
    names: tuple[str, ...], labels: Mapping[str, tuple[str, ...]], n_rows: int
) -> dict[tuple[str, ...], np.ndarray]:
    for name in names:
        if name not in labels:
            raise InputError(f"label `{name}`: missing; the models are told apart by it, add the column.")
    rows: dict[tuple[str, ...], list[int]] = {}
    for row in range(n_rows):
        rows.setdefault(tuple(labels[name][row] for name in names), []).append(row)
    return {key: np.array(own) for key, own in rows.items()}
