"""The one solver behind the cost models: least squares with coefficients that cannot be negative."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear, nnls


def relative_design(ops: np.ndarray, times_ms: np.ndarray) -> np.ndarray:
    """`[rows, 1 + terms]`, with a constant first, such that `design @ costs` is predicted over measured time.

    Relative, as a frame of 5 ms and one of 500 ms count alike.

    **Arguments:**

    - `ops`: `[rows, terms]`, not negative; `terms` may be 0.
    - `times_ms`: `[rows]`, positive.
    """
    return np.column_stack([np.ones(len(ops)), ops]) / times_ms[:, None]


def fit_costs(design: np.ndarray) -> np.ndarray:
    """Costs in ms, `[1 + terms]`, the fixed one first: minimises the sum of `(design @ costs - 1) ** 2`.

    None is negative: work takes time.

    SciPy, as a run makes thousands of refits of at most ten unknowns: 128 of them take 3 ms here, and 68 ms with
    jaxopt's `BoxCDQP` under `vmap`, after 1.2 s of compiling.
    """
    # Columns span ten orders of magnitude (one constant, 1e9 operations), and the solver's tolerance is absolute.
    scale = np.sqrt(np.einsum("rt,rt->t", design, design))
    scale[scale == 0] = 1
    scaled, target = design / scale, np.ones(len(design))
    try:
        costs, _ = nnls(scaled, target)
    except RuntimeError:  # its active-set loop can cycle on columns that are equal up to rounding
        costs = lsq_linear(scaled, target, bounds=(0, np.inf), method="bvls").x
    return costs / scale
