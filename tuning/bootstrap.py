"""What the costs would have been, had other repeats been measured: a thousand refits at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tuning.bounded import nonnegative_costs
from tuning.law import Law
from tuning.robust_fit import Problems, solve


def bootstrap_costs(
    law: Law,
    columns: Mapping[str, np.ndarray],
    repeats_ms: Sequence[Sequence[float]],
    weights: np.ndarray,
    delta: float,
    refits: int = 1000,
    seed: int = 0,
) -> np.ndarray:
    """Costs of the law in every refit, `[refits, terms]` milliseconds.

    A row with three repeats or more is drawn anew from its repeats (its median moves); and to every row comes a
    residual of the law, drawn from all of them: what no repeat shows, such as the law being wrong.

    **Arguments:**

    - `weights`, `delta`: of the fit, see `robust_fit.Problems`.
    """
    rng = np.random.default_rng(seed)
    n_rows, n_terms = len(repeats_ms), len(law.terms)
    times_ms = np.array([float(np.median(repeats)) for repeats in repeats_ms])
    fitted_ms = law.predict(columns)
    residual = np.log(times_ms / fitted_ms)
    # Residuals of a fit are smaller than the errors they stand for, by the costs that were fitted.
    residual = (residual - residual.mean()) * np.sqrt(n_rows / max(n_rows - n_terms, 1))
    drawn = residual[rng.integers(0, n_rows, (refits, n_rows))]
    for row, repeats in enumerate(repeats_ms):
        if len(repeats) >= 3:
            logs = np.log(np.array(repeats) / times_ms[row])
            drawn[:, row] += np.median(logs[rng.integers(0, len(logs), (refits, len(logs)))], axis=1)
    log_times = np.log(fitted_ms) + drawn

    design = law.design(columns)
    scale = (design / times_ms[:, None]).max(axis=0)
    designs = np.broadcast_to(design / scale, (refits, n_rows, n_terms))
    if any(law.sides):
        starts = np.tile(np.log(np.array(law.costs_ms) * scale), (refits, 1))
    else:
        # The bounded optimum is the right start where a cost goes to zero: its log would creep there.
        relative = designs * np.exp(-log_times)[:, :, None] * np.sqrt(weights)[None, :, None]
        costs = nonnegative_costs(relative, np.broadcast_to(np.sqrt(weights), (refits, n_rows)))
        starts = np.log(np.maximum(costs, 1e-9))
    log_costs, _ = solve(
        Problems(
            designs,
            np.broadcast_to(np.array(law.sides), (refits, n_terms)),
            log_times,
            np.broadcast_to(weights, (refits, n_rows)),
            starts,
            delta,
        )
    )
    return np.exp(log_costs) / scale
