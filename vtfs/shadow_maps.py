"""What the shadows of a frame look like on the image: what lies in shadow, and what it took to find out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vtfs.frame import cast_counted
from vtfs.frame_inputs import FrameInputs
from vtfs.gbuffer import from_runs
from vtfs.parameters import SHADOW_REFERENCES, Configuration
from vtfs.techniques import REGISTRY


@dataclass(frozen=True)
class ShadowMaps:
    """Of the visible solid samples, int `[h, w]`, summed over the lights that cast.

    - `lit`: lights that would light each sample; `shadowed`: those of them that do not reach it at all.
    - `tests`: triangles that its tile or cluster is tested against; of references 0.
    """

    lit: np.ndarray
    shadowed: np.ndarray
    tests: np.ndarray


def shadow_maps(config: Configuration, inputs: FrameInputs) -> ShadowMaps | None:
    """The maps of a shadow technique; None for the others."""
    if not REGISTRY[config.technique].casts_shadows:
        return None
    shadows = inputs.shadows
    solid, n_slots = shadows.views[0], len(shadows.lights)
    lit = np.sum([shadows.lit_by(solid, k) for k in range(n_slots)], axis=0)
    if config.technique in SHADOW_REFERENCES:
        masks = []
        for mask in shadows.reference_masks(config)[:n_slots]:
            stopped = np.all([np.asarray(c) == 0 for c in mask.transmittance], axis=0) if mask.transmittance else False
            masks.append(from_runs(np.asarray(mask.shadowed) | stopped, inputs.viewport))
        return ShadowMaps(lit, np.sum(masks, axis=0), np.zeros_like(lit))
    cast = cast_counted(config, inputs)
    opaque, alpha = cast.opaque[:n_slots], cast.alpha[:n_slots]
    # Of no sample both: alpha casters are tested on what opaque ones leave lit.
    shadowed = [each.shadowed for each in (*opaque, *alpha)]
    return ShadowMaps(lit, np.sum(shadowed, axis=0), np.sum([each.tests for each in (*opaque, *alpha)], axis=0))
