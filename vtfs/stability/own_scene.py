"""The ladders on a user's own casters and camera, as far as they make sense there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vtfs.camera import Camera
from vtfs.input_error import InputError
from vtfs.lights import Lights
from vtfs.scene_setup import SceneSetup
from vtfs.shadow_casters import BIAS, Casters, ShadowLight
from vtfs.shadow_mask import facing_samples
from vtfs.shadow_references import brute_force, view_points_m
from vtfs.stability.ladder import Ladder, Rung, power_of_ten
from vtfs.stability.light_methods import N_LIGHTS, LightCase
from vtfs.stability.shadow_ladders import OFFSET_WAY
from vtfs.stability.stage import VIEWPORT, ShadowCase, point_light
from vtfs.view_samples import ViewSamples

_MOST_PAIRS = 4e8
"""Of a sample and a triangle, on a rung: three seconds of brute force on two cores."""


@dataclass(frozen=True)
class OwnScene:
    """A frame of the user's scene, its opaque casters and one of its lights.

    - `own_triangle`: the caster on which each sample lies, `[h, w]`, -1 for none. `description`: for the record.
    """

    name: str
    samples: ViewSamples
    casters: Casters
    own_triangle: np.ndarray
    light: ShadowLight
    lights: Lights
    description: dict[str, Any]

    def shadow_ladders(self) -> tuple[Ladder[ShadowCase], ...]:
        """Offset, scale, planes of the view, and a light that comes to the camera."""
        eye, extent_m = np.array(self.samples.camera.eye_m), self.casters.extent_m
        camera = self.samples.camera
        way = np.array(self.light.position_m) - eye
        way /= max(float(np.linalg.norm(way)), 1e-300)

        def moved(scale: float, offset_m: np.ndarray) -> ShadowCase:
            return self._case(_moved(self.samples, scale, offset_m), scale, offset_m, self.light)

        def seen_by(near_m: float, far_m: float) -> ShadowCase:
            return self._case(_with_planes(self.samples, near_m, far_m), 1.0, np.zeros(3), self.light)

        def lit_from(position_m: np.ndarray) -> ShadowCase:
            return self._case(self.samples, 1.0, np.zeros(3), point_light(position_m))

        def of(name: str, title: str, rungs: list[tuple[str, Callable[[], ShadowCase]]]) -> Ladder[ShadowCase]:
            return Ladder(name, title, self.name, tuple(Rung(label, make) for label, make in rungs))

        unit = extent_m / 10
        return (
            of(
                "offset",
                "Offset from the origin, over a tenth of the extent",
                [
                    ("0", lambda: moved(1.0, np.zeros(3))),
                    *((power_of_ten(e), lambda e=e: moved(1.0, OFFSET_WAY * unit * 10.0**e)) for e in range(7)),
                ],
            ),
            of(
                "scale",
                "Scale of everything",
                [(power_of_ten(e), lambda e=e: moved(10.0**e, np.zeros(3))) for e in range(-3, 7)],
            ),
            of(
                "light_to_camera",
                "Light at the camera, distance over the extent",
                [
                    *(
                        (power_of_ten(e), lambda e=e: lit_from(eye + way * extent_m * 10.0**e))
                        for e in (0, -1, -2, -4, -6, -8)
                    ),
                    ("0", lambda: lit_from(eye)),
                ],
            ),
            of(
                "near",
                "Near plane, over the extent",
                [
                    (power_of_ten(e), lambda e=e: seen_by(min(extent_m * 10.0**e, camera.far_m / 2), camera.far_m))
                    for e in (-3, -4, -5, -6, -8, -10, -20)
                ],
            ),
            of(
                "far",
                "Far plane, over the extent",
                [
                    *(
                        (power_of_ten(e), lambda e=e: seen_by(camera.near_m, extent_m * 10.0**e))
                        for e in (1, 2, 4, 6, 9, 12)
                    ),
                    ("infinite", lambda: seen_by(camera.near_m, np.inf)),
                ],
            ),
        )

    def light_ladders(self) -> tuple[Ladder[LightCase], ...]:
        """Offset and scale of the view with its own lights."""

        def moved(scale: float, offset_m: np.ndarray) -> LightCase:
            lights = replace(
                self.lights, position_m=self.lights.position_m * scale + offset_m, range_m=self.lights.range_m * scale
            )
            return LightCase(_moved(self.samples, scale, offset_m), lights)

        unit = self.casters.extent_m / 10
        offsets = [("0", 0.0), *((power_of_ten(e), 10.0**e) for e in range(7))]
        scales = [(power_of_ten(e), 10.0**e) for e in range(-3, 7)]
        title = "Offset from the origin, over a tenth of the extent"
        return (
            Ladder(
                "offset", title, self.name,
                tuple(Rung(label, lambda o=o: moved(1.0, OFFSET_WAY * o * unit)) for label, o in offsets),
            ),
            Ladder(
                "scale", "Scale of everything", self.name,
                tuple(Rung(label, lambda s=s: moved(s, np.zeros(3))) for label, s in scales),
            ),
        )  # fmt: skip

    def _case(self, samples: ViewSamples, scale: float, offset_m: np.ndarray, light: ShadowLight) -> ShadowCase:
        casters = self.casters
        if scale != 1 or offset_m.any():
            casters = Casters(casters.vertices_m * scale + offset_m, casters.triangles)
            light = point_light(np.array(light.position_m) * scale + offset_m)
        bias_m = BIAS * self.casters.extent_m * scale
        return ShadowCase(samples, casters, light, bias_m, _tested(samples, casters), self.own_triangle)


def own_scene(setup: SceneSetup, seed: int) -> OwnScene:
    """The first frame of a scene, at the size of the ladders.

    **Raises:** `InputError` where the scene is a G-buffer, which has no casters, or the frame shows none.
    """
    scene = setup.scene
    if scene is None:
        raise InputError(f"{setup.name}: a G-buffer has no casters; give a scene file, or no scene at all.")
    setup = replace(setup, cameras=setup.cameras.resized(VIEWPORT))
    samples = setup.samples(0)
    opaque = np.array([material.alpha_mode == "opaque" for material in scene.materials])[scene.material_index]
    casters = Casters(scene.vertices_m, scene.triangles[opaque])
    if not casters.n_triangles or not samples.n_valid:
        raise InputError(f"{setup.name}: frame 0 shows no opaque triangle; give --cameras that do.")
    number = np.append(np.where(opaque, np.cumsum(opaque) - 1, -1), -1)
    # What hangs before the sample and is no caster leaves it without a triangle of its own.
    own_triangle = number[samples.triangle]
    lights = setup.lights
    some = np.random.default_rng(seed).permutation(lights.n_lights)[:N_LIGHTS]
    lights = replace(lights, **{name: getattr(lights, name)[some] for name in lights.__dataclass_fields__})
    light = _telling_light(samples, casters, lights.position_m, scene.bounds_m)
    description = {
        "name": setup.name,
        "key": scene.key,
        "triangles": scene.n_triangles,
        "casters": casters.n_triangles,
        "light_m": list(light.position_m),
    }
    return OwnScene(setup.name, samples, casters, own_triangle, light, lights, description)


def _telling_light(
    samples: ViewSamples, casters: Casters, position_m: np.ndarray, bounds_m: tuple[np.ndarray, np.ndarray]
) -> ShadowLight:
    """The light, of the scene's or of some high in its box, by which two fifths of some samples are in shadow, or
    nearly so: where all are lit or dark, little can go wrong."""
    low, high = bounds_m
    shares = np.array([[x, 0.85, z] for x in (0.2, 0.5, 0.8) for z in (0.2, 0.5, 0.8)])
    candidates = [point_light(p) for p in np.concatenate([position_m[:8], low + (high - low) * shares])]
    eye = np.array(samples.camera.eye_m)
    few = np.zeros(samples.valid.shape, bool)
    few[::5, ::5] = True

    def miss(light: ShadowLight) -> float:
        receives = facing_samples(samples, light) & few
        points = view_points_m(samples, receives)
        if not len(points):
            return 1.0
        return abs(brute_force(points, casters, light, BIAS * casters.extent_m, eye).mean() - 0.4)

    return min(candidates, key=miss)


def _tested(samples: ViewSamples, casters: Casters) -> np.ndarray:
    """All samples, or evenly spaced ones where brute force would take too long."""
    step = max(1, int(np.ceil(samples.valid.size * casters.n_triangles / _MOST_PAIRS)))
    tested = np.zeros(samples.valid.size, bool)
    tested[::step] = True
    return tested.reshape(samples.valid.shape)


def _moved(samples: ViewSamples, scale: float, offset_m: np.ndarray) -> ViewSamples:
    """The same image of everything scaled about the origin, then moved."""
    camera = samples.camera

    def at(point: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = (float(c) for c in np.asarray(point) * scale + offset_m)
        return x, y, z

    moved = replace(
        camera,
        eye_m=at(camera.eye_m),
        target_m=at(camera.target_m),
        near_m=camera.near_m * scale,
        far_m=camera.far_m * scale,
    )
    return replace(samples, camera=moved, position_m=(samples.position_m * scale).astype(np.float32))


def _with_planes(samples: ViewSamples, near_m: float, far_m: float) -> ViewSamples:
    camera: Camera = replace(samples.camera, near_m=near_m, far_m=far_m)
    depth_m = -samples.position_m[..., 2]
    return replace(samples, camera=camera, valid=samples.valid & (depth_m >= near_m) & (depth_m <= far_m))
