"""Running `vtfs` as its user does: in this process, or in one of its own (three seconds of imports)."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from vtfs.camera import Viewport
from vtfs.scene_setup import SceneOptions, SceneSetup, set_up

ROOT = Path(__file__).parents[1]

STREET = ("street", "--triangles", "1000", "--size", "64x36")
SMALL = (*STREET, "--lights", "20")
"""Its programs are compiled once for all tests: shapes depend on the size and on the number of lights."""

CAMERA = {
    "width": 64,
    "height": 36,
    "fov_y_deg": 60,
    "near": 0.1,
    "far": 100,
    "frames": [{"eye": [0, 1, 0], "target": [1, 1, 0], "up": [0, 1, 0]}],
}
"""What a file of cameras holds."""

_FRAME_CAP_S = 0.02
"""On a busy machine a frame of a millisecond is repeated for the whole two seconds; here that decides nothing."""

_PROGRAM = f"""
import functools, sys
from vtfs.cli import main
if sys.argv[1:2] == ["tune"]:
    import tuning.workload as workload
    workload.repeats_ms = functools.partial(workload.repeats_ms, cap_s={_FRAME_CAP_S})
    workload._DUEL_CAP_S = {_FRAME_CAP_S}
main()
"""


@dataclass(frozen=True)
class Ran:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


def small_setup() -> SceneSetup:
    """What `SMALL` names."""
    return set_up(SceneOptions("street", viewport=Viewport(64, 36), n_triangles=1000, lights="20"))


def write(name: str, content: Any) -> None:
    """A file of a user's, from a text or from bytes."""
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())


def vtfs(*arguments: object) -> Ran:
    """`vtfs ARGUMENTS` in this process. A defect of ours, a traceback to the user, is raised."""
    out, err, log = io.StringIO(), io.StringIO(), logging.getLogger("vtfs")
    level, code = log.level, 0
    with (
        mock.patch.object(sys, "argv", ["vtfs", *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        from vtfs.cli import main

        try:
            main()
        except SystemExit as left:
            code = left.code if isinstance(left.code, int) else int(left.code is not None)
        finally:
            log.setLevel(level)
    return Ran(code, out.getvalue(), err.getvalue())


def started(*arguments: object, folder: Path) -> subprocess.Popen[str]:
    """`vtfs ARGUMENTS` in a process of its own, with `folder` as its working directory."""
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, *map(str, arguments)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "default"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(process: subprocess.Popen[str]) -> Ran:
    out, err = process.communicate(timeout=120)
    return Ran(process.returncode, out, err)


@contextlib.contextmanager
def short_repeats() -> Iterator[None]:
    """A `tune` that takes a second."""
    from tuning.timing import repeats_ms

    quick = functools.partial(repeats_ms, cap_s=_FRAME_CAP_S)
    with mock.patch("tuning.workload.repeats_ms", quick), mock.patch("tuning.workload._DUEL_CAP_S", _FRAME_CAP_S):
        yield


@contextlib.contextmanager
def full_disk(folder: str, nth: int) -> Iterator[None]:
    """The disk is full from the n-th file on that is written below `folder` (each is made sure of by `fsync`)."""
    calls, fsync = [], os.fsync

    def full(handle: int) -> None:
        if f"/{folder}/" in str(Path(f"/proc/self/fd/{handle}").readlink()):
            calls.append(handle)
            if len(calls) >= nth:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    with mock.patch("os.fsync", full):
        yield


def is_refused(ran: Ran, *words: str) -> None:
    """Exit code 2 and one line on stderr that holds all `words`; nothing on stdout."""
    assert ran.code == 2, ran
    assert ran.err.startswith("vtfs: ") and ran.err.count("\n") == 1 and ran.err.endswith("\n"), ran.err
    assert "Traceback" not in ran.err and len(ran.err) < 500
    for word in words:
        assert word in ran.err, (word, ran.err)
    assert ran.out == ""
