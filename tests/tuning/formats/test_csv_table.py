"""A CSV loses nothing; its time and unit are found; a bad file or layout is refused in one line."""

import gzip
import math

import numpy as np
import pytest
from hypothesis import example, given, settings

from tests.tuning.formats.tables import are_the_same, tables, written
from tuning.formats.csv_table import CsvLayout, read_csv, read_features, read_layout, unit_of, write_csv
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

RETURNS = TimingTable({"row": np.array([0.0])}, {"scene": ("a\rb",)}, ((1.0,),))


@settings(max_examples=60, deadline=None)
@given(table=tables())
@example(table=RETURNS)
def test_csv_loses_nothing(folder, table):
    path = folder / "table.csv"
    write_csv(path, table)
    # Texts that look like numbers are numbers, unless the layout says otherwise.
    are_the_same(read_csv(path, CsvLayout(labels=tuple(table.labels))), table)


def test_rows_that_agree_in_all_but_the_time_are_repeats(folder):
    path = written(folder, "tile_px,quality,time_ms\n8,low,3\n16,low,2\n8,low,3.5\n16,high,2.5\n8,low,\n")
    table = read_csv(path)
    assert table.repeats_ms == ((3.0, 3.5), (2.0,), (2.5,)) and table.n_untimed == 1
    assert table.columns["tile_px"].tolist() == [8, 16, 16] and table.labels == {"quality": ("low", "low", "high")}


@pytest.mark.parametrize(
    ("header", "layout", "factor"),
    [
        ("time_us", CsvLayout(), 1e-3),
        ("gpu_ns", CsvLayout(), 1e-6),
        ("Frame Time (s)", CsvLayout(), 1e3),
        ("ms", CsvLayout(), 1.0),
        ("milliseconds", CsvLayout(), 1.0),
        ("time", CsvLayout(unit="us"), 1e-3),
        ("shade", CsvLayout(time="shade"), 1.0),
        ("shade_us", CsvLayout(), 1e-3),
        ("shade_us", CsvLayout(time="shade_us"), 1e-3),
        ("shade_us", CsvLayout(time="shade_us", unit="ns"), 1e-6),
        ("T", CsvLayout(time="T", unit="s", rename={"lights": "n"}), 1e3),
        ("T_us", CsvLayout(time="time_x", rename={"T_us": "time_x"}), 1.0),
        ("T_us", CsvLayout(time="T_us", rename={"T_us": "time_x"}), 1e-3),
    ],
)
def test_the_time_and_its_unit_are_found(folder, header, layout, factor):
    table = read_csv(written(folder, f"lights,{header}\n10,8\n20,16\n"), layout)
    assert list(table.columns) == [layout.rename.get("lights", "lights")]
    assert table.median_ms.tolist() == pytest.approx([8 * factor, 16 * factor], rel=1e-15)  # one rounding


@pytest.mark.parametrize("name", ["lights", "samples", "items", "columns", "alarms", "focus", "bonus"])
def test_an_ending_that_is_part_of_a_word_is_no_unit(name):
    assert unit_of(name) is None


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_separators_line_ends_and_marks_of_spreadsheets(folder, separator, end):
    rows = ["tile_px,time_ms", "8,3.5", "", "16,2.5"]
    text = "\ufeff" + end.join(row.replace(",", separator) for row in rows)
    assert read_csv(written(folder, text)).median_ms.tolist() == [3.5, 2.5]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", ("is empty",)),
        ("  \n\n", ("is empty",)),
        ("tile_px,time_ms\n", ("no rows",)),
        ("tile_px,lights\n8,3\n", ("time_ms", "--time", "tile_px, lights")),
        ("time_us,time_ns\n8,3\n", ("--time",)),
        ("lights,time_ms\n8,3\n9,x\n", ("line 3", "`time_ms`", "'x'")),
        ("lights,time_ms\n8,nan\n", ("line 2", "`time_ms`", "nan", "finite")),
        ("lights,time_ms\n8,-1\n", ("line 2", "`time_ms`", "-1", "negative")),
        ("lights,time_ms\n8,inf\n", ("`time_ms`", "inf")),
        ("lights,time_ms\n8,\n9,\n", ("no row has a time",)),
        ("lights,time_ms\n8,3\nmany,3\n9,4\n", ("line 3", "`lights`", "'many'", "not a number")),
        ("lights;time_ms\n8;3\n9;4,5\n10;4\n", ("line 3", "4,5")),
        ("lights,time_ms\n8,3\n9,4\nnan,4\n", ("line 4", "`lights`", "nan")),
        ("lights,lights,time_ms\n8,8,3\n", ("`lights`", "two columns")),
        (",lights,time_ms\n0,8,3\n", ("column 1", "no name")),
        ("lights,time_ms\n8,3,4\n", ("line 2", "3 cells", "2")),
        ("lights,time_ms\n8\n", ("line 2", "1 cells", "2")),
        ('lights,time_ms\n"8,3\n', ("line 2", "quotes")),
        ("lights,time_ms\n8,3\xff\n".encode("latin-1"), ("not UTF-8", "0xff")),
        ("lights,time_ms\n8,3\n".encode("utf-16"), ("UTF-16", "UTF-8")),
        (b"lights,time_ms\n8,3\0\n", ("NUL",)),
        (b"PK\x03\x04lights", ("zip archive",)),
        (b"\x1f\x8bnothing", ("gzip",)),
        (gzip.compress(b"lights,time_ms\n8,3\n", mtime=0)[:-9], ("gzip",)),
        ("lights,time_ms\n8," + "9" * 200_000 + "\n", ("field larger",)),
    ],
)
def test_a_bad_csv_is_refused(folder, content, words):
    path = written(folder, content)
    with pytest.raises(InputError) as refused:
        read_csv(path)
    message = str(refused.value)
    assert str(path) in message and "\n" not in message and len(message) < 400, message
    for word in words:
        assert word in message, message


def test_a_missing_file_and_a_folder_are_refused(folder):
    for path in (folder / "absent.csv", folder):
        with pytest.raises(InputError, match="cannot be read"):
            read_csv(path)


def test_a_layout_says_what_columns_are(folder):
    layout = read_layout(
        written(
            folder,
            'time = "gpu"\nunit = "us"\nignore = ["note"]\nlabels = ["build"]\n[rename]\nTileSize = "tile_px"\n',
            "map.toml",
        )
    )
    path = written(folder, "TileSize,build,note,gpu\n8,12,a,3000\n16,13,b,2000\n")
    table = read_csv(path, layout)
    assert table.columns["tile_px"].tolist() == [8, 16] and table.labels == {"build": ("12", "13")}
    assert table.median_ms.tolist() == [3, 2]
    assert CsvLayout(unit="ns").over(layout).unit == "ns" and CsvLayout(ignore=("x",)).over(layout).ignore == (
        "note",
        "x",
    )
    # Another time has another unit.
    assert CsvLayout(time="cpu_ms").over(layout).unit is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time = 3", ("`time` = 3", "a text")),
        ('unit = "hours"', ("hours", "ns, us, ms, s")),
        ('ignore = "a"', ("`ignore`", "a list")),
        ('labels = ["a", 3]', ("`labels`",)),
        ("[rename]\na = 3", ("`rename`",)),
        ("features = []", ("`features`", "unknown")),
        ("time = ", ("not TOML",)),
    ],
)
def test_a_bad_layout_is_refused(folder, text, words):
    with pytest.raises(InputError) as refused:
        read_layout(written(folder, text, "map.toml"))
    for word in words:
        assert word in str(refused.value)


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        (CsvLayout(time="absent"), ("`absent`", "lights, tile, ms")),
        (CsvLayout(ignore=("absent",)), ("`absent`",)),
        (CsvLayout(labels=("absent",)), ("`absent`",)),
        (CsvLayout(rename={"absent": "x"}), ("`absent`",)),
        (CsvLayout(rename={"tile": "lights"}), ("two columns",)),
    ],
)
def test_a_layout_that_does_not_fit_the_file_is_refused(folder, layout, words):
    path = written(folder, "lights,tile,ms\n1,2,3\n")
    with pytest.raises(InputError) as refused:
        read_csv(path, layout)
    for word in words:
        assert word in str(refused.value)


def test_features_are_read_row_by_row_without_a_time(folder):
    path = written(folder, "lights,scene\n3,a\n1,b\n3,a\n,\n")
    features = read_features(path, CsvLayout(time="ms", ignore=("note",), rename={"T": "tile"}))
    np.testing.assert_array_equal(features.columns["lights"], [3, 1, 3, math.nan])
    assert features.labels == {"scene": ("a", "b", "a", "")} and len(features) == 4
    with_times = written(folder, "lights,time_ms\n3,oops\n")
    assert list(read_features(with_times).columns) == ["lights"]
