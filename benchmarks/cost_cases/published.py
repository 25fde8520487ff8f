"""The tables of van Oosten 2017 and of Olsson et al. 2012: what models of their rows say, and how far they hold."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.cost_cases.peers import Case, Peers
from tuning.questions import BUDGETS_MS, largest_within
from tuning.table_model import TableModel, fit_table
from tuning.timing_table import TimingTable

Row = dict[str, str]
Line = tuple[str, str, str]
_STAGED = ("10.3", "10.4", "10.5", "10.6", "10.7", "10.8", "10.9", "10.10")
_CROSSED = (13_723.0, 28_580.0)
"""Lights at 60 and 30 FPS, tiled forward, Sponza: table 10.3, interpolated."""


def rows(folder: Path, peers: Peers) -> Iterator[Line]:
    """Question, figure and target, for the table."""
    with (folder / "van_oosten_2017_timings.csv").open() as file:
        printed = list(csv.DictReader(file))
    yield from _rates(folder, printed)
    timings = [row for row in printed if not row["duplicate_of_table"]]
    models = {name: fit_table(_table(_of(timings, name))) for name in _STAGED}
    for name, model in models.items():
        for (stage,), one in model.models.items():
            yield f"10.{name[3:]} {stage}", f"{one.law.text}", f"left out: {one.error:.1%}"
    yield from _crossings(models["10.3"])
    yield from _beyond(timings, "10.9", lambda n: n <= 1e6, "at most 4 %", peers)
    for name in ("10.5", "10.8", "10.10"):
        lights = sorted({float(row["num_lights"]) for row in _of(timings, name)})
        half = lights[(len(lights) - 1) // 2]
        yield from _beyond(timings, name, lambda n, half=half: n <= half, "reported", peers)
    yield from _olsson(folder)


def _of(timings: Sequence[Row], table: str) -> list[Row]:
    return [row for row in timings if row["table"] == table]


def _lights(rows_: Sequence[Row]) -> np.ndarray:
    return np.array([float(row["num_lights"]) for row in rows_])


def _table(rows_: Sequence[Row]) -> TimingTable:
    return TimingTable(
        {"num_lights": _lights(rows_)},
        {"stage": tuple(row["stage"] for row in rows_)},
        tuple((float(row["milliseconds"]),) for row in rows_),
    )


def _rates(folder: Path, printed: Sequence[Row]) -> Iterator[Line]:
    """`100 (t_max - t_min) / (l_max - l_min)` over all frames of a technique, van Oosten Eq. 10.1."""
    with (folder / "van_oosten_2017_rate_of_increase.csv").open() as file:
        wanted = list(csv.DictReader(file))
    reproduced = 0
    for rate in wanted:
        same = ("technique", "scene", "light_density_mode")
        frames = [row for row in printed if row["stage"] == "frame" and all(row[k] == rate[k] for k in same)]
        by_lights = {float(row["num_lights"]): float(row["milliseconds"]) for row in frames}
        ends_ms = by_lights[max(by_lights)], by_lights[min(by_lights)]
        found = 100 * (ends_ms[0] - ends_ms[1]) / (max(by_lights) - min(by_lights))
        text = rate["rate_ms_per_100_lights"]
        digit = 10.0 ** -len(text.split(".")[1])
        # One of the eleven is printed cut off and not rounded.
        reproduced += abs(found - float(text)) < digit
    yield "rate of increase, table 10.14", f"{reproduced} of {len(wanted)} reproduced", "11 of 11"


def _crossings(model: TableModel) -> Iterator[Line]:
    for budget_ms, wanted in zip(BUDGETS_MS, _CROSSED, strict=True):
        found = largest_within(model.parts(("frame",)), budget_ms, "num_lights", 100, 1e5, {})
        error = found.value / wanted - 1
        figure = f"{found.value:,.0f} lights ({found.low:,.0f} to {found.high:,.0f}): {error:+.1%}"
        yield f"tiled forward within {budget_ms:.1f} ms", figure, f"{wanted:,.0f}, within 3 %"


def _beyond(timings: Sequence[Row], name: str, keep, target: str, peers: Peers) -> Iterator[Line]:
    """Frames of the upper rows, from models of the lower ones."""
    all_ = _of(timings, name)
    model = fit_table(_table([row for row in all_ if keep(float(row["num_lights"]))]))
    frames = [row for row in all_ if row["stage"] == "frame"]
    lower = [row for row in frames if keep(float(row["num_lights"]))]
    upper = [row for row in frames if not keep(float(row["num_lights"]))]
    measured = np.array([float(row["milliseconds"]) for row in upper])
    found = model.predict({"num_lights": _lights(upper)}, {"stage": ("frame",) * len(upper)})
    title = f"10.{name[3:]} fitted to {_lights(lower).max():,.0f}, up to {_lights(upper).max():,.0f}"
    covered = sum(p.low_ms <= ms <= p.high_ms for p, ms in zip(found, measured, strict=True))
    figure = f"{_median(np.array([p.time_ms for p in found]), measured):.1%}, {covered} of {len(upper)} in the interval"
    yield f"{title}: median error", figure, target
    times_ms = np.array([float(row["milliseconds"]) for row in lower])
    case = Case(("num_lights",), _lights(lower)[:, None], times_ms, _lights(upper)[:, None])
    for peer, (predicted,) in peers.predict([case]).items():
        yield f"  {peer}", f"{_median(predicted, measured):.1%}", ""


def _median(predicted_ms: np.ndarray, measured_ms: np.ndarray) -> float:
    return float(np.median(np.abs(predicted_ms / measured_ms - 1)))


def _olsson(folder: Path) -> Iterator[Line]:
    with (folder / "olsson_2012_light_assignment_scaling.csv").open() as file:
        printed = list(csv.DictReader(file))
    for technique in dict.fromkeys(row["technique"] for row in printed):
        own = sorted((r for r in printed if r["technique"] == technique), key=lambda r: float(r["num_lights"]))
        model = fit_table(_table(own[:3]))
        far = own[3]
        (found,) = model.predict({"num_lights": _lights([far])}, {"stage": (far["stage"],)})
        measured = float(far["milliseconds"])
        inside = "holds" if found.low_ms <= measured <= found.high_ms else "misses"
        figure = f"{found.time_ms:.3g} ms ({found.low_ms:.2g} to {found.high_ms:.3g}) {inside} the measured {measured}"
        yield f"Olsson 2012, {technique}, 4th row from 3", figure, "refused, or an interval that holds it"
