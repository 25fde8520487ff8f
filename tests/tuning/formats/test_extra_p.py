"""Extra-P's lines: nothing is lost, and a bad line is refused by its number."""

import math

import numpy as np
import pytest
from hypothesis import given, settings

from tests.tuning.formats.tables import are_the_same, tables, written
from tuning.formats.extra_p import read_extra_p, write_extra_p
from tuning.formats.registry import recognised
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError


@settings(max_examples=60, deadline=None)
@given(table=tables(blanks=False, compiled=False))
def test_extra_p_loses_nothing(folder, table):
    write_extra_p(folder / "table.jsonl", table)
    are_the_same(read_extra_p(folder / "table.jsonl"), table)
    assert recognised(folder / "table.jsonl") == "extra_p"


def test_extra_p_lines_of_others(folder):
    text = (
        '{"params": {"p": 4}, "value": 1.5, "callpath": "main->solve", "metric": "time_us"}\n'
        '{"params": {"p": 4}, "value": [2.5, 3.5], "callpath": "main->solve", "metric": "time_us"}\n\n'
        '{"params": {"p": 8}, "value": 9, "callpath": "main->solve", "metric": "visits"}\n'
    )
    path = written(folder, text, "lines.jsonl")
    table = read_extra_p(path, "time_us")
    assert table.repeats_ms == (pytest.approx((0.0015, 0.0025, 0.0035)),) and table.columns["p"].tolist() == [4]
    assert table.labels == {"callpath": ("main->solve",)}
    with pytest.raises(InputError, match="time_us, visits"):
        read_extra_p(path)
    with pytest.raises(InputError, match="no metric `energy`"):
        read_extra_p(path, "energy")
    assert read_extra_p(written(folder, '{"params": {"p": 4}, "value": 2}', "l.jsonl"), unit="s").repeats_ms == (
        (2e3,),
    )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"value": 3}', ("line 2", "`params`")),
        ('{"params": {"p": 3}}', ("line 2", "`value`")),
        ('{"params": {"p": 3}, "value": []}', ("line 2", "`value`")),
        ('{"params": {"p": 3}, "value": -3}', ("line 2", "negative")),
        ('{"params": {"p": 3}, "value": true}', ("line 2", "not a time")),
        ('{"params": {"p": "four"}, "value": 3}', ("`p`", "numbers")),
        ('{"params": {"p": 3}, "val', ("line 2", "cut off")),
    ],
)
def test_a_bad_extra_p_line_is_refused(folder, line, words):
    with pytest.raises(InputError) as refused:
        read_extra_p(written(folder, '{"params": {"p": 3}, "value": 3}\n' + line, "lines.jsonl"))
    for word in words:
        assert word in str(refused.value), refused.value


def test_extra_p_needs_every_number(folder):
    table = TimingTable({"tile": np.array([8.0, math.nan])}, {}, ((1.0,), (2.0,)))
    with pytest.raises(InputError, match="`tile` is empty"):
        write_extra_p(folder / "t.jsonl", table)
