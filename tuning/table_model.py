"""Models of a whole table of times: one for each technique and stage, to and from JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tuning.fit_law import fit_law
from tuning.time_model import Prediction, TimeModel
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

SCHEMA = 1
FRAME = "frame"
UNLISTED = "unlisted"
_LEAST_REST = 1e-4  # of the frame: rounding may leave nothing of it, and nothing cannot be fitted

__all__ = ["Prediction", "TableModel", "fit_table"]


@dataclass(frozen=True)
class TableModel:
    """One model for each combination of labels.

    - `label_names`: in the order of the keys of `models`; none where the table has no labels.
    - `sums`: frames whose time is predicted as the sum of these stages, each by its own model: their parts were timed
      too, and what the parts leave of the frame (the stage `unlisted`) is nowhere negative. Stages grow by laws of
      their own, so their sum holds further out than one law for everything.
    """

    label_names: tuple[str, ...]
    models: dict[tuple[str, ...], TimeModel]
    sums: dict[tuple[str, ...], tuple[tuple[str, ...], ...]] = field(default_factory=dict)

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
            parts = [self._predict_one(part, table_columns, rows) for part in self.sums.get(key, (key,))]
            predictions |= zip(rows.tolist(), map(_added, zip(*parts, strict=True)), strict=True)
        return tuple(predictions[row] for row in range(n_rows))

    def as_json(self) -> dict[str, object]:
        return {
            "schema": SCHEMA,
            "labels": list(self.label_names),
            "models": [
                {"labels": dict(zip(self.label_names, key, strict=True))} | model.as_json()
                for key, model in self.models.items()
            ],
            "sums": [{"of": list(key), "stages": [list(part) for part in parts]} for key, parts in self.sums.items()],
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
            sums = {tuple(one["of"]): tuple(map(tuple, one["stages"])) for one in entry["sums"]}  # type: ignore[union-attr]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"model: a field is missing or wrong ({error!r}); write it again with `vtfs fit`."
            ) from None
        if not models:
            raise InputError("model: it is empty; write it again with `vtfs fit`.")
        return cls(names, models, sums)

    def parts(self, key: tuple[str, ...]) -> tuple[TimeModel, ...]:
        """The models whose times add up to that of these labels: one, but for the sums."""
        return tuple(self._model(part) for part in self.sums.get(key, (key,)))

    def _predict_one(
        self, key: tuple[str, ...], columns: Mapping[str, np.ndarray], rows: np.ndarray
    ) -> tuple[Prediction, ...]:
        model = self._model(key)
        used = [*model.columns, *(name for name in model.ranges if name in columns)]
        own = {name: _numbers(columns, name)[rows] for name in used}
        # A constant needs no column, but as many predictions as there are rows.
        return model.predict(own or {"": np.zeros(len(rows))})

    def _model(self, key: tuple[str, ...]) -> TimeModel:
        if key in self.models:
            return self.models[key]
        for i, (name, value) in enumerate(zip(self.label_names, key, strict=True)):
            known = dict.fromkeys(other[i] for other in self.models)
            if value not in known:
                raise InputError(f"{name} `{value}`: the model was not fitted to it; it knows {', '.join(known)}.")
        wanted = ", ".join(f"{name} `{value}`" for name, value in zip(self.label_names, key, strict=True))
        raise InputError(f"{wanted}: the model knows each of these, but was not fitted to them together.")


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
    by_label = {
        key: ({name: column[rows] for name, column in columns.items()}, [table.repeats_ms[row] for row in rows])
        for key, rows in _rows_by_label(label_names, table.labels, len(table)).items()
    }
    sums: dict[tuple[str, ...], tuple[tuple[str, ...], ...]] = {}
    if "stage" in label_names:
        at = label_names.index("stage")
        for key in [key for key in by_label if key[at] == FRAME]:
            parts = [other for other in by_label if other != key and _but(other, at) == _but(key, at)]
            if any(part[at] == UNLISTED for part in parts):  # given: the stages add up already
                rows = _medians(*by_label[key]).keys()
                if all(rows <= _medians(*by_label[part]).keys() for part in parts):
                    sums[key] = tuple(parts)
                continue
            rest = _unlisted(by_label[key], [by_label[part] for part in parts])
            if rest is not None:
                unlisted = (*key[:at], UNLISTED, *key[at + 1 :])
                by_label[unlisted] = rest
                sums[key] = (*parts, unlisted)
    models = {
        key: fit_law(own, repeats_ms, key[label_names.index("stage")] if "stage" in label_names else None, seed)
        for key, (own, repeats_ms) in by_label.items()
    }
    return TableModel(label_names, models, sums)


_Rows = tuple[dict[str, np.ndarray], list[tuple[float, ...]]]


def _but(key: tuple[str, ...], at: int) -> tuple[str, ...]:
    return key[:at] + key[at + 1 :]


def _unlisted(frame: _Rows, stages: list[_Rows]) -> _Rows | None:
    """What the stages leave of the frame's time, row by row; `None` where a stage lacks a row, or they overlap."""
    if not stages:
        return None
    rest = _medians(*frame)
    whole = dict(rest)
    for stage in stages:
        times_ms = _medians(*stage)
        for row in rest:
            if row not in times_ms:
                return None
            rest[row] -= times_ms[row]
    if any(rest[row] < _LEAST_REST * whole[row] for row in rest):
        return None
    keys = np.array(list(rest)).reshape(len(rest), len(frame[0]))
    columns = {name: keys[:, k] for k, name in enumerate(frame[0])}
    return columns, [(time_ms,) for time_ms in rest.values()]


def _medians(columns: dict[str, np.ndarray], repeats_ms: list[tuple[float, ...]]) -> dict[tuple[float, ...], float]:
    rows = zip(*columns.values(), strict=True) if columns else [()] * len(repeats_ms)
    return {tuple(map(float, row)): float(np.median(own)) for row, own in zip(rows, repeats_ms, strict=True)}


def _added(parts: tuple[Prediction, ...]) -> Prediction:
    """Errors of stages are taken for independent: the half widths of their intervals add up in squares."""
    if len(parts) == 1:
        return parts[0]
    time_ms = sum(part.time_ms for part in parts)
    below = math.hypot(*(part.time_ms - part.low_ms for part in parts))
    above = math.hypot(*(part.high_ms - part.time_ms for part in parts))
    return Prediction(time_ms, max(time_ms - below, 0.0), time_ms + above, any(part.extrapolated for part in parts))


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
