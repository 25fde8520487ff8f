"""Which columns of a table may explain a time: not those that number its rows, nor counts of our own program."""

from __future__ import annotations

from collections.abc import Iterable

from tuning.formats.grouping import without
from tuning.timing_table import TimingTable

_INDICES = frozenset({"frame", "seed"})
"""Numbers that tell rows apart and cost nothing."""

_OF_OUR_PROGRAM = frozenset(
    {"batch", "shading_lanes", "shading_steps", "shading_blocks", "assign_steps", "memory", "longest_list"}
)
"""Of how this JAX implementation cuts up the work: another engine does not pay for them."""

_CAP = "dropped_at_cap_"


def of_our_program(names: Iterable[str]) -> tuple[str, ...]:
    """Those of the names that mean nothing in another engine."""
    return tuple(name for name in names if name in _OF_OUR_PROGRAM or name.startswith(_CAP))


def explaining_columns(table: TimingTable) -> tuple[TimingTable, tuple[str, ...]]:
    """The table without such columns, and their names: rows that only they told apart become repeats.

    Counts of our program are left in where the times are its own (those have stages or a device) and where nothing
    else says that the table came from `vtfs count`.
    """
    left_out = tuple(name for name in table.columns if name in _INDICES)
    if "lighting_computations" in table.columns and "stage" not in table.labels:
        left_out += of_our_program(table.columns)
    return without(table, left_out), left_out
