"""One measurement: a line of `measurements.jsonl`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vtfs.parameters import Value

FLOAT32_ERROR = 2e-5
"""Error of an image that differs from the float64 reference by rounding alone: near a light the rounding of its
position (6e-8 of its distance to the eye) counts against its distance to the sample. In the atrium: 1.1e-5."""

Outcome = Literal["timed", "overflow", "out_of_memory", "timeout", "failed"]


@dataclass(frozen=True)
class Measurement:
    """One configuration on one scene. Failures are measurements too.

    - `frames`: which frames of the camera path, the one with the most work first.
    - `stages_ms`: for each stage, for each frame, every repeat. `frame` is the fused program, of shadow techniques
      see `frame_program`; the other stages are timed apart and need not add up to it.
    - `counts`: one record a frame.
    - `error`: RMSE over RMS of the float64 reference, on `frames[0]`.
    """

    technique: str
    params: dict[str, Value]
    scene_key: str
    frames: tuple[int, ...]
    seed: int
    outcome: Outcome
    compile_s: float
    stages_ms: dict[str, tuple[tuple[float, ...], ...]]
    counts: tuple[dict[str, int], ...]
    error: float | None
    error_p999: float | None
    device: str
    versions: dict[str, str]
    load: float
    message: str = ""
    schema: int = 1
