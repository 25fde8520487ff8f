"""How every chart of the report looks: its frame, its axes of time, and what it says under the pointer."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import plotly.graph_objects as go

from reports import number_text
from reports.palette import FONT, INK, QUIET_INK, RULE, technique_colour, technique_symbol
from vtfs.parameters import TECHNIQUES, Value

# No logo link, and no button that would send the data to a server (on by default since plotly.js 4).
_CONFIG: dict[str, Any] = {
    "displaylogo": False,
    "showSendToCloud": False,
    "responsive": True,
    "typesetMath": False,
    # Dragging and double-clicking zoom; the buttons for it would cover the legend.
    "modeBarButtonsToRemove": ["zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "select2d", "lasso2d", "autoScale2d"],
    "toImageButtonOptions": {"format": "svg"},
}

_AXIS: dict[str, Any] = {
    "gridcolor": "#eceff1",
    "linecolor": "#b8c0c7",
    "showline": True,
    "zeroline": False,
    "automargin": True,
    "ticks": "outside",
    "ticklen": 4,
    "tickcolor": "#b8c0c7",
    "title": {"font": {"size": 13, "color": QUIET_INK}, "standoff": 10},
}

_TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": FONT, "size": 13, "color": INK},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 56, "r": 16, "t": 44, "b": 52},
        "legend": {
            "orientation": "h",
            "traceorder": "normal",
            "x": 0,
            "xanchor": "left",
            "y": 1,
            "yanchor": "top",
            "yref": "container",
        },
        "hoverlabel": {
            "bgcolor": "#ffffff",
            "bordercolor": RULE,
            "align": "left",
            "font": {"family": FONT, "size": 12, "color": INK},
        },
        "xaxis": _AXIS,
        "yaxis": _AXIS,
    }
)


def styled(figure: go.Figure, height_px: int) -> go.Figure:
    """The figure in the report's dress; the page decides how wide it is."""
    figure.update_layout(template=_TEMPLATE, height=height_px)
    return figure


def chart_html(figure: go.Figure, div_id: str) -> str:
    """The figure as an element and the script that draws it; plotly.js must be on the page already."""
    return figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=div_id,
        config=_CONFIG,
        default_width="100%",
        default_height=f"{figure.layout.height}px",  # type: ignore[attr-defined]  # made by plotly at run time
    )


def technique_marker(technique: str, size: int = 9, opacity: float = 1.0) -> dict[str, Any]:
    """The mark of a technique, the same in every chart."""
    return {
        "color": technique_colour(technique),
        "symbol": technique_symbol(technique),
        "size": size,
        "opacity": opacity,
        "line": {"color": "#ffffff", "width": 1},
    }


def in_technique_order(names: Iterable[str]) -> list[str]:
    """Each technique once, in the project's order; unknown ones last, by name."""
    order = list(TECHNIQUES)
    return sorted(set(names), key=lambda name: (order.index(name) if name in order else len(order), name))


def time_axis(values_ms: Sequence[float], title: str) -> dict[str, Any]:
    """An axis of times: logarithmic where they differ by more than three times, with round ticks."""
    low, high = min(values_ms), max(values_ms)
    if low <= 0 or high / low <= 3:
        margin = 0.12 * (high - low) or 0.1 * high or 1.0
        return {"range": [max(0.0, low - margin), high + margin], "title": {"text": title}}
    low, high = low / 1.25, high * 1.25
    ticks = _log_ticks(low, high)
    return {
        "type": "log",
        "range": [math.log10(low), math.log10(high)],
        "tickvals": ticks,
        "ticktext": [f"{tick:,g}" for tick in ticks],
        "title": {"text": title},
    }


def hover(technique: str, params: Mapping[str, Value], last_line: str) -> str:
    """What the pointer shows: the configuration, one parameter a line, and a number."""
    lines = [f"{plain(str(name))} = {plain(number_text.setting(value))}" for name, value in params.items()]
    return "<br>".join([f"<b>{plain(technique)}</b>", *lines, f"<b>{last_line}</b>"])


def timed_text(time_ms: float, error: float | None) -> str:
    return f"{number_text.ms(time_ms)}, error {number_text.error(error)}"


def plain(text: str) -> str:
    """Plotly reads some HTML in its texts; what a file says is only text."""
    return html.escape(text, quote=False)


def power_of_ten(exponent: int) -> str:
    return f"10<sup>{'−' if exponent < 0 else ''}{abs(exponent)}</sup>"


def _log_ticks(low: float, high: float) -> list[float]:
    """Round numbers in the range, at most eight unless it spans more decades than that."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks: list[float] = []
    for steps in ((1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1,)):
        # Through text, since 3 * 10.0**-1 is not 0.3.
        ticks = [float(f"{step}e{decade}") for decade in decades for step in steps]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if len(ticks) <= 8:
            break
    return ticks
