"""How much may be measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vtfs.input_error import InputError


@dataclass(frozen=True)
class Budget:
    """How much may be measured: a number of configurations, or seconds in `Workload.measure` but for compiling."""

    measurements: int | None = None
    seconds: float | None = None

    @classmethod
    def parse(cls, text: str) -> Budget:
        """`"40"`: measurements. `"120s"`: seconds.

        **Raises:** `InputError` for anything else, and for nothing at all.
        """
        stripped = text.strip()
        try:
            if stripped.endswith("s"):
                seconds = float(stripped[:-1])
                if 0 < seconds < math.inf:
                    return cls(seconds=seconds)
            elif (measurements := int(stripped)) > 0:
                return cls(measurements=measurements)
        except ValueError:
            pass
        raise InputError(f"budget {text!r}: must be a number of measurements, as `40`, or of seconds, as `120s`.")

    def __str__(self) -> str:
        return f"{self.measurements} measurements" if self.seconds is None else f"{self.seconds:g} s of measuring"
