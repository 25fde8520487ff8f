"""Cameras: one view, a path of views, and `cameras.json`.

Right-handed; a camera looks down -z of its view space, with y up in the image. Row 0 of an image is
its top.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vtfs.files import write_atomically
from vtfs.flat_scenes import with_room
from vtfs.input_error import InputError

if TYPE_CHECKING:
    from vtfs.scene import Scene

Vector = tuple[float, float, float]

_LARGEST_SIDE_PX = 16384
_LARGEST_SHIFT = 100
_LENS_KEYS = ("shift_x", "shift_y", "orthographic_height_m")
_NO_ANGLE_DEG = 60.0  # of a parallel projection, which has none: any valid one
_LARGEST_FILE_BYTES = 256 * 2**20


@dataclass(frozen=True)
class Viewport:
    """The image. Static: it fixes the number of view samples."""

    width_px: int
    height_px: int

    def __post_init__(self):
        for name, value in asdict(self).items():
            if value < 1:
                raise InputError(f"`Viewport({name}={value})`: must be at least 1.")
            if value > _LARGEST_SIDE_PX:
                raise InputError(f"`Viewport({name}={value})`: must be at most {_LARGEST_SIDE_PX}.")


@dataclass(frozen=True)
class Pose:
    """Where a camera stands and what it looks at, in world space."""

    eye_m: Vector
    target_m: Vector
    up: Vector


@dataclass(frozen=True)
class Lens:
    """What a projection has besides its angle.

    - `shift_x`, `shift_y`: how far the image lies off the view direction, in widths and heights of the image: 0.5 puts
      the view direction on its left (bottom) edge. For tiled renders, headsets and shift lenses.
    - `orthographic_height_m`: height of the image of a parallel projection; 0: perspective.

    **Raises:** `InputError` that names the field.
    """

    shift_x: float = 0.0
    shift_y: float = 0.0
    orthographic_height_m: float = 0.0

    def __post_init__(self):
        for name in ("shift_x", "shift_y"):
            value = getattr(self, name)
            if not abs(value) <= _LARGEST_SHIFT:
                raise InputError(
                    f"camera `{name}` = {value:g}: must lie between -{_LARGEST_SHIFT} and {_LARGEST_SHIFT}."
                )
        height_m = self.orthographic_height_m
        if not (math.isfinite(height_m) and height_m >= 0):
            raise InputError(
                f"camera `orthographic_height_m` = {height_m:g}: must be above 0; leave it out for a perspective view."
            )


CENTRED = Lens()


@dataclass(frozen=True)
class Camera:
    """A view with square pixels: perspective, or parallel where its lens says so.

    - `fov_y_deg`: the full vertical angle; without meaning in a parallel projection.
    - `near_m`, `far_m`: distances along -z of view space; `far_m` may be infinite.

    **Raises:** `InputError` that names the field where the view is degenerate.
    """

    eye_m: Vector
    target_m: Vector
    up: Vector
    fov_y_deg: float
    near_m: float
    far_m: float
    viewport: Viewport
    lens: Lens = CENTRED

    def __post_init__(self):
        for name in ("eye_m", "target_m", "up"):
            value = getattr(self, name)
            if len(value) != 3 or not all(math.isfinite(component) for component in value):
                raise InputError(f"camera `{name}` = {value}: must be three finite numbers.")
        if not (math.isfinite(self.near_m) and self.near_m > 0):
            raise InputError(f"camera `near` = {self.near_m:g}: must be a finite distance above 0.")
        if not self.far_m > self.near_m:  # also where far is NaN
            raise InputError(f"camera `far` = {self.far_m:g}: must be beyond near = {self.near_m:g}.")
        if not 0 < self.fov_y_deg < 180:
            raise InputError(f"camera `fov_y_deg` = {self.fov_y_deg:g}: must lie between 0 and 180 degrees.")
        backward = np.subtract(self.eye_m, self.target_m)
        distance = float(np.linalg.norm(backward))
        if not distance > 1e-12 * (1 + float(np.abs(self.eye_m).max())):
            raise InputError(f"camera `target` = {self.target_m}: is where the eye is; move one of them.")
        up_length = float(np.linalg.norm(self.up))
        # The sine of the angle between up and the view: below 1e-6 rounding alone sets the roll.
        if not float(np.linalg.norm(np.cross(self.up, backward))) > 1e-6 * up_length * distance:
            raise InputError(f"camera `up` = {self.up}: is zero or parallel to the view direction; choose another.")

    @property
    def view_from_world(self) -> np.ndarray:
        """float64 `[4, 4]`: rotation and translation only."""
        backward = np.subtract(self.eye_m, self.target_m).astype(np.float64)
        backward /= np.linalg.norm(backward)
        right = np.cross(self.up, backward)
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3, :3] = right, np.cross(backward, right), backward
        matrix[:3, 3] = -matrix[:3, :3] @ np.asarray(self.eye_m, np.float64)
        return matrix

    @property
    def is_orthographic(self) -> bool:
        return self.lens.orthographic_height_m > 0

    @property
    def tan_half_y(self) -> float:
        """Half the image's height at depth 1; in a parallel projection at every depth, in metres."""
        if self.is_orthographic:
            return self.lens.orthographic_height_m / 2
        return math.tan(math.radians(self.fov_y_deg) / 2)

    @property
    def tan_half_x(self) -> float:
        return self.tan_half_y * self.viewport.width_px / self.viewport.height_px

    @property
    def slope_left(self) -> float:
        """`x / depth` at the image's left edge (x itself in a parallel projection)."""
        return (2 * self.lens.shift_x - 1) * self.tan_half_x

    @property
    def slope_top(self) -> float:
        """`y / depth` at the image's top edge (y itself in a parallel projection)."""
        return (2 * self.lens.shift_y + 1) * self.tan_half_y

    def pixel_slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """`x / depth` of every column and `y / depth` of every row at pixel centres: float64 `[w]`, `[h]`.

        In a parallel projection they are x and y themselves.
        """
        width, height = self.viewport.width_px, self.viewport.height_px
        x = (2 * (np.arange(width) + 0.5) / width - 1 + 2 * self.lens.shift_x) * self.tan_half_x
        y = (1 - 2 * (np.arange(height) + 0.5) / height + 2 * self.lens.shift_y) * self.tan_half_y
        return x, y

    def width_at(self, depth_m: np.ndarray) -> np.ndarray:
        """By what slopes are multiplied to give x and y at a depth: the depth, or 1 in a parallel projection."""
        return np.ones_like(depth_m) if self.is_orthographic else depth_m

    def primary_rays(self) -> tuple[np.ndarray, np.ndarray]:
        """World-space origins and directions of the rays through pixel centres, float64 `[h, w, 3]` each.

        Their depth in view space is 1, so that the parameter along such a ray is depth, not distance. They start at the
        eye; in a parallel projection beside it, and all have one direction.
        """
        x, y = self.pixel_slopes()
        right, up, backward = self.view_from_world[:3, :3]
        aside = x[None, :, None] * right + y[:, None, None] * up
        eye_m = np.asarray(self.eye_m, np.float64)
        if self.is_orthographic:
            return eye_m + aside, np.broadcast_to(-backward, aside.shape)
        return np.broadcast_to(eye_m, aside.shape), aside - backward

    @property
    def key(self) -> str:
        """SHA-256 of all fields, in hexadecimal."""
        return _digest(self)


@dataclass(frozen=True)
class CameraPath:
    """At least one view, all with the same lens."""

    viewport: Viewport
    fov_y_deg: float
    near_m: float
    far_m: float
    poses: tuple[Pose, ...]
    lens: Lens = CENTRED

    def __post_init__(self):
        if not self.poses:
            raise InputError("camera path `frames`: is empty; give at least one frame.")
        for i in range(len(self.poses)):
            try:
                self.camera(i)
            except InputError as error:
                raise InputError(f"frame {i}: {error}") from None

    def __len__(self) -> int:
        return len(self.poses)

    def camera(self, i: int) -> Camera:
        pose = self.poses[i]
        return Camera(
            pose.eye_m, pose.target_m, pose.up, self.fov_y_deg, self.near_m, self.far_m, self.viewport, self.lens
        )

    def resized(self, viewport: Viewport) -> CameraPath:
        """The same path for another image; the vertical angle stays."""
        return replace(self, viewport=viewport)

    @property
    def key(self) -> str:
        """SHA-256 of all fields, in hexadecimal."""
        return _digest(self)


def _digest(view: Camera | CameraPath) -> str:
    """Centred perspective views have the key that they had before there were other lenses: caches stay valid."""
    record = asdict(view)
    if view.lens == CENTRED:
        del record["lens"]
    return hashlib.sha256(repr(record).encode()).hexdigest()


def load_cameras(path: Path | str) -> CameraPath:
    """Read `cameras.json`: `{"width", "height", "fov_y_deg", "near", "far", "frames": [{"eye", "target", "up"}]}`.

    A missing `far`, or `null`, is infinite. Optional keys are those of `Lens`: `shift_x`, `shift_y`, and
    `orthographic_height_m`, which stands in place of `fov_y_deg`.

    **Raises:** `InputError` that names the file and the key.
    """
    path = Path(path)
    record = _read_json(path)
    try:
        viewport = Viewport(_whole(record, "width"), _whole(record, "height"))
        lens = Lens(*(_number(record, key) if key in record else 0.0 for key in _LENS_KEYS))
        if lens.orthographic_height_m and "fov_y_deg" in record:
            raise InputError("keys `fov_y_deg` and `orthographic_height_m`: a view has one of them; leave one out.")
        if "orthographic_height_m" in record and not lens.orthographic_height_m:
            raise InputError("key `orthographic_height_m` = 0: must be above 0; leave it out for a perspective view.")
        fov_y_deg = _NO_ANGLE_DEG if lens.orthographic_height_m else _number(record, "fov_y_deg")
        near_m = _number(record, "near")
        far_m = math.inf if record.get("far") is None else _number(record, "far")
        frames = record.get("frames")
        if not isinstance(frames, list):
            raise InputError(f"key `frames` = {_short(frames)}: must be a list of {{eye, target, up}}.")
        poses = tuple(_pose(frame, i) for i, frame in enumerate(frames))
        return CameraPath(viewport, fov_y_deg, near_m, far_m, poses, lens)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def save_cameras(path: Path | str, camera_path: CameraPath) -> None:
    """Write `cameras.json`; an infinite `far` becomes `null`.

    **Raises:** `InputError` where the file cannot be written.
    """
    lens = {key: value for key, value in asdict(camera_path.lens).items() if value}
    angle = {} if camera_path.lens.orthographic_height_m else {"fov_y_deg": camera_path.fov_y_deg}
    record = {
        "width": camera_path.viewport.width_px,
        "height": camera_path.viewport.height_px,
        **angle,
        **lens,
        "near": camera_path.near_m,
        "far": camera_path.far_m if math.isfinite(camera_path.far_m) else None,
        "frames": [
            {"eye": list(pose.eye_m), "target": list(pose.target_m), "up": list(pose.up)} for pose in camera_path.poses
        ],
    }
    write_atomically(path, json.dumps(record, indent=1).encode())


def default_cameras(scene: Scene, viewport: Viewport, seed: int = 0) -> CameraPath:
    """A 60-frame turn for a scene without cameras.

    The eye is that point inside the bounds from which most rays hit within half the diagonal, and not at once; back
    faces count against it (it would stand inside a solid or below the ground), and so do few different triangles (it
    would stand before a bare wall). Near is diagonal / 1e4, far is 2 diagonals; y is up. Deterministic for a `seed`.
    """
    from vtfs.tracer import Tracer  # Embree: only where it is used

    candidates = _standpoints(scene, np.random.default_rng(seed))
    directions = _sphere_directions(256)
    origins, along = np.repeat(candidates, len(directions), axis=0), np.tile(directions, (len(candidates), 1))
    triangle, distance_m = Tracer(scene).first_hits(origins, along)
    relative = np.where(triangle >= 0, distance_m, np.inf) / scene.diagonal_m
    corners = scene.vertices_m[scene.triangles[np.maximum(triangle, 0)]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    two_sided = np.array([material.two_sided for material in scene.materials])[scene.material_index[triangle]]
    is_back = (triangle >= 0) & ((normal * along).sum(axis=1) > 0) & ~two_sided
    shape = (len(candidates), len(directions))
    is_near = ((relative > 0.01) & (relative < 0.5) & ~is_back).reshape(shape)
    n_different = np.array([len(np.unique(seen)) for seen in triangle.reshape(shape)])
    score = is_near.mean(axis=1) * (1 - is_back.reshape(shape).mean(axis=1)) ** 4 * np.sqrt(n_different)
    eye = candidates[np.argmax(score)]
    poses = []
    for angle in 2 * np.pi * np.arange(60) / 60:
        # A little downward: floors and streets show, the sky does not fill half the image.
        target = eye + 0.25 * scene.diagonal_m * np.array([np.sin(angle), -0.15, -np.cos(angle)])
        poses.append(Pose(_vector(eye), _vector(target), (0.0, 1.0, 0.0)))
    return CameraPath(viewport, 60.0, scene.diagonal_m / 1e4, 2 * scene.diagonal_m, tuple(poses))


def _standpoints(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """Points inside the bounds, and before what is flat, `[N, 3]`: spread evenly, and above triangles (some scenes fill
    little of their box)."""
    low, high = with_room(scene.bounds_m)
    spread = low + (high - low) * rng.uniform(0.1, 0.9, (64, 3))
    centres = scene.vertices_m[scene.triangles[rng.integers(scene.n_triangles, size=192)]].mean(axis=1)
    centres[:, 1] += scene.diagonal_m * rng.uniform(0.002, 0.05, 192)
    return np.concatenate([spread, centres[((centres > low) & (centres < high)).all(axis=1)]])


def _sphere_directions(n: int) -> np.ndarray:
    """`n` evenly spread unit vectors: a Fibonacci lattice."""
    y = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=1)


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a cameras.json.")
    if path.stat().st_size > _LARGEST_FILE_BYTES:
        raise InputError(f"{path}: has {path.stat().st_size} bytes; a cameras.json has at most {_LARGEST_FILE_BYTES}.")
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, or nested without end
        reason = _short(str(error), 80)
        raise InputError(f"{path}: not JSON ({reason}); save it with the keys `width` to `frames`.") from None
    if not isinstance(record, dict):
        raise InputError(f"{path}: must hold an object with `width`, `height`, ..., `frames`, not {_short(record)}.")
    return record


def _number(record: dict[str, Any], key: str) -> float:
    if key not in record:
        raise InputError(f"key `{key}`: is missing; give a number.")
    value = record[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"key `{key}` = {_short(value)}: must be a number.")
    try:
        return float(value)
    except OverflowError:
        raise InputError(f"key `{key}` = {_short(value)}: is too large.") from None


def _whole(record: dict[str, Any], key: str) -> int:
    value = _number(record, key)
    if not (math.isfinite(value) and value == int(value)):
        raise InputError(f"key `{key}` = {value:g}: must be a whole number of pixels.")
    return int(value)


def _pose(frame: object, i: int) -> Pose:
    if not isinstance(frame, dict):
        raise InputError(f"`frames[{i}]` = {_short(frame)}: must be an object with `eye`, `target` and `up`.")
    return Pose(*(_triple(frame, key, i) for key in ("eye", "target", "up")))


def _triple(frame: dict[str, Any], key: str, i: int) -> Vector:
    value = frame.get(key)
    if not isinstance(value, list) or len(value) != 3:
        what = "is missing" if key not in frame else f"= {_short(value)}"
        raise InputError(f"`frames[{i}].{key}` {what}: must be a list of three numbers.")
    try:
        x, y, z = (_number({key: component}, key) for component in value)
    except InputError:
        raise InputError(f"`frames[{i}].{key}` = {_short(value)}: must be three numbers.") from None
    return x, y, z


def _short(value: object, length: int = 40) -> str:
    """A value for a message: one line, cut."""
    text = str(value) if isinstance(value, str) and length > 40 else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= length else text[: length - 3] + "..."
