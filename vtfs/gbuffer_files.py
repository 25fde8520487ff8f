"""A user's own view samples: the G-buffer of their renderer as an `.npz`, with its transparent layers."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np

from vtfs.camera import Camera
from vtfs.files import write_atomically
from vtfs.input_error import InputError
from vtfs.layers import Layers, TransparentLayer
from vtfs.view_samples import CHANNELS, ViewSamples

_KEYS = {"position_m": "position", "triangle": "primitive"}
_COLUMNS = {"position": 3, "normal": 3, "base_colour": 3, "emissive": 3} | dict.fromkeys(
    ("depth", "specular", "shininess", "primitive", "valid"), 0
)
_LAYER = "transparent_"
_LAYER_COLUMNS = _COLUMNS | {"opacity": 0}
_MOST_LAYERS = 64  # more than any renderer peels; a header that asks for more is not believed
_KINDS = {"primitive": ("iu", "integers"), "valid": ("b", "booleans")}
_SLACK_PX = 0.01  # half-precision positions are off by up to a third of a pixel at 720 rows: those are refused
_DEPTH_SLACK = 1e-3  # relative: decals lie in what they are on, and half-precision depths are off by 5e-4


def save_gbuffer(path: Path | str, samples: ViewSamples) -> None:
    """Write view samples, transparent layers too, as the `.npz` that `load_gbuffer` reads.

    **Raises:** `InputError` where the file cannot be written.
    """
    arrays = {_KEYS.get(name, name): getattr(samples, name) for name in CHANNELS}
    layers = samples.layers.transparent
    if layers:
        arrays |= {
            _LAYER + _KEYS.get(name, name): np.stack([getattr(layer.samples, name) for layer in layers])
            for name in CHANNELS
        }
        arrays[_LAYER + "opacity"] = np.stack([layer.opacity for layer in layers])
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

    Transparent layers before those samples have the same keys with `transparent_` before them, and a leading axis of
    at most 64 layers, nearest first; `transparent_opacity` (0 to 1) is required as well. A pixel that has no sample in
    a layer is not valid there.

    A position must lie in its own pixel: lights are listed by pixel tile.

    **Raises:** `InputError` that names the file, the key, and what it must be.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a G-buffer as .npz.")
    try:
        arrays = _read_arrays(path, camera)
        solid = _samples({key: array for key, array in arrays.items() if key in _COLUMNS}, camera)
        layers = _transparent_layers(arrays, solid, camera)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return replace(solid, layers=Layers(lambda: layers))


def _read_arrays(path: Path, camera: Camera) -> dict[str, np.ndarray]:
    """The arrays that we know, each with its header checked before it is read."""
    height, width = camera.viewport.height_px, camera.viewport.width_px
    arrays: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy"): name for name in archive.namelist() if name.endswith(".npy")}
            for key, name in names.items():
                is_layered = key.startswith(_LAYER)
                channel = key.removeprefix(_LAYER)
                columns = (_LAYER_COLUMNS if is_layered else _COLUMNS).get(channel)
                if columns is None:
                    continue
                with archive.open(name) as member:
                    shape, dtype = _header(member)
                expected = (height, width) + ((columns,) if columns else ())
                if is_layered:
                    if shape[1:] != expected or not 1 <= shape[0] <= _MOST_LAYERS:
                        raise InputError(
                            f"key `{key}`: has shape {shape}; must be 1 to {_MOST_LAYERS} layers of {expected}."
                        )
                    expected = shape
                elif shape not in (expected, (1, *expected)):
                    raise InputError(f"key `{key}`: has shape {shape}; the camera's image needs {expected}.")
                kinds, words = _KINDS.get(channel, ("f", "floats"))
                if dtype.hasobject or dtype.kind not in kinds:
                    raise InputError(f"key `{key}`: has dtype {dtype}; must be {words}.")
                with archive.open(name) as member:
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


def _transparent_layers(
    arrays: dict[str, np.ndarray], solid: ViewSamples, camera: Camera
) -> tuple[TransparentLayer, ...]:
    own = {key.removeprefix(_LAYER): array for key, array in arrays.items() if key.startswith(_LAYER)}
    if not own:
        return ()
    if "opacity" not in own:
        raise InputError(f"key `{_LAYER}opacity`: is missing; the file has {', '.join(_LAYER + key for key in own)}.")
    n_layers = len(own["opacity"])
    for key, array in own.items():
        if len(array) != n_layers:
            raise InputError(f"key `{_LAYER}{key}`: has {len(array)} layers; `{_LAYER}opacity` has {n_layers}.")
    layers: list[TransparentLayer] = []
    nearest_m = np.zeros(solid.valid.shape, np.float32)
    for i in range(n_layers):
        try:
            samples = _samples({key: array[i] for key, array in own.items() if key != "opacity"}, camera, _LAYER)
            opacity, depth_m = np.where(samples.valid, own["opacity"][i], 0), -samples.position_m[..., 2]
            is_behind = solid.valid & (depth_m * (1 - _DEPTH_SLACK) > -solid.position_m[..., 2])
            is_before = depth_m * (1 + _DEPTH_SLACK) < nearest_m
            for key, values, wrong, must in (
                ("opacity", opacity, ~((opacity >= 0) & (opacity <= 1)), "0 to 1"),
                ("depth", depth_m, is_behind, "before the solid sample"),
                ("depth", depth_m, is_before, "nearest first"),
            ):
                _refuse_at(_LAYER + key, values, samples.valid & wrong, must)
        except InputError as error:
            raise InputError(f"layer {i}: {error}") from None
        nearest_m = np.where(samples.valid, depth_m, nearest_m)
        layers.append(TransparentLayer(samples, opacity.astype(np.float32)))
    return tuple(layers)


def _refuse_at(key: str, values: np.ndarray, wrong: np.ndarray, must: str) -> None:
    """**Raises:** `InputError` that names the first pixel where a value is wrong, and what it must be."""
    bad = np.argwhere(wrong)
    if len(bad):
        row, column = bad[0]
        raise InputError(f"key `{key}` at row {row}, column {column} = {values[row, column]}: must be {must}.")


def _samples(arrays: dict[str, np.ndarray], camera: Camera, prefix: str = "") -> ViewSamples:
    """The samples of one layer, whose keys have a prefix in the file."""
    for key in ("normal", "base_colour"):
        if key not in arrays:
            known = ", ".join(prefix + name for name in arrays) or "nothing known"
            raise InputError(f"key `{prefix}{key}`: is missing; the file has {known}.")
    if "position" not in arrays and "depth" not in arrays:
        known = ", ".join(prefix + name for name in arrays)
        raise InputError(f"key `{prefix}position` or `{prefix}depth`: is missing; the file has {known}.")
    x, y = camera.pixel_slopes()
    depth_m = -arrays["position"][..., 2] if "position" in arrays else arrays["depth"]
    with np.errstate(invalid="ignore"):
        valid = arrays.get("valid", True) & (depth_m >= camera.near_m) & (depth_m <= camera.far_m)
        scale = camera.width_at(depth_m)
        from_depth = np.stack([x * scale, y[:, None] * scale, -depth_m], axis=-1)
    shape = valid.shape
    values = {
        "position": from_depth,
        "specular": np.full(shape, 0.04),
        "shininess": np.full(shape, 32.0),
        "emissive": np.zeros((*shape, 3)),
        "primitive": np.zeros(shape, np.int32),
    } | arrays
    for key in ("position", "normal", "base_colour", "emissive", "specular", "shininess"):
        _check_values(key, values[key], valid, prefix)
    _check_pixels(values["position"], valid, camera, prefix)
    length = np.linalg.norm(values["normal"].astype(np.float64), axis=-1)
    bad = np.argwhere(valid & ~(np.abs(length - 1) < 0.05))
    if len(bad):
        row, column = bad[0]
        at = f"key `{prefix}normal` at row {row}, column {column}"
        raise InputError(f"{at}: has length {length[row, column]:g}; must be 1.")
    primitive = np.where(valid, values["primitive"], -1)
    if primitive.max() > np.iinfo(np.int32).max:
        raise InputError(f"key `{prefix}primitive`: has {primitive.max()}; must be below 2**31.")

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


def _check_values(key: str, values: np.ndarray, valid: np.ndarray, prefix: str) -> None:
    """Valid samples hold numbers, and colours no negative ones."""
    is_signed = key in ("position", "normal")
    wrong = ~np.isfinite(values) if is_signed else ~(np.isfinite(values) & (values >= 0))
    must = "finite" if is_signed else "finite and 0 or more"
    _refuse_at(prefix + key, values, valid & (wrong.any(axis=-1) if values.ndim == 3 else wrong), must)


def _check_pixels(position: np.ndarray, valid: np.ndarray, camera: Camera, prefix: str) -> None:
    """Every valid position projects into its own pixel."""
    width, height = camera.viewport.width_px, camera.viewport.height_px
    with np.errstate(all="ignore"):
        scale = camera.width_at(-position[..., 2])
        column = (position[..., 0] / scale - camera.slope_left) / camera.tan_half_x * width / 2
        row = (camera.slope_top - position[..., 1] / scale) / camera.tan_half_y * height / 2
        off = np.maximum(np.abs(column - np.arange(width) - 0.5), np.abs(row - np.arange(height)[:, None] - 0.5))
    off = np.where(valid, off, 0)
    if off.max() > 0.5 + _SLACK_PX:
        at_row, at_column = np.unravel_index(np.argmax(off), off.shape)
        raise InputError(
            f"key `{prefix}position` at row {at_row}, column {at_column}: projects {off.max():.3g} pixels from its "
            "centre; must be within half a pixel (is it in view space, y up, looking down -z, and is this the camera?)."
        )
