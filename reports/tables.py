"""The tables of the report: cost models, counts, and every measurement."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from reports import number_text
from reports.recommendation import Setting
from reports.run_folder import RunFolder, StageModel, Timed, frame_medians_ms
from tuning.features import main_work
from tuning.measurement import Measurement
from vtfs.parameters import PARAMETERS, Value

# What each count means, in the order in which work arises.
COUNT_MEANINGS = {
    "samples": "valid view samples",
    "cells_total": "tiles or cells of the grid",
    "clusters_occupied": "cells that hold a sample",
    "light_cluster_pairs": "entries of all light lists",
    "tree_tests": "tests of nodes of the light tree",
    "leaf_tests": "tests of single lights",
    "lighting_computations": "one light evaluated for one sample",
    "approximated_pairs": "entries evaluated once for a cell",
    "lighting_computations_saved": "what that spared",
    "lighting_computations_tile_area": "the same as tile area times list length (2011 paper)",
    "shadow_lights": "lights that cast shadows",
    "shadow_samples": "samples that they would light",
    "casters": "triangles with a shadow volume",
    "shadow_clusters": "tiles or clusters of these samples",
    "alpha_casters": "alpha-masked and blended triangles with a shadow volume",
    "alpha_samples": "samples that opaque casters leave lit",
    "alpha_clusters": "tiles or clusters of those",
    "alpha_node_tests": "nodes tested against alpha casters",
    "alpha_sample_tests": "samples tested against alpha casters",
    "alpha_listed_pairs": "alpha casters in the lists of tiles or clusters",
    "test_and_set": "existing nodes or samples tested against a triangle; with a stencil, updates of it",
    "test_and_set_in_cluster": "the same, of a tile only the samples of the cluster",
    "node_tests": "nodes tested against a triangle",
    "accepted": "nodes in a volume as a whole",
    "refined": "nodes that go on to their children",
    "dropped": "tests of nodes that feedback spares",
    "sample_tests": "samples tested against a triangle",
    "rejected_nodes": "nodes that lie in no volume",
    "dropped_nodes": "tests of nodes that feedback spares",
    "dropped_samples": "tests of samples that feedback spares",
    "tests_of_largest": "tests of the 1,024 triangles with the most: how unevenly the work lies",
    "listed_pairs": "entries of all lists of triangles",
    "longest_shadow_list": "triangles tested against one tile or cluster, at most",
    "extra_plane_tests": "tests of the extra planes",
    "bytes_moved": "bytes read and written",
    "memory": "bytes held",
    "memory_planes": "of them by the planes of all shadow volumes",
    "memory_tree": "by the tree over tiles or clusters",
    "memory_lists": "by the lists of triangles at its nodes",
    "memory_samples": "by the samples in tiles, with their bits",
    "divergence": "32 times the longest list of each run of 32 samples",
    "dropped_at_cap": "lights lost at a cap per cell",
}

_OF_LEVELS = ("node_tests", "accepted", "refined", "dropped")


@dataclass(frozen=True)
class CountRow:
    """One count for every technique; `least` is its smallest value, which the others are compared with."""

    name: str
    meaning: str
    values: tuple[float | None, ...]

    @property
    def least(self) -> float | None:
        return min((value for value in self.values if value), default=None)


@dataclass(frozen=True)
class Cell:
    """One cell of the table of measurements.

    - `sort_key`: what a click on the header sorts by; None comes last in both directions.
    """

    text: str
    sort_key: float | str | None
    is_number: bool = False
    is_code: bool = False


@dataclass(frozen=True)
class Row:
    """One measurement. `message` says why it failed."""

    cells: tuple[Cell, ...]
    outcome: str
    message: str
    is_best: bool


@dataclass(frozen=True)
class MeasurementTable:
    """Every measurement.

    - `headers`: label and what it means; `constant`: parameters that never changed, which need no column.
    """

    headers: tuple[tuple[str, str, bool], ...]
    rows: tuple[Row, ...]
    constant: tuple[Setting, ...]


def cost_model_groups(run: RunFolder) -> dict[str, list[StageModel]]:
    """The stage models of each technique, in the order of the file."""
    groups: dict[str, list[StageModel]] = {}
    for model in run.cost_models:
        groups.setdefault(model.technique, []).append(model)
    return groups


def count_rows(run: RunFolder) -> tuple[CountRow, ...]:
    """One row a count that any technique has; known ones first, in the order of the work."""
    known = list(COUNT_MEANINGS)

    def place(name: str) -> int:
        return known.index(_stem(name)) if _stem(name) in known else len(known)

    found = dict.fromkeys(name for counts in run.counts.values() for name in counts)
    return tuple(
        CountRow(name, _what_is_counted(name), tuple(counts.get(name) for counts in run.counts.values()))
        for name in sorted(found, key=place)
    )


def _stem(name: str) -> str:
    """Without the level of a tree, or the cap."""
    return re.sub(r"[_ ]\d+$", "", name)


def _what_is_counted(name: str) -> str:
    meaning = COUNT_MEANINGS.get(_stem(name), "")
    of_level = _stem(name) != name and _stem(name) in _OF_LEVELS
    return f"{meaning}, level {name.rsplit('_', 1)[-1]} below the root" if of_level else meaning


def measurement_table(run: RunFolder) -> MeasurementTable:
    """Every line of `measurements.jsonl`, in the order of measuring."""
    varying, constant = _split_parameters(run.measurements)
    headers = (
        ("#", "order of measuring", True),
        ("technique", "", False),
        *((name, _meaning(name), _is_numeric(run.measurements, name)) for name in varying),
        ("slowest frame, ms", "median over the repeats of the slowest of the measured frames", True),
        ("mean, ms", "mean over the measured frames of their medians", True),
        ("error", "RMSE over RMS of the float64 reference image", True),
        (
            ("shadow tests", "nodes and samples tested against triangles, on the frame with the most", True)
            if run.casts_shadows
            else ("lighting computations", "lights times samples, on the frame with the most", True)
        ),
        ("compile, s", "time to compile the programs of this configuration", True),
        ("outcome", "", False),
    )
    rows = tuple(_row(number, line, varying, run.best) for number, line in enumerate(run.measurements, 1))
    return MeasurementTable(headers, rows, constant)


def _row(number: int, line: Measurement, varying: list[str], best: Timed | None) -> Row:
    medians_ms = frame_medians_ms(line)
    slowest_ms = max(medians_ms, default=None)
    mean_ms = sum(medians_ms) / len(medians_ms) if medians_ms else None
    work = main_work(line.counts[0]) if line.counts else None
    cells = (
        Cell(str(number), number, is_number=True),
        Cell(line.technique, line.technique, is_code=True),
        *(_parameter_cell(line.params.get(name)) for name in varying),
        _number_cell(slowest_ms, number_text.digits),
        _number_cell(mean_ms, number_text.digits),
        _number_cell(line.error, number_text.error),
        _number_cell(work, number_text.count),
        _number_cell(line.compile_s if math.isfinite(line.compile_s) else None, lambda value: f"{value:.1f}"),
        Cell(line.outcome.replace("_", " "), line.outcome),
    )
    return Row(
        cells=cells,
        outcome=line.outcome,
        message=line.message if line.outcome != "timed" else "",
        is_best=best is not None and best.is_configuration(line.technique, line.params),
    )


def _number_cell(value, text) -> Cell:
    return Cell("–" if value is None else text(value), value, is_number=True)


def _parameter_cell(value: Value | None) -> Cell:
    if value is None:
        return Cell("", None)
    is_number = isinstance(value, int | float)
    return Cell(f"{value:g}" if is_number else str(value), value if is_number else str(value), is_number, not is_number)


def _split_parameters(lines: tuple[Measurement, ...]) -> tuple[list[str], tuple[Setting, ...]]:
    """Parameters that took several values, and those that never changed wherever a technique has them."""
    names = dict.fromkeys(PARAMETERS)
    names |= dict.fromkeys(name for line in lines for name in line.params)
    varying, constant = [], []
    for name in names:
        values = list(dict.fromkeys(line.params[name] for line in lines if name in line.params))
        if len(values) > 1:
            varying.append(name)
        elif values:
            constant.append(Setting(name, values[0], PARAMETERS[name].default if name in PARAMETERS else None))
    return varying, tuple(constant)


def _is_numeric(lines: tuple[Measurement, ...], name: str) -> bool:
    return all(isinstance(line.params[name], int | float) for line in lines if name in line.params)


def _meaning(name: str) -> str:
    return PARAMETERS[name].meaning if name in PARAMETERS else ""
