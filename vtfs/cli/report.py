"""`vtfs report`: the page of a run, written again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a `vtfs tune` run.")]) -> None:
    """Write report.html again from the files of a run; measures nothing."""
    from reports.page import write_report

    print(write_report(folder))
