"""What to measure next: a small design first, then whatever the cost model expects to gain most."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import bdtr, ndtr

from tuning.cost_model import CostModel
from tuning.measurement import FLOAT32_ERROR, Measurement
from tuning.space import Space
from vtfs.configurations import Configuration
from vtfs.parameters import Value

Objective = Literal["max", "mean"]
"""The slowest frame decides, or the mean over frames."""

Counts = tuple[Mapping[str, int], ...]
CountsOf = Callable[[Configuration], Counts]
"""Exact counts of a configuration, one record a measured frame; none where it cannot be counted."""

_HYPERCUBES = 64

SMALLEST_GAIN = 0.01
"""A gain below this is never worth a measurement, however quiet the machine."""


@dataclass(frozen=True)
class Choice:
    """What to measure next, or why not.

    - `predicted_gain`: what the best of them is expected to gain over the best measured time, relative to it.
    - `stop_reason`: set where nothing is left that is worth measuring; `configurations` is then empty.
    """

    configurations: tuple[Configuration, ...]
    predicted_gain: float
    stop_reason: str | None = None


def time_ms(measurement: Measurement, objective: Objective) -> float:
    """The time that is minimised: the slowest frame's median over repeats, or the mean of the frames' medians."""
    frames_ms = [_median_ms(repeats) for repeats in measurement.stages_ms["frame"] if repeats]
    return _over_frames(np.array(frames_ms), objective)


def time_interval_ms(measurement: Measurement, objective: Objective) -> tuple[float, float]:
    """95 % interval of `time_ms`: that of the slowest frame's median, or the mean of all frames' (cautious)."""
    frames_ms = [repeats for repeats in measurement.stages_ms["frame"] if repeats]
    if objective == "max":
        return median_interval(max(frames_ms, key=_median_ms))
    low, high = np.mean([median_interval(repeats) for repeats in frames_ms], axis=0)
    return float(low), float(high)


def median_interval(repeats: Sequence[float]) -> tuple[float, float]:
    """Distribution-free 95 % interval of a median, from order statistics (the sign test).

    Fewer than six repeats cannot give 95 %: it is then their whole range.
    """
    ordered = sorted(repeats)
    n = len(ordered)
    # The k-th smallest is above the median with the probability of fewer than k successes in n fair trials.
    k = int(np.count_nonzero(bdtr(np.arange(n // 2), n, 0.5) <= 0.025))
    return float(ordered[max(k - 1, 0)]), float(ordered[n - max(k, 1)])


def is_timed(measurement: Measurement) -> bool:
    """Was it measured, with times that can be compared?

    The first frame is enough: a configuration that lost on it was not timed on the others.
    """
    frames_ms = measurement.stages_ms.get("frame", ())
    return (
        measurement.outcome == "timed"
        and len(frames_ms) > 0
        and len(frames_ms[0]) > 0
        and all(map(math.isfinite, itertools.chain(*frames_ms)))
    )


def initial_design(space: Space, counts_of: CountsOf, seed: int = 0, per_technique: int = 3) -> Iterator[Configuration]:
    """Each technique's default, also where it is not in the space; then, in turns, a few that fill its space.

    Those are the configurations next to the points of a Latin hypercube over the ranks of the values. What would
    do the same work as one before it is left out. Counted one by one, as they are asked for: a shadow technique's
    counts compile for seconds.
    """
    defaults = [space.default(technique) for technique in space.techniques]
    yield from defaults
    seen = {work_done(candidate, counts_of(candidate)) for candidate in defaults}

    def spread(technique: str) -> Iterator[Configuration]:
        for candidate in _space_filling(space, technique, seed, per_technique):
            work = work_done(candidate, counts_of(candidate))
            if counts_of(candidate) and work not in seen:
                seen.add(work)
                yield candidate

    spreads = [spread(technique) for technique in space.techniques]
    for _ in range(per_technique):
        for each in spreads:
            yield from itertools.islice(each, 1)


def choose_next(
    space: Space,
    measured: Mapping[Configuration, Measurement],
    counts_of: CountsOf,
    models: Mapping[str, CostModel],
    objective: Objective,
) -> Choice:
    """Two configurations: the one with the highest expected gain, and the best neighbour of the fastest measured.

    The expected gain (expected improvement, Jones et al. 1998) is that of a normal distribution about the
    prediction, as wide as the model's left-out error: an uncertain prediction is worth a look. The neighbour is
    there for what counts do not show, such as caches that a batch fits in.

    Stops where the expected gain is within the noise: the standard error of the fastest (its 95 % interval is taken
    for 1.96 of it on either side), at least `SMALLEST_GAIN`.

    **Arguments:**

    - `measured`: all that were measured, failed ones too; none of them, nor any that does the same work, is chosen.
    - `models`: of the stage `frame`, by technique; techniques without a model are not chosen from.
    """
    timed = {candidate: found for candidate, found in measured.items() if is_timed(found) and candidate in space}
    if not timed:
        return Choice((), 0.0, "no configuration could be timed")
    fastest = min(timed, key=lambda candidate: time_ms(timed[candidate], objective))
    best_ms = time_ms(timed[fastest], objective)
    low_ms, high_ms = time_interval_ms(timed[fastest], objective)
    noise = max((high_ms - low_ms) / (2 * 1.96) / best_ms, SMALLEST_GAIN)

    # A list, as what turns out not to be countable is added to what was measured.
    done = {work_done(candidate, counts_of(candidate)) for candidate in list(measured)}
    gains: dict[Configuration, float] = {}
    for technique, model in models.items():
        if not math.isfinite(model.loo_error):
            continue
        open_ = [c for c in space.configurations() if c.technique == technique and c not in measured]
        open_ = [c for c in open_ if counts_of(c) and work_done(c, counts_of(c)) not in done]
        predicted_ms = predict_ms(model, [counts_of(candidate) for candidate in open_], objective)
        gains |= zip(open_, _expected_gain(predicted_ms, model.spread, best_ms) / best_ms, strict=True)

    ranked = sorted(gains, key=lambda candidate: -gains[candidate])
    if not ranked:
        return Choice((), 0.0, "every configuration that can be predicted was measured")
    gain = float(gains[ranked[0]])
    if gain <= noise:
        return Choice((), gain, f"the gain still predicted, {gain:.1%}, is within the noise of {noise:.1%}")
    place = _places(space, fastest.technique)
    close = [c for c in ranked[1:] if c.technique == fastest.technique and _steps_apart(place, c, fastest) == 1]
    second = [c for c in (*close[:1], *ranked[1:2]) if gains[c] > noise]
    return Choice((ranked[0], *second[:1]), gain)


def predict_ms(model: CostModel, counts: Sequence[Counts], objective: Objective) -> np.ndarray:
    """Predicted `time_ms`, float64 `[len(counts)]`, from the counts of every frame of each configuration."""
    if not counts:
        return np.empty(0)
    n_frames = len(counts[0])
    frames_ms = model.predict([frame for frames in counts for frame in frames]).reshape(len(counts), n_frames)
    return frames_ms.max(axis=1) if objective == "max" else frames_ms.mean(axis=1)


def pareto_front(measurements: Iterable[Measurement], objective: Objective) -> tuple[Measurement, ...]:
    """Those that no other beats in both time and error, fastest first; what has no error is left out.

    Errors that are rounding alone count as equal.
    """
    points = [
        (time_ms(m, objective), max(m.error, FLOAT32_ERROR), m)
        for m in measurements
        if is_timed(m) and m.error is not None
    ]
    front: list[Measurement] = []
    least = math.inf
    for _, error, measurement in sorted(points, key=lambda point: point[:2]):
        if error < least:
            least = error
            front.append(measurement)
    return tuple(front)


def work_done(candidate: Configuration, counts: Counts) -> tuple[object, ...]:
    """Equal for two configurations that run the same program on the same work.

    The counts show what tiles, slices and branching do, and where loops are counted also what a batch does.
    """
    shown = {"tile_px", "depth_slices", "branching"}
    if all({"assign_steps", "shading_steps"} & frame.keys() and "shadow_lights" not in frame for frame in counts):
        shown.add("batch")
    hidden = tuple(item for item in candidate.items if item[0] not in shown)
    return candidate.technique, hidden, tuple(tuple(sorted(frame.items())) for frame in counts)


def _median_ms(repeats: Sequence[float]) -> float:
    return float(np.median(repeats))


def _over_frames(frames_ms: np.ndarray, objective: Objective) -> float:
    return float(frames_ms.max() if objective == "max" else frames_ms.mean())


def _expected_gain(predicted_ms: np.ndarray, spread: float, best_ms: float) -> np.ndarray:
    """Mean of `max(best - time, 0)` for times normal about the prediction. Jones et al. 1998, Eq. 15."""
    sigma_ms = np.maximum(spread * predicted_ms, 1e-12 * best_ms)
    z = (best_ms - predicted_ms) / sigma_ms
    density = np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
    return sigma_ms * (z * ndtr(z) + density)


def _space_filling(space: Space, technique: str, seed: int, n: int) -> list[Configuration]:
    from scipy.stats import qmc  # 0.6 s to import, and `vtfs --help` comes this way

    candidates = [candidate for candidate in space.configurations() if candidate.technique == technique]
    if len(candidates) <= n:
        return candidates
    place = _places(space, technique)
    size = np.array([max(len(ranks) - 1, 1) for ranks in place.values()])
    at = np.array([_ranks(place, candidate) for candidate in candidates]) / size
    hypercube = qmc.LatinHypercube(d=len(place), rng=np.random.default_rng(seed))
    # SciPy's own optimisation of one hypercube takes 2 s, and ends no better than the best of these.
    points = min((hypercube.random(n) for _ in range(_HYPERCUBES)), key=qmc.discrepancy)
    points = points * (1 + 1 / size) - 0.5 / size  # every rank, the first and last too, is the nearest equally often
    chosen: list[Configuration] = []
    for point in points:
        distance = np.square(at - point).sum(axis=1)
        distance[[candidates.index(taken) for taken in chosen]] = np.inf
        chosen.append(candidates[int(distance.argmin())])
    return chosen


def _places(space: Space, technique: str) -> dict[str, dict[Value, int]]:
    """The rank of every value of every parameter of a technique."""
    values = space.values.get(technique, {})
    return {name: {v: k for k, v in enumerate(sorted(set(values[name]), key=_order(name)))} for name in values}


def _order(name: str) -> Callable[[Value], tuple[bool, Value]]:
    # 0 stands for the most: all queries at once, as many slices as make cells cubic.
    return lambda value: (name in ("batch", "depth_slices") and value == 0, value)


def _ranks(place: Mapping[str, Mapping[Value, int]], candidate: Configuration) -> list[int]:
    return [ranks.get(candidate[name], 0) for name, ranks in place.items()]


def _steps_apart(place: Mapping[str, Mapping[Value, int]], a: Configuration, b: Configuration) -> int:
    return sum(abs(p - q) for p, q in zip(_ranks(place, a), _ranks(place, b), strict=True))
