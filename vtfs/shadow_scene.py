"""What casts shadows in a scene, whatever the frame: opaque triangles, alpha casters, directional lights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from vtfs.alpha_casters import (
    AlphaCasters,
    AlphaSurfaces,
    Casting,
    SceneCasters,
    alpha_on_device,
    scene_casters,
)
from vtfs.configurations import Configuration
from vtfs.directional_lights import DirectionalLights
from vtfs.input_error import InputError
from vtfs.light_shadows import MAX_SHADOW_LIGHTS
from vtfs.shadow_casters import Casters
from vtfs.shadow_mask import CastersOnDevice, casters_on_device, default_bias_m
from vtfs.shadow_references import ShadowRays
from vtfs.technique_names import STENCIL_NAMES

if TYPE_CHECKING:
    from vtfs.scene import Scene


@dataclass(frozen=True)
class ShadowScene:
    """What casts shadows in a scene.

    - `casters`: opaque ones; `alpha`: the others, on the same vertices, None where there are none.
    - `n_lights`: lights with a place that cast on each frame: those that light it most. Directional ones all do.
    - `seed`: of stochastic blending.
    """

    casters: Casters
    suns: DirectionalLights
    n_lights: int
    alpha: AlphaCasters | None = None
    seed: int = 0

    def __post_init__(self):
        if self.suns.n_lights > MAX_SHADOW_LIGHTS:
            raise InputError(
                f"the scene has {self.suns.n_lights} directional lights, which all cast: there must be at most "
                f"{MAX_SHADOW_LIGHTS}; remove some."
            )
        if not 0 <= self.n_lights <= MAX_SHADOW_LIGHTS - self.suns.n_lights:
            raise InputError(
                f"--shadow-lights {self.n_lights}: with {self.suns.n_lights} directional lights must be from 0 to "
                f"{MAX_SHADOW_LIGHTS - self.suns.n_lights}."
            )

    @cached_property
    def on_device(self) -> CastersOnDevice:
        return casters_on_device(self.casters)

    @cached_property
    def alpha_on_device(self) -> tuple[CastersOnDevice, AlphaSurfaces]:
        assert self.alpha is not None
        return casters_on_device(self.alpha.casters), alpha_on_device(self.alpha)

    @cached_property
    def together(self) -> Casters:
        """All casters, whatever they let through."""
        return self.casters if self.alpha is None else SceneCasters(self.casters, self.alpha).together

    @cached_property
    def bias_m(self) -> float:
        """By which samples move toward the light: a share of the extent of all casters."""
        return default_bias_m(self.together)

    def blending(self, config: Configuration) -> Casting:
        """What alpha casters do to light; `opaque` also where there are none.

        **Raises:** `InputError` where there are, and the technique cannot cast by them.
        """
        casting: Casting = config["blending"] if self.alpha is not None else "opaque"  # type: ignore[assignment]
        if casting != "opaque" and config.technique in STENCIL_NAMES:
            raise InputError(
                f"technique `{config.technique}`: a stencil cannot cast by this scene's alpha-masked and blended "
                "triangles; use ptsv or cluster_hierarchy, or blending=opaque, with which only opaque ones cast."
            )
        return casting

    def cannot_cast(self, techniques: Iterable[str]) -> dict[str, str]:
        """Those of some techniques whose defaults cannot cast by these casters, and why not."""
        stencils = [name for name in techniques if name in STENCIL_NAMES] if self.alpha is not None else []
        return dict.fromkeys(stencils, "a stencil cannot cast by alpha-masked and blended triangles")

    @cached_property
    def rays(self) -> ShadowRays:
        return ShadowRays(self.casters)


def shadow_scene(scene: Scene, suns: DirectionalLights, n_lights: int, seed: int = 0) -> ShadowScene:
    """Of a scene with materials: all its triangles cast."""
    casters = scene_casters(scene)
    return ShadowScene(
        casters.opaque, suns, n_lights, casters.alpha if casters.alpha.casters.n_triangles else None, seed
    )
