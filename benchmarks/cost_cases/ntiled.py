"""A public tile-size sweep: fitted to one scene, which tile size would be chosen in the other?

The CPU builds the light grid while the GPU shades. What is known before measuring: lights, image, tile size, and
the counts of lighting computations (a dry run counts them).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.cost_cases.peers import Case, Peers
from tuning.table_model import Prediction, fit_table
from tuning.timing_table import TimingTable

Row = dict[str, str]
_ALWAYS_PX = 32.0
_TARGETS = {"forward": "at most 0.7 %", "deferred": "at most 1.9 %"}


def rows(path: Path, peers: Peers) -> Iterator[tuple[str, str, str]]:
    """Question, figure and target, for the table."""
    with path.open() as file:
        everything = list(csv.DictReader(file))
    broken = _breaks_monotonicity(everything)
    yield "rows that break monotonicity", f"{len(broken)} of {len(everything)}", "listed below"
    for pipeline in _TARGETS:
        for label, keep in (("", lambda row: True), (", monotonic rows", lambda row: _key(row) not in broken)):
            own = [row for row in everything if row["pipeline"] == pipeline and keep(row)]
            yield from _both_ways(pipeline, label, own, peers)
    for pipeline, scene, lights, w_h, tile in sorted(broken):
        yield f"  {pipeline} {scene}", f"{lights:g} lights, {w_h:g} px, tile {tile:g}", ""


def _both_ways(pipeline: str, label: str, own: Sequence[Row], peers: Peers) -> Iterator[tuple[str, str, str]]:
    scenes = sorted({row["scene"] for row in own})
    regrets: dict[str, list[np.ndarray]] = {}
    for scene in scenes:
        train = [row for row in own if row["scene"] == scene]
        test = [row for row in own if row["scene"] != scene]
        times_ms = np.array([float(row["frame_ms_median"]) for row in train])
        model = fit_table(TimingTable(_columns(train), {}, tuple((t,) for t in times_ms.tolist())))
        yield f"  law of {scene}", next(iter(model.models.values())).law.text, ""
        found = model.predict(_columns(test), {})
        ours = np.array([p.time_ms for p in found])
        case = Case(
            tuple(_columns(train)),
            np.column_stack(list(_columns(train).values())),
            times_ms,
            np.column_stack(list(_columns(test).values())),
        )
        predictions = {
            "ours": ours,
            "ours, 32 kept unless surely slower": _kept(test, found),
            "always 32": np.abs(_columns(test)["tile_px"] - _ALWAYS_PX),
        }
        predictions |= {name: predicted for name, (predicted,) in peers.predict([case]).items()}
        for name, predicted in predictions.items():
            if np.isfinite(predicted).all():
                regrets.setdefault(name, []).append(_regrets(test, predicted))
    for name, both in regrets.items():
        every = np.concatenate(both)
        mean = np.mean([one.mean() for one in both])
        figure = f"{mean:.2%} mean, {every.max():.0%} worst, {(every == 0).sum()} of {len(every)} exactly right"
        target = _TARGETS[pipeline] if name == "ours" and not label else ""
        yield (f"{pipeline}{label}: regret" if name == "ours" else f"  {name}"), figure, target


def _columns(rows_: Sequence[Row]) -> dict[str, np.ndarray]:
    lights, side, tile, computations = (
        np.array([float(row[name]) for row in rows_])
        for name in ("lights", "w_h", "tile", "light_calcs_per_frame_median")
    )
    return {
        "samples": side**2,
        "cells_total": np.ceil(side / tile) ** 2,
        "light_cluster_pairs": computations / tile**2,
        "lighting_computations": computations,
        "leaf_tests": lights * np.ceil(side / tile) ** 2,
        "tile_px": tile,
    }


def _kept(test: Sequence[Row], found: Sequence[Prediction]) -> np.ndarray:
    """Lowest for the tile that `vtfs tune --measurements` would recommend: another one than the default only where its
    whole 90 % interval, inside the data, lies below the default's; float64 `[rows]`."""
    tiles = [float(row["tile"]) for row in test]
    default = {_case(row): p for row, p, tile in zip(test, found, tiles, strict=True) if tile == _ALWAYS_PX}
    wanted = np.full(len(test), np.finfo(float).max)  # not chosen
    for k, (row, p) in enumerate(zip(test, found, strict=True)):
        is_sure = not p.extrapolated and p.high_ms < default[_case(row)].low_ms
        if is_sure or tiles[k] == _ALWAYS_PX:
            wanted[k] = p.time_ms
    return wanted


def _case(row: Row) -> tuple[str, str]:
    return row["lights"], row["w_h"]


def _regrets(test: Sequence[Row], predicted: np.ndarray) -> np.ndarray:
    """How much slower than the fastest tile size the chosen one is, one number a configuration."""
    cases: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for row, value in zip(test, predicted, strict=True):
        cases.setdefault(_case(row), []).append((float(value), float(row["frame_ms_median"])))
    return np.array([min(case)[1] / min(ms for _, ms in case) - 1 for case in cases.values()])


_Key = tuple[str, str, float, float, float]


def _key(row: Row) -> _Key:
    return row["pipeline"], row["scene"], float(row["lights"]), float(row["w_h"]), float(row["tile"])


def _breaks_monotonicity(rows_: Sequence[Row]) -> set[_Key]:
    """Slower than a row with more lights or more pixels that is the same in everything else."""
    broken = set()
    for row in rows_:
        pipeline, scene, lights, side, tile = _key(row)
        for other in rows_:
            of_pipeline, of_scene, more_lights, larger, same = _key(other)
            alike = (of_pipeline, of_scene, same) == (pipeline, scene, tile)
            more = more_lights >= lights and larger >= side and (more_lights, larger) != (lights, side)
            if alike and more and float(other["frame_ms_median"]) < float(row["frame_ms_median"]):
                broken.add(_key(row))
    return broken
