"""The fit against another library's solver: both must find the same optimum."""

import jax
import jax.numpy as jnp
import jaxopt
import numpy as np
import pytest

from tuning.fit import fit_costs, relative_design


@pytest.mark.parametrize("seed", range(4))
def test_the_optimum_is_that_of_a_box_constrained_quadratic_solver(seed):
    rng = np.random.default_rng(seed)
    ops = 10 ** rng.uniform(0, 3, (24, 3))
    ops[:, 2] = ops[:, 0] * rng.uniform(0.9, 1.1, 24)  # nearly collinear: one of the two is likely to end at its bound
    times_ms = (0.5 + ops @ np.array([2e-2, 5e-3, 0.0])) * rng.normal(1, 0.05, 24)
    design = relative_design(ops, times_ms)
    scale = np.linalg.norm(design, axis=0)
    with jax.enable_x64(True):
        scaled = jnp.asarray(design / scale)
        solver = jaxopt.BoxCDQP(maxiter=20_000, tol=1e-12)
        bounds = (jnp.zeros(4), jnp.full(4, np.inf))
        found = solver.run(jnp.ones(4), (scaled.T @ scaled, -scaled.sum(0)), bounds).params
        theirs = np.asarray(found) / scale
    ours = fit_costs(design)
    assert (ours >= 0).all()

    def loss(costs):
        return np.sum((design @ costs - 1) ** 2)

    # The solvers stop at their own tolerances: 1e-12 in a gradient of order 1 is far below 1e-9 of the loss.
    assert loss(ours) <= loss(theirs) * (1 + 1e-9)
    assert np.abs(design @ ours - design @ theirs).max() < 1e-5
