"""PresentMon CSV: one row a presented frame, of v1, of v2, and of 2.4 and later, whose headers differ."""

from __future__ import annotations

from pathlib import Path

from tuning.formats.csv_sheet import Sheet, read_sheet
from tuning.formats.grouping import Value, as_time_ms, grouped
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

FRAME_TIMES = ("msbetweenpresents", "frametime", "msbetweenappstart")
"""Columns of the time from frame to frame, in lower case: of v1 and of 2.4 on, of 2.0 to 2.3, and of 2.4 on."""

_LABELS = {"application": "application", "swapchainaddress": "swap_chain", "presentmode": "present_mode"}


def is_presentmon(header: list[str]) -> bool:
    lowered = {name.strip().lower() for name in header}
    return {"application", "swapchainaddress"} <= lowered


def read_presentmon(path: Path | str, time: str | None = None) -> TimingTable:
    """Read a capture: a row for each application, swap chain and present mode, whose frames are its repeats.

    Frames that a driver generated (`FrameType`) are left out, and frames without a value (`NA`) are counted as
    untimed.

    **Arguments:**

    - `time`: the column of times, as `GPUTime`; `None`: the time from frame to frame, which holds what a limit on
      the frame rate adds.

    **Raises:** `InputError` for a file that is no such CSV, a column that there is not, and a time that is negative
    or no number.
    """
    sheet = read_sheet(path)
    names = {name.lower(): name for name in sheet.columns}
    column = _time_column(sheet, names, time)
    kinds = sheet.columns[names["frametype"]] if "frametype" in names else ("application",) * len(sheet)
    times_ms: list[tuple[float, ...]] = []
    kept: list[int] = []
    n_untimed = 0
    for row, (cell, kind) in enumerate(zip(sheet.columns[column], kinds, strict=True)):
        if kind.strip().lower() not in ("application", "not_set", "notset", "unspecified", ""):
            continue
        if cell.strip().upper() in ("", "NA"):
            n_untimed += 1
            continue
        kept.append(row)
        times_ms.append((as_time_ms(sheet.number(row, column), sheet.at(row, column)),))
    if not kept:
        raise InputError(f"{path}: no frame has a time in `{column}`; choose another column with --time.")
    labels: dict[str, list[Value]] = {
        ours: [sheet.columns[names[theirs]][row] for row in kept] for theirs, ours in _LABELS.items() if theirs in names
    }
    return grouped(labels, times_ms, n_untimed=n_untimed)


def _time_column(sheet: Sheet, names: dict[str, str], time: str | None) -> str:
    wanted = FRAME_TIMES if time is None else (time.strip().lower(), f"ms{time.strip().lower()}")
    for name in wanted:
        if name in names:
            return names[name]
    if time is not None:
        sheet.column(time)
    raise InputError(
        f"{sheet.path}: has none of MsBetweenPresents, FrameTime, MsBetweenAppStart; say with --time which of "
        f"{', '.join(sheet.columns)}."
    )
