"""`stability.html`: where methods fail, for a reader who has a minute and does not know the code."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from reports.chart_style import chart_html
from reports.page_environment import page_environment
from reports.stability_chart import error_map
from reports.stability_table import StabilityTable, tables
from vtfs.files import write_atomically
from vtfs.stability.record import FILE, StabilityResult, read_result


@dataclass(frozen=True)
class StabilityPart:
    """A table with its chart as HTML, or None."""

    table: StabilityTable
    chart: Markup | None

    @property
    def heading(self) -> str:
        kind = "Shadows" if self.table.kind == "shadow" else "Light tests"
        return kind if self.table.source == "built-in" else f"{kind} on {self.table.source}"


def stability_parts(result: StabilityResult) -> tuple[StabilityPart, ...]:
    """Tables and charts; charts only of what has several states."""
    parts = []
    for n, table in enumerate(tables(result)):
        figure = error_map(result, table.kind, table.source) if table.ladders else None
        chart = None if figure is None else Markup(chart_html(figure, f"error-map-{n}"))
        parts.append(StabilityPart(table, chart))
    return tuple(parts)


def write_stability_page(folder: Path | str) -> Path:
    """Write `stability.html` beside `stability.json`.

    **Returns:** where it is.

    **Raises:** `InputError` where the record is missing or damaged, or the page cannot be written.
    """
    path = Path(folder) / "stability.html"
    result = read_result(Path(folder))
    text = (
        page_environment()
        .get_template("stability.html")
        .render(result=result, parts_of_it=stability_parts(result), plotly_js=Markup(get_plotlyjs()))
    )
    write_atomically(path, text.encode("utf-8"))
    return path


def stability_of(folder: Path) -> StabilityResult | None:
    """The stability result that lies in the folder of a run, if there is one."""
    return read_result(folder) if (folder / FILE).exists() else None
