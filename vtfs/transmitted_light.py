"""The light that casters leave: opaque, alpha-masked, blended and coloured ones together, on each view sample."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, UInt32

from vtfs.alpha_casters import AlphaSurfaces, Blending, SceneCasters, alpha_on_device, scene_bias_m
from vtfs.gbuffer import Fragments, from_runs
from vtfs.input_error import InputError
from vtfs.shadow_capacities import fitted_to_all
from vtfs.shadow_casters import FrontFaces, ShadowLight, require_near
from vtfs.shadow_mask import ShadowFrame, ShadowPlan, casters_on_device, require_choice, shadow_frame
from vtfs.shadow_techniques import CastShadows, cast_by_bias, on_host, shadow_grid
from vtfs.shadow_volumes.transmittance import Transmitted, transmit
from vtfs.view_samples import ViewSamples

ALPHA_TECHNIQUES = ("ptsv", "cluster_hierarchy")
"""Techniques that alpha casters cast by: those that test samples against volumes. A stencil cannot tell surfaces
apart."""


@dataclass(frozen=True)
class TransmittedLight:
    """What one light's shadow casters leave of it on a view.

    - `transmittance`: float32 `[h, w]` (grey and stochastic) or `[h, w, 3]` (coloured); 1 where nothing was tested.
    - `opaque`: the mask of the opaque casters; `alpha`: of what alpha casters stop wholly, found on what is left lit.
    """

    transmittance: np.ndarray
    opaque: CastShadows
    alpha: CastShadows

    @property
    def shadowed(self) -> np.ndarray:
        """Samples that no light reaches, bool `[h, w]`: behind an opaque caster, or one that stops all light there."""
        return self.opaque.shadowed | self.alpha.shadowed


@functools.cache
def alpha_program(
    technique: str, plan: ShadowPlan, blending: Blending
) -> Callable[[ShadowFrame, AlphaSurfaces, UInt32[Array, " 2"]], Transmitted]:
    """Alpha casters as one program, from view samples to transmittance; to be called inside `jax.enable_x64(True)`."""

    def run(frame: ShadowFrame, surfaces: AlphaSurfaces, stream: UInt32[Array, " 2"]) -> Transmitted:
        return transmit(technique, frame, surfaces, stream, plan, blending)

    return jax.jit(run)


def transmitted_light(
    technique: str,
    plan: ShadowPlan,
    samples: ViewSamples,
    casters: SceneCasters,
    light: ShadowLight,
    blending: Blending = "grey",
    stream: tuple[int, int] = (0, 0),
    depth_slices: int = 0,
    front_faces: FrontFaces = "cast",
    receives: np.ndarray | None = None,
    bias_m: float | None = None,
) -> TransmittedLight:
    """The light that reaches each sample of a view: of one transparent layer, or of the solid ones.

    Opaque casters first, which may accept nodes whole; alpha casters then on the samples that they leave lit.

    **Arguments:** as of `cast_shadows`, and

    - `stream`: seed of stochastic blending, and the number of this view: layers and sub-samples have their own bits.
    - `front_faces`: of opaque casters alone, as panes and leaves are not closed.
    - `bias_m`: 1e-5 of the extent of all casters unless given.

    **Raises:** `InputError` as `cast_shadows`, and for an unknown `blending` or a technique without alpha casters.
    """
    if technique not in ALPHA_TECHNIQUES:
        raise InputError(
            f"shadow technique `{technique}`: casts no alpha shadows; use {' or '.join(ALPHA_TECHNIQUES)}."
        )
    require_choice(f"blending={blending!r}", blending, get_args(Blending))
    require_near(light, casters.together)
    bias = scene_bias_m(casters) if bias_m is None else bias_m
    opaque = cast_by_bias(
        technique, plan, samples, casters.opaque, light, depth_slices, front_faces, receives, bias
    )  # fmt: skip
    left_lit = ~opaque.shadowed if receives is None else receives & ~opaque.shadowed
    grid = shadow_grid(samples, plan.tile_px, depth_slices)
    on_device = casters_on_device(casters.alpha.casters)
    frame = shadow_frame(samples, on_device, light, grid, bias, left_lit)
    surfaces = alpha_on_device(casters.alpha)
    words = np.array(stream, np.uint32)

    @functools.cache  # what the sizing run found is not found again
    def found(plan: ShadowPlan) -> Transmitted:
        with jax.enable_x64(True):
            return alpha_program(technique, plan, blending)(frame, surfaces, jnp.asarray(words))

    plan, _ = fitted_to_all(technique, plan, [frame], run=lambda plan, _: found(plan).mask)
    transmitted = found(plan)
    alpha = on_host(transmitted.mask, plan, frame)
    stopped = opaque.shadowed | alpha.shadowed
    if blending == "stochastic":
        left = np.where(stopped, np.float32(0), np.float32(1))
    else:
        channels = [from_runs(np.asarray(channel), samples.camera.viewport) for channel in transmitted.transmittance]
        left = channels[0] if blending == "grey" else np.stack(channels, axis=-1)
        left = np.where(stopped if left.ndim == 2 else stopped[..., None], np.float32(0), left)
    return TransmittedLight(left, opaque, alpha)


def views_of(samples: ViewSamples) -> tuple[ViewSamples, ...]:
    """What receives shadow on a frame: the solid samples, then each transparent layer; a view each."""
    return (samples, *(layer.samples for layer in samples.layers.transparent))


def in_fragments(samples: ViewSamples, images: Sequence[np.ndarray]) -> np.ndarray:
    """Images of `views_of` a frame in the runs in which it is shaded: visible ones, then transparent ones.

    **Arguments:**

    - `images`: one a view, `[h, w]` or `[h, w, channels]`.

    **Returns:** `[runs, 32]` or `[runs, 32, channels]`; 0 in the padding.
    """
    of_view = {id(view): image for view, image in zip(views_of(samples), images, strict=True)}
    fragments = Fragments(samples, with_hidden=False)
    if images[0].ndim == 2:
        return fragments.channel(lambda view: of_view[id(view)])
    channels = range(images[0].shape[2])
    return np.stack([fragments.channel(lambda view, c=c: of_view[id(view)][..., c]) for c in channels], axis=-1)
