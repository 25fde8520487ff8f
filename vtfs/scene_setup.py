"""What a command works on: a scene, a camera path and lights, from what the user named."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from vtfs.cache import cached
from vtfs.camera import CameraPath, Viewport, default_cameras, load_cameras
from vtfs.directional_lights import NO_DIRECTIONAL, DirectionalLights
from vtfs.flat_scenes import with_room
from vtfs.gallery import GALLERY, build_scene
from vtfs.gbuffer_files import load_gbuffer
from vtfs.input_error import InputError
from vtfs.lights import Lights, load_lights, scatter_lights
from vtfs.scene import Scene, load_scene
from vtfs.view_samples import Tracer, ViewSamples, trace_view_samples

if TYPE_CHECKING:
    from vtfs.frame_inputs import FrameInputs
    from vtfs.shadow_scene import ShadowScene

log = logging.getLogger("vtfs.scene_setup")

DEFAULT_SCENE = "atrium"
DEFAULT_LIGHTS = 1000
DEFAULT_VIEWPORT = Viewport(1280, 720)
MAX_COUNTED_FRAMES = 12
MAX_SCATTERED_LIGHTS = 10_000_000

_SCATTER_SAMPLES = 512  # of each counted frame: a median over some 6,000 is known to 2 %


@dataclass(frozen=True)
class SceneOptions:
    """What the command line says of a scene.

    - `scene`: a file that `load_scene` reads, a G-buffer `.npz` or a folder of them (one a frame), the name
      of a built-in scene, or `None` for the default one.
    - `shadow_lights`: lights with a place that cast shadows on each frame; directional ones all do.
    - `lights`: a `lights.csv`, a number of lights to scatter, or `None`: the scene's own, else 1,000.
    """

    scene: str | None = None
    cameras: Path | None = None
    lights: str | None = None
    viewport: Viewport | None = None
    seed: int = 0
    lights_per_sample: int = 20
    density: Literal["constant", "fixed"] = "constant"
    n_triangles: int | None = None
    shadow_lights: int = 1


@dataclass
class SceneSetup:
    """A scene, its camera path and its lights, with view samples on demand.

    - `n_triangles`: 0 where the samples are the user's own.
    """

    name: str
    n_triangles: int
    cameras: CameraPath
    seed: int
    _source: _Source
    _lights: Lights | int = field(repr=False)
    _options: SceneOptions = field(repr=False)

    @property
    def n_frames(self) -> int:
        return len(self.cameras)

    def samples(self, frame: int) -> ViewSamples:
        """The view samples of a frame of the path.

        **Raises:** `InputError` where there is no such frame.
        """
        self._check_frame(frame)
        return self._source.samples(self.cameras, frame)

    def chosen_frames(self, asked: Sequence[int] | None) -> tuple[int, ...]:
        """The frames that were asked for, each once; without any all of them.

        **Raises:** `InputError` where there is no such frame, before work is spent on the others.
        """
        frames = tuple(dict.fromkeys(asked or range(self.n_frames)))
        for frame in frames:
            self._check_frame(frame)
        return frames

    def _check_frame(self, frame: int) -> None:
        if not 0 <= frame < self.n_frames:
            raise InputError(f"frame {frame}: the camera path has frames 0 to {self.n_frames - 1}.")

    @property
    def scene(self) -> Scene | None:
        """The geometry; None where the samples are the user's own."""
        return self._source.scene if isinstance(self._source, _TracedScene) else None

    @property
    def suns(self) -> DirectionalLights:
        """Directional lights, which shine and cast where shadows are asked for."""
        return self.scene.suns if self.scene is not None else NO_DIRECTIONAL

    def inputs(self, frame: int) -> FrameInputs:
        """A frame on the device."""
        from vtfs.frame import FrameInputs  # a scene is set up without the programs too

        return FrameInputs(self.samples(frame), self.lights, frame, shadow_scene=self.shadow_scene)

    @cached_property
    def shadow_scene(self) -> ShadowScene | None:
        """What casts shadows; None where the samples are the user's own.

        **Raises:** `InputError` for more lights that cast than there are bits.
        """
        from vtfs.shadow_scene import shadow_scene

        if self.scene is None:
            return None
        return shadow_scene(self.scene, self.suns, self._options.shadow_lights, self._options.seed)

    @property
    def bounds_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner of the scene, or of its visible samples."""
        return self._source.bounds_m(self.cameras)

    @property
    def counted_frames(self) -> tuple[int, ...]:
        """At most 12 evenly spaced frames of the path."""
        n = min(self.n_frames, MAX_COUNTED_FRAMES)
        return tuple(dict.fromkeys(int(f) for f in np.linspace(0, self.n_frames - 1, n).round()))

    @cached_property
    def lights(self) -> Lights:
        """Given, or scattered so that a visible sample is reached by so many in the median."""
        if isinstance(self._lights, Lights):
            return self._lights
        n_lights, options = self._lights, self._options

        def scatter() -> dict[str, np.ndarray]:
            visible = np.concatenate([self._some_positions(frame) for frame in self.counted_frames])
            seen_from_m = np.mean([pose.eye_m for pose in self.cameras.poses], axis=0)
            box_m = with_room(self.bounds_m, seen_from_m)
            scattered = scatter_lights(box_m, n_lights, self.seed, visible, options.lights_per_sample, options.density)
            return {field.name: getattr(scattered, field.name) for field in fields(scattered)}

        asked = (n_lights, self.seed, options.lights_per_sample, options.density)
        return Lights(**cached("lights", (self._source.key, self.cameras.key, repr(asked)), scatter))

    @property
    def key(self) -> str:
        """Of everything that its counts and times depend on."""
        parts = [self._source.key, self.cameras.key, self.lights.key]
        if self.suns.n_lights or self._options.shadow_lights != SceneOptions.shadow_lights:
            parts += [self.suns.key, f"shadow lights {self._options.shadow_lights}"]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _some_positions(self, frame: int) -> np.ndarray:
        positions = self.samples(frame).world_positions_m()
        return positions[:: max(1, len(positions) // _SCATTER_SAMPLES)]


class _TracedScene:
    """View samples by primary rays."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self._tracer: Tracer | None = None
        self.key = scene.key

    def samples(self, cameras: CameraPath, frame: int) -> ViewSamples:
        if self._tracer is None:
            self._tracer = Tracer(self.scene)
        return trace_view_samples(self.scene, cameras.camera(frame), self._tracer)

    def bounds_m(self, cameras: CameraPath) -> tuple[np.ndarray, np.ndarray]:
        return self.scene.bounds_m


class _OwnSamples:
    """View samples of the user's own renderer, one file a frame."""

    def __init__(self, files: Sequence[Path]):
        self._files = tuple(files)
        digest = hashlib.sha256()
        for file in self._files:
            digest.update(file.read_bytes())
        self.key = digest.hexdigest()

    def samples(self, cameras: CameraPath, frame: int) -> ViewSamples:
        return load_gbuffer(self._files[frame], cameras.camera(frame))

    def bounds_m(self, cameras: CameraPath) -> tuple[np.ndarray, np.ndarray]:
        seen = [self.samples(cameras, frame).world_positions_m() for frame in range(len(self._files))]
        corners = [positions for positions in seen if len(positions)]
        if not corners:
            raise InputError("the G-buffers hold no valid sample: lights cannot be scattered; give a lights.csv.")
        return (
            np.min([positions.min(0) for positions in corners], axis=0),
            np.max([positions.max(0) for positions in corners], axis=0),
        )


_Source = _TracedScene | _OwnSamples


def set_up(options: SceneOptions) -> SceneSetup:
    """Load what the options name.

    **Raises:** `InputError`, see the loaders.
    """
    cameras = load_cameras(options.cameras) if options.cameras else None
    lights = _given_lights(options.lights)
    own = _own_sample_files(options.scene)
    if own:
        return _own_setup(options, own, cameras, lights)
    scene = _scene(options)
    if cameras is None:
        cameras = scene.cameras
    if cameras is None:
        log.info("%s has no cameras: a 60-frame turn from where most of it is near", scene.name)
        cameras = default_cameras(scene, options.viewport or DEFAULT_VIEWPORT, options.seed)
    if options.viewport:
        cameras = cameras.resized(options.viewport)
    if lights is None:
        lights = scene.lights if scene.lights is not None and scene.lights.n_lights else DEFAULT_LIGHTS
    source = _TracedScene(scene)
    return SceneSetup(scene.name, scene.n_triangles, cameras, options.seed, source, lights, options)


def _scene(options: SceneOptions) -> Scene:
    name = options.scene or DEFAULT_SCENE
    if name in GALLERY:
        return build_scene(name, options.n_triangles, options.seed)
    _refuse_triangles(options)
    if not Path(name).suffix and not Path(name).exists():
        raise InputError(f"scene `{name}`: neither a file nor a built-in scene; built in are {', '.join(GALLERY)}.")
    return load_scene(name)


def _refuse_triangles(options: SceneOptions) -> None:
    if options.n_triangles is not None:
        raise InputError(
            f"--triangles {options.n_triangles}: {options.scene} has its own; it goes with a built-in scene: "
            f"{', '.join(GALLERY)}."
        )


def _given_lights(given: str | None) -> Lights | int | None:
    if given is None:
        return None
    try:
        n_lights = int(given)
    except ValueError:
        return load_lights(given)
    if not 0 <= n_lights <= MAX_SCATTERED_LIGHTS:
        raise InputError(
            f"lights {n_lights}: must be a lights.csv, or a number of lights from 0 to {MAX_SCATTERED_LIGHTS:,}."
        )
    return n_lights


def _own_sample_files(scene: str | None) -> tuple[Path, ...]:
    if scene is None:
        return ()
    path = Path(scene)
    if path.is_dir():
        files = tuple(sorted(path.glob("*.npz")))
        if not files:
            raise InputError(f"{path}: a folder without .npz files; name a scene file, or a folder of G-buffers.")
        return files
    return (path,) if path.suffix.lower() == ".npz" else ()


def _own_setup(
    options: SceneOptions, files: tuple[Path, ...], cameras: CameraPath | None, lights: Lights | int | None
) -> SceneSetup:
    _refuse_triangles(options)
    missing = next((file for file in files if not file.is_file()), None)
    if missing:
        raise InputError(f"{missing}: no such file; give the path of a G-buffer as .npz.")
    if cameras is None:
        raise InputError(f"{files[0]}: a G-buffer needs --cameras with the camera of each frame.")
    if options.viewport and options.viewport != cameras.viewport:
        raise InputError(f"{files[0]}: --size cannot change a G-buffer; leave it out.")
    if len(cameras) < len(files):
        raise InputError(f"{options.cameras}: has {len(cameras)} frames for {len(files)} G-buffers; give one for each.")
    cameras = replace(cameras, poses=cameras.poses[: len(files)])
    name = files[0].stem if len(files) == 1 else files[0].parent.name
    return SceneSetup(
        name, 0, cameras, options.seed, _OwnSamples(files), DEFAULT_LIGHTS if lights is None else lights, options
    )
