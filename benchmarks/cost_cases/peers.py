"""Other models on the same training rows, in environments of their own: JSON in, JSON out."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_SCRIPTS = Path(__file__).parent.parent / "peers"


@dataclass(frozen=True)
class Case:
    """Rows to fit and rows to predict.

    - `train`, `test`: float64 `[rows, columns]`.
    - `times_ms`: of the rows to fit.
    """

    columns: tuple[str, ...]
    train: np.ndarray
    times_ms: np.ndarray
    test: np.ndarray


@dataclass(frozen=True)
class Peers:
    """Interpreters that have the peers installed; `None`: left out."""

    regressors: Path | None
    extrap: Path | None

    def predict(self, cases: Sequence[Case]) -> dict[str, list[np.ndarray]]:
        """Predicted milliseconds of every peer for every case."""
        text = json.dumps(
            [
                {
                    "columns": case.columns,
                    "train": case.train.tolist(),
                    "times_ms": case.times_ms.tolist(),
                    "test": case.test.tolist(),
                }
                for case in cases
            ]
        )
        found: dict[str, list[np.ndarray]] = {}
        for python, script in ((self.regressors, "regressors.py"), (self.extrap, "extra_p.py")):
            if python is None:
                continue
            done = subprocess.run([python, _SCRIPTS / script], input=text, capture_output=True, text=True, check=True)
            found |= {name: [np.array(p, float) for p in all_] for name, all_ in json.loads(done.stdout).items()}
        return found
