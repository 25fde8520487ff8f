"""A stability result on a terminal: one line for each group of methods."""

from __future__ import annotations

from reports.number_text import percent
from reports.stability_table import StabilityTable, tables
from vtfs.stability.record import StabilityResult

_KINDS = {"shadow": "Shadows", "light": "Light tests"}


def stability_text(result: StabilityResult) -> str:
    lines = []
    for table in tables(result):
        lines += [f"{_KINDS[table.kind]}, {table.source}:", *_lines(table), ""]
    n_failed = sum(bool(rung.failed) for rung in result.rungs)
    failed = f", {n_failed} of them could not be run" if n_failed else ""
    lines.append(f"{len(result.rungs)} of {result.planned} rungs{failed}, {result.wall_s:.0f} s")
    return "\n".join(lines)


def _lines(table: StabilityTable) -> list[str]:
    lines = []
    for row in table.rows:
        wrong = [
            f"{column.name} {cell.text} ({percent(cell.worst_share)} at {cell.worst})" if cell.worst
            else f"{column.name} {cell.text}"
            for column, cell in zip(table.ladders, row.cells, strict=True)
            if cell.state != "holds"
        ]  # fmt: skip
        lines.append(f"  {'; '.join(row.methods)}")
        lines.append(f"      {'; '.join(wrong) if wrong else 'right on every rung'}")
    if table.quiet:
        lines.append(f"  No method is wrong on: {', '.join(column.name for column in table.quiet)}.")
    return lines
