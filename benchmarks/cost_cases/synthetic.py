"""Laws that are known: are the right terms found, how far do they hold, do the intervals cover?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.cost_cases.peers import Case, Peers
from tuning.table_model import TableModel, fit_table
from tuning.timing_table import TimingTable

ROWS = 25
NOISE = 0.03
X = (1.0, 1e4)
"""Sizes are spread evenly over their logs in this range; tiles, `y`, from 4 to 256."""
Y = (4.0, 256.0)

Columns = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Draw:
    """A law with drawn costs, and its rows.

    - `terms`: the names that are right; a cut is right at any knot.
    """

    shape: str
    law: Callable[[Columns], np.ndarray]
    terms: frozenset[str]
    columns: dict[str, np.ndarray]
    times_ms: np.ndarray

    @property
    def table(self) -> TimingTable:
        return TimingTable(self.columns, {}, tuple((float(time_ms),) for time_ms in self.times_ms))

    def beyond(self, factor: float) -> dict[str, np.ndarray]:
        """One row, that many times as large as the largest of every column."""
        return {name: np.array([factor * column.max()]) for name, column in self.columns.items()}


def draws(n: int) -> Iterator[Draw]:
    """In turns of nine shapes. Every term is at least half of the time in some row: else it could not be found."""
    makers = (_constant, _linear, _n_log_n, _root, _tile, _two, _product, _larger, _capacity)
    for k in range(n):
        rng = np.random.default_rng(k)
        x = np.exp(rng.uniform(np.log(X[0]), np.log(X[1]), ROWS))
        y = np.exp(rng.uniform(np.log(Y[0]), np.log(Y[1]), ROWS))
        shape, names, law, terms = makers[k % len(makers)](rng, x, y)
        columns = {name: column for name, column in (("x", x), ("y", y)) if name in names}
        times_ms = law(columns) * np.exp(NOISE * rng.normal(size=ROWS))
        yield Draw(shape, law, frozenset(terms), columns, times_ms)


def found_terms(model: TableModel) -> frozenset[str]:
    (one,) = model.models.values()
    kind = "larger of " if any(one.law.sides) else ""
    return frozenset(
        kind + (term.name if term.shape == "whole" else f"{term.shape} {term.columns[0]}")
        for term in one.law.terms
        if term.factors
    )


def rows(n: int, peers: Peers) -> Iterator[tuple[str, str, str]]:
    """Question, figure and target, for the table."""
    drawn = list(draws(n))
    models = [fit_table(draw.table, seed=k) for k, draw in enumerate(drawn)]
    right = np.array([found_terms(model) == draw.terms for model, draw in zip(models, drawn, strict=True)])
    yield f"right terms, {n} draws", f"{right.mean():.1%}", "at least 90 %"
    for shape in dict.fromkeys(draw.shape for draw in drawn):
        own = np.array([draw.shape == shape for draw in drawn])
        others = [
            " + ".join(sorted(found_terms(model))) or "constant"
            for model, draw, ok in zip(models, drawn, right, strict=True)
            if draw.shape == shape and not ok
        ]
        yield f"  of {shape}", f"{right[own].mean():.0%}{'; else ' if others else ''}{'; '.join(others[:2])}", ""
    cases = [
        Case(
            tuple(draw.columns),
            np.column_stack(list(draw.columns.values())),
            draw.times_ms,
            np.vstack([np.column_stack(list(draw.beyond(f).values())) for f in (4.0, 16.0)]),
        )
        for draw in drawn
    ]
    predicted = peers.predict(cases)
    for k, (factor, target) in enumerate(((4.0, 0.03), (16.0, 0.04))):
        truth = np.array([draw.law(draw.beyond(factor))[0] for draw in drawn])
        ours = np.array([m.predict(d.beyond(factor), {})[0].time_ms for m, d in zip(models, drawn, strict=True)])
        yield f"median error at {factor:g} times the data", f"{_median(ours, truth):.1%}", f"at most {target:.0%}"
        for name, values in predicted.items():
            theirs = np.array([v[k] for v in values])
            known = np.isfinite(theirs)
            yield f"  {name}", f"{_median(theirs[known], truth[known]):.1%} of {known.sum()} laws", ""
    yield from _coverage(models, drawn)


def tile_rows(n: int, peers: Peers) -> Iterator[tuple[str, str, str]]:
    """The minimum of 0.4 + 30 / T + 0.02 T on a grid of 25 tile sizes."""
    grid = np.geomspace(*Y, ROWS)
    truth = 0.4 + 30 / grid + 0.02 * grid
    cases, steps = [], []
    for k in range(n):
        times_ms = truth * np.exp(NOISE * np.random.default_rng(k).normal(size=ROWS))
        model = fit_table(TimingTable({"y": grid}, {}, tuple((float(t),) for t in times_ms)))
        steps.append(_steps_off(np.array([p.time_ms for p in model.predict({"y": grid}, {})]), truth))
        cases.append(Case(("y",), grid[:, None], times_ms, grid[:, None]))
    yield "tile of least time, steps off (worst)", f"{max(steps)} of {n} draws", "at most 1"
    for name, values in peers.predict(cases).items():
        constant = sum(np.ptp(value) < 1e-9 * value.max() for value in values)
        worst = max(_steps_off(value, truth) for value in values)
        yield f"  {name}", f"{worst}" + (f"; {constant} constants" if constant else ""), ""


def _coverage(models: list[TableModel], drawn: list[Draw]) -> Iterator[tuple[str, str, str]]:
    inside, far = [], []
    for k, (model, draw) in enumerate(zip(models, drawn, strict=True)):
        rng = np.random.default_rng(10_000 + k)
        # Fresh rows within the box of the fitted ones, with fresh noise.
        fresh = {n: np.exp(rng.uniform(np.log(c.min()), np.log(c.max()), 40)) for n, c in draw.columns.items()}
        inside += _covered(model, fresh, draw.law(fresh) * np.exp(NOISE * rng.normal(size=40)), extrapolated=False)
        for factor in (4.0, 16.0):
            at = draw.beyond(factor)
            far += _covered(model, at, draw.law(at) * np.exp(NOISE * rng.normal(size=1)), extrapolated=True)
    yield "90 % intervals cover, within the data", f"{np.mean(inside):.1%} of {len(inside)}", "85 to 95 %"
    yield "  at 4 and 16 times the data", f"{np.mean(far):.1%} of {len(far)}", ""


def _covered(model: TableModel, columns: Columns, times_ms: np.ndarray, extrapolated: bool) -> list[bool]:
    predictions = model.predict(dict(columns), {})
    return [
        p.low_ms <= time_ms <= p.high_ms
        for p, time_ms in zip(predictions, times_ms, strict=True)
        if p.extrapolated == extrapolated
    ]


def _median(predicted_ms: np.ndarray, truth_ms: np.ndarray) -> float:
    return float(np.median(np.abs(predicted_ms / truth_ms - 1)))


def _steps_off(predicted_ms: np.ndarray, truth_ms: np.ndarray) -> int:
    return abs(int(predicted_ms.argmin()) - int(truth_ms.argmin()))


_Law = tuple[str, tuple[str, ...], Callable[[Columns], np.ndarray], tuple[str, ...]]


def _share(rng: np.random.Generator, most: float = 20.0) -> float:
    """A term where it is largest, over the constant."""
    return float(np.exp(rng.uniform(np.log(1.5), np.log(most))))


def _constant(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a = rng.uniform(0.5, 5)
    return "constant", ("x", "y"), lambda c: np.full(len(c["x"]), a), ()


def _linear(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a, b = rng.uniform(0.5, 5), _share(rng) / x.max()
    return "a + b x", ("x",), lambda c: a * (1 + b * c["x"]), ("x",)


def _n_log_n(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a, b = rng.uniform(0.5, 5), _share(rng) / (x * np.log2(x)).max()
    return "a + b x log x", ("x",), lambda c: a * (1 + b * c["x"] * np.log2(c["x"])), ("x * log2(x)",)


def _root(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a, b = rng.uniform(0.5, 5), _share(rng) / np.sqrt(x.max())
    return "a + b sqrt x", ("x",), lambda c: a * (1 + b * np.sqrt(c["x"])), ("x^0.5",)


def _tile(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a, b, c_ = rng.uniform(0.2, 1), _share(rng) * y.min(), _share(rng) / y.max()
    return "a + b / y + c y", ("y",), lambda c: a * (1 + b / c["y"] + c_ * c["y"]), ("y", "y^-1")


def _two(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a, b, c_ = rng.uniform(0.5, 5), _share(rng) / x.max(), _share(rng) / y.max()
    return "a + b x + c y", ("x", "y"), lambda c: a * (1 + b * c["x"] + c_ * c["y"]), ("x", "y")


def _product(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    a, b = rng.uniform(0.5, 5), _share(rng) / (x * y).max()
    return "a + b x y", ("x", "y"), lambda c: a * (1 + b * c["x"] * c["y"]), ("x * y",)


def _larger(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    # Each is the larger one in a quarter of the rows or more.
    a, b = 1.0, float(np.exp(np.quantile(np.log(x / y), rng.uniform(0.25, 0.75))))
    terms = ("larger of x", "larger of y")
    return "max(a x, b y)", ("x", "y"), lambda c: 1e-3 * np.maximum(a * c["x"], b * c["y"]), terms


def _capacity(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> _Law:
    # Between half and three in ten of the rows are beyond it; a cut near the end of the rows is no more than a line.
    a, b, k = rng.uniform(0.5, 5), _share(rng), float(np.quantile(x, rng.uniform(0.5, 0.7)))
    slope = b / (x.max() - k)
    law = ("beyond x",)
    return "a + b max(x - k, 0)", ("x",), lambda c: a * (1 + slope * np.maximum(c["x"] - k, 0)), law
