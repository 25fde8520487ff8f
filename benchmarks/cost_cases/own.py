"""Our own measurements: frame times predicted from counts, of scenes or configurations that were left out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.cost_cases.peers import Case, Peers
from tuning.features import STAGE_TERMS, with_derived
from tuning.table_model import fit_table
from tuning.timing_table import TimingTable
from vtfs.configurations import configuration

Line = tuple[str, str, str]
_FOLDS = 5
_FEWEST = 10  # configurations of a technique


def rows(path: Path, peers: Peers) -> Iterator[Line]:
    """Question, figure and target, for the table: of a record, or of a folder with one record a scene."""
    records = [path] if path.is_file() else sorted(path.glob("*.jsonl"))
    timed = [_timed(record) for record in records]
    scenes = {one["scene_key"] for own in timed for one in own}
    yield f"{path}", f"{sum(map(len, timed))} exact configurations, {len(scenes)} scene(s)", "leave one scene out"
    if len(records) > 1:
        yield from _scenes([record.stem for record in records], timed, peers)
        return
    for technique in dict.fromkeys(one["technique"] for one in timed[0]):
        own = [one for one in timed[0] if one["technique"] == technique]
        if len(own) >= _FEWEST:
            frames = _frames([own])
            predicted = _left_out(frames, frames.configuration % _FOLDS, peers)
            for name, ms in predicted.items():
                regret = _regret(frames, ms, np.ones(len(ms), bool))
                label = f"{technique}: {_FOLDS} folds of configurations" if name == "ours" else f"  {name}"
                yield label, f"{_error(frames, ms):.1%} median error, chosen {regret:.1%} slower than the fastest", ""


def _timed(record: Path) -> list[dict]:
    """Settings that change the image change what an operation costs: they are no part of this."""
    read = [json.loads(line) for line in record.read_text().splitlines()]
    timed = [one for one in read if one["outcome"] == "timed"]
    return [one for one in timed if configuration(one["technique"], one["params"]).is_exact]


@dataclass(frozen=True)
class _Frames:
    """A row for each frame that was timed.

    - `columns`: float64 `[rows]` each, counts that all rows have.
    - `configuration`, `scene`: int `[rows]`, which one a row belongs to.
    """

    columns: dict[str, np.ndarray]
    repeats_ms: tuple[tuple[float, ...], ...]
    configuration: np.ndarray
    scene: np.ndarray

    @property
    def times_ms(self) -> np.ndarray:
        return np.array([float(np.median(repeats)) for repeats in self.repeats_ms])


def _frames(by_scene: Sequence[Sequence[dict]]) -> _Frames:
    found = [
        (with_derived(counts), tuple(repeats), k, scene)
        for scene, own in enumerate(by_scene)
        for k, one in enumerate(own)
        for counts, repeats in zip(one["counts"], one["stages_ms"]["frame"], strict=True)
        if repeats
    ]
    names = [name for name in STAGE_TERMS["frame"] if all(name in counts for counts, _, _, _ in found)]
    return _Frames(
        {name: np.array([counts[name] for counts, _, _, _ in found], float) for name in names},
        tuple(repeats for _, repeats, _, _ in found),
        np.array([k for _, _, k, _ in found]),
        np.array([scene for _, _, _, scene in found]),
    )


def _left_out(frames: _Frames, fold: np.ndarray, peers: Peers) -> dict[str, np.ndarray]:
    """Milliseconds of every row from models of the rows in other folds, ours and each peer's that can say."""
    design, times_ms = np.column_stack(list(frames.columns.values())), frames.times_ms
    everyone = {"ours": np.empty(len(fold))}
    cases = []
    folds = sorted(set(fold.tolist()))
    for k in folds:
        held = fold == k
        seen = {name: column[~held] for name, column in frames.columns.items()}
        model = fit_table(TimingTable(seen, {}, tuple(frames.repeats_ms[row] for row in np.flatnonzero(~held))))
        asked = {name: column[held] for name, column in frames.columns.items()}
        everyone["ours"][held] = [p.time_ms for p in model.predict(asked, {})]
        cases.append(Case(tuple(frames.columns), design[~held], times_ms[~held], design[held]))
    for name, parts in peers.predict(cases).items():
        everyone[name] = np.empty(len(fold))
        for k, part in zip(folds, parts, strict=True):
            everyone[name][fold == k] = part
    return {name: ms for name, ms in everyone.items() if np.isfinite(ms).all()}


def _error(frames: _Frames, predicted_ms: np.ndarray) -> float:
    return float(np.median(np.abs(predicted_ms / frames.times_ms - 1)))


def _regret(frames: _Frames, predicted_ms: np.ndarray, rows_: np.ndarray) -> float:
    """How much slower the configuration whose slowest frame is predicted to be shortest is than the fastest one."""
    known = _slowest(frames.configuration[rows_], frames.times_ms[rows_])
    predicted = _slowest(frames.configuration[rows_], predicted_ms[rows_])
    return known[min(predicted, key=predicted.__getitem__)] / min(known.values()) - 1


def _slowest(configurations: np.ndarray, times_ms: np.ndarray) -> dict[int, float]:
    slowest: dict[int, float] = {}
    for k, ms in zip(configurations.tolist(), times_ms.tolist(), strict=True):
        slowest[k] = max(ms, slowest.get(k, 0.0))
    return slowest


def _scenes(names: Sequence[str], timed: Sequence[Sequence[dict]], peers: Peers) -> Iterator[Line]:
    for technique in dict.fromkeys(one["technique"] for own in timed for one in own):
        own = [[one for one in scene if one["technique"] == technique] for scene in timed]
        frames = _frames(own)
        for name, ms in _left_out(frames, frames.scene, peers).items():
            regrets = [_regret(frames, ms, frames.scene == k) for k in range(len(names)) if len(own[k]) > 1]
            label = f"{technique}: each scene from the others, {len(ms)} frames" if name == "ours" else f"  {name}"
            figure = (
                f"{_error(frames, ms):.1%} median error; chosen {np.mean(regrets):.1%} slower, {max(regrets):.1%} worst"
            )
            yield label, figure, ""
            if name == "ours":
                for k, scene in enumerate(names):
                    rows_ = frames.scene == k
                    error = float(np.median(np.abs(ms[rows_] / frames.times_ms[rows_] - 1)))
                    yield f"    {scene}", f"{error:.1%} of {rows_.sum()} frames, {len(own[k])} configurations", ""
