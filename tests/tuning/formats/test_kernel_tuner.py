"""Kernel Tuner's cache: nothing is lost, and what it says wrong is refused in one line."""

import gzip
import json
import math

import pytest
from hypothesis import example, given, settings

from tests.tuning.formats.tables import are_the_same, tables, texts, written
from tuning.formats.csv_table import CsvLayout
from tuning.formats.kernel_tuner import read_kernel_tuner, write_kernel_tuner
from tuning.formats.registry import read_table, recognised
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

COMMAS = TimingTable({}, {"a": ("x,y", "x"), "b": ("z", "y,z")}, ((1.0,), (2.0,)))


@settings(max_examples=60, deadline=None)
@given(table=tables(), device=texts)
@example(table=COMMAS, device="a GPU")
def test_a_kernel_tuner_cache_loses_nothing(folder, table, device):
    labels = table.labels | {"device": (device,) * len(table)}
    table = TimingTable(table.columns, labels, table.repeats_ms, table.compile_ms)
    write_kernel_tuner(folder / "cache.json", table)
    are_the_same(read_kernel_tuner(folder / "cache.json"), table)
    assert recognised(folder / "cache.json") == "kernel_tuner"


CACHE = {
    "device_name": "A GPU", "kernel_name": "shade", "problem_size": [64, 64], "tune_params_keys": ["tile", "layout"],
    "tune_params": {"tile": [8, 16], "layout": ["soa"]}, "objective": "time",
    "cache": {
        "8,soa": {"tile": 8, "layout": "soa", "time": 2.0, "times": [1.5, 2.5], "compile_time": 900.0, "GFLOP/s": 7.0},
        "16,soa": {"tile": 16, "layout": "soa", "time": "RuntimeFailedConfig", "compile_time": 1.0},
        "32,soa": {"tile": 32, "layout": "soa", "time": 3.0, "compile_time": 800.0},
    },
}  # fmt: skip


def test_a_kernel_tuner_cache_holds_parameters_repeats_and_failures(folder):
    table = read_kernel_tuner(written(folder, json.dumps(CACHE), "cache.json"))
    assert table.columns["tile"].tolist() == [8, 32] and list(table.columns) == ["tile"]
    assert table.labels == {"layout": ("soa", "soa"), "device": ("A GPU",) * 2, "kernel": ("shade",) * 2}
    assert table.repeats_ms == ((1.5, 2.5), (3.0,)) and table.compile_ms == (900.0, 800.0) and table.n_untimed == 1
    # Kernel Tuner appends to an open cache, and closes it when it is done; hubs keep them packed.
    still_open = json.dumps(CACHE)[:-2] + ","
    packed = written(folder, gzip.compress(still_open.encode()), "open.json.gz")
    are_the_same(read_table(packed, CsvLayout()), table)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("tune_params_keys",), None, ("tune_params_keys",)),
        (("cache",), [], ("`cache`",)),
        (("cache", "8,soa"), 3, ("8,soa", "no object")),
        (("cache", "8,soa", "tile"), "wide", ("`tile`", "numbers", "'wide'")),
        (("cache", "8,soa", "tile"), [8], ("`tile`", "not a number")),
        (("cache", "8,soa", "times"), [1.0, -1.0], ("8,soa", "`time` = -1", "negative")),
        (("cache", "8,soa", "times"), [math.nan], ("8,soa", "nan")),
        (("cache", "8,soa", "times"), [], ("8,soa", "`times`")),
        (("cache", "32,soa", "time"), None, ("32,soa", "`time`", "None")),
        (("cache",), {}, ("no configuration",)),
    ],
)
def test_a_bad_kernel_tuner_cache_is_refused(folder, path, value, words):
    content = json.loads(json.dumps(CACHE))
    at = content
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    with pytest.raises(InputError) as refused:
        read_kernel_tuner(written(folder, json.dumps(content), "cache.json"))
    for word in words:
        assert word in str(refused.value), refused.value


def test_a_missing_parameter_of_a_cache_is_named(folder):
    content = json.loads(json.dumps(CACHE))
    del content["cache"]["8,soa"]["tile"]
    with pytest.raises(InputError, match=r"8,soa.*`tile` is missing"):
        read_kernel_tuner(written(folder, json.dumps(content), "cache.json"))
