"""Counts of many configurations and frames, as records, as a table and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vtfs.configurations import Configuration, counted_configuration
from vtfs.frame import KeptStages
from vtfs.frame_counts import FrameCounts, count
from vtfs.op_counts import OpCounts
from vtfs.parameters import GRID_PARAMETERS
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
        kept = KeptStages()
        # Those that share clusters one after the other, and of those the ones that share a tree.
        for done, config in enumerate(sorted(map(counted_configuration, configs), key=_shared), 1):
            if config not in counted:
                counted[config] = count(config, inputs, kept=kept)[0]
            progress(len(rows) + done, len(frames) * len(configs))
        rows += [CountRow(config, frame, counted[counted_configuration(config)].of(config)) for config in configs]
    return rows


def _shared(config: Configuration) -> tuple[str, str]:
    """Equal in the first where clusters are, and in both where lists are."""
    grid = [(name, value) for name, value in config.items if name in GRID_PARAMETERS]
    return str(grid), str(config.params.get("branching", ""))


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
