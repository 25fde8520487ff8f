"""Directional lights: the same direction and the same light everywhere, as from the sun."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from vtfs.input_error import InputError


@dataclass(frozen=True)
class DirectionalLights:
    """Lights without a place, float64, world space.

    - `toward`: unit vectors toward each light, `[D, 3]`.
    - `colour`: `[D, 3]`, linear, intensity included: what arrives at a surface that faces the light.

    **Raises:** `InputError` that names the field and the light.
    """

    toward: np.ndarray
    colour: np.ndarray

    def __post_init__(self):
        toward, colour = (np.asarray(c, np.float64).reshape(-1, 3) for c in (self.toward, self.colour))
        if len(toward) != len(colour):
            raise InputError(f"directional lights: {len(toward)} directions for {len(colour)} colours; give as many.")
        for name, wrong, right in (
            ("toward", ~np.isfinite(toward).all(axis=1) | ~toward.any(axis=1), "finite and not zero"),
            ("colour", ~np.isfinite(colour).all(axis=1) | (colour < 0).any(axis=1), "finite, and 0 or more"),
        ):
            bad = np.flatnonzero(wrong)
            if len(bad):
                value = (toward if name == "toward" else colour)[bad[0]]
                raise InputError(f"directional light {bad[0]} `{name}` = {value}: must be {right}.")
        scaled = toward / np.abs(toward).max(axis=1, keepdims=True, initial=1e-300)  # no square overflows or vanishes
        object.__setattr__(self, "toward", scaled / np.linalg.norm(scaled, axis=1, keepdims=True))
        object.__setattr__(self, "colour", colour)

    @property
    def n_lights(self) -> int:
        return len(self.colour)

    @property
    def key(self) -> str:
        """SHA-256 of the content, in hexadecimal."""
        return hashlib.sha256(b"directional 1" + self.toward.tobytes() + self.colour.tobytes()).hexdigest()


NO_DIRECTIONAL = DirectionalLights(np.zeros((0, 3)), np.zeros((0, 3)))
