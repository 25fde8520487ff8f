"""A progress bar on a terminal; nothing in a pipe."""

from __future__ import annotations

from typing import Any


class Status:
    """A line on the terminal that says what is being done; silent in a pipe."""

    def __enter__(self) -> Status:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._progress.start()
        self._task = self._progress.add_task("", total=None)
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def say(self, what: str) -> None:
        self._progress.update(self._task, description=what)

    def share(self, what: str, done: float) -> None:
        self._progress.update(self._task, description=what, total=1.0, completed=done)

    def search(self, state: Any) -> None:
        best = "" if state.best_ms is None else f", best {state.best_ms:.1f} ms"
        self.share(f"{state.n_measured} measured{best}; now {state.configuration}", min(state.spent, 1.0))
