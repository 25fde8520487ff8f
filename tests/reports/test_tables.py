import pytest

from reports.run_folder import read_run_folder
from reports.tables import cost_model_groups, count_rows, measurement_table
from tests.reports.synthetic_run import complete_run, run_without_times


@pytest.fixture
def run(tmp_path):
    return read_run_folder(complete_run().write(tmp_path))


def column(table, label):
    place = [header[0] for header in table.headers].index(label)
    return [row.cells[place] for row in table.rows]


def test_every_measurement_is_a_row_in_its_order(run):
    table = measurement_table(run)
    assert [cell.text for cell in column(table, "#")] == [str(i) for i in range(1, 25)]
    assert all(len(row.cells) == len(table.headers) for row in table.rows)


def test_times_sort_as_numbers_and_failures_have_no_key(run):
    cells = column(measurement_table(run), "slowest frame, ms")
    for cell, line in zip(cells, run.measurements, strict=True):
        assert cell.is_number
        assert cell.sort_key == run.time_ms(line)
    assert [cell.text for cell in cells if cell.sort_key is None] == ["–", "–"]


def test_a_failure_says_why(run):
    table = measurement_table(run)
    told = {row.outcome: row.message for row in table.rows if row.message}
    assert told["out_of_memory"].startswith("RESOURCE_EXHAUSTED")
    assert "<more>" in told["failed"]


def test_the_best_is_marked_once(run):
    assert [row.is_best for row in measurement_table(run).rows].count(True) == 1


def test_parameters_that_never_changed_need_no_column(run):
    table = measurement_table(run)
    labels = [header[0] for header in table.headers]
    assert [setting.name for setting in table.constant] == ["batch", "bounds"]
    assert not {"batch", "bounds"} & set(labels)
    # tiled_deferred has no depth slices: an empty cell that sorts last.
    assert {(cell.text, cell.sort_key) for cell in column(table, "depth_slices") if cell.sort_key is None} == {
        ("", None)
    }


def test_counts_stand_in_the_order_of_the_work_with_the_least_of_each(run):
    rows = count_rows(run)
    assert [row.name for row in rows][:3] == ["samples", "cells_total", "clusters_occupied"]
    computations = next(row for row in rows if row.name == "lighting_computations")
    assert computations.values == (908_412_000, 118_200_311, 38_114_907)
    assert computations.least == 38_114_907
    assert next(row for row in rows if row.name == "cells_total").values[0] is None


def test_cost_models_stand_by_technique(run):
    assert {name: len(models) for name, models in cost_model_groups(run).items()} == {
        "tiled_deferred": 2,
        "volume_tiled_bvh": 3,
    }


def test_without_times_every_row_is_still_there(tmp_path):
    table = measurement_table(read_run_folder(run_without_times().write(tmp_path)))
    assert len(table.rows) == 24
    assert not any(row.is_best for row in table.rows)
