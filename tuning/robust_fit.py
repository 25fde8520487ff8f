"""Costs of many laws at once: robust least squares on log times by Levenberg-Marquardt.

Everything is padded to few shapes, so that a whole session compiles a handful of programs; it runs on the CPU, as these
are many tiny problems.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tuning.law import SHARPNESS

MOST_COSTS = 6
_MAX_STEPS = 32  # a cost that goes to zero would go on for ever, in its log; nothing else needs as many
_LEAST_LOG = -60.0
_LANES = 128
_ROWS = (32, 256)  # then every power of four


@dataclass(frozen=True)
class Problems:
    """Lanes of the same table; each is a law with its own terms, weights and times.

    - `designs`: float64 `[lanes, rows, costs]`, not negative.
    - `sides`: int `[lanes, costs]`: 0 or 1, the side of the smooth maximum; -1 where there is no term.
    - `log_times`: `[lanes, rows]`.
    - `weights`: `[lanes, rows]`, of squared residuals; 0 leaves a row out.
    - `starts`: `[lanes, costs]`, logs of the costs to begin with.
    - `delta`: residual from which on a row counts by its size and no longer by its square (pseudo-Huber).
    """

    designs: np.ndarray
    sides: np.ndarray
    log_times: np.ndarray
    weights: np.ndarray
    starts: np.ndarray
    delta: float


def solve(problems: Problems) -> tuple[np.ndarray, np.ndarray]:
    """Logs of the costs `[lanes, costs]` and the loss `[lanes]` (infinite where no minimum was found)."""
    lanes, rows, costs = problems.designs.shape
    spare_rows, spare_costs = (0, _padded_rows(rows) - rows), (0, MOST_COSTS - costs)
    log_costs, losses = np.empty((lanes, costs)), np.empty(lanes)
    for first in range(0, lanes, _LANES):
        # Spare lanes repeat the last: they end when it does.
        lane = np.minimum(np.arange(first, first + _LANES), lanes - 1)
        found, loss = _on_cpu(_solver())(
            np.pad(problems.designs[lane], ((0, 0), spare_rows, spare_costs)),
            np.pad(problems.sides[lane], ((0, 0), spare_costs), constant_values=-1),
            np.pad(problems.log_times[lane], ((0, 0), spare_rows)),
            np.pad(problems.weights[lane], ((0, 0), spare_rows)),
            np.pad(problems.starts[lane], ((0, 0), spare_costs)),
            np.float64(problems.delta),
        )
        last = min(first + _LANES, lanes)
        log_costs[first:last], losses[first:last] = found[: last - first, :costs], loss[: last - first]
    return log_costs, losses


def influence(problems: Problems) -> np.ndarray:
    """d log(cost) / d log(measured time), `[costs, rows]`, of the first lane, by implicit differentiation.

    `starts` must be the optimum. It moves such that the gradient of the loss stays zero (implicit function theorem).
    """
    _, rows, costs = problems.designs.shape
    spare_rows, spare_costs = (0, _padded_rows(rows) - rows), (0, MOST_COSTS - costs)
    (slopes,) = _on_cpu(_influence())(
        np.pad(problems.starts[0], spare_costs),
        np.pad(problems.log_times[0], spare_rows),
        np.pad(problems.designs[0], (spare_rows, spare_costs)),
        np.pad(problems.sides[0], spare_costs, constant_values=-1),
        np.pad(problems.weights[0], spare_rows),
        np.float64(problems.delta),
    )
    return slopes[:costs, :rows]


def _padded_rows(rows: int) -> int:
    return next((n for n in _ROWS if n >= rows), 4 ** math.ceil(math.log(rows, 4)))


def _on_cpu(program: Callable) -> Callable:
    import jax

    def run(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        with jax.enable_x64(True), jax.default_device(jax.devices("cpu")[0]):
            return tuple(np.asarray(result) for result in program(*arrays))

    return run


def _residuals(log_costs, args):
    """Weighted, such that their sum of squares is twice the pseudo-Huber loss; then those that hold unused costs."""
    import jax.numpy as jnp

    design, sides, log_times, weights, delta = args
    parts = design * jnp.where(sides >= 0, jnp.exp(jnp.clip(log_costs, _LEAST_LOG, 100.0)), 0.0)
    # The maximum itself is taken out before the power, which would overflow.
    first = jnp.sum(jnp.where(sides == 0, parts, 0.0), axis=1)
    second = jnp.sum(jnp.where(sides == 1, parts, 0.0), axis=1)
    larger = jnp.maximum(jnp.maximum(first, second), 1e-30)
    ratio = jnp.maximum(jnp.minimum(first, second), 0.0) / larger
    predicted = jnp.log(larger) + jnp.log1p(ratio**SHARPNESS) / SHARPNESS
    used = weights > 0
    residual = jnp.where(used, jnp.expm1(jnp.minimum(predicted - log_times, 20.0)), 0.0)
    softened = residual * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (residual / delta) ** 2)))
    return jnp.concatenate([jnp.sqrt(weights) * softened, jnp.where(sides >= 0, 0.0, log_costs)])


def _loss(log_costs, log_times, design, sides, weights, delta):
    import jax.numpy as jnp

    return 0.5 * jnp.sum(_residuals(log_costs, (design, sides, log_times, weights, delta)) ** 2)


@functools.cache
def _solver() -> Callable:
    import jax
    import jax.numpy as jnp
    import lineax as lx
    import optimistix as optx

    # Columns are of one scale, and damped: normal equations are as good as a QR here, and quicker for tiny problems.
    method = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-7, linear_solver=lx.Normal(lx.Cholesky()))

    def one(design, sides, log_times, weights, start, delta):
        arguments = (design, sides, log_times, weights, delta)
        # The result is judged by its loss; `throw` would stop all lanes for one that needs more steps.
        found = optx.least_squares(_residuals, method, start, args=arguments, max_steps=_MAX_STEPS, throw=False).value
        loss = _loss(found, log_times, design, sides, weights, delta)
        return found, jnp.where(jnp.isfinite(loss), loss, jnp.inf)

    return jax.jit(jax.vmap(one, in_axes=(0, 0, 0, 0, 0, None)))


@functools.cache
def _influence() -> Callable:
    import jax
    import jax.numpy as jnp

    def slopes(log_costs, *rest):
        hessian, mixed = jax.jacfwd(jax.grad(_loss), (0, 1))(log_costs, *rest)
        # The pseudo-inverse: a cost that is all but zero moves nothing, and does not move.
        return (-jnp.linalg.pinv(hessian, rtol=1e-9, hermitian=True) @ mixed,)

    return jax.jit(slopes)
