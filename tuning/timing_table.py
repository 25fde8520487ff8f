"""Times with what they may depend on: what every importer makes and every fit takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TimingTable:
    """One row for each configuration (or frame) that was timed.

    - `columns`: numbers a time may depend on, float64 `[rows]` each: sizes, counts, parameters. NaN where a row has
      none, as a technique without tiles has no tile size.
    - `labels`: columns of text: technique, stage, scene, device.
    - `repeats_ms`: the repeats of each row, at least one; one time where only a median or mean is known.
    - `compile_ms`: what compiling each row took, where the file says.
    - `n_untimed`: rows of the file that had no time and are left out.
    """

    columns: dict[str, np.ndarray]
    labels: dict[str, tuple[str, ...]]
    repeats_ms: tuple[tuple[float, ...], ...]
    compile_ms: tuple[float, ...] | None = None
    n_untimed: int = 0

    def __len__(self) -> int:
        return len(self.repeats_ms)

    @property
    def median_ms(self) -> np.ndarray:
        """float64 `[rows]`."""
        return np.array([float(np.median(repeats)) for repeats in self.repeats_ms])
