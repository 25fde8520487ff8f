"""What the shadow techniques start from on one frame: casters, the lights that cast, and a task for each light."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from vtfs.alpha_casters import (
    AlphaSurfaces,
    Blending,
    Casting,
)
from vtfs.configurations import Configuration
from vtfs.gbuffer import Fragments, to_runs
from vtfs.input_error import InputError
from vtfs.layers import Layers
from vtfs.light_shadows import MAX_SHADOW_LIGHTS, CastMask, ShadowSlots
from vtfs.lights import Lights
from vtfs.shadow_casters import FrontFaces, ShadowLight, require_near
from vtfs.shadow_mask import (
    CastersOnDevice,
    ShadowFrame,
    facing_samples,
    shadow_frame,
)
from vtfs.shadow_references import ShadowRays, brute_force, kept_casters, view_points_m
from vtfs.shadow_scene import ShadowScene
from vtfs.shadow_techniques import grid_of
from vtfs.shadow_volumes.volumes import rotated
from vtfs.transmittance_references import brute_force_transmittance

if TYPE_CHECKING:
    from vtfs.view_samples import ViewSamples

_RANKED_SAMPLES = 4096
"""Of a frame, by which its lights are ranked."""


class AlphaTask(eqx.Module):
    """What alpha casters of one light on one view are; `stream`: of random bits, see `transmit`."""

    casters: CastersOnDevice
    surfaces: AlphaSurfaces
    stream: UInt32[Array, " 2"]


class ShadowTask(eqx.Module):
    """The shadow of one light on one view: the solid samples, or a transparent layer.

    - `frame`: which samples receive shadow is not known yet: all that are valid do.
    - `range_m`: beyond it the light lights nothing; infinite for a directional one.
    - `alpha`: None where no alpha casters cast.
    """

    frame: ShadowFrame
    normal: tuple[Float[Array, "runs 32"], ...]
    range_m: Float[Array, ""]
    alpha: AlphaTask | None = None


def with_receivers(task: ShadowTask) -> ShadowFrame:
    """Only samples that the light would light are tested: in its range, and not turned away from it. Inside of
    `jax.enable_x64(True)`."""
    frame = task.frame
    from_eye = frame.light_m if frame.directional else frame.light_m - frame.eye_m
    light = tuple(c.astype(jnp.float32) for c in rotated(frame, tuple(from_eye)))
    at = frame.positions.x_m, frame.positions.y_m, frame.positions.z_m
    to = light if frame.directional else tuple(c - p for c, p in zip(light, at, strict=True))
    faces = sum(n * t for n, t in zip(task.normal, to, strict=True)) > 0
    if not frame.directional:
        faces &= sum(t * t for t in to) < task.range_m * task.range_m
    return eqx.tree_at(lambda f: f.receives, frame, frame.receives & faces)


def alpha_frame(task: ShadowTask, shadowed: Bool[Array, "runs 32"]) -> ShadowFrame:
    """What alpha casters start from: samples that opaque ones leave lit. Inside of `jax.enable_x64(True)`."""
    assert task.alpha is not None
    frame, casters = with_receivers(task), task.alpha.casters
    return replace(
        frame,
        receives=frame.receives & ~shadowed,
        vertex_m=casters.vertex_m,
        triangles=casters.triangles,
        edges=casters.edges,
        culls_front=jnp.bool_(False),  # panes and leaves are not closed
    )


def brightest_lights(samples: ViewSamples, lights: Lights, n: int) -> np.ndarray:
    """The `n` lights that light the visible samples most, brightest first; fewer where fewer light any.

    Irradiance, mean over the colours, summed over at most 4,096 evenly spaced samples: solid ones, or those of
    transparent layers where there are no others.
    """
    views = (samples, *(layer.samples for layer in samples.layers.transparent))
    seen = next((view for view in views if view.valid.any()), samples)
    at = np.flatnonzero(seen.valid.ravel())
    at = at[:: max(1, -(-len(at) // _RANKED_SAMPLES))]
    position, normal = (c.reshape(-1, 3)[at].astype(np.float64) for c in (seen.position_m, seen.normal))
    view = lights.relative_to(samples.camera.view_from_world)
    light_of_all = np.zeros(lights.n_lights)
    for light in np.flatnonzero(view.range_m > 0):
        to = view.position_m[light] - position
        squared = np.maximum((to * to).sum(axis=1), 1e-300)
        near = squared < view.range_m[light] ** 2
        to, squared, facing = to[near], squared[near], normal[near]
        along = -(to @ view.direction[light]) / np.sqrt(squared)
        cone = (along - view.cos_outer[light]) / (view.cos_inner[light] - view.cos_outer[light])
        window = (1 - (squared / view.range_m[light] ** 2) ** 2) ** 2
        arriving = np.maximum((to * facing).sum(axis=1), 0) / np.sqrt(squared) * window / np.maximum(squared, 1e-4)
        light_of_all[light] = (arriving * cone.clip(0, 1)).sum() * view.colour[light].mean()
    ranked = np.argsort(-light_of_all, kind="stable")[:n]
    return ranked[light_of_all[ranked] > 0]


class FrameShadows:
    """Lights that cast on one frame, its views, and their tasks on the device.

    - `views`: the solid samples, then each transparent layer.
    - `lights`, `range_m`: in the order of their slots, directional ones first.
    - `slot`: of each light with a place its slot; -1 where it casts nothing.
    """

    def __init__(self, scene: ShadowScene, samples: ViewSamples, lights: Lights):
        self.scene = scene
        self.views = (samples, *(layer.samples for layer in samples.layers.transparent))
        suns = scene.suns
        chosen = brightest_lights(samples, lights, scene.n_lights)
        for place in lights.position_m[chosen].tolist():
            require_near(ShadowLight(tuple(place)), scene.together)
        if not len(chosen) and not suns.n_lights:
            # A frame that no light lights is a dark frame of its path: one of them casts on no sample.
            chosen = np.flatnonzero(lights.range_m > 0)[: min(scene.n_lights, 1)]
        self.slot = np.full(max(lights.n_lights, 1), -1, np.int32)  # no light at all is one without range
        self.slot[chosen] = suns.n_lights + np.arange(len(chosen))
        self.lights = (
            *(ShadowLight(tuple(toward), directional=True) for toward in suns.toward.tolist()),
            *(ShadowLight(tuple(place)) for place in lights.position_m[chosen].tolist()),
        )
        self.range_m = np.concatenate([np.full(suns.n_lights, np.inf), lights.range_m[chosen]])
        if not self.lights:
            raise InputError("no light casts shadows; give --shadow-lights 1 or more, and lights that have a range.")

    @cached_property
    def slots(self) -> ShadowSlots:
        """Upload which light has which bit."""
        rotation = self.views[0].camera.view_from_world[:3, :3]
        suns = self.scene.suns
        row = np.concatenate([suns.toward @ rotation.T, suns.colour], axis=1).astype(np.float32)
        return ShadowSlots(jax.device_put(self.slot), jax.device_put(row), len(self.lights))

    @cached_property
    def bias_m(self) -> float:
        return self.scene.bias_m

    @cached_property
    def _deepest_m(self) -> float:
        depths = [-view.position_m[..., 2][view.valid].min(initial=-view.camera.near_m) for view in self.views]
        return float(max(depths))

    @cached_property
    def _on_device(self) -> tuple:
        alone = [replace(view, layers=Layers()) for view in self.views]
        fragments = [Fragments(view, with_hidden=False) for view in alone]
        positions = [own.positions() for own in fragments]
        return tuple((own, part.gbuffer(own, "float32").normal) for part, own in zip(fragments, positions, strict=True))

    def _alpha_task(self, casting: Casting, view: int, slot: int) -> AlphaTask | None:
        if casting == "opaque":
            return None
        stream = np.array(self.stream(view, slot), np.uint32)
        return AlphaTask(*self.scene.alpha_on_device, jax.device_put(stream))

    def stream(self, view: int, slot: int) -> tuple[int, int]:
        """Of random bits: every view and light has its own."""
        return self.scene.seed % 2**32, view * MAX_SHADOW_LIGHTS + slot

    def tasks(self, config: Configuration, counted: bool = False) -> list[ShadowTask]:
        """For each view the tasks of all slots.

        **Arguments:**

        - `counted`: see `ShadowFrame`.

        **Raises:** `InputError`, see `ShadowScene.blending`.
        """
        casting = self.scene.blending(config)
        params = config.params
        camera = self.views[0].camera
        grid = grid_of(camera, self._deepest_m, int(params["tile_px"]), int(params.get("depth_slices", 0)))
        front_faces: FrontFaces = params["front_faces"]  # type: ignore[assignment]
        tasks = []
        for v, (view, (positions, normal)) in enumerate(zip(self.views, self._on_device, strict=True)):
            for k, (light, range_m) in enumerate(zip(self.lights, self.range_m, strict=True)):
                frame = shadow_frame(
                    view, self.scene.on_device, light, grid, self.bias_m, None, front_faces, positions, counted
                )
                alpha = self._alpha_task(casting, v, k)
                tasks.append(ShadowTask(frame, normal, jax.device_put(np.float32(range_m)), alpha))
        return tasks

    def reference_masks(self, config: Configuration) -> list[CastMask]:
        """Masks of a reference technique, in the order of `tasks`, in runs."""
        front_faces: FrontFaces = config["front_faces"]  # type: ignore[assignment]
        casting = self.scene.blending(config)
        masks = []
        for v, view in enumerate(self.views):
            for k in range(len(self.lights)):
                mask = self.reference(view, k, config.technique, front_faces)
                left: tuple[np.ndarray, ...] = ()
                if casting != "opaque":
                    lit = self.lit_by(view, k) & ~mask
                    left = tuple(np.moveaxis(self.reference_light(v, k, lit, casting)[0], -1, 0))
                channels = tuple(jax.device_put(to_runs(channel.astype(np.float32))) for channel in left)
                masks.append(CastMask(jax.device_put(to_runs(mask)), jax.device_put(np.bool_(False)), channels))
        return masks

    def reference_light(self, v: int, k: int, some: np.ndarray, blending: Blending) -> tuple[np.ndarray, np.ndarray]:
        """What alpha casters leave of the light of a slot on some samples `[h, w]` of a view, in float64.

        **Returns:** `[h, w, channels]`, one or three, 1 on the other samples; and `[h, w]` the distance of the nearest
        decision from its threshold, see `ReferenceLight`.
        """
        assert self.scene.alpha is not None
        view = self.views[v]
        points, eye_m = view_points_m(view, some), np.array(view.camera.eye_m)
        pixel, stream = np.flatnonzero(some.ravel()), self.stream(v, k)
        found = brute_force_transmittance(
            points, self.scene.alpha, self.lights[k], self.bias_m, eye_m, blending, pixel, stream
        )
        left = np.ones((*some.shape, 3 if blending == "coloured" else 1))
        left[some] = found.transmittance.reshape(len(points), left.shape[-1])
        margin = np.full(some.shape, np.inf)
        margin[some] = found.cutoff_margin
        return left, margin

    def lit_by(self, view: ViewSamples, k: int) -> np.ndarray:
        """Samples of a view that the light of a slot would light: bool `[h, w]`, in float64."""
        light, range_m = self.lights[k], self.range_m[k]
        lit = facing_samples(view, light)
        if not light.directional:
            matrix = view.camera.view_from_world
            place = matrix[:3, :3] @ np.array(light.position_m) + matrix[:3, 3]
            lit &= ((place - view.position_m.astype(np.float64)) ** 2).sum(axis=-1) < range_m**2
        return lit

    def reference(self, view: ViewSamples, k: int, name: str, front_faces: FrontFaces) -> np.ndarray:
        """Samples of a view in the shadow of the light of a slot, bool `[h, w]`, by `shadow_rays` or `brute_force`."""
        lit = self.lit_by(view, k)
        points, eye_m = view_points_m(view, lit), np.array(view.camera.eye_m)
        light = self.lights[k]
        casters = kept_casters(self.scene.casters, light, front_faces)
        if name == "brute_force":
            shadowed = brute_force(points, casters, light, self.bias_m, eye_m)
        else:
            shadowed = self._rays(light, front_faces).shadowed(points, light, self.bias_m, eye_m)
        mask = np.zeros(lit.shape, bool)
        mask[lit] = shadowed
        return mask

    def _rays(self, light: ShadowLight, front_faces: FrontFaces) -> ShadowRays:
        if front_faces == "cast":
            return self.scene.rays
        return ShadowRays(kept_casters(self.scene.casters, light, front_faces))


@jax.jit
def _receiving(task: ShadowTask) -> ShadowFrame:
    return with_receivers(task)


def receiving(task: ShadowTask) -> ShadowFrame:
    """`with_receivers`, as a program of its own."""
    with jax.enable_x64(True):
        return _receiving(task)


@jax.jit
def _alpha_frame(task: ShadowTask, shadowed: Bool[Array, "runs 32"]) -> ShadowFrame:
    return alpha_frame(task, shadowed)


def alpha_receiving(task: ShadowTask, shadowed: Bool[Array, "runs 32"]) -> ShadowFrame:
    """`alpha_frame`, as a program of its own."""
    with jax.enable_x64(True):
        return _alpha_frame(task, shadowed)
