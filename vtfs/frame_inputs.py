"""What a frame starts from on the device, for every configuration."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import numpy as np

from vtfs.cluster_grid import cluster_grid, configured_grid
from vtfs.configurations import Configuration, lists_configuration
from vtfs.gbuffer import RUN_WIDTH_PX, Fragments, GBuffer, LayerTable, Positions
from vtfs.input_error import InputError
from vtfs.light_assignment.light_tree import reduce_lights, sort_lights
from vtfs.light_lists import ViewLights, view_lights
from vtfs.lights import Lights
from vtfs.morton import morton_codes
from vtfs.shadow_inputs import FrameShadows
from vtfs.shadow_scene import ShadowScene
from vtfs.technique_names import SHADOW_REFERENCES
from vtfs.techniques import REGISTRY
from vtfs.view_samples import ViewSamples

_SCALARS = ("grid", "light_cutoff", "approximate", "frame", "resort_every")


class FrameInputs:
    """One frame on the device: view samples and lights, uploaded once and used by every configuration.

    - `frame`: its number on the path: where `resort_every` divides it, the light tree is sorted.
    - `earlier_lights`: where lights were in an earlier frame, in its view space; where they are now unless given.
    - `shadow_scene`: what casts shadows, for shadow techniques.
    """

    def __init__(
        self,
        samples: ViewSamples,
        lights: Lights,
        frame: int = 0,
        earlier_lights: Callable[[int], ViewLights] | None = None,
        shadow_scene: ShadowScene | None = None,
    ):
        self._shadow_scene = shadow_scene
        self._lights = lights
        self.samples = samples
        self.frame = frame
        self._earlier_lights = earlier_lights
        self._orders: dict[tuple[int, float], jax.Array] = {}
        self._scalars: dict[tuple[str, ...], Any] = {}
        self.camera = samples.camera
        self.viewport = samples.camera.viewport
        self.lights = view_lights(lights, samples.camera)
        self.n_lights = lights.n_lights
        depths = -samples.position_m[..., 2][samples.valid]
        self.deepest_m = float(depths.max(initial=samples.camera.near_m))
        self._fragments: dict[bool, Fragments] = {}
        self._positions: dict[bool, Positions] = {}
        self._gbuffers: dict[tuple[bool, str], GBuffer] = {}

    @cached_property
    def shadows(self) -> FrameShadows:
        """What casts on this frame.

        **Raises:** `InputError` where there is no geometry, or no light that casts.
        """
        if self._shadow_scene is None:
            raise InputError("shadow techniques need the triangles of a scene: give a scene file, not a G-buffer.")
        return FrameShadows(self._shadow_scene, self.samples, self._lights)

    @cached_property
    def layers(self) -> LayerTable:
        return self.fragments(with_hidden=False).layer_table()

    @property
    def has_transparent(self) -> bool:
        return bool(self.fragments(with_hidden=False).n_transparent_runs)

    def fragments(self, with_hidden: bool) -> Fragments:
        if with_hidden not in self._fragments:
            self._fragments[with_hidden] = Fragments(self.samples, with_hidden=with_hidden)
        return self._fragments[with_hidden]

    def positions(self, with_hidden: bool) -> Positions:
        if with_hidden not in self._positions:
            self._positions[with_hidden] = self.fragments(with_hidden).positions()
        return self._positions[with_hidden]

    def gbuffer(self, precision: str, with_hidden: bool) -> GBuffer:
        key = with_hidden, precision
        if key not in self._gbuffers:
            self._gbuffers[key] = self.fragments(with_hidden).gbuffer(self.positions(with_hidden), precision)
        return self._gbuffers[key]

    def order_of(self, frame: int, light_cutoff: float) -> jax.Array:
        """The lights in Morton order of an earlier frame: what that frame left for those after it."""
        if (frame, light_cutoff) not in self._orders:
            lights = self._earlier_lights(frame) if self._earlier_lights else self.lights
            self._orders[frame, light_cutoff] = _morton_order(lights, np.float32(light_cutoff))
        return self._orders[frame, light_cutoff]

    def seen(self) -> np.ndarray:
        """Which pixels show anything: bool `[h, w]`."""
        layers = [layer.samples.valid for layer in self.samples.layers.transparent]
        return np.logical_or.reduce([self.samples.valid, *layers])

    def environment(self, config: Configuration) -> dict[str, Any]:
        """What the stages of a configuration start from, by the names that `Stage.needs` uses."""
        params = lists_configuration(config).params
        technique = REGISTRY[config.technique]
        with_hidden = technique.shades_hidden(config)
        env: dict[str, Any] = {
            "positions": self.positions(with_hidden),
            "gbuffer": self.gbuffer(str(params["gbuffer"]), with_hidden),
            "layers": self.layers,
            "lights": self.lights,
            "light_cutoff": np.float32(params["light_cutoff"]),
            "approximate": np.float32(params.get("approximate", 0)),
            "cluster_light": None,
        }
        resort_every = int(params.get("resort_every", 1))
        if resort_every > 1:
            last_sorted = self.frame - self.frame % resort_every
            env["old_order"] = self.order_of(last_sorted, float(params["light_cutoff"]))
            env |= {"frame": np.int32(self.frame), "resort_every": np.int32(resort_every)}
        if technique.lists == "clusters":
            env["grid"] = configured_grid(self.camera, params, self.deepest_m, technique.one_slice)
            # Only where they are read: each precision of the G-buffer would compile the clusters again.
            has_cones = technique.plan(config).normal_cones == "explicit"
            needs_normals = has_cones or params.get("normal_bins", 0)
            env["normals"] = env["gbuffer"].normal if needs_normals else None
        elif technique.lists == "light_volumes":  # for its pixels
            env["grid"] = cluster_grid(self.camera, RUN_WIDTH_PX, 1, self.deepest_m)
        env |= {name: self._on_device(name, env[name]) for name in _SCALARS if name in env}
        if technique.casts_shadows:
            env["shadow_slots"] = self.shadows.slots
            if config.technique in SHADOW_REFERENCES:
                env["shadow_masks"] = self.shadows.reference_masks(config)
            else:
                env["shadow_tasks"] = self.shadows.tasks(config)
        return env

    def _on_device(self, name: str, scalars: Any) -> Any:
        """Sent once: a dozen scalars, each by itself, would take a GPU 0.3 ms in every frame. The same for the same
        values: see `KeptStages`."""
        key = (name, *map(repr, jax.tree.leaves(scalars)))
        if key not in self._scalars:
            self._scalars[key] = jax.device_put(scalars)
        return self._scalars[key]


@jax.jit
def _morton_order(lights: ViewLights, light_cutoff) -> jax.Array:
    spheres = lights.spheres(light_cutoff)
    return sort_lights(morton_codes(spheres, *reduce_lights(spheres)))
