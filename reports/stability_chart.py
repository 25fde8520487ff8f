"""Every method on every rung as one picture: the share of wrong samples, and where each first fails."""

from __future__ import annotations

import math

import plotly.graph_objects as go

from reports import number_text
from reports.chart_style import plain, styled
from reports.palette import FAILS, FEW, HOLDS, INK, NOT_RUN
from vtfs.stability.record import Kind, RungResult, StabilityResult, Verdict

_LEAST = 1e-4  # one sample of the built-in view is 3e-4
_HOLDS, _REFUSED = -4.8, -5.6  # places on the colour scale below the logarithms
_ROW_PX = 19


def error_map(result: StabilityResult, kind: Kind, source: str) -> go.Figure | None:
    """Rungs along x in the order of the ladders, methods along y."""
    rungs = [rung for rung in result.rungs if (rung.kind, rung.source) == (kind, source) and rung.verdicts]
    methods = list(dict.fromkeys(name for rung in rungs for name in rung.verdicts))
    if not methods:
        return None
    figure = go.Figure()
    figure.add_heatmap(
        z=[[_place(rung.verdicts.get(name)) for rung in rungs] for name in methods],
        x=list(range(len(rungs))),
        y=[plain(name) for name in methods],
        zmin=_REFUSED - 0.4,
        zmax=0,
        colorscale=_scale(),
        xgap=1,
        ygap=1,
        hovertext=[[_hover(rung, name) for rung in rungs] for name in methods],
        hoverinfo="text",
        colorbar={
            "thickness": 12,
            "tickvals": [_REFUSED, _HOLDS, -4, -3, -2, -1, 0],
            "ticktext": ["no answer", "right", "0.01 %", "0.1 %", "1 %", "10 %", "100 %"],
            "outlinewidth": 0,
        },
    )
    firsts = _first_failures(rungs, methods)
    figure.add_scatter(
        x=[x for x, _ in firsts],
        y=[plain(name) for _, name in firsts],
        mode="markers",
        marker={"symbol": "circle", "size": 5, "color": INK},
        hoverinfo="skip",
        showlegend=False,
    )
    starts = [n for n, rung in enumerate(rungs) if n == 0 or rungs[n - 1].ladder != rung.ladder]
    for start in starts[1:]:
        figure.add_vline(x=start - 0.5, line={"color": INK, "width": 1})
    ends = [*starts[1:], len(rungs)]
    figure.update_xaxes(
        tickvals=[(start + end - 1) / 2 for start, end in zip(starts, ends, strict=True)],
        ticktext=[plain(rungs[start].ladder.replace("_", " ")) for start in starts],
        tickangle=-35,
        side="bottom",
        range=[-0.5, len(rungs) - 0.5],
        showgrid=False,
        showline=False,
    )
    figure.update_yaxes(autorange="reversed", showgrid=False, showline=False, ticks="", tickfont={"size": 11})
    return styled(figure, height_px=150 + _ROW_PX * len(methods))


def _scale() -> list[tuple[float, str]]:
    low, width = _REFUSED - 0.4, 0.4 - _REFUSED
    steps = [
        (low, NOT_RUN),
        (-5.2, NOT_RUN),
        (-5.2, HOLDS),
        (-4.4, HOLDS),
        (-4.4, FEW[0]),
        (-2, FEW[1]),
        (-2, FAILS[0]),
    ]
    return [*(((value - low) / width, colour) for value, colour in steps), (1.0, FAILS[1])]


def _place(verdict: Verdict | None) -> float | None:
    if verdict is None:
        return None
    if verdict.refused:
        return _REFUSED
    return max(math.log10(verdict.share), math.log10(_LEAST)) if verdict.share else _HOLDS


def _hover(rung: RungResult, method: str) -> str:
    verdict = rung.verdicts.get(method)
    lines = [f"<b>{plain(method)}</b>", f"{plain(rung.title)}: <b>{plain(rung.label)}</b>"]
    if verdict is None:
        return "<br>".join([*lines, "not run"])
    if verdict.refused:
        return "<br>".join([*lines, plain(verdict.refused)])
    tested = number_text.count(rung.tested)
    if rung.kind == "light":
        return "<br>".join([*lines, f"{number_text.count(verdict.wrong)} of {tested} pairs missed"])
    return "<br>".join(
        [
            *lines,
            f"{number_text.count(verdict.wrong)} of {tested} samples wrong: {verdict.false_light} light, "
            f"{verdict.false_shadow} shadow",
            f"{verdict.excused} differ within the bands; {rung.lit} are lit, {rung.shadowed} in shadow",
        ]
    )


def _first_failures(rungs: list[RungResult], methods: list[str]) -> list[tuple[int, str]]:
    firsts: dict[tuple[str, str], tuple[int, str]] = {}
    for n, rung in enumerate(rungs):
        for name in methods:
            verdict = rung.verdicts.get(name)
            if verdict is not None and verdict.wrong:
                firsts.setdefault((rung.ladder, name), (n, name))
    return list(firsts.values())
