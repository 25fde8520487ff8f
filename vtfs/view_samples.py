"""View samples: what each pixel sees, from our own primary rays; those of a user's renderer are in `gbuffer_files.py`.

Primary rays go through pixel centres. Embree finds the triangle in float32; the position is then computed again in
float64 where the ray meets the plane of that triangle. Only triangle indices are cached on disk.
"""

from __future__ import annotations

import functools
import hashlib
import io
import logging
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from vtfs.cache import cache_dir
from vtfs.camera import Camera
from vtfs.files import write_atomically
from vtfs.input_error import InputError
from vtfs.layers import Layers, TransparentLayer, hidden_triangles, transparent_triangles
from vtfs.scene import Material, Scene
from vtfs.tracer import Planes, Tracer, by_bands, pixel_rays

log = logging.getLogger("vtfs.view_samples")

_VERSION = 1  # of the rule by which a pixel gets its triangle; part of the cache key
CHANNELS = ("position_m", "normal", "base_colour", "specular", "shininess", "emissive", "triangle", "valid")
_FLAT = ("specular", "shininess", "triangle", "valid")


@dataclass(frozen=True)
class ViewSamples:
    """One sample for each pixel, arrays `[h, w]` or `[h, w, 3]`, row 0 at the top.

    - `position_m`: float32, view space; 0 where nothing was hit.
    - `normal`: float32, view space, unit, geometric, facing the eye where we traced it.
    - `base_colour`, `emissive`, `specular`, `shininess`: float32, of the material.
    - `triangle`: int32, -1 where nothing was hit.
    - `valid`: there is a surface, and its depth lies in `[near, far]`.
    - `layers`: transparent surfaces before these, and overdraw, which a user's own samples do not have.
    """

    camera: Camera
    position_m: np.ndarray
    normal: np.ndarray
    base_colour: np.ndarray
    specular: np.ndarray
    shininess: np.ndarray
    emissive: np.ndarray
    triangle: np.ndarray
    valid: np.ndarray
    layers: Layers = field(default_factory=Layers, compare=False, repr=False)

    def __post_init__(self):
        height, width = self.camera.viewport.height_px, self.camera.viewport.width_px
        for name in CHANNELS:
            shape = (height, width) if name in _FLAT else (height, width, 3)
            if getattr(self, name).shape != shape:
                raise InputError(f"view samples `{name}` has shape {getattr(self, name).shape}, not {shape}.")

    @property
    def n_valid(self) -> int:
        return int(self.valid.sum())

    @cached_property
    def key(self) -> str:
        """SHA-256 of the content, in hexadecimal."""
        digest = hashlib.sha256(self.camera.key.encode())
        for name in CHANNELS:
            digest.update(np.ascontiguousarray(getattr(self, name)).data)
        return digest.hexdigest()

    def world_positions_m(self) -> np.ndarray:
        """World-space positions of the valid samples, float64 `[n_valid, 3]`."""
        matrix = self.camera.view_from_world
        return (self.position_m[self.valid].astype(np.float64) - matrix[:3, 3]) @ matrix[:3, :3]


def trace_view_samples(scene: Scene, camera: Camera, tracer: Tracer | None = None) -> ViewSamples:
    """What each pixel of a view sees.

    The triangle of each pixel is read from the cache, or traced and kept there; a damaged cache file is replaced.
    `tracer` holds the scene for several frames; without one it is built here, and only if the cache has no answer.
    """
    cached = cache_dir() / "view_samples" / f"{_cache_key(scene, camera)}.npy"
    triangle = _read_cached(cached, camera, scene.n_triangles)
    planes = Planes(scene, camera)
    if triangle is None:
        triangle = (tracer or Tracer(scene)).triangles(camera, planes)
        try:
            _write_cached(cached, triangle)
        except InputError as error:  # a cache that cannot be written costs time, not the result
            log.warning("view samples are not cached: %s", error)
    samples = _samples_from(planes, camera, triangle)
    return replace(samples, layers=_layers(scene, samples, tracer))


def _layers(scene: Scene, samples: ViewSamples, tracer: Tracer | None) -> Layers:
    camera, key = samples.camera, _cache_key(scene, samples.camera)
    any_tracer = functools.cache(lambda: tracer or Tracer(scene))
    # Planes are 14 numbers a triangle: made again where layers are asked for, and not kept for each frame.
    made_planes = functools.partial(Planes, scene, camera)

    def transparent() -> tuple[TransparentLayer, ...]:
        if not any(material.alpha_mode == "blend" for material in scene.materials):
            return ()
        until_m = np.where(samples.valid, -samples.position_m[..., 2].astype(np.float64), camera.far_m)
        planes, (x, y) = made_planes(), camera.pixel_slopes()
        layers = []
        for triangle in transparent_triangles(any_tracer, planes, camera, until_m, key):
            layer = _samples_from(planes, camera, triangle)
            row, column = np.nonzero(layer.valid)
            depth_m = -layer.position_m[row, column, 2].astype(np.float64)
            opacity = np.zeros(triangle.shape, np.float32)
            opacity[row, column] = planes.alpha(triangle[row, column], x[column], y[row], depth_m).clip(0, 1)
            layers.append(TransparentLayer(layer, opacity))
        return tuple(layers)

    def hidden() -> tuple[ViewSamples, ...]:
        planes = made_planes()
        return tuple(_samples_from(planes, camera, t) for t in hidden_triangles(any_tracer, planes, camera, key))

    return Layers(transparent, hidden)


def _samples_from(planes: Planes, camera: Camera, triangle: np.ndarray) -> ViewSamples:
    """Positions, normals and materials of the triangles that pixels see."""
    height, width = triangle.shape
    position, normal, base_colour, emissive = (np.empty((height, width, 3), np.float32) for _ in range(4))
    specular, shininess = (np.empty((height, width), np.float32) for _ in range(2))
    valid = np.empty((height, width), bool)
    looks = _looks(planes.scene.materials)

    def fill(rows: slice) -> None:
        x, y = pixel_rays(camera, rows)
        is_hit = triangle[rows].ravel() >= 0
        seen = np.maximum(triangle[rows].ravel(), 0)  # what is not there is any triangle, and cleared below
        depth_m = planes.depth_m(seen, x, y)
        valid[rows] = (is_hit & (depth_m >= camera.near_m) & (depth_m <= camera.far_m)).reshape(-1, width)
        scale = camera.width_at(depth_m)
        # Where a ray goes: (x, y, -1), or straight ahead in a parallel projection.
        slopes = (np.zeros_like(x), np.zeros_like(y)) if camera.is_orthographic else (x, y)
        facing = _facing_normals(planes.row[seen], *slopes)
        look = looks[planes.scene.material_index[seen]]
        for values, result in (
            (np.stack([x * scale, y * scale, -depth_m], axis=1), position),
            (facing, normal),
            (look[:, 0:3], base_colour),
            (look[:, 3:6], emissive),
            (look[:, 6], specular),
            (look[:, 7], shininess),
        ):
            band = result[rows].reshape(values.shape)
            band[...] = values
            band[~is_hit] = 0

    by_bands(camera, fill)
    return ViewSamples(camera, position, normal, base_colour, specular, shininess, emissive, triangle, valid)


def _looks(materials: tuple[Material, ...]) -> np.ndarray:
    """One row a material: base colour, emissive, specular, shininess; float32 `[M, 8]`."""
    return np.array([(*m.base_colour, *m.emissive, m.specular, m.shininess) for m in materials], np.float32)


def _facing_normals(row: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Unit normals on the side from which rays `(x, y, -1)` come; the ray's own where a triangle has no area."""
    nx, ny, nz = row[:, 0], row[:, 1], row[:, 2]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    factor = np.where(nx * x + ny * y - nz > 0, -1.0, 1.0) / np.maximum(length, np.finfo(np.float64).tiny)
    unit = row[:, :3] * factor[:, None]
    flat = np.flatnonzero(length <= np.finfo(np.float64).tiny)
    if len(flat):
        back = np.stack([-x[flat], -y[flat], np.ones(len(flat))], axis=1)
        unit[flat] = back / np.linalg.norm(back, axis=1, keepdims=True)
    return unit


def _cache_key(scene: Scene, camera: Camera) -> str:
    return hashlib.sha256(f"{_VERSION} {scene.key} {camera.key}".encode()).hexdigest()


def _read_cached(path: Path, camera: Camera, n_triangles: int) -> np.ndarray | None:
    """The cached triangle indices, or None where there are none or the file is damaged.

    The file is an `.npy` with the SHA-256 of its bytes behind it.
    """
    shape = (camera.viewport.height_px, camera.viewport.width_px)
    try:
        if not path.is_file() or path.stat().st_size > 4 * shape[0] * shape[1] + 4096:
            return None
        content = path.read_bytes()
    except OSError:
        return None
    body, checksum = content[:-32], content[-32:]
    if hashlib.sha256(body).digest() != checksum:
        log.warning("%s: damaged; tracing again", path)
        return None
    triangle = np.load(io.BytesIO(body), allow_pickle=False)
    if triangle.shape != shape or triangle.dtype != np.int32 or triangle.max() >= n_triangles:
        return None
    return triangle


def _write_cached(path: Path, triangle: np.ndarray) -> None:
    body = io.BytesIO()
    np.save(body, triangle, allow_pickle=False)
    write_atomically(path, body.getvalue() + hashlib.sha256(body.getvalue()).digest())
