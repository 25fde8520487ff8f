"""Where the time of a compiled program goes: what its kernels took in JAX's profiler, by the function that asked."""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

_TABLE_ROW = re.compile(r'^(\d+) (?:"(.*)"|\{(.*)\})$')
_NUMBERS = re.compile(r"([._-]\d+)+$")
_INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?([\w.-]+) = .*stack_frame_id=(\d+)")

_CALLERS = ("while", "conditional", "call")
"""Of which a CPU's profile holds what they call as well."""


@dataclass(frozen=True)
class Kernels:
    """Of one call: `ms` and `launches` in all, and by function, the longest first."""

    ms: float
    launches: float
    by_function: dict[str, tuple[float, float]]


def asked_by(hlo: str) -> dict[str, str]:
    """The function, as file:name, that asked for each instruction of an optimised program's text; by the name of its
    kernel."""
    tables: dict[str, dict[str, Any]] = {}
    table: dict[str, Any] = {}
    found: dict[str, str] = {}
    for line in hlo.splitlines():
        if line in ("FileNames", "FunctionNames", "FileLocations", "StackFrames"):
            table = tables.setdefault(line, {})
        elif row := _TABLE_ROW.match(line):
            number, name, fields = row.groups()
            table[number] = name if fields is None else dict(field.split("=") for field in fields.split())
        elif instruction := _INSTRUCTION.match(line):
            name, frame = instruction.groups()
            at = tables["FileLocations"][tables["StackFrames"][frame]["file_location_id"]]
            file = Path(tables["FileNames"][at["file_name_id"]]).stem
            found[_kernel(name)] = f"{file}:{tables['FunctionNames'][at['function_name_id']].split('.')[-1]}"
    return found


def _kernel(instruction: str) -> str:
    return re.sub(r"[.-]", "_", instruction)


def kernels_of(compiled: Any, call: Callable[[], Any], n_calls: int = 10) -> Kernels:
    """**Arguments:** `compiled`: the program; `call`: runs it, and nothing else."""
    functions = asked_by(compiled.as_text())
    jax.block_until_ready(call())
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(n_calls):
                jax.block_until_ready(call())
        (file,) = Path(folder).rglob("*.xplane.pb")
        profile = jax.profiler.ProfileData.from_file(str(file))
    ns, launches = Counter[str](), Counter[str]()
    on_gpu = jax.default_backend() != "cpu"
    for plane in profile.planes:
        for line in plane.lines:
            # A GPU's other lines sum up what its streams say.
            if on_gpu and not (plane.name.startswith("/device:GPU") and line.name.startswith("Stream")):
                continue
            for event in line.events:
                op = dict(event.stats).get("hlo_op")
                if op is not None and not str(op).startswith(_CALLERS):
                    # In a CUDA graph all kernels are of one instruction, and only their own names tell them apart.
                    known = (functions.get(_kernel(name)) for name in (event.name, str(op)))
                    function = next(filter(None, known), "kernel " + _NUMBERS.sub("", event.name))
                    ns[function] += event.duration_ns
                    launches[function] += 1
    by_function = {name: (total / n_calls / 1e6, launches[name] / n_calls) for name, total in ns.most_common()}
    return Kernels(sum(ns.values()) / n_calls / 1e6, sum(launches.values()) / n_calls, by_function)


def table(found: Kernels, n_rows: int = 12) -> str:
    """In Markdown: the functions that took longest, and the rest as one row."""
    rows = list(found.by_function.items())
    rest = rows[n_rows:]
    if rest:
        rows = [*rows[:n_rows], ("others", (sum(ms for _, (ms, _) in rest), sum(n for _, (_, n) in rest)))]
    lines = ["| function | ms | launches |", "| --- | --- | --- |"]
    lines += [f"| {name} | {ms:.3f} | {n:.0f} |" for name, (ms, n) in rows]
    return "\n".join([*lines, f"| all | {found.ms:.3f} | {found.launches:.0f} |"])
