"""Rows of techniques with different columns are fitted and predicted in one table, each by itself."""

import math

import numpy as np
import pytest

from tuning.label_groups import fit_groups, predict_groups
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

LIGHTS = np.array([100.0, 200, 400, 800, 1600, 3200, 6400])
CLUSTERS = LIGHTS**0.7 * np.array([1.0, 1.3, 0.9, 1.1, 0.8, 1.2, 1.0])


def mixed() -> TimingTable:
    """Forward has no clusters; both techniques take 1 ms and 1 us a light, forward twice that."""
    rng = np.random.default_rng(0)
    columns = {
        "lights": np.concatenate([LIGHTS, LIGHTS]),
        "clusters": np.concatenate([np.full(len(LIGHTS), math.nan), CLUSTERS]),
    }
    technique = ("forward",) * len(LIGHTS) + ("clustered",) * len(LIGHTS)
    times_ms = (1 + 1e-3 * columns["lights"]) * np.repeat([2, 1], len(LIGHTS)) * rng.normal(1, 0.02, 2 * len(LIGHTS))
    return TimingTable(columns, {"technique": technique}, tuple((time,) for time in times_ms.tolist()))


@pytest.fixture(scope="module")
def model():
    return fit_groups(mixed())


def test_predictions_come_in_the_order_of_mixed_rows(model):
    """To 10 %: 2 % noise on seven points."""
    table = mixed()
    order = np.random.default_rng(1).permutation(len(table))
    shuffled = TimingTable(
        {name: column[order] for name, column in table.columns.items()},
        {"technique": tuple(table.labels["technique"][row] for row in order)},
        ((math.nan,),) * len(table),
    )
    predicted = [p.time_ms for p in predict_groups(model, shuffled)]
    assert predicted == pytest.approx(table.median_ms[order].tolist(), rel=0.1)


def test_a_label_that_all_models_share_need_not_be_given():
    table = rows_of(mixed(), "clustered")
    one = fit_groups(table)
    unnamed = TimingTable(table.columns, {}, table.repeats_ms)
    assert predict_groups(one, unnamed) == predict_groups(one, table)


def test_a_label_that_tells_models_apart_must_be_given(model):
    table = mixed()
    with pytest.raises(InputError, match="`technique`"):
        predict_groups(model, TimingTable(table.columns, {}, table.repeats_ms))


def test_a_column_that_some_rows_of_a_technique_lack_is_refused():
    table = rows_of(mixed(), "clustered")
    table.columns["clusters"][2] = math.nan
    with pytest.raises(InputError, match="`clusters`"):
        fit_groups(table)


def rows_of(table: TimingTable, technique: str) -> TimingTable:
    kept = [row for row, name in enumerate(table.labels["technique"]) if name == technique]
    return TimingTable(
        {name: column[kept] for name, column in table.columns.items()},
        {"technique": (technique,) * len(kept)},
        tuple(table.repeats_ms[row] for row in kept),
    )
