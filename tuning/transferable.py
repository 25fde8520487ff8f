"""Which columns of a table may explain a time: not those that number its rows, nor counts of our own program."""

from __future__ import annotations

from collections.abc import Iterable

from tuning.formats.grouping import without
from tuning.timing_table import TimingTable
from vtfs.parameters import PARAMETERS

_INDICES = frozenset({"frame", "seed"})
"""Numbers that tell rows apart and cost nothing."""

_OF_OUR_PROGRAM = frozenset({"batch", "shading_lanes", "shading_steps", "assign_steps"})
"""Of how this JAX implementation cuts up the work: another engine does not pay for them."""

_NO_WORK = frozenset({"shading_blocks", "memory", "longest_list"})
_NO_WORK_STEMS = ("dropped_at_cap_", "memory_")


def of_our_program(names: Iterable[str]) -> tuple[str, ...]:
    """Those of the names that mean nothing in another engine."""
    return tuple(name for name in names if name in _OF_OUR_PROGRAM or _is_no_work(name))


def explaining_columns(table: TimingTable) -> tuple[TimingTable, tuple[str, ...]]:
    """The table without such columns, and their names: rows that only they told apart become repeats.

    A table with counts goes without those that are no work. Where the times are our program's own (those have stages),
    all that a parameter does is counted, so parameters are left out; elsewhere the counts of our program are.
    """
    left_out = [name for name in table.columns if name in _INDICES]
    if "lighting_computations" in table.columns:
        if "stage" in table.labels:
            left_out += [name for name in table.columns if name in PARAMETERS or _is_no_work(name)]
        else:
            left_out += of_our_program(table.columns)
    return without(table, left_out), tuple(left_out)


def _is_no_work(name: str) -> bool:
    return name in _NO_WORK or name.startswith(_NO_WORK_STEMS)
