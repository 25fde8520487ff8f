"""How well the models of the search predict configurations that they have not seen, and how good their choice is.

```sh
python -m benchmarks.search_models benchmarks/h200_atrium/measurements.jsonl benchmarks/h100/own/*.jsonl
```
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tuning.choose import is_timed, predict_ms
from tuning.measurement import Measurement
from tuning.record import read_measurements
from tuning.stage_models import fit_stage
from vtfs.configurations import configuration

_FEWEST = 5  # configurations of a technique
_DRAWS = 24


def left_out_errors(own: Sequence[Measurement]) -> np.ndarray:
    """Mean size of `predicted / measured - 1` over the frames of each configuration, without it in the fit."""
    errors = []
    for out in own:
        model = fit_stage([m for m in own if m is not out], out.technique, "frame")
        assert model is not None
        timed = [(c, np.median(r)) for c, r in zip(out.counts, out.stages_ms["frame"], strict=False) if r]
        predicted_ms = model.predict([counts for counts, _ in timed])
        errors.append(np.mean(np.abs(predicted_ms / np.array([ms for _, ms in timed]) - 1)))
    return np.array(errors)


def regrets(own: Sequence[Measurement]) -> np.ndarray:
    """How much slower the predicted best of all is, from models of a random half: of the first frame, the busiest."""
    first_ms = np.array([np.median(m.stages_ms["frame"][0]) for m in own])
    found = []
    for draw in range(_DRAWS):
        half = np.random.default_rng([0, draw]).choice(len(own), max(4, len(own) // 2), replace=False)
        model = fit_stage([own[k] for k in sorted(half)], own[0].technique, "frame")
        assert model is not None
        chosen = int(predict_ms(model, [m.counts[:1] for m in own], "max").argmin())
        found.append(first_ms[chosen] / first_ms.min() - 1)
    return np.array(found)


def rows(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, float]]:
    """For each technique of a record: what it is, both of the above, and CPU seconds a fit."""
    timed = [m for m in read_measurements(path) if is_timed(m) and configuration(m.technique, m.params).is_exact]
    for technique in dict.fromkeys(m.technique for m in timed):
        own = [m for m in timed if m.technique == technique]
        if len(own) >= _FEWEST:
            started = time.process_time()
            errors = left_out_errors(own)
            cpu_s = (time.process_time() - started) / len(own)
            yield f"{path}, {technique}, {len(own)} configurations", errors, regrets(own), cpu_s


def main() -> None:
    print("| record | left-out error: median, mean | regret: median, mean, worst | CPU s a fit |")
    print("| --- | --- | --- | --- |")
    every = []
    for path in sys.argv[1:]:
        for name, errors, regret, cpu_s in rows(Path(path)):
            every.append((np.median(errors), errors.mean(), np.median(regret), regret.mean(), regret.max()))
            median, mean, *of_choice = every[-1]
            choice = ", ".join(f"{100 * one:.1f}" for one in of_choice)
            print(f"| {name} | {100 * median:.1f}, {100 * mean:.1f} % | {choice} % | {cpu_s:.3f} |", flush=True)
    medians = ", ".join(f"{100 * one:.1f}" for one in np.median(every, axis=0))
    print(f"| median of these {len(every)} | {medians} % | | |")


if __name__ == "__main__":
    main()
