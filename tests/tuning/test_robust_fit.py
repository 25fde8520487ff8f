"""The optimiser against SciPy's, the influence against moving a measurement, the bounded solver against SciPy's."""

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tuning.bootstrap import bootstrap_costs
from tuning.bounded import nonnegative_costs
from tuning.law import SHARPNESS, Law
from tuning.robust_fit import Problems, influence, solve
from tuning.terms import CONSTANT, Factor, Term

ROWS = 25


def problem(seed, n_costs=3, sides=None, noise=0.03, starts=4):
    rng = np.random.default_rng(seed)
    columns = np.exp(rng.uniform(-3, 3, (ROWS, n_costs)))
    costs = np.exp(rng.normal(0, 0.5, n_costs))
    sides = np.zeros(n_costs, int) if sides is None else np.array(sides)
    parts = columns * costs
    first, second = parts[:, sides == 0].sum(axis=1), parts[:, sides == 1].sum(axis=1)
    log_times = np.log(np.maximum(first, second)) + noise * rng.normal(size=ROWS)
    lanes = (starts, ROWS)
    return Problems(
        np.broadcast_to(columns, (starts, ROWS, n_costs)),
        np.broadcast_to(sides, (starts, n_costs)),
        np.broadcast_to(log_times, lanes),
        np.ones(lanes),
        np.log(costs) + rng.normal(0, 1, (starts, n_costs)),
        1.5 * noise,
    )


def loss(log_costs, given_: Problems):
    """The slow, obvious pseudo-Huber loss of relative residuals."""
    total = 0.0
    for row in range(ROWS):
        sums = [0.0, 0.0]
        for k, side in enumerate(given_.sides[0]):
            sums[side] += given_.designs[0, row, k] * np.exp(log_costs[k])
        predicted = (sums[0] ** SHARPNESS + sums[1] ** SHARPNESS) ** (1 / SHARPNESS)
        residual = predicted / np.exp(given_.log_times[0, row]) - 1
        total += given_.weights[0, row] * given_.delta**2 * (np.sqrt(1 + (residual / given_.delta) ** 2) - 1)
    return total


@pytest.mark.parametrize("sides", [None, (0, 0, 1)])
@pytest.mark.parametrize("seed", range(3))
def test_scipy_finds_no_better_optimum(seed, sides):
    given_ = problem(seed, sides=sides)
    log_costs, losses = solve(given_)
    best = int(losses.argmin())
    assert losses[best] == pytest.approx(loss(log_costs[best], given_), rel=1e-9)
    found = scipy.optimize.minimize(loss, log_costs[best], (given_,), method="BFGS", options={"gtol": 1e-10})
    # Both stop where the loss, of order 0.01, no longer moves in its last digits.
    assert losses[best] <= found.fun * (1 + 1e-6) + 1e-9
    elsewhere = min(
        scipy.optimize.minimize(loss, start, (given_,), method="Nelder-Mead", options={"maxiter": 2000}).fun
        for start in given_.starts
    )
    assert losses[best] <= elsewhere * (1 + 1e-4)


def test_a_row_without_weight_changes_nothing():
    given_ = problem(0)
    spoiled = given_.log_times.copy()
    spoiled[:, 5] += 7.0
    weights = given_.weights.copy()
    weights[:, 5] = 0.0
    one = solve(Problems(given_.designs, given_.sides, given_.log_times, weights, given_.starts, given_.delta))
    other = solve(Problems(given_.designs, given_.sides, spoiled, weights, given_.starts, given_.delta))
    assert_allclose(one[0], other[0])


def test_influence_is_what_moving_a_measurement_does():
    given_ = problem(1)
    log_costs, losses = solve(given_)
    start = np.broadcast_to(log_costs[losses.argmin()], given_.starts.shape)
    at = Problems(given_.designs, given_.sides, given_.log_times, given_.weights, start, given_.delta)
    slopes = influence(at)
    for row in (0, 7, 24):
        moved = given_.log_times.copy()
        moved[:, row] += 1e-3
        there, _ = solve(Problems(at.designs, at.sides, moved, at.weights, at.starts, at.delta))
        # A difference of first order over 1e-3: the curvature leaves a hundredth of the largest slope.
        assert_allclose((there[0] - start[0]) / 1e-3, slopes[:, row], atol=0.01 * np.abs(slopes).max() + 1e-3)


@settings(deadline=None)  # the first one compiles
@given(seed=st.integers(0, 2**32 - 1))
def test_bounded_costs_are_scipys(seed):
    rng = np.random.default_rng(seed)
    designs = np.exp(rng.normal(size=(8, 12, 1)) + 0.3 * rng.normal(size=(8, 12, 4)) + rng.uniform(-9, 9, 4))
    targets = np.exp(rng.normal(size=(8, 12)))
    costs = nonnegative_costs(designs, targets)
    assert (costs >= 0).all()
    for design, target, ours in zip(designs, targets, costs, strict=True):
        scale = np.linalg.norm(design, axis=0)
        theirs, residual = scipy.optimize.nnls(design / scale, target)
        # Columns that grow together leave costs open, not the residual.
        assert np.linalg.norm(design @ ours - target) <= residual * (1 + 1e-4) + 1e-9, theirs


def test_bootstrap_scatters_as_much_as_repeating_the_experiment():
    rng = np.random.default_rng(0)
    x = np.exp(rng.uniform(0, 7, 40))
    law = Law((CONSTANT, Term((Factor("x"),))), (1.0, 0.01), (0, 0))
    columns, noise = {"x": x}, 0.05
    times_ms = law.predict(columns)

    def experiment(n):
        return times_ms * np.exp(noise * rng.normal(size=(n, 40)))

    measured = experiment(1)[0]
    costs = bootstrap_costs(law, columns, [(t,) for t in measured], np.ones(40), 1.5 * noise, refits=256)
    design = np.column_stack([np.ones(40), x])
    again = np.array([scipy.optimize.nnls(design / t[:, None], np.ones(40))[0] for t in experiment(400)])
    # One experiment knows its noise to 1 / sqrt(2 * 38), 11 %; the scatter of 256 refits to 4 %.
    assert_allclose(np.log(costs).std(axis=0), np.log(again).std(axis=0), rtol=0.35)
