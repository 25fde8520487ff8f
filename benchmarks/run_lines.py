"""Runs of a benchmark side by side, each a line of a file: written as it is known, run once."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

from vtfs.files import write_atomically

T = TypeVar("T")


class RunLines:
    """A file of one JSON object a line; `key`: what tells a run from the others."""

    def __init__(self, path: Path, key: Callable[[dict], Hashable] = itemgetter("key")):
        self.path, self._key, self._lock = path, key, threading.Lock()
        text = path.read_text() if path.exists() else ""
        # A run that was killed may have left half a line.
        self.lines = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, "".join(json.dumps(line) + "\n" for line in self.lines).encode())

    def known(self) -> dict[Hashable, dict]:
        """The last line of each key; of those that failed none, so that they are run again."""
        with self._lock:
            return {self._key(line): line for line in self.lines if "failed" not in line}

    def add(self, line: dict) -> None:
        with self._lock:
            self.lines.append(line)
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")


def side_by_side(tasks: Iterable[T], n_workers: int, end: float, run: Callable[[T], None]) -> None:
    """Run tasks in their order, none begun after `end` (of `time.monotonic`); what still runs then is left alone.

    A caller that wants to be over leaves by `os._exit`: a compiler cannot be stopped.
    """

    def in_time(task: T) -> None:
        if time.monotonic() < end:
            run(task)

    pool = ThreadPoolExecutor(n_workers)
    wait([pool.submit(in_time, task) for task in tasks], timeout=max(0.0, end - time.monotonic()))
    pool.shutdown(wait=False, cancel_futures=True)


def why(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]
