"""What is asked of models of a table, against laws that made its times."""

import json

import numpy as np
import pytest

from tuning.answers import Answers, answer_lines, answers
from tuning.budget_lines import sizes_within
from tuning.label_groups import fit_groups
from tuning.table_model import TableModel
from tuning.timing_table import TimingTable

NOISE = 0.005
LIGHTS = np.geomspace(64, 65536, 14)


def asked(model: TableModel, table: TimingTable) -> Answers:
    return answers(model, tuple(sizes_within(model)), table)


def two_lines() -> TimingTable:
    """`forward` takes 1 ms and 0.010 a light, `tiled_deferred` 5 ms and 0.002: they cross at 500 lights."""
    rng = np.random.default_rng(0)
    times_ms = np.concatenate([1.0 + 0.010 * LIGHTS, 5.0 + 0.002 * LIGHTS])
    times_ms = times_ms * np.exp(NOISE * rng.normal(size=len(times_ms)))
    techniques = ("forward",) * len(LIGHTS) + ("tiled_deferred",) * len(LIGHTS)
    return TimingTable({"lights": np.tile(LIGHTS, 2)}, {"technique": techniques}, tuple((ms,) for ms in times_ms))


@pytest.fixture(scope="module")
def of_lines():
    table = two_lines()
    return asked(fit_groups(table), table)


def test_two_techniques_cross_where_their_laws_do(of_lines):
    (found,) = of_lines["crossovers"]
    assert (found["first"], found["second"]) == ({"technique": "forward"}, {"technique": "tiled_deferred"})
    assert found["low"] <= found["value"] <= found["high"]
    # Half a per cent of 6 ms on either side, over a difference of slopes of 0.008 a light: some 5 lights of 500.
    assert found["value"] == pytest.approx(500, rel=0.03)
    assert not found["extrapolated"]


def test_sizes_within_both_budgets_stand_in_the_record(of_lines):
    assert [(one["labels"]["technique"], round(one["budget_ms"], 1)) for one in of_lines["within"]] == [
        ("forward", 16.7),
        ("forward", 33.3),
        ("tiled_deferred", 16.7),
        ("tiled_deferred", 33.3),
    ]
    # (1000 / 60 - 1) / 0.010; costs are known to a fraction of the noise.
    assert of_lines["within"][0]["value"] == pytest.approx((1000 / 60 - 1) / 0.010, rel=0.02)


def test_what_matters_is_the_slope_at_the_row_in_the_middle(of_lines):
    forward = of_lines["matters"][0]
    (n,) = forward["at"].values()
    assert n == LIGHTS[7]  # the 8th of 14 times, which grow with the lights
    assert forward["slopes"]["lights"] == pytest.approx(0.010 * n / (1 + 0.010 * n), abs=0.01)


def test_rows_that_move_predictions_are_rows_of_the_table(of_lines):
    assert {one["labels"]["technique"] for one in of_lines["influential"]} == {"forward", "tiled_deferred"}
    for one in of_lines["influential"]:
        assert np.isclose(LIGHTS, one["row"]["lights"]).any()
        assert 0 < one["slope"] < 1


def test_answers_are_json_without_nan_and_lines_to_read(of_lines):
    json.dumps(of_lines, allow_nan=False)
    lines = list(answer_lines(of_lines))
    assert any(line.startswith("  forward and tiled_deferred at ") for line in lines)
    assert not any(line.startswith("Predicted best") for line in lines)  # sizes vary: rows are not settings of one job


def test_techniques_that_never_cross_have_no_crossover():
    table = two_lines()
    forward = table.repeats_ms[: len(LIGHTS)]
    slower = TimingTable(table.columns, table.labels, (*forward, *((9 * ms,) for (ms,) in forward)))
    (found,) = asked(fit_groups(slower), slower)["crossovers"]
    assert found["value"] is None
    assert not any(line.startswith("Where another") for line in answer_lines({**EMPTY, "crossovers": [found]}))


EMPTY = {"within": [], "crossovers": [], "matters": [], "best": [], "influential": []}


@pytest.mark.parametrize("n_repeats", [1, 3])
def test_the_best_tile_is_at_the_minimum_of_its_law(n_repeats):
    # 0.4 + 30 / T + 0.02 T has its minimum at 38.7. Rows that agree in all columns are repeats of one.
    tiles = np.array([8.0, 16, 24, 32, 40, 48, 64, 96, 128])
    rng = np.random.default_rng(1)
    law = 0.4 + 30 / tiles + 0.02 * tiles
    repeats = tuple(
        (ms * np.exp(NOISE * rng.normal()), ms * np.exp(NOISE * rng.normal())) for ms in np.tile(law, n_repeats)
    )
    table = TimingTable({"tile_px": np.tile(tiles, n_repeats)}, {}, repeats)
    (best,) = asked(fit_groups(table), table)["best"]
    assert best["params"]["tile_px"] in (32.0, 40.0, 48.0)  # one step about the minimum
    assert best["of"] == len(tiles)
    assert best["time_ms"] == pytest.approx(law.min(), rel=0.03)
    assert 0 <= best["expected_regret"] <= best["worst_regret"] < 0.1


def test_frames_of_a_setting_are_taken_together():
    # Frames of 1 and 4 units; a tile of 16 does half the work of one of 32 on both. The least row of all is no answer:
    # tile 48 has it, on a frame that is nearly empty, and loses on the other.
    work = {8.0: (2e6, 8e6), 16.0: (1e6, 4e6), 24.0: (1.5e6, 6e6), 32.0: (2e6, 8e6), 48.0: (1e5, 9e6)}
    rng = np.random.default_rng(2)
    rows = [(tile, count) for tile, frames in work.items() for count in frames]
    columns = {
        "tile_px": np.array([tile for tile, _ in rows]),
        "lighting_computations": np.array([count for _, count in rows]),
    }
    times = tuple(
        (ms, ms) for ms in (1 + 2e-6 * columns["lighting_computations"]) * np.exp(0.003 * rng.normal(size=10))
    )
    whole = TimingTable(columns, {}, times)
    counted = TimingTable({"lighting_computations": columns["lighting_computations"]}, {}, times)
    (best,) = asked(fit_groups(counted), whole)["best"]
    assert best["params"] == {"tile_px": 16.0}
    assert best["time_ms"] == pytest.approx(1 + 2e-6 * 2.5e6, rel=0.02)  # the mean of its two frames
    assert best["of"] == 5
    unequal = TimingTable({n: c[:-1] for n, c in columns.items()}, {}, times[:-1])
    assert asked(fit_groups(counted), unequal)["best"] == []  # one setting was timed on one frame only


def test_a_constant_prefers_no_setting_and_a_single_row_moves_nothing_else():
    rng = np.random.default_rng(3)
    tiles = np.array([8.0, 16, 24, 32, 48, 64])
    table = TimingTable({"tile_px": tiles}, {}, tuple((ms,) for ms in 5 * np.exp(0.05 * rng.normal(size=6))))
    found = asked(fit_groups(table), table)
    assert found["best"] == found["matters"] == []
    one = TimingTable({"tile_px": tiles[:1]}, {}, ((5.0, 5.1),))
    assert asked(fit_groups(one), one) == EMPTY


def test_labels_are_named_where_they_tell_records_apart(of_lines):
    alike = {name: [add_label(one) for one in records] for name, records in of_lines.items()}
    assert list(answer_lines(alike)) == list(answer_lines(of_lines))


def add_label(record):
    return {k: {**v, "device": "one"} if k in ("labels", "first", "second") else v for k, v in record.items()}
