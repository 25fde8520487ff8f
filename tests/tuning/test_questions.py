import numpy as np
import pytest

from tuning.law import Law
from tuning.questions import BUDGETS_MS, best_configuration, crossover, largest_within, sensitivities
from tuning.terms import CONSTANT, Factor, Term
from tuning.time_model import PlausibleLaw, TimeModel
from vtfs.input_error import InputError

X, Y = Term((Factor("x"),)), Term((Factor("y"),))
PER_Y = Term((Factor("y", -1.0),))


def model(terms, costs, sides=None, error=0.02, n_rows=30, hull=None) -> TimeModel:
    law = Law(tuple(terms), tuple(costs), tuple(sides or (0,) * len(terms)))
    hull = hull or {name: np.array([1.0, 1e4]) for name in law.columns}
    covariance = np.eye(len(costs)) * error**2
    return TimeModel((PlausibleLaw(law, 1.0, covariance, error),), n_rows, error, 1.0, hull, {}, (), ())


FAST_START = model((CONSTANT, X), (1.0, 0.010))
SLOW_START = model((CONSTANT, X), (5.0, 0.002))


def test_where_two_lines_cross():
    found = crossover([FAST_START], [SLOW_START], "x", 1, 1e4, {})
    assert found.value == pytest.approx(500, rel=1e-3)  # 1 + 0.010 x = 5 + 0.002 x; 512 points over four decades
    # The gap moves by 2 % of about 6 ms a side, over a slope of 0.008: some 20 either way, 1.64 times.
    assert 440 < found.low < 480 < 520 < found.high < 560
    assert found.probability == 1
    assert not found.extrapolated


def test_lines_that_do_not_cross_say_so():
    found = crossover([FAST_START], [model((CONSTANT, X), (2.0, 0.02))], "x", 1, 1e4, {})
    assert np.isnan(found.value)
    assert found.probability == 0


def test_sums_of_parts_cross_where_their_sums_do():
    parts = [model((CONSTANT,), (0.5,)), model((CONSTANT, X), (0.5, 0.010))]
    assert crossover(parts, [SLOW_START], "x", 1, 1e4, {}).value == pytest.approx(500, rel=1e-3)


def test_the_largest_size_within_a_budget():
    found = largest_within([FAST_START], BUDGETS_MS[0], "x", 1, 1e6, {})
    assert found.value == pytest.approx((1000 / 60 - 1) / 0.010, rel=1e-3)
    assert found.low < found.value < found.high
    assert largest_within([FAST_START], 1e3, "x", 1, 1e6, {}).extrapolated
    assert largest_within([FAST_START], 100, "x", 1, 50, {}).value == pytest.approx(50)
    none = largest_within([FAST_START], 0.5, "x", 1, 1e6, {})
    assert np.isnan(none.value)
    with pytest.raises(InputError, match="budget"):
        largest_within([FAST_START], 0.0, "x", 1, 10, {})
    with pytest.raises(InputError, match="range of `x`"):
        largest_within([FAST_START], 1.0, "x", 10, 10, {})


@pytest.mark.parametrize("sides", [(0, 0, 0), (0, 0, 1)])
def test_sensitivities_are_slopes_of_the_log(sides):
    one = model((CONSTANT, X, Y), (1.0, 0.01, 0.3), sides)
    point = {"x": 300.0, "y": 11.0}
    found = sensitivities([one], point)
    for name in point:
        up, down = ({**point, name: point[name] * f} for f in (1.001, 1 / 1.001))
        ends = [one.times_ms({n: np.array([v]) for n, v in p.items()})[0] for p in (up, down)]
        # A central difference of second order over 1e-3.
        assert found[name] == pytest.approx(np.log(ends[0] / ends[1]) / (2 * np.log(1.001)), abs=1e-4)
    with pytest.raises(InputError, match="`y`"):
        sensitivities([one], {"x": 1.0})


def test_the_best_row_and_what_it_costs_to_be_wrong():
    u_shaped = model((CONSTANT, PER_Y, Y), (0.4, 30.0, 0.02), error=0.2)
    candidates = {"y": np.array([8.0, 16, 32, 64, 128])}
    found = best_configuration([u_shaped], candidates)
    assert found.row == 2
    assert found.time_ms == pytest.approx(0.4 + 30 / 32 + 0.64)
    assert 0 < found.expected_regret < found.worst_regret < 0.3
    sure = best_configuration([model((CONSTANT, PER_Y, Y), (0.4, 30.0, 0.02), error=0.001)], candidates)
    assert sure.worst_regret == 0
    with pytest.raises(InputError, match="candidates"):
        best_configuration([u_shaped], {"y": np.empty(0)})
