"""The cases of the shadow benchmarks: views of scenes, and rolling ground with clumps of leaf triangles."""

from __future__ import annotations

import argparse
import functools
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from vtfs.camera import Camera, CameraPath, Pose, Viewport, load_cameras
from vtfs.gallery import GALLERY, build_scene
from vtfs.scene import Material, Scene, load_scene
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight
from vtfs.shadow_mask import (
    CastersOnDevice,
    ShadowFrame,
    ShadowMask,
    ShadowPlan,
    default_bias_m,
    facing_samples,
    shadow_frame,
)
from vtfs.shadow_programs import counting_program
from vtfs.shadow_techniques import shadow_grid
from vtfs.view_samples import ViewSamples, trace_view_samples

LIGHT = ShadowLight((10.0, 30.0, -20.0))

FULL_TREE_SLICES = 512
"""Of a full tree at 1024 squared: one of cubic cells does not fit."""


def clumps_scene(n_triangles: int, seed: int = 0) -> Scene:
    """Ground of 64 x 64 quads, and the rest small single triangles, normally distributed about 40 places above it."""
    rng = np.random.default_rng(seed)
    n = 64
    x, depth = np.meshgrid(np.linspace(-60, 60, n + 1), np.linspace(2, 120, n + 1), indexing="ij")
    height = -6 + np.sin(x / 6) + 0.8 * np.cos(depth / 5)
    ground = np.stack([x, height, -depth], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = np.concatenate(
        [
            np.stack([corner, corner + n + 1, corner + n + 2], axis=1),
            np.stack([corner, corner + n + 2, corner + 1], axis=1),
        ]
    )
    middles = np.stack([rng.uniform(-30, 30, 40), rng.uniform(-2, 4, 40), -rng.uniform(10, 80, 40)], axis=1)
    n_leaves = n_triangles - len(quads)
    first = middles[rng.integers(0, 40, n_leaves)] + rng.normal(0, 1.2, (n_leaves, 3))
    edges = rng.normal(0, 0.15, (2, n_leaves, 3))
    leaves = np.stack([first, first + edges[0], first + edges[1]], axis=1).reshape(-1, 3)
    triangles = np.concatenate([quads, len(ground) + np.arange(3 * n_leaves).reshape(-1, 3)])
    return Scene(
        f"clumps {n_triangles}", np.concatenate([ground, leaves]), triangles, None,
        np.zeros(len(triangles), np.int32), (Material("matt"),), clumps_path(),
    )  # fmt: skip


def clumps_path() -> CameraPath:
    return CameraPath(
        Viewport(1024, 1024), 60.0, 0.1, 400.0, (Pose((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),)
    )


def at_size(camera: Camera, size_px: int) -> Camera:
    """The same view, square."""
    return Camera(
        camera.eye_m, camera.target_m, camera.up, camera.fov_y_deg, camera.near_m,
        camera.far_m if math.isfinite(camera.far_m) else 1e4, Viewport(size_px, size_px),
    )  # fmt: skip


def with_room(plan: ShadowPlan, n_triangles: int, times: int = 1) -> ShadowPlan:
    """A plan to size on a GPU, where memory is at hand and each step up compiles; on a CPU the plan itself.

    The capacities hold all but the largest views of a million pixels; `times`: so much more.
    """
    if jax.default_backend() == "cpu":
        return plan
    groups = max(times * 2**19, 2 * n_triangles)
    return replace(plan, groups=groups, leaf_groups=times * 2**22, pairs=times * 2**21 if plan.passes == 2 else 0)


def run_alone(
    technique: str, frame: ShadowFrame, one_at_once: threading.Lock
) -> Callable[[ShadowPlan, int], ShadowMask]:
    """What `fitted_to_all` runs: programs are compiled side by side, and run one after the other."""

    def run(plan: ShadowPlan, _: int) -> ShadowMask:
        with jax.enable_x64(True):
            program = counting_program(technique, plan).lower(frame).compile()
            with one_at_once:
                return jax.block_until_ready(program(frame))

    return run


def scene_arguments(description: str | None, minutes: float) -> argparse.ArgumentParser:
    """What benchmarks of several scenes take: SCENE[,SCENE...], `named_case`, for so many minutes."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--triangles", type=int, default=60_000)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--minutes", type=float, default=minutes)
    parser.add_argument("--workers", type=int, default=1)
    return parser


@dataclass(frozen=True)
class Case:
    """One view of one scene with one light."""

    name: str
    samples: ViewSamples
    casters: Casters
    light: ShadowLight
    receives: np.ndarray
    bias_m: float

    def frame(
        self, casters: CastersOnDevice, tile_px: int, depth_slices: int = 0, front_faces: FrontFaces = "cast"
    ) -> ShadowFrame:
        """What a technique takes; `casters` are its own, sent once."""
        grid = shadow_grid(self.samples, tile_px, depth_slices)
        return shadow_frame(self.samples, casters, self.light, grid, self.bias_m, self.receives, front_faces)


@functools.lru_cache
def read_scene(scene_name: str, cameras: str | None, n_triangles: int) -> tuple[Scene, CameraPath]:
    """The clumps, a built-in scene or a file, and its path."""
    if scene_name == "clumps":
        scene = clumps_scene(n_triangles)
    elif scene_name in GALLERY:
        scene = build_scene(scene_name, n_triangles)
    else:
        scene = load_scene(Path(scene_name))
    path = load_cameras(Path(cameras)) if cameras else scene.cameras
    if path is None:
        raise SystemExit(f"{scene_name}: has no cameras; give --cameras FILE.")
    return scene, path


def named_case(name: str, folder: Path | None, n_triangles: int, along: float, size_px: int) -> Case:
    """A view as of `read_case`, of a built-in scene, or of `folder`/NAME.glb with NAME.cameras.json beside it."""
    if name in GALLERY or name == "clumps":
        return read_case(name, None, n_triangles, along, size_px)
    if folder is None:
        raise SystemExit(f"{name}: is not built in; give --scenes FOLDER that has {name}.glb.")
    return read_case(str(folder / f"{name}.glb"), str(folder / f"{name}.cameras.json"), n_triangles, along, size_px)


def read_case(scene_name: str, cameras: str | None, n_triangles: int, along: float, size_px: int) -> Case:
    """A view of the clumps, of a built-in scene or of a file, at a share `along` of its path.

    All triangles that are not blended cast, masked ones as if they were solid. The samples of the clumps are all
    tested, as by the rays that they are compared with, elsewhere those that face the light.
    """
    scene, path = read_scene(scene_name, cameras, n_triangles)
    frame = int(along * len(path.poses))
    samples = trace_view_samples(scene, at_size(path.camera(frame), size_px))
    low, high = scene.bounds_m
    in_scene = ShadowLight(tuple(low + (high - low) * np.array([0.45, 0.8, 0.55])))
    light = LIGHT if scene_name == "clumps" else in_scene
    is_solid = np.array([material.alpha_mode != "blend" for material in scene.materials])
    casters = Casters(scene.vertices_m, scene.triangles[is_solid[scene.material_index]])
    receives = samples.valid if scene_name == "clumps" else facing_samples(samples, light)
    name = f"{scene.name} ({casters.n_triangles:,} triangles, {size_px} squared)"
    return Case(name, samples, casters, light, receives, default_bias_m(casters))
