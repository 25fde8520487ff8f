"""Times with what they may depend on: what every importer makes and every fit takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TimingTable:
    """One row for each configuration (or frame) that was timed.

    - `columns`: numbers a time may depend on, float64 `[rows]` each: sizes, counts, parameters.
    - `labels`: columns of text: technique, stage, scene, device.
    - `repeats_ms`: the repeats of each row, at least one; one time where only a median or mean is known.
    """

    columns: dict[str, np.ndarray]
    labels: dict[str, tuple[str, ...]]
    repeats_ms: tuple[tuple[float, ...], ...]

    def __len__(self) -> int:
        return len(self.repeats_ms)

    @property
    def median_ms(self) -> np.ndarray:
        """float64 `[rows]`."""
        return np.array([float(np.median(repeats)) for repeats in self.repeats_ms])
