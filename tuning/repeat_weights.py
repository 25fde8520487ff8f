"""How far a time is to be trusted, from how its repeats scatter."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

NOISE_FLOOR = 0.005
"""Relative: clocks and rounding leave no time better known than this."""


def repeat_weights(repeats_ms: Sequence[Sequence[float]]) -> np.ndarray:
    """Of squared relative residuals, mean 1: rows whose repeats scatter count less.

    The variance of a row is that of its median plus what no repeat shows, taken as the median of the former.
    """
    scatter = np.full(len(repeats_ms), np.nan)
    for k, repeats in enumerate(repeats_ms):
        if len(repeats) >= 3:
            logs = np.log(repeats)
            sigma = 1.4826 * np.median(np.abs(logs - np.median(logs)))
            scatter[k] = sigma**2 * math.pi / 2 / len(repeats)
    known = scatter[np.isfinite(scatter)]
    if not len(known):
        return np.ones(len(repeats_ms))
    typical = max(float(np.median(known)), NOISE_FLOOR**2)
    weights = 1 / (np.where(np.isfinite(scatter), scatter, typical) + typical)
    return weights / weights.mean()
