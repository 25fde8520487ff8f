"""What the cost models predict, beside what was measured, as plotly figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from reports import number_text
from reports.chart_style import hover, in_technique_order, plain, styled, technique_marker, time_axis
from reports.palette import INK, QUIET_INK, technique_colour
from reports.run_folder import Prediction, RunFolder
from vtfs.parameters import PARAMETERS, Value

_PANELS_IN_A_ROW = 4


def predicted_against_measured(run: RunFolder) -> go.Figure | None:
    """Log-log scatter, one mark a measured configuration, with the line on which a perfect model would lie."""
    both = [(made, made.measured_ms) for made in run.predictions if made.measured_ms and made.predicted_ms > 0]
    if not both:
        return None
    values_ms = [value for made, measured_ms in both for value in (made.predicted_ms, measured_ms)]
    ends_ms = [min(values_ms) / 1.2, 1.2 * max(values_ms)]
    figure = go.Figure()
    figure.add_scatter(
        x=ends_ms,
        y=ends_ms,
        mode="lines",
        name="perfect model",
        line={"color": QUIET_INK, "width": 1.2, "dash": "dash"},
        hoverinfo="skip",
    )
    for technique in in_technique_order(made.technique for made, _ in both):
        of_it = [(made, measured_ms) for made, measured_ms in both if made.technique == technique]
        figure.add_scatter(
            x=[measured_ms for _, measured_ms in of_it],
            y=[made.predicted_ms for made, _ in of_it],
            mode="markers",
            name=plain(technique),
            marker=technique_marker(technique),
            error_y={
                "type": "data",
                "array": [max(0.0, _high_ms(made) - made.predicted_ms) for made, _ in of_it],
                "arrayminus": [max(0.0, made.predicted_ms - _low_ms(made)) for made, _ in of_it],
                "color": technique_colour(technique),
                "thickness": 1.1,
                "width": 2,
            },
            hovertext=[_hover(made) for made, _ in of_it],
            hoverinfo="text",
        )
    figure.update_xaxes(time_axis(values_ms, "measured, ms"))
    figure.update_yaxes(time_axis(values_ms, "predicted, ms"))
    return styled(figure, height_px=430)


def time_along_parameters(run: RunFolder) -> go.Figure | None:
    """Predicted time along one parameter at a time, starting from each technique's best configuration.

    A parameter has a panel where the predictions hold three of its values (two of a choice) that differ in
    nothing else.
    """
    lines = [line for name in PARAMETERS for line in _lines_along(run, name)]
    names = list(dict.fromkeys(name for name, _ in lines))
    if not names:
        return None
    columns = len(names) if len(names) <= _PANELS_IN_A_ROW else -(-len(names) // 2)
    rows = -(-len(names) // columns)
    figure = make_subplots(
        rows=rows,
        cols=columns,
        shared_yaxes=True,
        vertical_spacing=0.32 / rows,
        horizontal_spacing=0.04,
        subplot_titles=[f"<b>{name}</b>" for name in names],
    )
    in_legend: set[str] = set()
    for name, points in lines:
        row, column = divmod(names.index(name), columns)
        _add_line(figure, name, points, row + 1, column + 1, points[0].technique not in in_legend)
        in_legend.add(points[0].technique)
    for i, name in enumerate(names):
        row, column = divmod(i, columns)
        values = {made.params[name] for of_name, points in lines if of_name == name for made in points}
        labels = [_label(value) for value in _in_order(name, values)]
        figure.update_xaxes(
            type="category",
            categoryarray=labels,
            # Room beside the first and the last, which lines alone do not get.
            range=[-0.3, len(labels) - 0.7],
            tickfont={"size": 11},
            row=row + 1,
            col=column + 1,
        )
    values_ms = [value for _, points in lines for made in points for value in (made.predicted_ms, made.measured_ms)]
    figure.update_yaxes(time_axis([value for value in values_ms if value is not None], ""))
    figure.update_yaxes(title={"text": "ms"}, col=1)
    figure.update_annotations(font={"size": 13, "color": INK})
    figure.update_layout(margin={"t": 76})
    return styled(figure, height_px=140 + 230 * rows)


def _add_line(
    figure: go.Figure, name: str, points: Sequence[Prediction], row: int, column: int, in_legend: bool
) -> None:
    """One technique in one panel: the interval as a band, the prediction as a line, measurements as marks."""
    technique = points[0].technique
    colour = technique_colour(technique)
    labels = [_label(made.params[name]) for made in points]
    figure.add_scatter(
        x=labels + labels[::-1],
        y=[_high_ms(made) for made in points] + [_low_ms(made) for made in points[::-1]],
        mode="lines",
        line={"width": 0},
        fill="toself",
        fillcolor=_tint(colour),
        hoverinfo="skip",
        showlegend=False,
        legendgroup=technique,
        row=row,
        col=column,
    )
    figure.add_scatter(
        x=labels,
        y=[made.predicted_ms for made in points],
        mode="lines",
        line={"color": colour, "width": 1.8},
        name=plain(technique),
        showlegend=in_legend,
        legendgroup=technique,
        hovertext=[_hover(made) for made in points],
        hoverinfo="text",
        row=row,
        col=column,
    )
    measured = [made for made in points if made.measured_ms is not None]
    figure.add_scatter(
        x=[_label(made.params[name]) for made in measured],
        y=[made.measured_ms for made in measured],
        mode="markers",
        marker=technique_marker(technique),
        name=f"{plain(technique)}, measured",
        showlegend=False,
        legendgroup=technique,
        hovertext=[_hover(made) for made in measured],
        hoverinfo="text",
        row=row,
        col=column,
    )


def _lines_along(run: RunFolder, name: str) -> list[tuple[str, list[Prediction]]]:
    """For each technique, the predictions that differ from its best configuration in this parameter alone."""
    lines = []
    for technique in in_technique_order(made.technique for made in run.predictions):
        of_it = [made for made in run.predictions if made.technique == technique and name in made.params]
        if not of_it:
            continue
        rest = _without(_best_params(run, of_it), name)
        by_value = {made.params[name]: made for made in of_it if _without(made.params, name) == rest}
        points = [by_value[value] for value in _in_order(name, by_value)]
        is_choice = any(isinstance(value, str) for value in by_value)
        if len(points) >= (2 if is_choice else 3):
            lines.append((name, points))
    return lines


def _best_params(run: RunFolder, of_technique: Sequence[Prediction]) -> Mapping[str, Value]:
    if run.best is not None and run.best.technique == of_technique[0].technique:
        return run.best.params
    measured = [made for made in of_technique if made.measured_ms is not None]
    if measured:
        return min(measured, key=lambda made: made.measured_ms or 0.0).params
    return min(of_technique, key=lambda made: made.predicted_ms).params


def _without(params: Mapping[str, Value], name: str) -> dict[str, Value]:
    return {key: value for key, value in params.items() if key != name}


def _in_order(name: str, values: Iterable[Value]) -> list[Value]:
    """Numbers by size, choices as the parameter lists them."""
    choices = PARAMETERS[name].choices

    def place(value: Value) -> tuple[float, str]:
        if isinstance(value, str):
            return (choices.index(value) if value in choices else len(choices), value)
        return (value, "")

    return sorted(values, key=place)


def _label(value: Value) -> str:
    # The no-break space keeps plotly from reading the label as a place on the axis.
    return value if isinstance(value, str) else f"{value:g}\u00a0"


def _low_ms(made: Prediction) -> float:
    return made.interval_ms[0] if made.interval_ms else made.predicted_ms


def _high_ms(made: Prediction) -> float:
    return made.interval_ms[1] if made.interval_ms else made.predicted_ms


def _hover(made: Prediction) -> str:
    text = f"predicted {number_text.ms(made.predicted_ms)}"
    if made.interval_ms:
        text += f" ({number_text.interval(*made.interval_ms)})"
    if made.measured_ms is not None:
        text += f"<br>measured {number_text.ms(made.measured_ms)}"
    return hover(made.technique, made.params, text)


def _tint(colour: str) -> str:
    """The colour of a band behind a line of this colour."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.13)"
