"""What the shadows of a frame look like on the image: what lies in shadow, and what it took to find out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vtfs.configurations import Configuration
from vtfs.frame import cast_counted, image_on_host
from vtfs.frame_inputs import FrameInputs
from vtfs.gbuffer import from_runs
from vtfs.technique_names import SHADOW_REFERENCES, STENCIL_NAMES
from vtfs.techniques import REGISTRY


@dataclass(frozen=True)
class ShadowMaps:
    """Of the visible solid samples, `[h, w]`, summed over the lights that cast.

    - `lit`: lights that would light each sample; `stopped`: how much of them does not reach it: 1 of a light that it
      lies in the shadow of, a share of one that comes through panes (mean of the colours).
    - `tests`: what its tile or cluster is tested against, `tested` in words; of references 0.
    """

    lit: np.ndarray
    stopped: np.ndarray
    tests: np.ndarray
    tested: Literal["triangles", "volume polygons"]

    @property
    def share_stopped(self) -> float:
        """Of what all lights that cast would light."""
        return float(self.stopped.sum()) / max(int(self.lit.sum()), 1)


def shadow_maps(config: Configuration, inputs: FrameInputs) -> ShadowMaps | None:
    """The maps of a shadow technique; None for the others."""
    if not REGISTRY[config.technique].casts_shadows:
        return None
    shadows = inputs.shadows
    solid, n_slots = shadows.views[0], len(shadows.lights)
    lit = np.sum([shadows.lit_by(solid, k) for k in range(n_slots)], axis=0)
    if config.technique in SHADOW_REFERENCES:
        masks = shadows.reference_masks(config)[:n_slots]
        shadowed = [from_runs(np.asarray(mask.shadowed), inputs.viewport) for mask in masks]
        left = [image_on_host(mask.transmittance, inputs) for mask in masks if mask.transmittance]
        return ShadowMaps(lit, _stopped(shadowed, left), np.zeros_like(lit), "triangles")
    cast = cast_counted(config, inputs)
    opaque, alpha = cast.opaque[:n_slots], cast.alpha[:n_slots]
    stopped = _stopped([each.shadowed for each in opaque], cast.transmittance[:n_slots])
    tests = np.sum([each.tests for each in (*opaque, *alpha)], axis=0)
    return ShadowMaps(lit, stopped, tests, "volume polygons" if config.technique in STENCIL_NAMES else "triangles")


def _stopped(shadowed: list[np.ndarray], left: list[np.ndarray]) -> np.ndarray:
    # Of no sample both: alpha casters are tested on what opaque ones leave lit.
    by_alpha = [1 - channels.mean(axis=-1, dtype=np.float64) for channels in left]
    return np.asarray(np.sum([*shadowed, *by_alpha], axis=0, dtype=np.float64))
