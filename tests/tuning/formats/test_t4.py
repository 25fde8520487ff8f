"""The T4 results of autotuners: nothing is lost, they are written as the schema wants, and bad ones are refused."""

import json
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings

from tests.tuning.formats.tables import are_the_same, tables, written
from tuning.formats.registry import recognised
from tuning.formats.t4 import read_t4, write_t4
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError


@settings(max_examples=60, deadline=None)
@given(table=tables())
def test_t4_loses_nothing(folder, table):
    write_t4(folder / "table.json", table)
    are_the_same(read_t4(folder / "table.json"), table)
    assert recognised(folder / "table.json") == "t4"


T4 = {
    "schema_version": "1.0.0", "metadata": {"timeunit": "milliseconds"},
    "results": [
        {"configuration": {"tile": 8}, "times": {"compilation": 900.0, "runtimes": [1.5, 2.5]},
         "invalidity": "correct", "correctness": 1, "measurements": [], "objectives": ["time"]},
        {"configuration": {"tile": 16}, "times": {}, "invalidity": "runtime", "correctness": 0},
        {"configuration": {"tile": 32}, "times": {"compilation_time": 800.0, "runtimes": []}, "invalidity": "correct",
         "correctness": 1, "measurements": [{"name": "energy", "value": 5, "unit": "J"},
                                            {"name": "kernel", "value": 3000, "unit": "us"}],
         "objectives": ["kernel"]},
    ],
}  # fmt: skip


def test_t4_results_of_others(folder):
    table = read_t4(written(folder, json.dumps(T4), "t4.json"))
    assert table.columns["tile"].tolist() == [8, 32] and table.n_untimed == 1
    assert table.repeats_ms == ((1.5, 2.5), (3.0,)) and table.compile_ms == (900.0, 800.0)
    seconds = {**T4, "metadata": {"timeunit": "seconds"}}
    assert read_t4(written(folder, json.dumps(seconds), "t4.json")).repeats_ms[0] == (1500.0, 2500.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"results": None}, ("`results`",)),
        ({"results": []}, ("no correct result",)),
        ({"results": [3]}, ("results[0]", "configuration")),
        ({"results": [{**T4["results"][0], "times": {"runtimes": [-1]}}]}, ("results[0]", "times.runtimes", "-1")),
        ({"results": [{**T4["results"][0], "times": {}}]}, ("results[0]", "neither")),
        ({"metadata": {"timeunit": "fortnights"}}, ("timeunit", "fortnights")),
        ({"schema_version": "2.0.0"}, ("schema_version", "2.0.0")),
    ],
)
def test_a_bad_t4_file_is_refused(folder, change, words):
    with pytest.raises(InputError) as refused:
        read_t4(written(folder, json.dumps({**T4, **change}), "t4.json"))
    for word in words:
        assert word in str(refused.value), refused.value


def test_t4_is_written_as_its_schema_wants_it(folder):
    """Required fields and types of the results schema 1.0.0; Kernel Tuner's name of the compile time."""
    table = TimingTable({"tile": np.array([8.0])}, {"technique": ("forward",)}, ((1.0, 3.0),), (250.0,))
    write_t4(folder / "t4.json", table)
    content = json.loads((folder / "t4.json").read_text())
    result = content["results"][0]
    assert content["schema_version"] == "1.0.0" and content["metadata"] == {"timeunit": "milliseconds"}
    assert result["configuration"] == {"tile": 8, "technique": "forward"}
    assert result["times"]["compilation"] == 250.0 and result["times"]["runtimes"] == [1.0, 3.0]
    assert result["invalidity"] == "correct" and result["correctness"] == 1
    assert result["measurements"] == [{"name": "time", "value": 2.0, "unit": "ms"}] and result["objectives"] == ["time"]


T4_RESULT = {"configuration": dict, "times": dict, "invalidity": str, "correctness": (int, float)}
"""What the results schema requires of a result, and of what type; the rest is optional there."""


@pytest.mark.parametrize("compile_ms", [None, (250.0, 1e3, 0.0)])
def test_all_that_t4s_schema_requires_is_there_in_its_types(folder, compile_ms):
    """By hand, after results-schema.json of github.com/odgaard/TuningSchema: no validator is among the dependencies."""
    repeats = ((1.0, 3.0), (0.5,), (1e-6, 2e9, 4.0))
    columns = {"tile": np.array([8.0, 0.5, 1e12]), "batch": np.array([1.0, math.nan, 3.0])}
    write_t4(folder / "t4.json", TimingTable(columns, {"technique": ("a", "b", "c")}, repeats, compile_ms))
    text = (folder / "t4.json").read_text()
    content = json.loads(text, parse_constant=pytest.fail)  # NaN and Infinity are no JSON
    assert re.fullmatch(r"[0-9]+\.[0-9]+\.[0-9]+", content["schema_version"])
    assert len(content["results"]) == len(repeats)
    for result in content["results"]:
        assert all(isinstance(result[name], kind) for name, kind in T4_RESULT.items())
        times = result["times"]
        assert {"compilation", "runtimes", "framework", "search_algorithm", "validation"} <= times.keys()
        assert all(isinstance(value, list if name == "runtimes" else (int, float)) for name, value in times.items())
        assert all(isinstance(ms, (int, float)) for ms in times["runtimes"])
        assert isinstance(result["objectives"], list)
        for one in result["measurements"]:
            assert isinstance(one["name"], str) and isinstance(one["value"], (int, float))
            assert isinstance(one["unit"], str)
