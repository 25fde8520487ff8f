"""`report.html`: everything a colleague needs to follow a run, in one file that asks no network for anything."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from reports.chart_style import chart_html
from reports.charts import beyond_the_chart, list_lengths, speed_against_error, stage_times
from reports.model_charts import predicted_against_measured, time_along_parameters
from reports.page_environment import page_environment
from reports.pictures import heat_scale, read_pictures
from reports.recommendation import recommend
from reports.run_folder import RunFolder, read_run_folder
from reports.stability_page import stability_of, stability_parts
from reports.tables import cost_model_groups, count_rows, measurement_table
from vtfs.files import write_atomically

_CHARTS = {
    "speed-against-error": speed_against_error,
    "stage-times": stage_times,
    "predicted-against-measured": predicted_against_measured,
    "time-along-parameters": time_along_parameters,
    "list-lengths": list_lengths,
}


def write_report(folder: Path | str) -> Path:
    """Write `report.html` into the folder of a run, from the files that are there.

    **Returns:** where it is.

    **Raises:** `InputError` where a file is missing or damaged, or the page cannot be written.
    """
    path = Path(folder) / "report.html"
    write_atomically(path, render_report(read_run_folder(folder)).encode("utf-8"))
    return path


def render_report(run: RunFolder) -> str:
    """The page as text.

    **Raises:** `InputError` where a picture is missing or damaged.
    """
    pictures = read_pictures(run.path / "pictures", run.quoted("pictures") or [])
    figures = {name: draw(run) for name, draw in _CHARTS.items()}
    stability = stability_of(run.path)
    return (
        page_environment()
        .get_template("report.html")
        .render(
            run=run,
            recommendation=recommend(run),
            pictures=pictures,
            heat_scale=heat_scale(pictures, run.quoted("heat_scale") or {}),
            # Both are made by plotly, which escapes what could end a script element.
            charts={
                name: None if figure is None else Markup(chart_html(figure, name)) for name, figure in figures.items()
            },
            plotly_js=Markup(get_plotlyjs()),
            beyond_the_chart=beyond_the_chart(run),
            cost_models=cost_model_groups(run),
            count_rows=count_rows(run),
            table=measurement_table(run),
            stability=stability,
            stability_parts=stability_parts(stability) if stability else (),
        )
    )
