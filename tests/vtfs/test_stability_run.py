"""A run of the ladders: what is kept when it ends early, and what is refused."""

from __future__ import annotations

import json

import pytest

from tests.command_line import is_refused, vtfs
from vtfs.input_error import InputError
from vtfs.stability import run as run_module
from vtfs.stability.ladder import Ladder
from vtfs.stability.record import FILE, RungResult, Verdict, read_result
from vtfs.stability.run import run_stability

LADDER = Ladder("tilt", "Tilt of it all", "built-in", ())


@pytest.fixture
def judged(monkeypatch):
    """Six rungs that take no time; what was run, in order."""
    ran: list[str] = []

    def job(label: str):
        def judge():
            ran.append(label)
            if label == "3":
                raise InputError("too many cells")
            if label == "4" and "interrupt" in ran:
                raise KeyboardInterrupt
            return 100, 60, 40, {"z_pass": Verdict(5, 1, 3, 2, 0.05), "ptsv": Verdict(refused="does not fit")}

        return run_module._Job(LADDER, "shadow", label, judge)

    monkeypatch.setattr(run_module, "_jobs", lambda seed, own: map(job, "012345"))
    return ran


def test_every_rung_is_kept_and_read_again(judged, tmp_path):
    result = run_stability(tmp_path, seed=3)
    assert judged == list("012345") and result.is_complete and result.seed == 3
    assert read_result(tmp_path) == result
    assert result.rungs[0] == RungResult(
        "tilt", "Tilt of it all", "built-in", "shadow", "0", 100, 60, 40,
        {"z_pass": Verdict(5, 1, 3, 2, 0.05), "ptsv": Verdict(refused="does not fit")},
    )  # fmt: skip
    assert result.rungs[3].failed == "too many cells" and result.rungs[3].verdicts == {}


def test_an_interrupted_run_goes_on_where_it_was(judged, tmp_path):
    judged.append("interrupt")
    with pytest.raises(KeyboardInterrupt):
        run_stability(tmp_path, seed=3)
    kept = json.loads((tmp_path / FILE).read_text())
    assert [rung["label"] for rung in kept["rungs"]] == list("0123") and not kept["complete"]
    judged.clear()
    result = run_stability(tmp_path, seed=3, resume=True)
    assert judged == ["4", "5"] and [rung.label for rung in result.rungs] == list("012345")
    assert result.rungs[:4] == tuple(read_result(tmp_path).rungs[:4]) and result.wall_s >= kept["wall_s"]


def test_another_runs_file_is_not_gone_on_with(judged, tmp_path):
    run_stability(tmp_path, seed=3)
    with pytest.raises(InputError, match=r"is of another `seed` \(3\)"):
        run_stability(tmp_path, seed=4, resume=True)


@pytest.mark.parametrize("damage", ["", "[]", '{"schema": 9}', '{"schema": 1, "rungs": [{}]}', '{"schema": 1}'])
def test_a_damaged_file_is_refused_by_name(damage, tmp_path):
    (tmp_path / FILE).write_text(damage)
    with pytest.raises(InputError, match=FILE):
        read_result(tmp_path)


def test_the_command_prints_writes_and_refuses(judged, tmp_path):
    out = tmp_path / "run"
    ran = vtfs("stability", "--out", out, "--json", tmp_path / "result.json")
    assert ran.code == 0, ran.err
    assert "z_pass" in ran.out and "6 of 6 rungs, 1 of them could not be run" in ran.out
    assert json.loads((tmp_path / "result.json").read_text()) == json.loads((out / FILE).read_text())
    assert (out / "stability.html").stat().st_size > 10_000
    again = vtfs("stability", "--out", out)
    is_refused(again, "holds an earlier result")
    judged.clear()
    assert vtfs("stability", "--out", out, "--resume").code == 0 and judged == []
    is_refused(vtfs("stability", "--lights", "5", "--out", tmp_path / "x"), "go with a SCENE")
