"""View samples: what each pixel sees, from our own primary rays or from the user's renderer.

Primary rays go through pixel centres. Embree finds the triangle in float32; the position is then computed again in
float64 where the ray meets the plane of that triangle. Only triangle indices are cached on disk.
"""

from __future__ import annotations

import functools
import hashlib
import io
import logging
import zipfile
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import IO

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
    - `layers`: transparent surfaces before these, and overdraw; none in a user's own samples.
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
        facing = _facing_normals(planes.row[seen], x, y)
        look = looks[planes.scene.material_index[seen]]
        for values, result in (
            (np.stack([x * depth_m, y * depth_m, -depth_m], axis=1), position),
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


# --- the user's own samples -----------------------------------------------------------------------------------------


def save_gbuffer(path: Path | str, samples: ViewSamples) -> None:
    """Write view samples as the `.npz` that `load_gbuffer` reads.

    **Raises:** `InputError` where the file cannot be written.
    """
    arrays = {_KEYS.get(name, name): getattr(samples, name) for name in CHANNELS}
    content = io.BytesIO()
    np.savez(content, **arrays)
    write_atomically(path, content.getvalue())


def load_gbuffer(path: Path | str, camera: Camera) -> ViewSamples:
    """Read the samples of the user's own renderer from an `.npz`, for the camera they were made with.

    Arrays `[h, w, ...]`, row 0 at the top, or with a leading layer axis of length 1:

    - `position` (view space, 3 columns) or `depth` (distance along -z at pixel centres); `normal` (view space, 3) and
      `base_colour` (linear, 3) are required;
    - `specular`, `shininess`, `emissive` (3), `primitive` (integers) and `valid` (booleans) are optional: 0.04, 32, 0,
      0, and "the depth is finite and in [near, far]".

    A position must lie in its own pixel: lights are listed by pixel tile.

    **Raises:** `InputError` that names the file, the key, and what it must be.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a G-buffer as .npz.")
    try:
        return _gbuffer(_read_arrays(path, camera), camera)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


_KEYS = {"position_m": "position", "triangle": "primitive"}
_COLUMNS = {"position": 3, "normal": 3, "base_colour": 3, "emissive": 3} | dict.fromkeys(
    ("depth", "specular", "shininess", "primitive", "valid"), 0
)
_KINDS = {"primitive": ("iu", "integers"), "valid": ("b", "booleans")}
_SLACK_PX = 0.01  # half-precision positions are off by up to a third of a pixel at 720 rows: those are refused


def _read_arrays(path: Path, camera: Camera) -> dict[str, np.ndarray]:
    """The arrays that we know, each with its header checked before it is read."""
    height, width = camera.viewport.height_px, camera.viewport.width_px
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
            for key, columns in _COLUMNS.items():
                if key not in names:
                    continue
                with archive.open(names[key]) as member:
                    shape, dtype = _header(member)
                expected = (height, width) + ((columns,) if columns else ())
                if shape not in (expected, (1, *expected)):
                    raise InputError(f"key `{key}`: has shape {shape}; the camera's image needs {expected}.")
                kinds, words = _KINDS.get(key, ("f", "floats"))
                if dtype.hasobject or dtype.kind not in kinds:
                    raise InputError(f"key `{key}`: has dtype {dtype}; must be {words}.")
                with archive.open(names[key]) as member:
                    arrays[key] = np.lib.format.read_array(member, allow_pickle=False).reshape(expected)
    except InputError:
        raise
    except Exception as error:  # damaged archives raise many kinds: zip, zlib, struct, value errors
        reason = " ".join(f"{error}".split())[:80]
        raise InputError(f"is not an .npz that can be read ({reason}); write it with numpy.savez.") from None
    return arrays


def _header(member: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(member)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(member)
    return shape, dtype


def _gbuffer(arrays: dict[str, np.ndarray], camera: Camera) -> ViewSamples:
    for key in ("normal", "base_colour"):
        if key not in arrays:
            raise InputError(f"key `{key}`: is missing; the file has {', '.join(arrays) or 'nothing known'}.")
    if "position" not in arrays and "depth" not in arrays:
        raise InputError(f"key `position` or `depth`: is missing; the file has {', '.join(arrays)}.")
    camera.require_perspective("G-buffers")
    x, y = camera.pixel_slopes()
    depth_m = -arrays["position"][..., 2] if "position" in arrays else arrays["depth"]
    with np.errstate(invalid="ignore"):
        valid = arrays.get("valid", True) & (depth_m >= camera.near_m) & (depth_m <= camera.far_m)
        from_depth = np.stack([x * depth_m, y[:, None] * depth_m, -depth_m], axis=-1)
    shape = valid.shape
    values = {
        "position": from_depth,
        "specular": np.full(shape, 0.04),
        "shininess": np.full(shape, 32.0),
        "emissive": np.zeros((*shape, 3)),
        "primitive": np.zeros(shape, np.int32),
    } | arrays
    for key in ("position", "normal", "base_colour", "emissive", "specular", "shininess"):
        _check_values(key, values[key], valid)
    _check_pixels(values["position"], valid, camera)
    length = np.linalg.norm(values["normal"].astype(np.float64), axis=-1)
    bad = np.argwhere(valid & ~(np.abs(length - 1) < 0.05))
    if len(bad):
        row, column = bad[0]
        raise InputError(f"key `normal` at row {row}, column {column}: has length {length[row, column]:g}; must be 1.")
    primitive = np.where(valid, values["primitive"], -1)
    if primitive.max() > np.iinfo(np.int32).max:
        raise InputError(f"key `primitive`: has {primitive.max()}; must be below 2**31.")

    def kept(key: str) -> np.ndarray:
        """float32, and 0 where no sample is."""
        mask = valid[..., None] if values[key].ndim == 3 else valid
        return np.ascontiguousarray(np.where(mask, values[key], 0), np.float32)

    position, normal, base_colour, emissive = (kept(key) for key in ("position", "normal", "base_colour", "emissive"))
    normal /= np.where(valid, length, 1)[..., None].astype(np.float32)
    return ViewSamples(
        camera, position, normal, base_colour, kept("specular"), kept("shininess"), emissive,
        primitive.astype(np.int32), valid,
    )  # fmt: skip


def _check_values(key: str, values: np.ndarray, valid: np.ndarray) -> None:
    """Valid samples hold numbers, and colours no negative ones."""
    is_signed = key in ("position", "normal")
    wrong = ~np.isfinite(values) if is_signed else ~(np.isfinite(values) & (values >= 0))
    bad = np.argwhere(valid & (wrong.any(axis=-1) if values.ndim == 3 else wrong))
    if len(bad):
        row, column = bad[0]
        must = "finite" if is_signed else "finite and 0 or more"
        raise InputError(f"key `{key}` at row {row}, column {column} = {values[row, column]}: must be {must}.")


def _check_pixels(position: np.ndarray, valid: np.ndarray, camera: Camera) -> None:
    """Every valid position projects into its own pixel."""
    width, height = camera.viewport.width_px, camera.viewport.height_px
    with np.errstate(all="ignore"):
        column = (position[..., 0] / -position[..., 2] - camera.slope_left) / camera.tan_half_x * width / 2
        row = (camera.slope_top - position[..., 1] / -position[..., 2]) / camera.tan_half_y * height / 2
        off = np.maximum(np.abs(column - np.arange(width) - 0.5), np.abs(row - np.arange(height)[:, None] - 0.5))
    off = np.where(valid, off, 0)
    if off.max() > 0.5 + _SLACK_PX:
        at_row, at_column = np.unravel_index(np.argmax(off), off.shape)
        raise InputError(
            f"key `position` at row {at_row}, column {at_column}: projects {off.max():.3g} pixels from its centre; must"
            " be within half a pixel (is it in view space, y up, looking down -z, and is this the camera?)."
        )
