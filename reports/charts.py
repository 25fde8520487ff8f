"""Speed against error, and where the time of a frame goes, as plotly figures.

A chart without data is None. Nothing is in a chart alone: the tables have every number too.
"""

from __future__ import annotations

import math

import plotly.graph_objects as go

from reports import number_text
from reports.chart_style import (
    hover,
    in_technique_order,
    plain,
    power_of_ten,
    styled,
    technique_marker,
    time_axis,
    timed_text,
)
from reports.palette import INK, QUIET_INK, in_stage_order, stage_colour, technique_colour
from reports.run_folder import RunFolder, Timed

_BEYOND = 8.0  # times the fastest technique


def speed_against_error(run: RunFolder) -> go.Figure | None:
    """Every measured point, and the front: those that no other point beats in both time and error.

    The error axis is logarithmic. Images that differ from the reference by rounding alone stand together at
    an end marked "exact", since a logarithm has no place for them.
    """
    measured = [
        Timed(line.technique, line.params, time_ms, None, line.error)
        for line in run.measurements
        if (time_ms := run.time_ms(line)) is not None and line.error is not None
    ]
    front = sorted((point for point in run.pareto if point.error is not None), key=lambda point: point.time_ms)
    if not measured and not front:
        return None
    limit = _max_error(run)
    errors = [point.error for point in measured + front if point.error and point.error >= number_text.EXACT_BELOW]
    errors += [limit] if limit else []
    first_decade = math.floor(math.log10(min(errors, default=1e-6)))
    last_decade = math.ceil(math.log10(1.2 * max(errors, default=1e-4)))
    exact_at = 10.0 ** (first_decade - 1)

    def place(point: Timed) -> float:
        return max(point.error or 0.0, exact_at) if (point.error or 0.0) >= number_text.EXACT_BELOW else exact_at

    figure = go.Figure()
    figure.add_shape(
        type="rect",
        yref="paper",
        x0=exact_at / 2.2,
        x1=exact_at * 2.2,
        y0=0,
        y1=1,
        fillcolor="#eff3f4",
        line_width=0,
        layer="below",
    )
    for technique in in_technique_order(point.technique for point in measured):
        of_it = [point for point in measured if point.technique == technique]
        figure.add_scatter(
            x=[place(point) for point in of_it],
            y=[point.time_ms for point in of_it],
            mode="markers",
            name=plain(technique),
            marker=technique_marker(technique, opacity=0.45),
            hovertext=[hover(technique, point.params, timed_text(point.time_ms, point.error)) for point in of_it],
            hoverinfo="text",
        )
    figure.add_scatter(
        x=[place(point) for point in front],
        y=[point.time_ms for point in front],
        mode="lines",
        name="front",
        line={"color": INK, "width": 1.6},
        hoverinfo="skip",
    )
    for technique in in_technique_order(point.technique for point in front):
        of_it = [point for point in front if point.technique == technique]
        figure.add_scatter(
            x=[place(point) for point in of_it],
            y=[point.time_ms for point in of_it],
            mode="markers",
            showlegend=False,
            marker=technique_marker(technique, size=11) | {"line": {"color": INK, "width": 1.4}},
            hovertext=[hover(technique, point.params, timed_text(point.time_ms, point.error)) for point in of_it],
            hoverinfo="text",
        )
    if run.best is not None and run.best.error is not None:
        figure.add_scatter(
            x=[place(run.best)],
            y=[run.best.time_ms],
            mode="markers",
            name="best",
            marker={"symbol": "circle-open", "size": 22, "color": INK, "line": {"width": 1.8}},
            hoverinfo="skip",
        )
    if limit:
        figure.add_vline(
            x=limit,
            line={"color": QUIET_INK, "width": 1.2, "dash": "dash"},
            annotation={"text": "largest error allowed", "font": {"size": 12, "color": QUIET_INK}},
        )
    decades = range(first_decade, last_decade + 1)
    figure.update_xaxes(
        type="log",
        range=[first_decade - 1.4, last_decade + 0.1],
        tickvals=[exact_at, *(10.0**decade for decade in decades)],
        ticktext=["exact", *(power_of_ten(decade) for decade in decades)],
        title={"text": "error of the image: RMSE over RMS of the float64 reference"},
    )
    which = "mean over the frames, ms" if run.objective == "mean" else "slowest frame, ms"
    figure.update_yaxes(time_axis([point.time_ms for point in measured + front], which))
    return styled(figure, height_px=440)


def stage_times(run: RunFolder) -> go.Figure | None:
    """For each technique two bars: its stages, each timed apart and stacked, and the fused frame."""
    beyond = beyond_the_chart(run)
    techniques = in_technique_order(name for name, stages in run.stages_ms.items() if stages and name not in beyond)
    if not techniques:
        return None
    figure = go.Figure()
    # Bars stand in the order in which plotly meets their names: these, of no length, fix it.
    figure.add_bar(
        x=[0.0] * (2 * len(techniques)),
        y=[[plain(t) for t in techniques for _ in range(2)], ["stages apart", "fused frame"] * len(techniques)],
        orientation="h",
        showlegend=False,
        hoverinfo="skip",
    )
    for stage in in_stage_order(stage for t in techniques for stage in run.stages_ms[t] if stage != "frame"):
        having = [technique for technique in techniques if stage in run.stages_ms[technique]]
        figure.add_bar(
            x=[run.stages_ms[technique][stage] for technique in having],
            y=[[plain(technique) for technique in having], ["stages apart"] * len(having)],
            orientation="h",
            name=plain(stage),
            marker={"color": stage_colour(stage), "line": {"color": "#ffffff", "width": 1}},
            hovertext=[_stage_hover(run, technique, stage) for technique in having],
            hoverinfo="text",
        )
    framed = [technique for technique in techniques if "frame" in run.stages_ms[technique]]
    frames_ms = [run.stages_ms[technique]["frame"] for technique in framed]
    figure.add_bar(
        x=frames_ms,
        y=[[plain(technique) for technique in framed], ["fused frame"] * len(framed)],
        orientation="h",
        name="frame, fused",
        marker={"color": INK},
        text=[number_text.ms(value) for value in frames_ms],
        textposition="outside",
        cliponaxis=False,
        hovertext=[_stage_hover(run, technique, "frame") for technique in framed],
        hoverinfo="text",
    )
    sums_ms = [sum(run.stages_ms[t].values()) - run.stages_ms[t].get("frame", 0.0) for t in techniques]
    # Room for the text beside the longest bar.
    longest_ms = max([*sums_ms, *frames_ms]) or 1.0
    figure.update_layout(barmode="stack", bargap=0.28)
    figure.update_xaxes(title={"text": "ms, median on the slowest frame"}, range=[0, 1.14 * longest_ms])
    figure.update_yaxes(autorange="reversed", showgrid=False, showdividers=False, ticks="", showline=False)
    return styled(figure, height_px=136 + 84 * len(techniques))


def list_lengths(run: RunFolder) -> go.Figure | None:
    """How many lists have how many lights: one line a technique, stepped at the edges of its bins."""
    histograms = {own.technique: own for own in run.list_lengths if own.n_lists}
    if not histograms:
        return None
    figure = go.Figure()
    for technique in in_technique_order(histograms):
        own = histograms[technique]
        edges = [i * own.bin_width for i in range(len(own.lists_in_bin) + 1)]
        shares = [100 * n / own.n_lists for n in own.lists_in_bin]
        figure.add_scatter(
            x=edges,
            y=[*shares, 0.0],
            mode="lines",
            name=plain(technique),
            line={"color": technique_colour(technique), "width": 2, "shape": "hv"},
            hovertext=[
                f"<b>{plain(technique)}</b><br>{first:g} to {first + own.bin_width - 1:g} lights: {n:,.0f} lists"
                for first, n in zip(edges, (*own.lists_in_bin, 0), strict=True)
            ],
            hoverinfo="text",
        )
    figure.update_xaxes(title={"text": "lights on the list of a cell"}, rangemode="tozero")
    figure.update_yaxes(title={"text": "lists, %"}, rangemode="tozero")
    return styled(figure, height_px=320)


def beyond_the_chart(run: RunFolder) -> dict[str, float]:
    """Techniques so slow that the others would be slivers beside them, with their times, which the table has too."""
    times_ms = {name: max(stages.values()) for name, stages in run.stages_ms.items() if stages}
    fastest_ms = min(times_ms.values(), default=0.0)
    return {name: time_ms for name, time_ms in times_ms.items() if time_ms > _BEYOND * fastest_ms}


def _max_error(run: RunFolder) -> float | None:
    limit = run.quoted("max_error")
    return float(limit) if isinstance(limit, int | float) and 0 < limit < math.inf else None


def _stage_hover(run: RunFolder, technique: str, stage: str) -> str:
    return f"<b>{plain(stage)}</b> of {plain(technique)}<br>{number_text.ms(run.stages_ms[technique][stage])}"
