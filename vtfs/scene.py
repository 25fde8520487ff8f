"""Scenes: triangles in world space with materials, and the files that they come from."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from vtfs.camera import CameraPath
from vtfs.directional_lights import NO_DIRECTIONAL, DirectionalLights
from vtfs.input_error import InputError
from vtfs.lights import Lights

log = logging.getLogger("vtfs.scene")

AlphaMode = Literal["opaque", "mask", "blend"]
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")


@dataclass(frozen=True)
class Material:
    """One surface; the parts of glTF's PBR and of MTL that Blinn-Phong shading uses.

    - `base_colour`, `emissive`: linear. A base colour texture stands here as its mean.
    - `specular`, `shininess`: reflectance at normal incidence and Blinn-Phong exponent.
    - `alpha_mode`: `mask` surfaces are there where `opacity * alpha_image >= alpha_cutoff`; `blend` surfaces belong to
      a transparent layer, and hide `opacity * alpha_image` of what is behind them.
    - `alpha_image`: float32 `[h, w]` in [0, 1], row 0 at v = 0; none where the mode is `opaque`.
    """

    name: str
    base_colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    opacity: float = 1.0
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    specular: float = 0.04
    shininess: float = 32.0
    alpha_mode: AlphaMode = "opaque"
    alpha_image: np.ndarray | None = None
    alpha_cutoff: float = 0.5
    two_sided: bool = False

    def __post_init__(self):
        for name in ("base_colour", "opacity", "emissive", "specular", "shininess", "alpha_cutoff"):
            value = getattr(self, name)
            if not (np.isfinite(value).all() and np.min(value) >= 0):
                raise InputError(f"material `{self.name}` `{name}` = {value}: must be finite and 0 or more.")


@dataclass(frozen=True)
class Scene:
    """Triangles in world space, right-handed, y up.

    - `vertices_m`: float64 `[V, 3]`; `triangles`: int32 `[T, 3]`; `material_index`: int32 `[T]`.
    - `uv`: float32 `[V, 2]`, v = 0 at the first row of an image (as glTF); None where no triangle needs it.
    - `cameras`, `lights`: what the file holds, or None; `suns`: its directional lights.

    **Raises:** `InputError` where vertices are not finite, indices out of range, or there is no triangle.
    """

    name: str
    vertices_m: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray | None
    material_index: np.ndarray
    materials: tuple[Material, ...]
    cameras: CameraPath | None = None
    lights: Lights | None = None
    suns: DirectionalLights = NO_DIRECTIONAL

    def __post_init__(self):
        for name, dtype in (("vertices_m", np.float64), ("triangles", np.int32), ("material_index", np.int32)):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype))
        if len(self.triangles) == 0:
            raise InputError(f"scene `{self.name}`: has no triangles; export a mesh with faces.")
        n_bad = int((~np.isfinite(self.vertices_m)).any(axis=1).sum())
        if n_bad:
            raise InputError(
                f"scene `{self.name}`: {n_bad} of {len(self.vertices_m)} vertices are NaN or infinite; repair the mesh."
            )
        if self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices_m):
            wrong = self.triangles.max() if self.triangles.min() >= 0 else self.triangles.min()
            raise InputError(
                f"scene `{self.name}`: triangle index {wrong} is out of range; has {len(self.vertices_m)} vertices."
            )
        # Embree and the device see float32; what overflows there is no scene.
        largest = float(np.abs(self.vertices_m).max())
        if largest > 1e15:
            raise InputError(f"scene `{self.name}`: a coordinate of {largest:g} m is beyond 1e15; scale the scene.")
        if self.uv is not None:
            uv = np.ascontiguousarray(self.uv, np.float32)
            if uv.shape != (len(self.vertices_m), 2) or not np.isfinite(uv).all():
                raise InputError(f"scene `{self.name}`: texture coordinates must be finite, two for each vertex.")
            object.__setattr__(self, "uv", uv)
        if self.material_index.min() < 0 or self.material_index.max() >= len(self.materials):
            raise InputError(f"scene `{self.name}`: a material index is not in [0, {len(self.materials)}).")

    @property
    def n_triangles(self) -> int:
        return len(self.triangles)

    @cached_property
    def bounds_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner of the vertices that triangles use, float64 `[3]` each."""
        used = self.vertices_m[np.unique(self.triangles)]
        return used.min(axis=0), used.max(axis=0)

    @cached_property
    def diagonal_m(self) -> float:
        low, high = self.bounds_m
        return float(np.linalg.norm(high - low))

    @cached_property
    def key(self) -> str:
        """SHA-256 of triangles and materials, in hexadecimal; names, cameras and lights are not part of it."""
        digest = hashlib.sha256(b"scene 1")
        for array in (self.vertices_m, self.triangles, self.material_index):
            digest.update(repr(array.shape).encode() + array.tobytes())
        if self.uv is not None:
            digest.update(self.uv.tobytes())
        for material in self.materials:
            values = (
                material.base_colour, material.opacity, material.emissive, material.specular, material.shininess,
                material.alpha_mode, material.alpha_cutoff, material.two_sided,
            )  # fmt: skip
            digest.update(repr(values).encode())
            if material.alpha_image is not None:
                digest.update(repr(material.alpha_image.shape).encode() + material.alpha_image.tobytes())
        return digest.hexdigest()


def load_scene(path: Path | str) -> Scene:
    """Read a scene: GLB, glTF, OBJ, PLY or STL.

    Instances and transforms are written out. Base colour textures become their mean colour times the factor; an
    alpha image is kept where the material is alpha-tested. Cameras and lights come from glTF only. Nothing outside
    the file's folder is read.

    **Raises:** `InputError` that names the file, what is wrong in it, and the fix.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of scene file `{suffix}`; use one of {', '.join(SUFFIXES)}.")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a scene, or the name of a built-in one.")
    try:
        if suffix in (".glb", ".gltf"):
            from vtfs.gltf import load_gltf  # both know `Scene`, and load trimesh

            return load_gltf(path)
        from vtfs.mesh_files import load_mesh_file

        return load_mesh_file(path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the file.") from None


def save_scene(scene: Scene, path: Path | str) -> None:
    """Write a scene as GLB (materials, alpha images, cameras, lights), OBJ (with its MTL beside it) or PLY.

    Coordinates become float32 in GLB and PLY. OBJ and PLY keep neither cameras nor lights, PLY only the base colours,
    in 8 bits.

    **Raises:** `InputError` for another suffix, or where the file cannot be written.
    """
    path = Path(path)
    from vtfs import scene_writing  # it knows `Scene`, and loads trimesh

    savers = {".glb": scene_writing.save_glb, ".obj": scene_writing.save_obj, ".ply": scene_writing.save_ply}
    if path.suffix.lower() not in savers:
        raise InputError(f"{path}: cannot write `{path.suffix}`; use one of {', '.join(savers)}.")
    savers[path.suffix.lower()](scene, path)
