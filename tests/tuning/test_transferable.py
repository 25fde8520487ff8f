"""Which columns may explain a time."""

import numpy as np
import pytest

from tuning.timing_table import TimingTable
from tuning.transferable import explaining_columns

COUNTS = ("lighting_computations", "cells_total", "shading_steps")
NO_WORK = ("memory", "memory_tree", "longest_list", "dropped_at_cap_64", "shading_blocks")


def a_table(names: tuple[str, ...], labels: tuple[str, ...]) -> TimingTable:
    rng = np.random.default_rng(0)
    return TimingTable(
        {name: rng.uniform(1, 9, 5) for name in names},
        {name: tuple("abcde") for name in labels},
        tuple((ms,) for ms in (1.0, 2.0, 3.0, 4.0, 5.0)),
    )


@pytest.mark.parametrize(
    ("labels", "kept"),
    [
        (("stage",), COUNTS),  # our own times: all that a parameter does is counted
        ((), ("lighting_computations", "cells_total", "tile_px")),  # an engine's: it has no steps of ours
    ],
)
def test_counts_of_work_explain_a_time_and_what_is_no_work_does_not(labels, kept):
    table, left_out = explaining_columns(a_table((*COUNTS, "tile_px", "batch", "frame", *NO_WORK), labels))
    assert tuple(table.columns) == kept
    assert set(left_out) == {*COUNTS, "tile_px", "batch", "frame", *NO_WORK} - set(kept)


def test_a_table_without_counts_keeps_what_it_has():
    table, left_out = explaining_columns(a_table(("tile_px", "memory", "frame"), ("stage",)))
    assert tuple(table.columns) == ("tile_px", "memory") and left_out == ("frame",)
