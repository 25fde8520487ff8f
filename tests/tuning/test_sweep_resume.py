"""A search that was killed goes on, and measures nothing twice."""

import dataclasses
from pathlib import Path

import pytest

from tests.tuning.synthetic_workload import LAUNCH_BOUND, WHOLE, Synthetic, erratic
from tuning.budget import Budget
from tuning.record import read_measurements
from tuning.search_run import Workload
from tuning.sweep import search
from vtfs.input_error import InputError

N_SEARCHED = 16
N_DESIGN = 6  # two techniques' defaults, two more of each


def sought() -> Synthetic:
    """No model is ever sure of it: the budget is used up, and most of it on what models chose."""
    return Synthetic(LAUNCH_BOUND, hidden=erratic)


def searched(path: Path, workload: Workload):
    return search(WHOLE, workload, path, Budget(measurements=N_SEARCHED))


@pytest.mark.parametrize("torn", [b"", b'{"schema": 1, "technique": "tiled_def'])
def test_a_kill_after_any_line_neither_loses_nor_repeats_a_measurement(tmp_path, torn):
    whole = tmp_path / "whole.jsonl"
    complete = sought()
    expected = searched(whole, complete)
    lines = whole.read_bytes().splitlines(keepends=True)
    assert len(lines) == N_SEARCHED
    for n_kept in range(0, N_SEARCHED, 3):
        path = tmp_path / f"{n_kept}.jsonl"
        path.write_bytes(b"".join(lines[:n_kept]) + torn)
        workload = sought()
        result = searched(path, workload)
        assert path.read_bytes().splitlines(keepends=True)[:n_kept] == lines[:n_kept]
        kept = complete.measured[:n_kept]
        assert not set(kept) & set(workload.measured) and len(set(workload.measured)) == N_SEARCHED - n_kept
        # Later choices are made two at a time: a half one is made anew, knowing more.
        if n_kept <= N_DESIGN:
            assert workload.measured == complete.measured[n_kept:]
            assert path.read_bytes() == whole.read_bytes()
            assert result == expected


def test_a_kill_while_measuring_loses_that_measurement_alone(tmp_path):
    path = tmp_path / "measurements.jsonl"
    with pytest.raises(KeyboardInterrupt):
        searched(path, dataclasses.replace(sought(), dies_at=7))
    assert len(read_measurements(path)) == 7
    workload = sought()
    searched(path, workload)
    assert len(workload.measured) == N_SEARCHED - 7
    assert len(read_measurements(path)) == N_SEARCHED


def test_a_finished_search_is_only_evaluated_again(tmp_path):
    path = tmp_path / "measurements.jsonl"
    first = searched(path, sought())
    workload = sought()
    assert searched(path, workload) == first
    assert workload.measured == []


@pytest.mark.parametrize("other", [{"scene_key": "another"}, {"device": "another"}, {"frames": (1, 2, 3)}])
def test_measurements_of_something_else_are_kept_but_not_used(tmp_path, other):
    path = tmp_path / "measurements.jsonl"
    searched(path, dataclasses.replace(sought(), **other))
    workload = sought()
    result = searched(path, workload)
    assert len(workload.measured) == len(result.measurements) == N_SEARCHED
    assert len(read_measurements(path)) == 2 * N_SEARCHED


def test_a_damaged_record_is_refused_before_anything_is_measured(tmp_path):
    path = tmp_path / "measurements.jsonl"
    path.write_text("nonsense\n")
    workload = Synthetic(LAUNCH_BOUND)
    with pytest.raises(InputError, match="line 1"):
        searched(path, workload)
    assert workload.measured == []
