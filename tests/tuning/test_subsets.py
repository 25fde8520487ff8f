"""Sets of terms against an obvious search with SciPy, and the left-out residuals against refits."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

from tuning.select import select_subset
from tuning.subsets import Problem, score_subsets


def problem(seed, n_terms=7, n_rows=24, noise=0.03, true=(2, 5)):
    rng = np.random.default_rng(seed)
    columns = np.exp(rng.uniform(0, 7, (n_rows, n_terms + 1)))
    columns[:, 0] = 1.0
    times_ms = 5.0 + columns[:, list(true)] @ np.full(len(true), 0.05)
    times_ms = times_ms * np.exp(noise * rng.normal(size=n_rows))
    sizes = np.ones(n_terms + 1, int)
    sizes[0] = 0
    return Problem(columns, times_ms, np.ones(n_rows), sizes, np.zeros(n_terms + 1))


@pytest.mark.parametrize("seed", range(4))
def test_the_best_pair_is_that_of_an_exhaustive_search(seed):
    given = problem(seed)
    best = min(
        itertools.combinations(range(1, 8), 2),
        key=lambda pair: scipy.optimize.nnls(
            given.columns[:, [0, *pair]] / given.times_ms[:, None], np.ones(len(given.times_ms))
        )[1],
    )
    found = next(one for one in score_subsets(given, 3) if one.size == 2)
    assert found.support[-2:] == best == (2, 5)
    # 24 rows of 3 % noise; a cost is half of the time in most rows.
    assert_allclose(found.costs[-2:], 0.05, rtol=0.08)


def test_left_out_residuals_are_those_of_refits_without_the_row():
    given = problem(0, true=(2,))
    found = next(one for one in score_subsets(given, 1) if one.support == (0, 2))

    def loss(logs, keep):
        predicted = np.exp(logs[0]) + np.exp(logs[1]) * given.columns[keep, 2]
        return np.sum(np.log(given.times_ms[keep] / predicted) ** 2)

    for row in (0, 11, 23):
        keep = np.arange(24) != row
        logs = scipy.optimize.minimize(loss, np.log(found.costs), (keep,), method="Nelder-Mead").x
        predicted = np.exp(logs[0]) + np.exp(logs[1]) * given.columns[row, 2]
        # The formula keeps the robust weights and the slopes of the fit to all rows.
        assert found.left_out[row] == pytest.approx(np.log(given.times_ms[row] / predicted), abs=0.01)


def test_a_size_is_judged_with_the_selection_inside():
    # 30 columns of noise: the best of 435 pairs looks better than a constant; it is not.
    constants = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        columns = np.exp(rng.uniform(0, 7, (20, 31)))
        columns[:, 0] = 1.0
        sizes = np.ones(31, int)
        sizes[0] = 0
        given = Problem(columns, np.exp(0.1 * rng.normal(size=20)), np.ones(20), sizes, np.zeros(31))
        selection = select_subset(given, 2)
        constants += selection.chosen.support == (0,)
        assert selection.path[-1].error < selection.path[0].error  # what a selection outside the folds would have said
    # A useless term has to beat a constant by a standard error: one in six by chance, at most.
    assert constants >= 5


def test_of_terms_that_fit_alike_the_plainer_is_taken():
    given = problem(1, true=(2,))
    columns = given.columns.copy()
    columns[:, 1] = columns[:, 2] * np.exp(0.001 * np.random.default_rng(0).normal(size=24))
    for plain, other in ((1, 2), (2, 1)):
        surprise = np.zeros(8)
        surprise[other] = 1.0
        alike = Problem(columns, given.times_ms, given.weights, given.sizes, surprise)
        assert select_subset(alike, 2).chosen.support == (0, plain)


def test_an_outlier_does_not_move_the_costs():
    given = problem(3)
    times_ms = given.times_ms.copy()
    times_ms[4] *= 3
    found = select_subset(Problem(given.columns, times_ms, given.weights, given.sizes, given.surprise), 3).chosen
    assert {2, 5} <= set(found.support)
    costs = dict(zip(found.support, found.costs, strict=True))
    assert_allclose([costs[2], costs[5]], 0.05, rtol=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_rows_of_a_group_leave_together(seed):
    given = problem(seed)
    group = np.random.default_rng(seed).permutation(np.arange(24) // 3)
    grouped = replace(given, group=group)
    for n in (2, 3, 8):
        fold = grouped.folds(n)
        assert set(fold) == set(range(n))
        assert all(len(set(fold[group == k])) == 1 for k in range(8))
    held = group == 2
    assert grouped.rows(~held).n_groups == 7
    assert_allclose(grouped.group_means(given.times_ms)[2], given.times_ms[held].mean())


def test_copies_of_rows_do_not_make_a_constant_look_better_than_it_is():
    # Four groups of six equal rows each: left out one by one, each row is known from its copies.
    columns = np.column_stack([np.ones(24), np.repeat([1.0, 5.0, 2.0, 3.0], 6)])
    times_ms = np.repeat([1.0, 8.0, 3.0, 1.0], 6)
    given = Problem(columns, times_ms, np.ones(24), np.array([0, 1]), np.zeros(2), np.repeat(np.arange(4), 6))
    once = Problem(columns[::6], times_ms[::6], np.ones(4), given.sizes, given.surprise)
    found, alone = select_subset(given, 1), select_subset(once, 1)
    # The median size of residuals, which sets the width of the robust loss, is that of the same numbers.
    assert_allclose(found.errors, alone.errors, rtol=1e-6)
    assert_allclose(found.standard_errors, alone.standard_errors, rtol=1e-6)


def test_one_group_says_nothing_about_the_error():
    found = select_subset(replace(problem(0), group=np.zeros(24, int)), 3)
    assert found.chosen.support == (0,)
    assert found.errors == (np.inf,)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_a_constant_that_is_nothing_but_rounding_hides_no_law(power):
    # Its cost comes out as a little more than 0, a little less, or 0, by the order in which a machine adds.
    for seed in range(8):
        column = np.exp(np.random.default_rng(seed).uniform(0, 9, 7)) if seed else 2.0 ** np.arange(7)
        times_ms = column**power
        columns = np.column_stack([np.ones(7), times_ms])
        found = select_subset(Problem(columns, times_ms, np.ones(7), np.array([0, 1]), np.zeros(2)), 1)
        assert found.chosen.size == 1
        assert_allclose(found.chosen.costs[-1], 1.0, rtol=1e-9)
