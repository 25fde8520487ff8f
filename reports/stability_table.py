"""What a stability result says: for each method and ladder, where it first fails, and how badly; and why."""

from __future__ import annotations

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

    - `first`: the first rung on which it is wrong; `worst_share`: of what was tested, on `worst` rung.
    - `ratio`: of light tests, the most that the lists held over what samples prove.
    """

    state: State
    first: str = ""
    worst: str = ""
    worst_share: float = 0.0
    ratio: float | None = None

    @property
    def text(self) -> str:
        """In a word or two."""
        if self.state == "holds":
            return "holds"
        return self.state if self.state == "not run" else f"from {self.first}" if self.first else self.state


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
    """Methods whose cells are the same in all ladders, and why they fail where they do."""

    methods: tuple[str, ...]
    cells: tuple[Cell, ...]
    why: str

    @property
    def is_peer(self) -> bool:
        return self.methods[0].startswith("shadow_rays")


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


def tables(result: StabilityResult) -> tuple[StabilityTable, ...]:
    """In the order of the run: the user's scene first, shadows before lights."""
    places = dict.fromkeys((rung.kind, rung.source) for rung in result.rungs)
    return tuple(
        _table([rung for rung in result.rungs if (rung.kind, rung.source) == place], *place) for place in places
    )


def _table(rungs: Sequence[RungResult], kind: Kind, source: str) -> StabilityTable:
    by_ladder: dict[str, list[RungResult]] = {}
    for rung in rungs:
        by_ladder.setdefault(rung.ladder, []).append(rung)
    methods = list(dict.fromkeys(name for rung in rungs for name in rung.verdicts))
    cells = {name: {ladder: _cell(name, found) for ladder, found in by_ladder.items()} for name in methods}
    loud = [ladder for ladder in by_ladder if any(cells[name][ladder].state != "holds" for name in methods)]
    quiet = [ladder for ladder in by_ladder if ladder not in loud]
    grouped: dict[tuple[Cell, ...], list[str]] = {}
    for name in methods:
        grouped.setdefault(tuple(cells[name][ladder] for ladder in by_ladder), []).append(name)
    rows = []
    for of_it in grouped.values():
        wrong = {ladder: cells[of_it[0]][ladder] for ladder in loud}
        rows.append(Row(tuple(of_it), tuple(wrong.values()), _why(kind, of_it[0], wrong)))
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
    ratio = max((v.listed_ratio for _, v in found if v.listed_ratio is not None), default=None)
    wrong = [(label, v) for label, v in found if v.wrong]
    refused = [label for label, v in found if v.refused]
    if not wrong:
        return Cell("refused", refused[0], ratio=ratio) if refused else Cell("holds", ratio=ratio)
    worst, verdict = max(wrong, key=lambda pair: pair[1].share)
    state = "fails" if verdict.share > FEW else "few"
    return Cell(state, wrong[0][0], worst, verdict.share, ratio)


def _why(kind: Kind, method: str, cells: dict[str, Cell]) -> str:
    """Sentences for the ladders that it fails on, the worst first, at most two of them."""
    failing = sorted(
        (ladder for ladder, cell in cells.items() if cell.state not in ("holds", "not run")),
        key=lambda ladder: -cells[ladder].worst_share,
    )
    if not failing:
        return "Right on every rung."
    return " ".join(list(dict.fromkeys(reason(kind, method, ladder) for ladder in failing))[:2])
