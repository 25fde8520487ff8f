"""Counts of many configurations and frames, as records, as a table and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vtfs.frame import FrameCounts, count
from vtfs.op_counts import OpCounts
from vtfs.parameters import Configuration, counted_configuration
from vtfs.scene_setup import SceneSetup


@dataclass(frozen=True)
class CountRow:
    configuration: Configuration
    frame: int
    counts: OpCounts


def count_frames(
    setup: SceneSetup,
    configs: Sequence[Configuration],
    frames: Sequence[int],
    progress: Callable[[int, int], None],
) -> list[CountRow]:
    """Exact counts of every configuration on every frame, frame by frame (samples are traced once)."""
    rows: list[CountRow] = []
    for frame in frames:
        inputs = setup.inputs(frame)
        counted: dict[Configuration, FrameCounts] = {}
        for config in configs:
            canonical = counted_configuration(config)
            if canonical not in counted:
                counted[canonical] = count(canonical, inputs)[0]
            rows.append(CountRow(config, frame, counted[canonical].of(config)))
            progress(len(rows), len(frames) * len(configs))
    return rows


def counts_csv(rows: Sequence[CountRow]) -> str:
    """One line a configuration and frame: technique, parameters, frame, counts."""
    params = list(dict.fromkeys(name for row in rows for name in row.configuration.params))
    names = list(dict.fromkeys(name for row in rows for name in row.counts))
    text = io.StringIO()
    writer = csv.DictWriter(text, ["technique", *params, "frame", *names], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(
            {"technique": row.configuration.technique, **row.configuration.params, "frame": row.frame, **row.counts}
        )
    return text.getvalue()


def print_counts(rows: Sequence[CountRow]) -> None:
    """A table of the counts that matter most; all are in the JSON and the CSV."""
    from rich.console import Console
    from rich.table import Table

    shown = (
        "samples",
        "clusters_occupied",
        "light_cluster_pairs",
        "lighting_computations",
        "divergence",
        "tree_tests",
        "leaf_tests",
        "shadow_lights",
        "test_and_set",
        "extra_plane_tests",
        "longest_shadow_list",
        "memory",
    )
    names = [name for name in shown if any(name in row.counts for row in rows)]
    table = Table(box=None, pad_edge=False)
    table.add_column("configuration")
    for name in ("frame", *names):
        table.add_column(name.replace("_", " "), justify="right")
    for row in rows:
        table.add_row(str(row.configuration), str(row.frame), *(f"{row.counts.get(name, 0):,}" for name in names))
    Console(width=None if Console().is_terminal else 200).print(table)
