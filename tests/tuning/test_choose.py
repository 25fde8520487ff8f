import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from tests.tuning.measurements import a_measurement
from tests.tuning.synthetic_workload import LARGE, SHADING_BOUND, SMALL, WHOLE, Synthetic, erratic
from tuning.choose import (
    choose_next,
    initial_design,
    is_timed,
    median_interval,
    pareto_front,
    time_interval_ms,
    time_ms,
    work_done,
)
from tuning.cost_model import CostModel
from tuning.measurement import FLOAT32_ERROR, Measurement, Outcome
from tuning.space import Space
from tuning.stage_models import fit_stage
from vtfs.configurations import configuration


def measurement(*frames_ms, error=None, outcome: Outcome = "timed") -> Measurement:
    return a_measurement(n_frames=len(frames_ms), outcome=outcome, stages_ms={"frame": tuple(frames_ms)}, error=error)


def test_the_slowest_frame_or_the_mean_decides():
    m = measurement((1.0, 2.0, 30.0), (4.0, 5.0, 9.0), (3.0, 3.5))
    assert time_ms(m, "max") == 5.0
    assert time_interval_ms(m, "max") == (4.0, 9.0)
    assert time_ms(m, "mean") == pytest.approx((2.0 + 5.0 + 3.25) / 3)
    assert time_interval_ms(m, "mean") == pytest.approx(((1 + 4 + 3) / 3, (30 + 9 + 3.5) / 3))


@pytest.mark.parametrize(
    ("n", "ranks"),
    # The sign test's ranks for 95 %, from a table (Conover 1999, A3); below 6 there are none.
    [(1, (1, 1)), (2, (1, 2)), (5, (1, 5)), (6, (1, 6)), (8, (1, 8)), (9, (2, 8)), (12, (3, 10)), (20, (6, 15))],
)
def test_the_interval_of_a_median_is_that_of_the_sign_test(n, ranks):
    repeats = np.random.default_rng(0).permutation(n) + 1.0
    assert median_interval(tuple(repeats)) == ranks


def test_the_interval_of_a_median_covers_it_in_95_percent():
    rng = np.random.default_rng(0)
    draws = rng.exponential(size=(2000, 25))
    covered = [low <= math.log(2) <= high for low, high in map(median_interval, draws)]
    assert 0.95 - 0.015 < np.mean(covered) < 0.98  # 2000 draws: three standard errors are 0.015


@given(st.lists(st.floats(0.1, 1e6), min_size=1, max_size=30))
def test_the_interval_holds_the_median(repeats):
    low, high = median_interval(repeats)
    assert min(repeats) <= low <= np.median(repeats) <= high <= max(repeats)


@pytest.mark.parametrize(
    "m",
    [
        measurement((1.0,), outcome="timeout"),
        measurement((1.0,), (math.nan,)),
        measurement((1.0,), (), (math.inf,)),
        measurement((), (1.0,)),
        measurement((), ()),
        measurement(),
    ],
)
def test_what_has_no_sound_time_is_not_timed(m):
    assert not is_timed(m)


@pytest.mark.parametrize("objective", ["max", "mean"])
def test_the_first_frame_alone_is_a_time(objective):
    m = measurement((5.0, 7.0, 6.0), (), ())
    assert is_timed(m)
    assert time_ms(m, objective) == 6.0
    assert time_interval_ms(m, objective) == (5.0, 7.0)


def test_frames_without_times_count_in_neither_the_maximum_nor_the_mean():
    m = measurement((2.0, 4.0), (), (8.0, 10.0))
    assert is_timed(m)
    assert time_ms(m, "max") == 9.0
    assert time_interval_ms(m, "max") == (8.0, 10.0)
    assert time_ms(m, "mean") == pytest.approx((3 + 9) / 2)
    assert time_interval_ms(m, "mean") == pytest.approx(((2 + 8) / 2, (4 + 10) / 2))


def test_errors_of_rounding_alone_are_equal_on_the_front():
    fast = measurement((1.0,), error=0.9 * FLOAT32_ERROR)
    slow = measurement((2.0,), error=0.1 * FLOAT32_ERROR)
    assert pareto_front([slow, fast], "max") == (fast,)
    assert pareto_front([slow, measurement((1.0,), error=FLOAT32_ERROR)], "max")[-1].error == FLOAT32_ERROR
    # What is more than rounding is beaten by what is rounding, and what beats it is still told by its own error.
    approximate = measurement((1.0,), error=1.1 * FLOAT32_ERROR)
    assert pareto_front([slow, approximate], "max") == (approximate, slow)
    coarse = measurement((0.5,), error=0.01)
    assert pareto_front([fast, slow, coarse], "max") == (coarse, fast)


@given(st.lists(st.tuples(st.integers(1, 9), st.none() | st.integers(0, 9)), max_size=12))
def test_the_front_is_what_an_obvious_loop_finds(points):
    made = [measurement((float(ms),), error=None if e is None else e / 10) for ms, e in points]
    front = {(time_ms(m, "max"), m.error) for m in pareto_front(made, "max")}
    known = {(float(ms), e / 10) for ms, e in points if e is not None}
    expected = {p for p in known if not any(q != p and q[0] <= p[0] and q[1] <= p[1] for q in known)}
    assert front == expected
    assert len(pareto_front(made, "max")) == len(expected)


@pytest.mark.parametrize("seed", range(5))
def test_the_design_starts_with_the_defaults_and_spreads_over_the_values(seed):
    workload = Synthetic(SHADING_BOUND)
    design = list(initial_design(WHOLE, workload.counts, seed))
    assert design[:3] == [configuration(technique) for technique in WHOLE.techniques]
    assert len(design) == len(set(design))
    assert all(candidate in WHOLE for candidate in design)
    per_technique = Counter(candidate.technique for candidate in design)
    # The default and three more, one of which may turn out to be the default.
    assert set(per_technique) == set(WHOLE.techniques)
    assert 3 <= min(per_technique.values()) <= max(per_technique.values()) == 4
    tried = [c for c in design if c.technique == "volume_tiled_bvh"]
    # Latin: three points in three strata; every batch and both values of branching, and two of four values at least.
    for name, n_least in {"batch": 3, "branching": 2, "tile_px": 2, "depth_slices": 2}.items():
        assert len({c[name] for c in tried}) >= n_least
    assert design == list(initial_design(WHOLE, workload.counts, seed))
    assert design != list(initial_design(WHOLE, workload.counts, seed + 1))


@pytest.mark.parametrize("seed", range(5))
def test_a_larger_design_spreads_over_a_larger_space(seed):
    workload = Synthetic(SHADING_BOUND)
    design = list(initial_design(LARGE, workload.counts, seed, per_technique=5))
    per_technique = Counter(candidate.technique for candidate in design)
    assert 4 <= min(per_technique.values()) <= max(per_technique.values()) <= 6
    spread = [c for c in design[3:] if c.technique == "volume_tiled_bvh"]
    # Latin: five points in five strata; four values of branching, five of tile size and batch.
    assert len({c["tile_px"] for c in spread}) >= 4
    assert len({c["batch"] for c in spread}) >= 4
    assert len({c["depth_slices"] for c in spread}) >= 3
    assert len({c["branching"] for c in spread}) >= 3
    assert design == list(initial_design(LARGE, workload.counts, seed, per_technique=5))


def test_the_design_of_a_small_space_is_all_of_it():
    space = Space(("forward", "tiled_deferred"), {"tiled_deferred": {"tile_px": (8, 32)}})
    forward, tiled = configuration("forward"), configuration("tiled_deferred")
    assert list(initial_design(space, Synthetic(SHADING_BOUND).counts)) == [forward, tiled, tiled.replaced(tile_px=8)]


def test_a_design_counts_what_it_is_asked_for():
    workload = Synthetic(SHADING_BOUND)
    design = initial_design(WHOLE, workload.counts)
    defaults = [next(design) for _ in WHOLE.techniques]
    assert not workload.counted
    first = next(design)
    assert first not in defaults and workload.counted >= {*defaults, first}
    n_counted = len(workload.counted)
    assert list(design) and len(workload.counted) > n_counted


def test_a_default_outside_the_space_is_in_the_design():
    space = Space(("tiled_deferred",), {"tiled_deferred": {"tile_px": (64, 128)}})
    assert next(initial_design(space, Synthetic(SHADING_BOUND).counts)) == configuration("tiled_deferred")


def test_what_does_the_same_work_is_known_by_its_counts():
    steps = ({"samples": 5, "shading_steps": 1},)
    one = configuration("tiled_deferred", {"batch": 0})
    other = configuration("tiled_deferred", {"batch": 65536})
    assert work_done(one, steps) == work_done(other, steps)
    assert work_done(one, steps) != work_done(other, ({"samples": 5, "shading_steps": 2},))
    # Where loops are not counted, the counts do not show what a batch does.
    assert work_done(one, ({"samples": 5},)) != work_done(other, ({"samples": 5},))
    assert work_done(one, steps) != work_done(one.replaced(gbuffer="float16"), steps)
    assert work_done(one, steps) != work_done(configuration("forward"), steps)


def measured_at(workload, candidates):
    return {candidate: workload.measure(candidate, None) for candidate in candidates}


def models_of(measured):
    techniques = {m.technique for m in measured.values()}
    models = {t: fit_stage([m for m in measured.values() if m.technique == t], t, "frame") for t in techniques}
    return {t: model for t, model in models.items() if model is not None}


def test_the_predicted_fastest_is_chosen_and_nothing_twice():
    workload = Synthetic(SHADING_BOUND, noise=0.0)
    candidates = SMALL.configurations()
    slowest_first = sorted(candidates, key=lambda c: -max(workload.true_ms(c)))
    measured = measured_at(workload, [c for c in slowest_first if c.technique == "volume_tiled_bvh"][:6])
    choice = choose_next(SMALL, measured, workload.counts, models_of(measured), "max")
    assert choice.stop_reason is None
    assert choice.configurations[0] == slowest_first[-1]
    assert not set(choice.configurations) & set(measured)
    best_ms = min(time_ms(m, "max") for m in measured.values())
    assert choice.predicted_gain == pytest.approx(1 - max(workload.true_ms(slowest_first[-1])) / best_ms, rel=0.05)


@pytest.mark.parametrize("predicted_ms", [70.0, 95.0, 100.0, 112.0])
def test_the_gain_is_the_mean_of_what_would_be_saved(predicted_ms):
    space = Space(("forward",), {"forward": {"batch": (0, 4096)}})
    measured = {configuration("forward"): measurement((100.0,))}
    model = CostModel("forward", "frame", (), predicted_ms, (), 0.15, 0.15, (), n=9, n_configurations=3)
    choice = choose_next(space, measured, lambda _: ({},), {"forward": model}, "max")
    # Of a normal distribution, the mean size of the error is sqrt(2 / pi) of its standard deviation.
    sigma_ms = 0.15 / math.sqrt(2 / math.pi) * predicted_ms

    def saved_ms(ms: float) -> float:
        return (100 - ms) * float(stats.norm.pdf(ms, predicted_ms, sigma_ms))

    saved, _ = integrate.quad(saved_ms, -200, 100, points=[predicted_ms - 50])
    assert choice.predicted_gain == pytest.approx(saved / 100, rel=1e-4)


def test_the_second_choice_is_a_neighbour_of_the_fastest():
    workload = Synthetic(SHADING_BOUND, noise=0.02, hidden=erratic)
    measured = measured_at(workload, [c for c in initial_design(WHOLE, workload.counts) if c.technique != "forward"])
    fastest = min(measured, key=lambda c: time_ms(measured[c], "max"))
    choice = choose_next(WHOLE, measured, workload.counts, models_of(measured), "max")
    assert len(choice.configurations) == 2
    differing = [n for n in fastest.params if choice.configurations[1][n] != fastest[n]]
    assert len(differing) == 1


def test_what_does_the_same_work_as_a_measured_one_is_not_chosen():
    workload = Synthetic(SHADING_BOUND)
    space = Space(("tiled_deferred",), {"tiled_deferred": {"tile_px": (8, 16, 32), "batch": (0, 2**23, 2**24)}})
    measured = measured_at(workload, [c for c in space.configurations() if c["batch"] == 0])
    choice = choose_next(space, measured, workload.counts, models_of(measured), "max")
    assert choice.configurations == ()
    assert choice.stop_reason == "every configuration that can be predicted was measured"


def test_it_stops_within_the_noise_of_the_fastest():
    quiet, loud = Synthetic(SHADING_BOUND, noise=0.001), Synthetic(SHADING_BOUND, noise=0.4)
    candidates = SMALL.configurations()
    by_time = sorted(candidates, key=lambda c: max(quiet.true_ms(c)))
    measured = measured_at(quiet, by_time[:8])  # the fastest are known
    choice = choose_next(SMALL, measured, quiet.counts, models_of(measured), "max")
    assert choice.configurations == ()
    assert choice.stop_reason is not None
    assert "within the noise of 1.0%" in choice.stop_reason
    # A loud machine: the interval of the fastest is wider than any gain that is predicted.
    measured = measured_at(loud, by_time[:12])
    choice = choose_next(SMALL, measured, loud.counts, models_of(measured_at(quiet, by_time[:12])), "max")
    assert choice.configurations == ()


def test_without_any_time_or_any_error_estimate_there_is_no_choice():
    workload = Synthetic(SHADING_BOUND, fails=lambda _: True)
    measured = measured_at(workload, SMALL.configurations()[:3])
    assert choose_next(SMALL, measured, workload.counts, {}, "max").stop_reason == "no configuration could be timed"
    sound = Synthetic(SHADING_BOUND)
    measured = measured_at(sound, SMALL.configurations()[:1])
    choice = choose_next(SMALL, measured, sound.counts, models_of(measured), "max")
    assert choice.configurations == ()
