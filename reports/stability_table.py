"""What a stability result says: for each method and ladder where it first fails, how badly, and why."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from reports.stability_reasons import reason
from vtfs.stability.record import Kind, RungResult, StabilityResult

FEW = 0.01
"""Up to this share of wrong samples a rung is called "a few": single pixels, not areas."""

State = Literal["holds", "few", "fails", "refused", "not run"]


@dataclass(frozen=True)
class Cell:
    """One method on one ladder.

    - `where`: the rungs on which it is wrong, or without an answer: "from 256", "at 1, from 1e4".
    - `worst_share`: of what was tested, on `worst` rung.
    """

    state: State
    where: str = ""
    worst: str = ""
    worst_share: float = 0.0

    @property
    def text(self) -> str:
        """In a few words."""
        if self.state in ("holds", "not run"):
            return self.state
        return f"refused {self.where}" if self.state == "refused" else self.where


@dataclass(frozen=True)
class LadderColumn:
    """A ladder that some method fails on, or none. `span`: its first and last rung."""

    name: str
    title: str
    span: str
    n_rungs: int
    only_lit: tuple[str, ...]


@dataclass(frozen=True)
class Row:
    """Methods whose cells are the same in all ladders, and why they fail where they do.

    - `ratios`: of light tests, what lists held over what samples prove: on the middle rung and the most.
    """

    methods: tuple[str, ...]
    cells: tuple[Cell, ...]
    why: str
    ratios: tuple[float, float] | None = None

    @property
    def worst_share(self) -> float:
        return max((cell.worst_share for cell in self.cells), default=0.0)

    @property
    def state(self) -> State:
        """The worst of its cells."""
        found = {"holds", *(cell.state for cell in self.cells)}
        order: list[State] = ["fails", "few", "refused", "not run", "holds"]
        return next(state for state in order if state in found)

    @property
    def is_detail(self) -> bool:
        """A variant that says little more than its siblings: stencils whose samples are tested in float32."""
        return all(name.startswith("z_") and name.endswith("float32 test") for name in self.methods)


@dataclass(frozen=True)
class StabilityTable:
    """One kind of method on the ladders of one source.

    - `quiet`: ladders on which no method is wrong.
    """

    kind: Kind
    source: str
    ladders: tuple[LadderColumn, ...]
    quiet: tuple[LadderColumn, ...]
    rows: tuple[Row, ...]

    @property
    def main_rows(self) -> tuple[Row, ...]:
        return tuple(row for row in self.rows if not row.is_detail)

    @property
    def detail_rows(self) -> tuple[Row, ...]:
        return tuple(row for row in self.rows if row.is_detail)

    def with_state(self, state: State) -> tuple[Row, ...]:
        """Main rows whose worst cell is in that state."""
        return tuple(row for row in self.main_rows if row.state == state)

    @property
    def n_methods(self) -> int:
        """Of the main rows."""
        return sum(len(row.methods) for row in self.main_rows)


def tables(result: StabilityResult) -> tuple[StabilityTable, ...]:
    """In the order of the run: the user's scene first, shadows before lights."""
    places: list[tuple[Kind, str]] = [(rung.kind, rung.source) for rung in result.rungs]
    return tuple(
        _table([rung for rung in result.rungs if (rung.kind, rung.source) == (kind, source)], kind, source)
        for kind, source in dict.fromkeys(places)
    )


def _table(rungs: Sequence[RungResult], kind: Kind, source: str) -> StabilityTable:
    by_ladder: dict[str, list[RungResult]] = {}
    for rung in rungs:
        by_ladder.setdefault(rung.ladder, []).append(rung)
    methods = list(dict.fromkeys(name for rung in rungs for name in rung.verdicts))
    cells = {name: {ladder: _cell(name, found) for ladder, found in by_ladder.items()} for name in methods}
    loud = [ladder for ladder in by_ladder if any(cells[name][ladder].state != "holds" for name in methods)]
    quiet = [ladder for ladder in by_ladder if ladder not in loud]
    grouped: dict[tuple[object, ...], list[str]] = {}
    for name in methods:
        key = (*(cells[name][ladder] for ladder in by_ladder), _ratios(rungs, name))
        grouped.setdefault(key, []).append(name)
    rows = []
    for of_it in grouped.values():
        wrong = {ladder: cells[of_it[0]][ladder] for ladder in loud}
        rows.append(Row(tuple(of_it), tuple(wrong.values()), _why(kind, of_it[0], wrong), _ratios(rungs, of_it[0])))
    # Robust ones first, and tight ones.
    rows.sort(key=lambda row: (row.worst_share, row.ratios or (0.0, 0.0)))
    return StabilityTable(
        kind,
        source,
        tuple(_column(by_ladder[ladder]) for ladder in loud),
        tuple(_column(by_ladder[ladder]) for ladder in quiet),
        tuple(rows),
    )


def _column(rungs: Sequence[RungResult]) -> LadderColumn:
    span = f"{rungs[0].label} to {rungs[-1].label}"
    only_lit = tuple(rung.label for rung in rungs if rung.kind == "shadow" and rung.tested and not rung.shadowed)
    return LadderColumn(rungs[0].ladder, rungs[0].title, span, len(rungs), only_lit)


def _cell(method: str, rungs: Sequence[RungResult]) -> Cell:
    found = [(rung.label, rung.verdicts[method]) for rung in rungs if method in rung.verdicts]
    if not found:
        return Cell("not run")
    labels = [label for label, _ in found]
    if not any(v.wrong for _, v in found):
        refused = [bool(v.refused) for _, v in found]
        return Cell("refused", _where(labels, refused)) if any(refused) else Cell("holds")
    worst, verdict = max(found, key=lambda pair: pair[1].share)
    state = "fails" if verdict.share > FEW else "few"
    return Cell(state, _where(labels, [v.wrong > 0 for _, v in found]), worst, verdict.share)


def _where(labels: Sequence[str], is_wrong: Sequence[bool]) -> str:
    """Runs of consecutive rungs; what goes on to the last rung is "from" its first."""
    runs: list[list[int]] = []
    for n, wrong in enumerate(is_wrong):
        if wrong and runs and runs[-1][-1] == n - 1:
            runs[-1].append(n)
        elif wrong:
            runs.append([n])
    words = []
    for run in runs:
        first, last = labels[run[0]], labels[run[-1]]
        if run[-1] == len(labels) - 1 and len(run) > 1:
            words.append(f"from {first}")
        else:
            words.append(f"at {first}" if len(run) == 1 else f"{first} to {last}")
    return ", ".join(words)


def _ratios(rungs: Sequence[RungResult], method: str) -> tuple[float, float] | None:
    found = [rung.verdicts[method].listed_ratio for rung in rungs if method in rung.verdicts]
    known = [ratio for ratio in found if ratio is not None]
    return (statistics.median(known), max(known)) if known else None


def _why(kind: Kind, method: str, cells: dict[str, Cell]) -> str:
    """Sentences for the ladders that it fails on, the worst first, at most two of them."""
    failing = sorted(
        (ladder for ladder, cell in cells.items() if cell.state not in ("holds", "not run")),
        key=lambda ladder: -cells[ladder].worst_share,
    )
    if not failing:
        return "Right on every rung."
    return " ".join(list(dict.fromkeys(reason(kind, method, ladder) for ladder in failing))[:2])
