"""Rows of a table put together, and chosen."""

import pytest

from tests.tuning.formats.tables import written
from tuning.formats.csv_table import CsvLayout, read_csv
from tuning.formats.grouping import rows_where, without
from vtfs.input_error import InputError


def test_columns_left_out_make_repeats_of_rows(folder):
    path = written(folder, "tile_px,frame,time_ms\n8,0,3\n16,0,2\n8,1,4\n")
    expected = ((3.0, 4.0), (2.0,))
    assert read_csv(path, CsvLayout(ignore=("frame",))).repeats_ms == expected
    assert without(read_csv(path), ["frame"]).repeats_ms == expected


def test_rows_are_chosen_by_a_value(folder):
    table = read_csv(written(folder, "lights,scene,ms\n3,a,1\n4,b,2\n3,b,5\n"))
    assert rows_where(table, "scene", "b").median_ms.tolist() == [2, 5]
    assert rows_where(table, "lights", "3.0").median_ms.tolist() == [1, 5]
    for name, value, word in (("scene", "c", "a, b"), ("lights", "many", "numbers"), ("x", "1", "lights, scene")):
        with pytest.raises(InputError, match=word):
            rows_where(table, name, value)
