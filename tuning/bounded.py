"""Least squares with costs that cannot be negative, many at once: what optimistix has no solver for.

jaxopt has one. It is no longer maintained and says so on import; nothing else here depends on it.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable

import numpy as np

_STEPS = 2_000
_TOLERANCE = 1e-10


def nonnegative_costs(designs: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Minimises `sum((design @ costs - target) ** 2)` over `costs >= 0`, for every lane at once.

    **Arguments:**

    - `designs`: float64 `[lanes, rows, costs]`.
    - `targets`: `[lanes, rows]`.

    **Returns:** `[lanes, costs]`.
    """
    import jax

    # The solver takes as many steps as the worst scaled column needs.
    scale = np.sqrt(np.einsum("lrc,lrc->lc", designs, designs))
    scale[scale == 0] = 1.0
    scaled = designs / scale[:, None, :]
    quadratic = np.einsum("lrc,lrd->lcd", scaled, scaled)
    linear = -np.einsum("lrc,lr->lc", scaled, targets)
    with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
        costs = np.asarray(_solver()(quadratic, linear))
    return costs / scale


@functools.cache
def _solver() -> Callable:
    import jax
    import jax.numpy as jnp

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        import jaxopt

    solver = jaxopt.BoxCDQP(maxiter=_STEPS, tol=_TOLERANCE)

    def one(quadratic, linear):
        bounds = (jnp.zeros_like(linear), jnp.full_like(linear, jnp.inf))
        return solver.run(jnp.ones_like(linear), params_obj=(quadratic, linear), params_ineq=bounds).params

    return jax.jit(jax.vmap(one))
