"""What a command leaves behind: in a pipe, when it is interrupted, where nothing can be written."""

from pathlib import Path

import pytest

from tests.command_line import ROOT, SMALL, Ran, finished, full_disk, is_refused, started, vtfs, write

pytestmark = pytest.mark.usefixtures("own_folder")


def test_in_a_pipe_only_the_result_is_printed():
    ran = finished(started("count", *SMALL, "--frame", "0", "--json", "-", folder=ROOT))
    assert ran.code == 0 and ran.err == ""
    assert ran.json["technique"] == "tiled_deferred"


def test_a_pipe_that_nobody_reads_ends_quietly():
    run = started("count", *SMALL, "--json", "-", folder=ROOT)
    assert run.stdout is not None
    run.stdout.close()
    assert run.stderr is not None
    err = run.stderr.read()
    run.stderr.close()
    assert run.wait(60) in (0, 1) and "Traceback" not in err


def test_an_interrupt_says_so_in_one_line(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("vtfs.scene_setup.set_up", interrupted)
    assert vtfs("count", *SMALL) == Ran(130, "", "vtfs: interrupted.\n")
    ran = vtfs("tune", *SMALL)
    assert ran.code == 130 and "--resume" in ran.err and ran.err.count("\n") == 1


def test_a_defect_of_ours_keeps_its_traceback(monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("ours")

    monkeypatch.setattr("vtfs.scene_setup.set_up", broken)
    with pytest.raises(ZeroDivisionError, match="ours"):
        vtfs("count", *SMALL)


@pytest.mark.parametrize("folder", ["file", "file/below"])
@pytest.mark.parametrize("command", ["tune", "render"])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_done(command, folder, monkeypatch):
    write("file", "")
    monkeypatch.setattr("vtfs.scene_setup.set_up", None)
    is_refused(vtfs(command, *SMALL, "--out", folder), f"--out {folder}", "no folder")


@pytest.mark.parametrize("arguments", [("count", "--json", "."), ("predict", "model.json", "rows.csv", "--out", ".")])
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_done(arguments, monkeypatch):
    monkeypatch.setattr("vtfs.scene_setup.set_up", None)
    is_refused(vtfs(*arguments), f"{arguments[-2]} .", "is a folder")


def test_a_bad_scene_leaves_nothing_behind():
    is_refused(vtfs("count", "none.glb", "--json", "x.json"))
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [("render", *SMALL, "--out", "out"), ("count", *SMALL, "--frame", "0", "--json", "out/counts.json")],
    ids=["render", "count"],
)
def test_a_full_disk_leaves_nothing_half_written(arguments):
    with full_disk("out", 2 if arguments[0] == "render" else 1):
        ran = vtfs(*arguments)
    assert ran.code == 2 and ran.err.count("\n") == 1 and "No space left on device" in ran.err
    assert not Path("out").exists() or list(Path("out").iterdir()) == []
