"""A measurement with nothing in it but what a test says."""

from typing import Any

from tuning.measurement import Measurement


def a_measurement(technique: str = "forward", n_frames: int = 1, **changes: Any) -> Measurement:
    empty: dict[str, Any] = {
        "technique": technique,
        "params": {},
        "scene_key": "",
        "frames": tuple(range(n_frames)),
        "seed": 0,
        "outcome": "timed",
        "compile_s": 0.0,
        "stages_ms": {},
        "counts": ({},) * n_frames,
        "error": None,
        "error_p999": None,
        "device": "",
        "versions": {},
        "load": 0.0,
    }
    return Measurement(**(empty | changes))
