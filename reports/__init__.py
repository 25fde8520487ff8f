"""The report: reads the files of a run, runs nothing, writes one HTML page.

Loaded lazily, so that naming the package costs nothing: plotly and jinja2 come with the first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reports.page import render_report, write_report
    from reports.run_folder import RunFolder, read_run_folder

_ROOMS = {
    "RunFolder": "reports.run_folder",
    "read_run_folder": "reports.run_folder",
    "render_report": "reports.page",
    "write_report": "reports.page",
}

__all__ = ["RunFolder", "read_run_folder", "render_report", "write_report"]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module `reports` has no `{name}`")
    return getattr(importlib.import_module(_ROOMS[name]), name)
