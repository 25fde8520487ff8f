"""A run of `vtfs tune` that was cut or killed anywhere goes on, and measures nothing twice."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from tests.command_line import SMALL, finished, is_refused, started
from tests.tuning.tune_runs import configurations_of, is_complete, lines_of, result_of, tune

pytestmark = pytest.mark.usefixtures("quick_tune")


def test_a_folder_with_measurements_is_not_written_over():
    result_of(tune("--budget", "2"))
    before = lines_of()
    is_refused(tune("--budget", "2"), "out", "--resume")
    assert lines_of() == before


def test_going_on_twice_measures_nothing_new():
    first = result_of(tune("--budget", "4"))
    before = lines_of()
    for _ in range(2):
        again = result_of(tune("--budget", "4", "--resume"))
        assert lines_of() == before
        assert again["best"]["params"] == first["best"]["params"] and again["measured"] == first["measured"]
    more = result_of(tune("--budget", "5", "--resume"))
    assert lines_of()[:-1] == before and more["measured"] == 5


def test_a_run_that_was_cut_anywhere_goes_on():
    """What a kill leaves is the file up to some byte: any of a line's start, middle, last byte, missing line end."""
    result_of(tune("--budget", "4"))
    whole = b"".join(lines_of())
    ends = np.cumsum([len(line) for line in lines_of()])
    for k, length in enumerate(
        [0, 10, ends[0] - 1, ends[0], ends[1] - 2, ends[1] + 1, (ends[1] + ends[2]) // 2, ends[3] - 1]
    ):
        out = f"cut{k}"
        Path(out).mkdir()
        Path(out, "measurements.jsonl").write_bytes(whole[:length])
        complete = [line.strip() for line, end in zip(lines_of(), ends, strict=True) if end - 1 <= length]
        result_of(tune("--budget", "4", "--resume", out=out), out)
        assert [line.strip() for line in lines_of(out)[: len(complete)]] == complete
        assert len(lines_of(out)) == len(set(configurations_of(out))) == 4


def test_a_run_that_was_killed_goes_on(tmp_path):
    arguments = ("tune", *SMALL, "--space", "space.toml", "--budget", "6", "--out", "out")
    run = started(*arguments, folder=tmp_path)
    deadline = time.monotonic() + 100
    while not (Path("out/measurements.jsonl").exists() and len(lines_of()) >= 2):
        assert run.poll() is None and time.monotonic() < deadline, run.communicate()
        time.sleep(0.005)
    os.kill(run.pid, signal.SIGKILL)
    run.communicate()
    kept = [line for line in lines_of() if line.endswith(b"\n")]
    assert 2 <= len(kept) < 6 and not Path("out/result.json").exists()
    ran = finished(started(*arguments, "--resume", folder=tmp_path))
    result = result_of(ran)
    is_complete(result)
    assert lines_of()[: len(kept)] == kept
    assert len(lines_of()) == len(set(configurations_of())) == 6


def test_another_scene_in_the_same_folder_is_a_run_of_its_own():
    result_of(tune("--budget", "2"))
    grove = ("grove", "--triangles", "1000", "--size", "64x36", "--lights", "20")
    result = result_of(tune("--budget", "2", "--resume", scene=grove))
    assert result["scene"]["name"] == "grove" and result["measured"] + result["failed"] == 2
    assert len(lines_of()) == 4


def test_a_damaged_record_is_refused():
    Path("out").mkdir()
    Path("out/measurements.jsonl").write_text('{"schema": 1}\n{"schema": 1}\n')
    is_refused(tune("--resume"), "measurements.jsonl", "line 1")
