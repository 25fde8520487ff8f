"""Repeating a run until its median is known well enough."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from tuning.choose import median_interval

MIN_REPEATS = 3
PRECISION = 0.02
"""Half of what the 95 % interval of the median may span, relative to the median."""

MIN_S = 0.1
"""Least time spent on one frame: a GPU's first milliseconds after a compile are up to half as slow again."""

KEPT_REPEATS = 1000
"""Of a stage of a few microseconds 10,000 runs fill `MIN_S`: the last ones say the same, in a tenth of the file."""

CAP_S = 2.0
"""Most time spent on one frame, once it has `MIN_REPEATS`."""


def timed_ms(run: Callable[[], object]) -> float:
    """One run. It must return only when its result is there (`block_until_ready`)."""
    started = time.perf_counter()
    run()
    return (time.perf_counter() - started) * 1e3


def repeats_ms(
    run: Callable[[], object],
    decided: Callable[[tuple[float, float]], bool],
    cap_s: float = CAP_S,
    hopeless_ms: float = math.inf,
) -> tuple[float, ...]:
    """Times of at least three runs. The caller has made one before, which compiled and warmed up.

    More are made until the 95 % interval of the median is within 2 %, or `cap_s` is spent, or the interval
    already decides what the caller wants to know (a configuration that has lost needs no third digit). Of many the
    last `KEPT_REPEATS` are returned.

    **Arguments:**

    - `hopeless_ms`: where all runs are slower than this there may be fewer than three, even one, if they fill `MIN_S`.
    """
    times: list[float] = []
    started = time.perf_counter()
    while True:
        times.append(timed_ms(run))
        if time.perf_counter() - started < min(MIN_S, cap_s):
            continue
        if min(times) > hopeless_ms:
            return tuple(times)
        if len(times) < MIN_REPEATS:
            continue
        low, high = median_interval(times)
        middle = (low + high) / 2
        precise = len(times) > 2 * MIN_REPEATS - 1 and high - low <= 2 * PRECISION * middle
        if precise or decided((low, high)) or time.perf_counter() - started >= cap_s:
            return tuple(times[-KEPT_REPEATS:])


def interleaved_ms(runs: Sequence[Callable[[], object]], rounds: int, cap_s: float) -> list[tuple[float, ...]]:
    """Times of several runs taken in turns, so that a drift of the machine's speed meets all of them.

    At least three rounds, then until `rounds` or `cap_s`.
    """
    times: list[list[float]] = [[] for _ in runs]
    started = time.perf_counter()
    for done in range(rounds):
        if done >= MIN_REPEATS and time.perf_counter() - started > cap_s:
            break
        for run, own in zip(runs, times, strict=True):
            own.append(timed_ms(run))
    return [tuple(own) for own in times]
