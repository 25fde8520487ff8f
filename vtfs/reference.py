"""The float64 reference image: every light on every sample, in NumPy, apart from all code under test."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from vtfs.directional_lights import DirectionalLights
from vtfs.layers import composite
from vtfs.lights import Lights
from vtfs.view_samples import ViewSamples

_BOX_PX = 32
_MIN_DISTANCE2_M2 = 1e-4


@dataclass(frozen=True)
class ViewShadows:
    """Shadows on one view: the solid samples, or a transparent layer.

    - `slot`: of each light, which of the masks is its shadow, -1 for none; the directional lights have the first ones.
    - `masks`: samples in shadow, bool `[slots, h, w]`.
    - `transmittance`: what is left of each light elsewhere, `[slots, h, w, channels]` of one or three; None: all.
    """

    slot: np.ndarray
    masks: np.ndarray
    suns: DirectionalLights
    transmittance: np.ndarray | None = None


def forward_reference(
    samples: ViewSamples, lights: Lights, shadows: Sequence[ViewShadows | None] | None = None
) -> np.ndarray:
    """The image of `forward` in float64 `[h, w, 3]`, transparent layers blended over it; 0 where nothing is seen.

    **Arguments:**

    - `shadows`: of the solid samples and each layer; a light adds nothing in its shadow, and directional lights shine.
    """
    layers = samples.layers.transparent
    of_solid, *of_layers = shadows or [None] * (1 + len(layers))
    blended = tuple(
        (_reference(layer.samples, lights, own), layer.opacity.astype(np.float64))
        for layer, own in zip(layers, of_layers, strict=True)
    )
    return composite(_reference(samples, lights, of_solid), blended)


def _reference(samples: ViewSamples, lights: Lights, shadows: ViewShadows | None) -> np.ndarray:
    """One layer.

    A light is left out of a box of 32 x 32 pixels only where the box of their positions lies outside its
    range, where its window is exactly 0; so the sum is that over all lights.
    """
    view = lights.relative_to(samples.camera.view_from_world)
    height, width = samples.valid.shape
    image = np.zeros((height, width, 3))

    def shade_box(corner: tuple[int, int]) -> None:
        box = np.s_[corner[0] : corner[0] + _BOX_PX, corner[1] : corner[1] + _BOX_PX]
        valid = samples.valid[box]
        if valid.any():
            image[box][valid] = _shade(samples, box, valid, view, shadows)

    corners = [(y, x) for y in range(0, height, _BOX_PX) for x in range(0, width, _BOX_PX)]
    with ThreadPoolExecutor() as pool:
        list(pool.map(shade_box, corners))
    return image


def _shade(
    samples: ViewSamples, box: tuple[slice, slice], valid: np.ndarray, view: Lights, shadows: ViewShadows | None
) -> np.ndarray:
    """`[samples, 3]` of the valid samples of a box; see `shading.reflected` for the formula."""
    position, normal, base, emissive = (
        channel[box][valid].astype(np.float64)
        for channel in (samples.position_m, samples.normal, samples.base_colour, samples.emissive)
    )
    specular, shininess = (channel[box][valid].astype(np.float64) for channel in (samples.specular, samples.shininess))
    outside = np.maximum(position.min(0) - view.position_m, view.position_m - position.max(0)).clip(0)
    reach = np.flatnonzero((outside**2).sum(1) <= view.range_m**2 * (1 + 1e-12))
    reach = reach[view.range_m[reach] > 0]
    # Pairs in reach only: beyond its range a light's window is exactly 0.
    to_all = [view.position_m[reach, c, None] - position[None, :, c] for c in range(3)]
    counts = sum(t * t for t in to_all) < view.range_m[reach, None] ** 2
    if shadows is not None and len(reach):
        slot = shadows.slot[reach]
        counts[slot >= 0] &= ~shadows.masks[(slot[slot >= 0], *box)][:, valid]
    light, sample = np.nonzero(counts)
    to = np.stack([t[light, sample] for t in to_all])
    light = reach[light]
    # A light behind the surface adds nothing; half of them are.
    facing = np.einsum("cp,pc->p", to, normal[sample]) > 0
    to, light, sample = to[:, facing], light[facing], sample[facing]
    distance2 = np.einsum("cp,cp->p", to, to)
    to_unit = to / np.sqrt(distance2)
    window = (1 - (distance2 / view.range_m[light] ** 2) ** 2) ** 2
    if samples.camera.is_orthographic:
        from_eye = np.broadcast_to([0.0, 0.0, -1.0], position.shape)
    else:
        from_eye = position / np.linalg.norm(position, axis=1, keepdims=True)
    n = normal[sample].T
    n_dot_h = _highlight(to_unit, n, from_eye[sample].T)
    along = -np.einsum("cp,pc->p", to_unit, view.direction[light])
    cone = ((along - view.cos_outer[light]) / (view.cos_inner - view.cos_outer)[light]).clip(0, 1)
    lit = cone * window / np.maximum(distance2, _MIN_DISTANCE2_M2) * np.einsum("cp,cp->p", n, to_unit)
    gloss = specular[sample] * n_dot_h ** shininess[sample]
    left = np.ones((len(sample), 1))
    if shadows is not None and shadows.transmittance is not None:
        slot, of_box = shadows.slot[light], shadows.transmittance[(slice(None), *box)][:, valid]
        left = np.where((slot >= 0)[:, None], of_box[np.maximum(slot, 0), sample], 1.0)
    left = np.broadcast_to(left, (len(sample), 3))
    colour = emissive + np.stack(
        [
            np.bincount(
                sample, lit * left[:, c] * view.colour[light, c] * (base[sample, c] + gloss), minlength=len(position)
            )
            for c in range(3)
        ],
        axis=1,
    )
    if shadows is None:
        return colour
    rotation = samples.camera.view_from_world[:3, :3]
    for k, (toward, sun, mask) in enumerate(zip(shadows.suns.toward, shadows.suns.colour, shadows.masks, strict=False)):
        to_unit = np.broadcast_to((rotation @ toward)[:, None], normal.T.shape)
        n_dot_h = _highlight(to_unit, normal.T, from_eye.T)
        lit = np.where(mask[box][valid], 0, np.maximum((normal.T * to_unit).sum(axis=0), 0))
        left_of_sun = 1.0 if shadows.transmittance is None else shadows.transmittance[(k, *box)][valid]
        colour += left_of_sun * lit[:, None] * sun * (base + (specular * n_dot_h**shininess)[:, None])
    return colour


def _highlight(to_light: np.ndarray, normal: np.ndarray, from_eye: np.ndarray) -> np.ndarray:
    """`max(0, n.h)` of unit vectors, components `[3, n]`."""
    half = to_light - from_eye
    length = np.sqrt(np.einsum("cp,cp->p", half, half))
    # Light straight from behind the sample has no half vector, and no highlight.
    return np.maximum(np.einsum("cp,cp->p", normal, half) / np.where(length > 0, length, 1), 0)


def image_error(image: np.ndarray, reference: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    """RMSE and 99.9th percentile of the absolute difference, both over the RMS of the reference.

    Linear HDR before tone mapping, valid pixels only. 0 for a black reference that is met exactly.
    """
    if not valid.any():
        return 0.0, 0.0
    difference = np.abs(image[valid].astype(np.float64) - reference[valid])
    rms = float(np.sqrt(np.mean(reference[valid] ** 2))) or 1.0
    return float(np.sqrt(np.mean(difference**2))) / rms, float(np.percentile(difference, 99.9)) / rms


def largest_relative_difference(image: np.ndarray, reference: np.ndarray, valid: np.ndarray) -> float:
    """`max |a - b| / max(|b|, mean b)`: what "within 1e-4" speaks of."""
    if not valid.any():
        return 0.0
    a, b = image[valid].astype(np.float64), reference[valid]
    return float(np.max(np.abs(a - b) / np.maximum(np.abs(b), b.mean() or 1.0)))
