"""The views of the shadow campaign: scenes at full size, three frames of a path, three lights; what is right on each.

Triangles are padded to few counts, and all views have one size, so that scenes share programs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.device_rays import BY_ITSELF, SHADOWED, answers
from vtfs.camera import CameraPath, Viewport, load_cameras
from vtfs.gallery import GALLERY, build_scene
from vtfs.input_error import InputError
from vtfs.scene import Scene, load_scene
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight
from vtfs.shadow_mask import (
    CastersOnDevice,
    ShadowFrame,
    casters_on_device,
    default_bias_m,
    facing_samples,
    shadow_frame,
)
from vtfs.shadow_references import facing_light, is_excused, kept_casters, view_points_m
from vtfs.shadow_techniques import shadow_grid
from vtfs.tracer import Tracer
from vtfs.view_samples import ViewSamples, trace_view_samples

SIZES = (2**16, 2**18, 2**19, 2**20)
"""Triangles on the device."""

LIGHTS = ("inside", "above", "at the eye")
"""The last one behind the camera on every other frame."""

MOST_CLASSIFIED = 400


class Once:
    """Values that are made once, however many threads ask."""

    def __init__(self) -> None:
        self._lock, self._of_key, self._made = threading.Lock(), {}, {}

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        with self._lock:
            lock = self._of_key.setdefault(key, threading.Lock())
        with lock:
            if key not in self._made:
                self._made[key] = make()
            return self._made[key]


class Subject:
    """A scene, its casters on the device, and the views of it.

    All triangles that are not blended cast, masked ones as if they were solid.
    """

    def __init__(self, name: str, folder: Path | None, viewport: Viewport | None, n_triangles: int | None = None):
        self.name, self._viewport, self._views = name, viewport, Once()
        if name in GALLERY:
            self.scene: Scene = build_scene(name, n_triangles)
            path = self.scene.cameras
        else:
            if folder is None:
                raise InputError(f"scene `{name}`: not built in; give the folder of {name}.glb by --scenes.")
            self.scene = load_scene(folder / f"{name}.glb")
            path = load_cameras(folder / f"{name}.cameras.json")
        assert path is not None
        self.path: CameraPath = path
        solid = np.array([material.alpha_mode != "blend" for material in self.scene.materials])
        casts = solid[self.scene.material_index]
        self.casters = Casters(self.scene.vertices_m, self.scene.triangles[casts])
        self.caster_of_triangle = np.where(casts, np.cumsum(casts) - 1, -1)
        self.n_padded = next(size for size in SIZES if size >= self.casters.n_triangles)

    @cached_property
    def _tracer(self) -> Tracer:
        return Tracer(self.scene)

    @cached_property
    def _on_device(self) -> CastersOnDevice:
        """Padded by triangles without area, which cast nothing. Edges are for stencils, which are not asked here."""
        vertices, triangles = np.zeros((3 * self.n_padded, 3)), np.zeros((self.n_padded, 3), np.int32)
        if len(self.casters.vertices_m) > len(vertices):
            raise InputError(f"scene `{self.name}`: has more than three vertices a triangle; weld it.")
        vertices[: len(self.casters.vertices_m)] = self.casters.vertices_m
        triangles[: self.casters.n_triangles] = self.casters.triangles
        sent = casters_on_device(Casters(vertices, triangles))
        with jax.enable_x64(True):
            no_edges = jax.device_put(np.full((1, 4), -1, np.int32))
        return replace(sent, edges=no_edges)

    def _samples(self, frame: int, n_frames: int) -> ViewSamples:
        camera = self.path.camera(frame * len(self.path.poses) // n_frames)
        if self._viewport is not None:
            camera = replace(camera, viewport=self._viewport)
        return trace_view_samples(self.scene, camera, self._views.get("tracer", lambda: self._tracer))

    def view(self, frame: int, n_frames: int, light: str) -> View:
        """The view of a frame by a light; made once."""
        samples = self._views.get(frame, lambda: self._samples(frame, n_frames))
        return self._views.get((frame, light), lambda: self._view(samples, frame, light))

    def _view(self, samples: ViewSamples, frame: int, light: str) -> View:
        placed = self._light(samples, frame, light)
        receives, bias_m = facing_samples(samples, placed), default_bias_m(self.casters)
        casters = self._views.get("on device", lambda: self._on_device)
        sent = shadow_frame(samples, casters, placed, shadow_grid(samples, 8), bias_m, receives)
        own = self.caster_of_triangle[samples.triangle[receives]]
        return View(self, frame, light, samples, placed, receives, bias_m, own, sent, Once())

    def _light(self, samples: ViewSamples, frame: int, light: str) -> ShadowLight:
        low, high = self.scene.bounds_m
        if light == "inside":
            return ShadowLight(tuple(low + (high - low) * np.array([0.45, 0.8, 0.55])))
        if light == "above":
            return ShadowLight(tuple(low + (high - low) * np.array([0.3, 1.6, 0.6])))
        eye, target = np.array(samples.camera.eye_m), np.array(samples.camera.target_m)
        back = (eye - target) / np.linalg.norm(eye - target)
        return ShadowLight(tuple(eye + back * (frame % 2) * 0.02 * self.casters.extent_m))


@dataclass(frozen=True)
class View:
    """Samples of one frame before one light; `own`: the caster that each receiving sample lies on."""

    subject: Subject
    frame: int
    light_name: str
    samples: ViewSamples
    light: ShadowLight
    receives: np.ndarray
    bias_m: float
    own: np.ndarray
    sent: ShadowFrame
    made: Once

    @property
    def eye_m(self) -> np.ndarray:
        return np.array(self.samples.camera.eye_m)

    @property
    def points_m(self) -> np.ndarray:
        return self.made.get("points", lambda: view_points_m(self.samples, self.receives))

    def shadow_frame(self, tile_px: int, depth_slices: int, front_faces: FrontFaces) -> ShadowFrame:
        """What a program starts from; all on the device but a few numbers."""
        grid = shadow_grid(self.samples, tile_px, depth_slices)
        with jax.enable_x64(True):
            culls = jax.device_put(np.bool_(front_faces == "culled"))
        return replace(self.sent, grid=grid, culls_front=culls)

    def reference(self, front_faces: FrontFaces) -> np.ndarray:
        """`benchmarks.device_rays.answers` of all samples that receive."""

        def ask() -> np.ndarray:
            casters = self.subject.casters
            casts = ~facing_light(casters, self.light) if front_faces == "culled" else None
            return answers(self.points_m, self.own, casters, self.light, self.bias_m, self.eye_m, casts)

        return self.made.get(("reference", front_faces), ask)

    def judged(self, mask: np.ndarray, front_faces: FrontFaces) -> dict[str, int]:
        """Where a mask of the image differs from the reference, by reason.

        - `by_itself`: samples that only their own triangle meets, which the reference leaves lit. The techniques know
          no own triangle: those of them that a mask has in shadow differ by their `own_plane`.
        - `near_edge`, `near_plane`: what else differs, where a sample that is moved within the band has the answer
          (`is_excused`: that some edge or plane is near excuses nothing, as every sample lies on a plane).
        - `errors`: neither; also what receives nothing and yet is in shadow.
        """
        reference, found = self.reference(front_faces), mask[self.receives]
        differs = np.flatnonzero(found != (reference == SHADOWED))
        own = (reference[differs] == BY_ITSELF) & found[differs]
        asked = differs[~own]
        reasons = self._reasons(asked[:MOST_CLASSIFIED], found, front_faces)
        return {
            "samples": len(reference),
            "shadowed": int((reference == SHADOWED).sum()),
            "by_itself": int((reference == BY_ITSELF).sum()),
            "differs": len(differs),
            "own_plane": int(own.sum()),
            "near_edge": reasons.count("edge"),
            "near_plane": reasons.count("plane"),
            "errors": reasons.count("error") + int(mask[~self.receives].sum()),
            "not_classified": len(asked) - len(reasons),
        }

    def _reasons(self, indices: np.ndarray, found: np.ndarray, front_faces: FrontFaces) -> list[str]:
        """Of each sample that differs; a reference has two answers, so that a sample's reason does not depend on who
        asks."""
        known: dict[int, str] = self.made.get(("reasons", front_faces), dict)
        new = np.array([index for index in indices.tolist() if index not in known], int)
        if len(new):
            casters, own = self.subject.casters, self.own[new]
            if front_faces == "culled":
                casts = ~facing_light(casters, self.light)
                own = np.where((own >= 0) & casts[own], np.cumsum(casts)[own] - 1, -1)
                casters = kept_casters(casters, self.light, front_faces)
            by_edge, by_plane = is_excused(
                self.points_m[new], found[new], casters, self.light, self.bias_m, own, self.eye_m
            )
            for index, is_edge, is_plane in zip(new.tolist(), by_edge, by_plane, strict=True):
                known[index] = "edge" if is_edge else "plane" if is_plane else "error"
        return [known[index] for index in indices.tolist()]
