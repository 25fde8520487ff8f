"""A budget is read, and kept by a search."""

import pytest

from tests.tuning.synthetic_workload import LAUNCH_BOUND, SMALL, WHOLE, Synthetic, erratic
from tuning.budget import Budget
from tuning.record import read_measurements
from tuning.sweep import search
from vtfs.input_error import InputError


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("40", Budget(measurements=40)),
        (" 1 ", Budget(measurements=1)),
        ("120s", Budget(seconds=120.0)),
        ("0.5 s", Budget(seconds=0.5)),
    ],
)
def test_a_budget_is_a_count_or_seconds(text, budget):
    assert Budget.parse(text) == budget


@pytest.mark.parametrize("text", ["", "0", "-3", "2.5", "s", "0s", "-1s", "nans", "infs", "2m", "ten", "9" * 5000])
def test_a_bad_budget_is_refused(text):
    with pytest.raises(InputError, match=r"budget .*: must be a number of measurements, as `40`, or of seconds"):
        Budget.parse(text)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
def test_a_count_is_never_exceeded_and_some_of_it_goes_to_accuracy(tmp_path, n):
    workload = Synthetic(LAUNCH_BOUND, hidden=erratic)
    result = search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(measurements=n))
    assert len(workload.measured) == n
    approximate = [c for c in workload.measured if not c.is_exact]
    assert len(approximate) >= n // 5
    assert len(result.pareto) >= 1 + (n >= 12)
    if n == 12:
        assert result.stop_reason == "the budget of 12 measurements was used"


def test_seconds_are_those_spent_measuring_and_the_last_measurement_is_completed(tmp_path):
    now = 0.0

    class Slow(Synthetic):
        def measure(self, configuration, best_ms, /):
            nonlocal now
            now += 10.5  # with half a second of compiling
            return super().measure(configuration, best_ms)

    workload = Slow(LAUNCH_BOUND)
    search(WHOLE, workload, tmp_path / "measurements.jsonl", Budget(seconds=95), clock=lambda: now)
    assert len(workload.measured) == 10  # the tenth starts at 90 s


def test_seconds_of_an_earlier_run_are_those_of_its_repeats(tmp_path):
    path = tmp_path / "measurements.jsonl"
    search(SMALL, Synthetic(LAUNCH_BOUND), path, Budget(measurements=4))
    spent_s = sum(sum(map(sum, m.stages_ms["frame"])) / 1e3 for m in read_measurements(path))
    again = Synthetic(LAUNCH_BOUND)
    search(SMALL, again, path, Budget(seconds=spent_s * 0.99), clock=lambda: 0.0)
    assert again.measured == []
    search(SMALL, again, path, Budget(seconds=spent_s * 1.3), clock=lambda: 0.0)
    assert again.measured  # the clock stands still: only the earlier run's seconds count
