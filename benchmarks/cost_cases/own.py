"""Our own measurements: frame times predicted from counts, for configurations that were left out of the fit."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.cost_cases.peers import Case, Peers
from tuning.features import STAGE_TERMS, with_derived
from tuning.table_model import fit_table
from tuning.timing_table import TimingTable

_FOLDS = 5
_FEWEST = 10  # configurations of a technique


def rows(path: Path, peers: Peers) -> Iterator[tuple[str, str, str]]:
    """Question, figure and target, for the table."""
    timed = [one for one in map(json.loads, path.read_text().splitlines()) if one["outcome"] == "timed"]
    scenes = {one["scene_key"] for one in timed}
    yield f"{path}", f"{len(timed)} measurements, {len(scenes)} scene(s)", "leave one scene out"
    for technique in dict.fromkeys(one["technique"] for one in timed):
        own = [one for one in timed if one["technique"] == technique]
        if len(own) >= _FEWEST:
            yield from _folds(technique, own, peers)


def _folds(technique: str, own: Sequence[dict], peers: Peers) -> Iterator[tuple[str, str, str]]:
    frames = [
        (k, with_derived(counts), float(np.median(repeats)), tuple(repeats))
        for k, one in enumerate(own)
        for counts, repeats in zip(one["counts"], one["stages_ms"]["frame"], strict=True)
        if repeats
    ]
    names = [name for name in STAGE_TERMS["frame"] if all(name in counts for _, counts, _, _ in frames)]
    columns = {name: np.array([counts[name] for _, counts, _, _ in frames], float) for name in names}
    design = np.column_stack(list(columns.values()))
    times_ms = np.array([time_ms for _, _, time_ms, _ in frames])
    configuration = np.array([k for k, _, _, _ in frames])
    fold = configuration % _FOLDS
    ours = np.empty(len(frames))
    cases = []
    for k in range(_FOLDS):
        held = fold == k
        table = TimingTable(
            {name: column[~held] for name, column in columns.items()},
            {},
            tuple(frames[row][3] for row in np.flatnonzero(~held)),
        )
        found = fit_table(table).predict({name: column[held] for name, column in columns.items()}, {})
        ours[held] = [p.time_ms for p in found]
        cases.append(Case(tuple(columns), design[~held], times_ms[~held], design[held]))
    everyone = {"ours": ours}
    for name, parts in peers.predict(cases).items():
        everyone[name] = np.empty(len(frames))
        for k, part in enumerate(parts):
            everyone[name][fold == k] = part
    for name, predicted in everyone.items():
        if np.isfinite(predicted).all():
            error = np.median(np.abs(predicted / times_ms - 1))
            regret = times_ms[predicted.argmin()] / times_ms.min() - 1
            label = f"{technique}: {_FOLDS} folds of configurations" if name == "ours" else f"  {name}"
            yield label, f"{error:.1%} median error, chosen {regret:.1%} slower than the fastest", ""
