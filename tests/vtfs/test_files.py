"""Files are all there, or as they were."""

import errno
import os
import stat

import pytest

from vtfs import files
from vtfs.files import write_atomically
from vtfs.input_error import InputError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("data", [b"", b"new", b"x" * 10_000_000])
def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path, data):
    path = tmp_path / "deep" / "down" / "result.json"
    write_atomically(path, b"old, and longer")
    write_atomically(str(path), data)
    assert path.read_bytes() == data and names(path.parent) == ["result.json"]


def test_others_may_read_what_the_umask_lets_them(tmp_path):
    mask = os.umask(0o027)
    try:
        write_atomically(tmp_path / "a", b"")
        assert os.umask(0o027) == 0o027  # left as it was
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def full(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("step", ["fsync", "replace", "chmod", "fdopen"])
@pytest.mark.parametrize("existed", [True, False])
def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch, step, existed):
    path = tmp_path / "result.json"
    if existed:
        path.write_bytes(b"old")
    monkeypatch.setattr(files.os, step, full)
    with pytest.raises(
        InputError, match=r"result\.json: cannot be written \(No space left on device\); choose another"
    ):
        write_atomically(path, b"new")
    assert names(tmp_path) == (["result.json"] if existed else [])
    assert not existed or path.read_bytes() == b"old"


def test_a_disk_that_fills_up_during_the_write_leaves_what_was_there(tmp_path, monkeypatch):
    path, fdopen = tmp_path / "result.json", os.fdopen
    path.write_bytes(b"old")

    class Filling:
        def __init__(self, handle, mode):
            self.file = fdopen(handle, mode)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.file.close()

        def write(self, data):
            self.file.write(data[: len(data) // 2])
            full()

    monkeypatch.setattr(files.os, "fdopen", Filling)
    with pytest.raises(InputError, match="No space left"):
        write_atomically(path, b"new and longer")
    assert path.read_bytes() == b"old" and names(tmp_path) == ["result.json"]


def test_an_interrupt_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "result.json"
    path.write_bytes(b"old")

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(files.os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and names(tmp_path) == ["result.json"]


def test_a_path_that_cannot_be_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "file" / "below", tmp_path / "folder", tmp_path / ("x" * 300)):
        with pytest.raises(InputError, match="cannot be written") as caught:
            write_atomically(path, b"new")
        assert "\n" not in str(caught.value)
    assert names(tmp_path) == ["file", "folder"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        write_atomically(tmp_path / "a", b"")
    assert names(tmp_path) == []


def test_a_folder_that_refuses_new_files_is_named(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(files.tempfile, "mkstemp", refuse)
    with pytest.raises(InputError, match="a: cannot be written \\(Permission denied\\)"):
        write_atomically(tmp_path / "a", b"")
