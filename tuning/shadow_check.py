"""Is a shadow technique right? Its masks against Embree and float64, before it is timed."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vtfs.alpha_casters import Blending, Casting
from vtfs.cache import cached
from vtfs.configurations import Configuration
from vtfs.frame import image_on_host
from vtfs.frame_inputs import FrameInputs
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.layers import Layers, TransparentLayer
from vtfs.light_shadows import CastMask
from vtfs.lights import Lights
from vtfs.reference import ViewShadows, forward_reference
from vtfs.shadow_casters import FrontFaces
from vtfs.shadow_inputs import FrameShadows
from vtfs.shadow_references import brute_force, classify, kept_casters, view_points_m
from vtfs.shadow_scene import ShadowScene
from vtfs.view_samples import ViewSamples

MOST_IN_BANDS = 1e-3
"""Share of the tested samples that may differ near edges and planes of casters, where rounding decides."""

_GRAZING = 1e-6
"""Cosine below which rounding decides whether a surface faces the light; it is black there, in shadow or not."""

LIGHT_ERROR = 1e-5
"""Largest difference of a transmittance from float64: it is a product in float64, rounded to float32 (6e-8)."""

_DECISION_MARGIN = 1e-9
"""Of an alpha from its cutoff, or from a random number: below it roundings of texture coordinates decide."""

_MOST_ALPHA_SAMPLES, _MOST_ALPHA_PAIRS = 2**14, 2**30
"""Samples on which alpha casters are checked, of all lights and views, and pairs of them with triangles: some 10 s."""

_MOST_CLASSIFIED = 200
"""Each costs a look at all casters; of more mismatches so many, evenly spread, are looked at."""


@dataclass(frozen=True)
class MaskCheck:
    """What is wrong with the masks of a configuration; empty where they are right.

    - `image`: the reference image, with the masks' own answer where either is right.
    """

    wrong: str
    image: np.ndarray


class ShadowChecker:
    """The reference masks and image of one frame, made once and kept in the cache."""

    def __init__(self, shadows: FrameShadows, samples: ViewSamples, lights: Lights, key: tuple[str, ...]):
        self._shadows, self._samples, self._lights, self._key = shadows, samples, lights, key
        self._masks: dict[FrontFaces, np.ndarray] = {}
        self._images: dict[Casting, np.ndarray] = {}
        self._left: dict[Casting, np.ndarray] = {}

    def masks(self, front_faces: FrontFaces) -> np.ndarray:
        """By Embree: bool `[views, slots, h, w]`."""
        if front_faces not in self._masks:
            shadows = self._shadows

            def trace() -> dict[str, np.ndarray]:
                masks = [
                    [shadows.reference(view, k, "shadow_rays", front_faces) for k in range(len(shadows.lights))]
                    for view in shadows.views
                ]
                return {"bits": np.packbits(np.array(masks), axis=-1)}

            width = self._samples.valid.shape[1]
            bits = cached("shadow_references", (*self._key, front_faces), trace)["bits"]
            self._masks[front_faces] = np.unpackbits(bits, axis=-1, count=width).astype(bool)
        return self._masks[front_faces]

    def image(self, casting: Casting = "opaque") -> np.ndarray:
        """The float64 image under the shadows that Embree finds, with all casters.

        Alpha casters leave the light that the first configuration with such casters found and that was checked: no ray
        of Embree's finds it, and float64 for every sample would take hours.
        """
        if casting not in self._images:
            left = self._left.get(casting)

            def shade() -> dict[str, np.ndarray]:
                of_views = self._of_views(self.masks("cast"), left)
                return {"image": forward_reference(self._samples, self._lights, of_views)}

            alpha = () if left is None else (casting, hashlib.sha256(left.tobytes()).hexdigest())
            self._images[casting] = cached("references", (*self._key, "shadowed", *alpha), shade)["image"]
        return self._images[casting]

    def check(self, config: Configuration, masks: Sequence[np.ndarray], left: Sequence[np.ndarray] = ()) -> MaskCheck:
        """Compare the masks `[h, w]` of all slots on each view with those of the same casters.

        Where they differ from Embree's, which is float32, brute force in float64 decides.

        **Arguments:**

        - `left`: what alpha casters leave of each light, `[h, w, channels]`; compared with float64 on some samples.
        """
        casting = self._shadows.scene.blending(config)
        if casting != "opaque":
            wrong = self._wrong_light(casting, masks, left)
            channels = np.array(left, np.float64).reshape(len(self._shadows.views), -1, *left[0].shape)
            if wrong and casting not in self._left:  # no light is known to be right: the image is of what was found
                of_views = self._of_views(self.masks("cast"), channels)
                return MaskCheck(wrong, forward_reference(self._samples, self._lights, of_views))
            self._left.setdefault(casting, channels)
            if wrong:
                return MaskCheck(wrong, self.image(casting))
        shadows = self._shadows
        n_slots = len(shadows.lights)
        front_faces: FrontFaces = config["front_faces"]  # type: ignore[assignment]
        found = np.array(masks).reshape(len(shadows.views), n_slots, *self._samples.valid.shape)
        reference = self.masks(front_faces)
        n_tested = n_errors = n_edge = n_plane = 0
        differs = np.zeros_like(found)
        for v, view in enumerate(shadows.views):
            for k in range(n_slots):
                tested = shadows.lit_by(view, k) & self._not_grazing(view, k)
                differs[v, k] = tested & (found[v, k] != reference[v, k])
                n_tested += int(tested.sum())
                edge, plane, errors = self._by_reason(view, k, found[v, k], differs[v, k], front_faces)
                n_edge, n_plane, n_errors = n_edge + edge, n_plane + plane, n_errors + errors
        wrong = ""
        if n_errors or n_edge + n_plane > MOST_IN_BANDS * max(n_tested, 1000):
            wrong = (
                f"shadows: {n_errors:,} of {n_tested:,} samples are wrong against float64 brute force, besides "
                f"{n_edge:,} near an edge and {n_plane:,} near the plane of a caster"
            )
        if wrong or front_faces == "culled" or not differs.any():
            return MaskCheck(wrong, self.image(casting))
        return MaskCheck(
            "", self._with_masks(np.where(differs, found, reference), np.any(differs, axis=(0, 1)), casting)
        )

    def _by_reason(
        self, view: ViewSamples, k: int, mask: np.ndarray, differs: np.ndarray, front_faces: FrontFaces
    ) -> tuple[int, int, int]:
        """Of the samples that differ from Embree: near an edge, near a plane, wrong."""
        n = int(differs.sum())
        if not n:
            return 0, 0, 0
        light, bias_m = self._shadows.lights[k], self._shadows.bias_m
        casters = kept_casters(self._shadows.scene.casters, light, front_faces)
        points, eye_m = view_points_m(view, differs), np.array(view.camera.eye_m)
        spread = np.linspace(0, n - 1, min(n, _MOST_CLASSIFIED)).round().astype(int)
        points, own = points[spread], mask[differs][spread]
        truth = brute_force(points, casters, light, bias_m, eye_m)
        reasons = classify(points, own != truth, casters, light, bias_m, eye_m)
        scale = n / len(points)
        counts = (reasons.near_edge, reasons.near_plane, reasons.errors)
        return tuple(round(scale * count) for count in counts)  # type: ignore[return-value]

    def _not_grazing(self, view: ViewSamples, k: int) -> np.ndarray:
        light, camera = self._shadows.lights[k], view.camera
        at = light.homogeneous
        to = camera.view_from_world[:3, :3] @ at[:3] + at[3] * camera.view_from_world[:3, 3]
        to = to - at[3] * view.position_m.astype(np.float64)
        length = np.linalg.norm(to, axis=-1)
        range_m = self._shadows.range_m[k]
        near = True if light.directional else length < range_m * (1 - 1e-6)
        return near & ((to * view.normal).sum(axis=-1) > _GRAZING * length)

    def _of_views(self, masks: np.ndarray, left: np.ndarray | None) -> list[ViewShadows]:
        of_views = [None] * len(masks) if left is None else left
        suns = self._shadows.scene.suns
        return [ViewShadows(self._shadows.slot, own, suns, light) for own, light in zip(masks, of_views, strict=True)]

    def _wrong_light(self, blending: Blending, masks: Sequence[np.ndarray], left: Sequence[np.ndarray]) -> str:
        """What is wrong with the light that alpha casters leave, on evenly spread samples that opaque ones miss."""
        shadows, n_slots = self._shadows, len(self._shadows.lights)
        alpha = shadows.scene.alpha
        assert alpha is not None
        most = min(_MOST_ALPHA_SAMPLES, _MOST_ALPHA_PAIRS // alpha.casters.n_triangles) // len(masks) + 1
        n_tested = n_errors = n_bands = 0
        for i, (mask, found) in enumerate(zip(masks, left, strict=True)):
            v, k = divmod(i, n_slots)
            view, light = shadows.views[v], shadows.lights[k]
            lit = np.flatnonzero(shadows.lit_by(view, k) & self._not_grazing(view, k) & ~mask)
            some = np.zeros(mask.shape, bool)
            some.flat[lit[:: max(1, -(-len(lit) // most))]] = True
            expected, margin = shadows.reference_light(v, k, some, blending)
            error = np.abs(found - expected).max(axis=-1)[some]
            differs = ~(error <= LIGHT_ERROR)
            rounded = differs & (margin[some] < _DECISION_MARGIN)
            points, eye_m = view_points_m(view, some), np.array(view.camera.eye_m)
            bands = classify(points, differs & ~rounded, alpha.casters, light, shadows.bias_m, eye_m)
            n_tested, n_errors = n_tested + len(points), n_errors + bands.errors
            n_bands += bands.near_edge + bands.near_plane + int(rounded.sum())
        if not n_errors and n_bands <= MOST_IN_BANDS * max(n_tested, 1000):
            return ""
        return (
            f"transmittance: {n_errors:,} of {n_tested:,} samples are off by over {LIGHT_ERROR:g} against float64 "
            f"brute force, besides {n_bands:,} near an edge, a plane or a cutoff of an alpha caster"
        )

    def _with_masks(self, masks: np.ndarray, pixels: np.ndarray, casting: Casting) -> np.ndarray:
        """The reference image, shaded again with other masks in the pixels where any has changed."""
        layers = tuple(
            TransparentLayer(replace(layer.samples, valid=layer.samples.valid & pixels), layer.opacity * pixels)
            for layer in self._samples.layers.transparent
        )
        some = replace(self._samples, valid=self._samples.valid & pixels, layers=Layers(lambda: layers))
        image, left = self.image(casting).copy(), self._left.get(casting)
        image[pixels] = forward_reference(some, self._lights, self._of_views(masks, left))[pixels]
        return image


def one_blending(configurations: Sequence[Configuration], scene: ShadowScene) -> None:
    """**Raises:** `InputError` where configurations would not cast the same shadows, or one cannot cast them."""
    found = list(dict.fromkeys(scene.blending(config) for config in configurations))
    if len(found) > 1:
        raise InputError(
            f"parameter `blending` = {', '.join(found)}: are different shadows: give one, to compare their times."
        )


def light_on_host(masks: Sequence[CastMask], inputs: FrameInputs) -> list[np.ndarray]:
    """What alpha casters leave by `CastMask`s, `[h, w, channels]`; none where none cast."""
    return [image_on_host(mask.transmittance, inputs) for mask in masks if mask.transmittance]


def masks_on_host(masks: Sequence[CastMask], samples: ViewSamples) -> list[np.ndarray]:
    """`CastMask`s as images `[h, w]`."""
    return [from_runs(np.asarray(mask.shadowed), samples.camera.viewport) for mask in masks]
