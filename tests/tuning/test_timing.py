"""Repeats, against a clock that the runs themselves move on."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import tuning.timing
from tuning.choose import median_interval
from tuning.timing import KEPT_REPEATS, MIN_REPEATS, MIN_S, PRECISION, interleaved_ms, repeats_ms, timed_ms


class FakeClock:
    """`runs[i]()` takes the next of its times, over and over."""

    def __init__(self, monkeypatch, *times_ms):
        self.now_s = 0.0
        self.order: list[int] = []
        self.runs = [self._run(i, times) for i, times in enumerate(times_ms)]
        monkeypatch.setattr(tuning.timing, "time", SimpleNamespace(perf_counter=lambda: self.now_s))

    def _run(self, i, times_ms):
        def run():
            self.now_s += times_ms[self.order.count(i) % len(times_ms)] / 1e3
            self.order.append(i)

        return run


def never(_):
    return False


def test_one_run_is_timed_from_its_start_to_its_end(monkeypatch):
    assert timed_ms(FakeClock(monkeypatch, [12.5]).runs[0]) == pytest.approx(12.5)


def test_times_that_agree_need_six_repeats(monkeypatch):
    """Below six no interval is one of 95 %."""
    assert repeats_ms(FakeClock(monkeypatch, [100.0]).runs[0], never) == pytest.approx((100.0,) * 6)


def test_three_repeats_even_where_one_is_over_the_cap(monkeypatch):
    assert repeats_ms(FakeClock(monkeypatch, [30e3]).runs[0], never) == pytest.approx((30e3,) * MIN_REPEATS)


def test_three_repeats_even_where_all_is_decided(monkeypatch):
    seen = []

    def decided(interval):
        seen.append(interval)
        return True

    assert len(repeats_ms(FakeClock(monkeypatch, [300.0, 100.0, 200.0]).runs[0], decided)) == MIN_REPEATS
    assert np.allclose(seen, [(100.0, 300.0)])  # asked once, with what the three runs say


def test_what_is_hopeless_is_not_repeated(monkeypatch):
    assert len(repeats_ms(FakeClock(monkeypatch, [161.0]).runs[0], never, hopeless_ms=160.0)) == 1
    assert len(repeats_ms(FakeClock(monkeypatch, [159.0]).runs[0], never, hopeless_ms=160.0)) == 6
    # One run that something else on the machine held up is none of its own: the second was fast.
    assert len(repeats_ms(FakeClock(monkeypatch, [61.0, 20.0]).runs[0], never, hopeless_ms=60.0)) >= MIN_REPEATS
    short = repeats_ms(FakeClock(monkeypatch, [10.0]).runs[0], never, hopeless_ms=1.0)
    assert sum(short[:-1]) < 1e3 * MIN_S + 1e-6 < sum(short) + 10.0  # as long as any other: a GPU's first ones are slow


def test_times_that_disagree_are_repeated_up_to_the_cap(monkeypatch):
    times = repeats_ms(FakeClock(monkeypatch, [10.0, 20.0]).runs[0], never, cap_s=1.0)
    assert sum(times) >= 1000 > sum(times[:-1])


few_ms = st.lists(st.floats(1.0, 500.0), min_size=1, max_size=30)


@given(times_ms=few_ms, cap_s=st.floats(0.0, 0.5))
@example(times_ms=[1.0, 1.0, 1.0, 1.0, 1.0, 500.0], cap_s=0.5)
@settings(deadline=None)
def test_repeats_stop_where_they_are_precise_or_cost_too_much_and_no_earlier(times_ms, cap_s):
    with pytest.MonkeyPatch.context() as monkeypatch:
        times = repeats_ms(FakeClock(monkeypatch, times_ms).runs[0], never, cap_s)

    def done(n):
        low, high = median_interval(times[:n])
        precise = n >= 6 and high - low <= PRECISION * (low + high)
        spent_s = sum(times[:n]) / 1e3
        return spent_s >= min(MIN_S, cap_s) and (precise or spent_s >= cap_s)

    assert len(times) >= MIN_REPEATS and done(len(times))
    assert not any(done(n) for n in range(MIN_REPEATS, len(times)))


def test_of_a_short_run_the_last_thousand_times_are_kept(monkeypatch):
    times = np.arange(1, 5001) * 1e-4 / 3
    kept = repeats_ms(FakeClock(monkeypatch, times).runs[0], never, cap_s=0.05)
    assert len(kept) == KEPT_REPEATS
    steps = np.diff(kept)
    assert (steps > 0).sum() >= KEPT_REPEATS - 2  # in order, none left out
    assert kept[-1] >= kept[0]


def test_runs_in_turns_meet_the_same_drift(monkeypatch):
    clock = FakeClock(monkeypatch, [1.0, 2.0], [10.0, 20.0])
    first, second = interleaved_ms(clock.runs, rounds=5, cap_s=60.0)
    assert clock.order == [0, 1] * 5
    assert first == pytest.approx((1, 2, 1, 2, 1)) and second == pytest.approx((10, 20, 10, 20, 10))


def test_turns_end_with_the_cap_but_not_before_the_third(monkeypatch):
    clock = FakeClock(monkeypatch, [5e3], [1e3])
    assert [len(times) for times in interleaved_ms(clock.runs, rounds=15, cap_s=4.0)] == [3, 3]
    clock = FakeClock(monkeypatch, [500.0], [500.0])
    assert [len(times) for times in interleaved_ms(clock.runs, rounds=15, cap_s=4.0)] == [5, 5]


def test_one_run_or_none_takes_turns_with_nobody(monkeypatch):
    assert interleaved_ms(FakeClock(monkeypatch, [7.0]).runs, rounds=4, cap_s=1.0) == [pytest.approx((7.0,) * 4)]
    assert interleaved_ms([], rounds=4, cap_s=1.0) == []
