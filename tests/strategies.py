"""Inputs of the tests: values over their whole range, shapes from short lists, as each shape compiles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from tests import oracles
from vtfs.camera import Camera, Lens, Viewport
from vtfs.gbuffer import Fragments, GBuffer, Positions
from vtfs.layers import Layers, TransparentLayer
from vtfs.lights import Lights
from vtfs.view_samples import ViewSamples

SMALL, WIDE = Viewport(33, 17), Viewport(64, 40)
N_LIGHTS = (1, 37, 200)
BRANCHINGS = (2, 8, 32, 64)

seeds = st.integers(0, 2**32 - 1)


def a_camera(
    viewport: Viewport = SMALL,
    near_m: float = 0.1,
    far_m: float = 100.0,
    fov_y_deg: float = 60.0,
    eye_m: tuple[float, float, float] = (1.0, 2.0, 3.0),
) -> Camera:
    target = (eye_m[0] + 3.0, eye_m[1] - 1.0, eye_m[2] - 7.0)
    return Camera(eye_m, target, (0.0, 1.0, 0.0), fov_y_deg, near_m, far_m, viewport)


@st.composite
def cameras(draw) -> Camera:
    """Far over near up to 1e5 or infinite, at the origin or 100 km from it."""
    near_m = draw(st.sampled_from([1e-3, 0.1, 1.0]))
    ratio = draw(st.one_of(st.floats(1.001, 1e5), st.just(math.inf)))
    eye_m = draw(st.sampled_from([(0.0, 0.0, 0.0), (1.0, -20.0, 3.0), (1e5, -3e4, 1e5)]))
    return a_camera(SMALL, near_m, near_m * ratio, draw(st.floats(2, 150)), eye_m)


def samples_at(camera: Camera, depth_m: np.ndarray, valid: np.ndarray, rng: np.random.Generator) -> ViewSamples:
    """Samples at given depths `[h, w]` on the rays through pixel centres, of random materials."""
    viewport = camera.viewport
    shape = (viewport.height_px, viewport.width_px)
    top = math.tan(math.radians(camera.fov_y_deg) / 2)
    right = top * viewport.width_px / viewport.height_px
    x = (2 * (np.arange(shape[1]) + 0.5) / shape[1] - 1) * right
    y = (1 - 2 * (np.arange(shape[0]) + 0.5) / shape[0]) * top
    ray = np.stack([*np.meshgrid(x, y), -np.ones(shape)], axis=-1)
    normal = rng.normal(size=(*shape, 3))
    normal *= -np.sign((normal * ray).sum(-1, keepdims=True))  # towards the eye
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)

    def channel(low: float, high: float, columns: tuple[int, ...] = ()) -> np.ndarray:
        return rng.uniform(low, high, (*shape, *columns)).astype(np.float32)

    return ViewSamples(
        camera,
        np.where(valid[..., None], ray * depth_m[..., None], 0).astype(np.float32),
        normal.astype(np.float32),
        channel(0.05, 1, (3,)),
        channel(0, 0.2),
        channel(1, 64),
        np.where(rng.random((*shape, 1)) < 0.1, channel(0, 2, (3,)), 0).astype(np.float32),
        np.where(valid, 0, -1).astype(np.int32),
        valid,
    )


def through(samples: ViewSamples, lens: Lens) -> ViewSamples:
    """The same depths seen through another lens."""
    camera = replace(samples.camera, lens=lens)
    slope = np.stack(np.meshgrid(*camera.pixel_slopes()), axis=-1)
    width = 1.0 if camera.is_orthographic else -samples.position_m[..., 2:].astype(np.float64)
    position_m = samples.position_m.copy()
    position_m[..., :2] = np.where(samples.valid[..., None], slope * width, 0)
    return replace(samples, camera=camera, position_m=position_m)


def random_samples(camera: Camera, seed: int, valid_share: float = 0.8) -> ViewSamples:
    """Depths log-uniform over the whole range, the planes themselves included."""
    rng = np.random.default_rng(seed)
    shape = (camera.viewport.height_px, camera.viewport.width_px)
    far_m = camera.far_m if math.isfinite(camera.far_m) else camera.near_m * 1e4
    depth_m = camera.near_m * (far_m / camera.near_m) ** rng.random(shape)
    depth_m = np.where(rng.random(shape) < 0.05, camera.near_m, depth_m)
    depth_m = np.where(rng.random(shape) < 0.05, far_m, depth_m)
    return samples_at(camera, depth_m, rng.random(shape) < valid_share, rng)


def surface_samples(camera: Camera, seed: int, valid_share: float = 0.9) -> ViewSamples:
    """Depths as of a few smooth surfaces 2 to 20 m away: neighbours share cells."""
    rng = np.random.default_rng(seed)
    height, width = camera.viewport.height_px, camera.viewport.width_px
    y, x = np.mgrid[:height, :width] / max(height, width)
    depth_m = 4 + 3 * np.sin(7 * x + rng.uniform(0, 6)) * np.cos(5 * y) + 10 * (x + y > rng.uniform(0.3, 1.2))
    return samples_at(camera, depth_m, rng.random((height, width)) < valid_share, rng)


def layered_samples(camera: Camera, seed: int, n_layers: int = 3) -> ViewSamples:
    """Solid surfaces with sparse transparent layers before them, and hidden fragments behind."""
    rng = np.random.default_rng(seed)
    solid = surface_samples(camera, seed)
    shape = solid.valid.shape
    depth_m = np.where(solid.valid, -solid.position_m[..., 2], 5.0)

    def layer(share: float) -> ViewSamples:
        # Only the left part, so that some runs have no sample and some tiles no layer.
        valid = (rng.random(shape) < 0.5) & (np.arange(shape[1]) < 0.7 * shape[1])
        return samples_at(camera, depth_m * share, valid, rng)

    nearest_first = [layer(share) for share in np.sort(rng.uniform(0.3, 0.95, n_layers))]
    transparent = tuple(
        TransparentLayer(samples, np.where(samples.valid, rng.random(shape), 0).astype(np.float32))
        for samples in nearest_first
    )
    hidden = tuple(layer(share) for share in rng.uniform(1.05, 3, 2))
    return replace(solid, layers=Layers(lambda: transparent, lambda: hidden))


def positions_of(samples: ViewSamples, with_hidden: bool = False) -> Positions:
    return Fragments(samples, with_hidden=with_hidden).positions()


def gbuffer_of(samples: ViewSamples, precision: str = "float32") -> GBuffer:
    return Fragments(samples, with_hidden=False).gbuffer(positions_of(samples), precision)


def samples_in_slices(
    viewport: Viewport, n_slices: int, seed: int, valid_share: float = 0.8
) -> tuple[ViewSamples, np.ndarray]:
    """Samples well inside known slices `[h, w]`, so that float32 and float64 agree on the slice."""
    rng = np.random.default_rng(seed)
    camera = a_camera(viewport, 0.1, 100.0)
    shape = (viewport.height_px, viewport.width_px)
    slices = rng.integers(rng.integers(n_slices), n_slices, shape)
    growth = (camera.far_m / camera.near_m) ** (1 / n_slices)
    depth_m = camera.near_m * growth ** (slices + rng.uniform(0.05, 0.95, shape))
    return samples_at(camera, depth_m, rng.random(shape) < valid_share, rng), slices


def no_lights() -> Lights:
    return Lights(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


def lights_in_view(
    camera: Camera, position_m: np.ndarray, range_m: np.ndarray, rng: np.random.Generator, spots: bool = False
) -> Lights:
    """Lights at view-space positions, of random colours; every other one a spot where `spots`."""
    n = len(range_m)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    cos_inner, cos_outer = np.full(n, -1.0), np.full(n, -2.0)
    if spots:
        cos_outer[::2] = rng.uniform(-0.9, 0.9, len(cos_outer[::2]))
        cos_inner[::2] = cos_outer[::2] + rng.uniform(0.05, 0.1, len(cos_outer[::2]))
    return Lights(
        oracles.in_world_space(camera, position_m), range_m, rng.uniform(0, 3, (n, 3)), direction, cos_inner, cos_outer
    )


LIGHT_KINDS = ("touching", "behind", "around_eye", "huge", "no_range", "on_planes", "one_point", "anywhere")


def adversarial_lights(samples: ViewSamples, n_lights: int, kinds: tuple[str, ...], seed: int) -> Lights:
    """Lights of the given kinds in turn.

    - `touching`: ends less than a millionth of its range behind a sample;
    - `on_planes`: centred on a corner of 16-pixel tiles, at a sample's depth, with a power of two as range.
    """
    rng = np.random.default_rng(seed)
    camera = samples.camera
    seen = samples.position_m[samples.valid].astype(np.float64)
    if not len(seen):
        seen = np.array([[0.0, 0.0, -camera.near_m]])
    position_m, range_m = np.zeros((n_lights, 3)), np.zeros(n_lights)
    for n in range(n_lights):
        kind = kinds[n % len(kinds)]
        sample = seen[rng.integers(len(seen))]
        scale = np.linalg.norm(sample)
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        distance = scale * 10 ** rng.uniform(-3, 2)
        position_m[n] = sample + direction * distance
        range_m[n] = distance * (1 + 10 ** rng.uniform(-9, -6))
        if kind == "behind":
            position_m[n] = (*rng.normal(size=2) * scale, abs(rng.normal()) * scale)
            range_m[n] = np.linalg.norm(position_m[n] - sample) * rng.uniform(0.9, 1.5)
        elif kind == "around_eye":
            position_m[n], range_m[n] = direction * scale * 1e-3, scale * rng.uniform(0.01, 2)
        elif kind == "huge":
            range_m[n] = 10 ** rng.uniform(3, 8) * scale
        elif kind == "no_range":
            position_m[n], range_m[n] = sample, 0.0
        elif kind == "on_planes":
            corner_px = 16 * rng.integers(0, 3, 2) / camera.viewport.height_px * 2
            depth_m = -sample[2]
            position_m[n] = (
                (corner_px[0] - camera.viewport.width_px / camera.viewport.height_px) * camera.tan_half_y * depth_m,
                (1 - corner_px[1]) * camera.tan_half_y * depth_m,
                -depth_m,
            )
            range_m[n] = 2.0 ** rng.integers(-8, 4) * depth_m
        elif kind == "one_point":
            position_m[n], range_m[n] = seen[0], 0.3 * np.linalg.norm(seen[0])
        elif kind == "anywhere":
            range_m[n] = distance * 10 ** rng.uniform(-1, 1)
    return lights_in_view(camera, position_m, range_m, rng)


def nearby_lights(samples: ViewSamples, n_lights: int, seed: int, spots: bool = False) -> Lights:
    """Lights at least a decimetre from every sample: float32 is then good to 1e-5 everywhere."""
    rng = np.random.default_rng(seed)
    seen = samples.position_m[samples.valid].astype(np.float64)
    if not len(seen):
        seen = np.array([[0.0, 0.0, -1.0]])
    position_m = np.zeros((0, 3))
    while len(position_m) < n_lights:
        some = seen[rng.integers(len(seen), size=4 * n_lights + 8)] + rng.normal(size=(4 * n_lights + 8, 3))
        gap = np.linalg.norm(some[:, None] - seen, axis=2).min(axis=1)
        position_m = np.concatenate([position_m, some[gap > 0.1]])
    return lights_in_view(samples.camera, position_m[:n_lights], rng.uniform(0.5, 6, n_lights), rng, spots)
