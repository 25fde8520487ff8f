"""The ladders of the light tests, on the built-in stage or on a user's view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vtfs.lights import Lights, point_lights
from vtfs.stability.ladder import Ladder, Rung, power_of_ten
from vtfs.stability.light_methods import N_LIGHTS, LightCase
from vtfs.stability.shadow_ladders import OFFSET_WAY, posts
from vtfs.stability.stage import Stage, default_stage

LightLadder = Ladder[LightCase]
Placed = tuple[np.ndarray, np.ndarray]

_SOURCE = "built-in"


def light_ladders(seed: int) -> tuple[LightLadder, ...]:
    """All ladders on the built-in stage. Lights are placed about the samples that the camera sees."""
    stage = default_stage(seed)
    extent_m = stage.extent_m

    def of(name: str, title: str, rungs: list[tuple[str, Callable[[], LightCase]]]) -> LightLadder:
        return Ladder(name, title, _SOURCE, tuple(Rung(label, make) for label, make in rungs))

    def rng() -> np.random.Generator:
        return np.random.default_rng(seed + 2)

    def mixed(on: Stage) -> LightCase:
        return _case(on, lambda seen: _mixed(seen, on.extent_m, rng()))

    def lens(near_m: float, far_m: float) -> Stage:
        return replace(stage, camera=replace(stage.camera, near_m=near_m, far_m=far_m))

    def powers(exponents: range | tuple[int, ...]) -> list[tuple[str, float]]:
        return [(power_of_ten(e), 10.0**e) for e in exponents]

    offsets = [("0", 0.0), *powers(range(7))]
    return (
        of(
            "offset",
            "Offset from the origin, over a tenth of the extent",
            [(label, lambda o=o: mixed(stage.moved(1.0, OFFSET_WAY * o * extent_m / 10))) for label, o in offsets],
        ),
        of(
            "scale",
            "Scale of everything",
            [(label, lambda s=s: mixed(stage.moved(s, np.zeros(3)))) for label, s in powers(range(-3, 7))],
        ),
        of(
            "touching",
            "Lights that end just beyond a sample, over their range",
            [
                (label, lambda g=g: _case(stage, lambda seen: _touching(seen, g, rng())))
                for label, g in powers((-1, -3, -5, -6, -7, -9, -12))
            ],
        ),
        of(
            "light_to_camera",
            "Lights around the camera, distance over the extent",
            [
                (label, lambda d=d: _case(stage, lambda seen: _around_the_eye(seen, d * extent_m, extent_m, rng())))
                for label, d in (*powers((0, -1, -2, -4, -6, -8)), ("0", 0.0))
            ],
        ),
        of(
            "range",
            "Range of the lights, over the extent",
            [
                (label, lambda r=r: _case(stage, lambda seen: _beside(seen, r * extent_m, rng())))
                for label, r in powers((-6, -4, -2, -1, 0, 2, 4, 8))
            ],
        ),
        of(
            "crowd",
            "Lights on one place",
            [
                (str(n), lambda n=n: _case(stage, lambda seen: _crowd(seen, n, extent_m, rng())))
                for n in (8, 32, 33, 64, 128)
            ],
        ),
        of(
            "near",
            "Near plane, over the extent",
            [
                (label, lambda n=n: mixed(lens(n * extent_m, 100.0)))
                for label, n in powers((-2, -3, -4, -5, -6, -8, -10, -20))
            ],
        ),
        of(
            "far",
            "Far plane, over the extent",
            [
                (label, lambda f=f: mixed(lens(0.1, f * extent_m)))
                for label, f in (*powers((1, 2, 4, 6, 9, 12)), ("infinite", math.inf))
            ],
        ),
        of(
            "discontinuities",
            "Posts before the camera, in each tile of 8 pixels",
            [(str(n), lambda n=n: mixed(stage.with_triangles(posts(stage.camera, n)))) for n in (0, 1, 2, 4)],
        ),
    )


def _case(stage: Stage, place: Callable[[np.ndarray], Placed]) -> LightCase:
    """Lights where `place` puts them, given the samples, relative to the eye: positions and ranges."""
    samples = stage.case().samples
    eye_m = np.array(stage.camera.eye_m)
    seen = samples.position_m[samples.valid].astype(np.float64) @ stage.camera.view_from_world[:3, :3]
    position_m, range_m = place(seen)
    return LightCase(samples, _lights(position_m + eye_m, range_m))


def _lights(position_m: np.ndarray, range_m: np.ndarray) -> Lights:
    return point_lights(position_m, range_m, np.ones((len(range_m), 3)))


def _directions(n: int, rng: np.random.Generator) -> np.ndarray:
    way = rng.normal(size=(n, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def _touching(
    seen: np.ndarray,
    gap: float | np.ndarray,
    rng: np.random.Generator,
    n: int = N_LIGHTS,
) -> Placed:
    """Lights up to a tenth as far from a sample as the eye is, which end `gap` of that beyond it."""
    sample = seen[rng.integers(len(seen), size=n)]
    distance = np.linalg.norm(sample, axis=1) * 10 ** rng.uniform(-2.5, -1, n)
    return sample + _directions(n, rng) * distance[:, None], distance * (1 + gap)


def _beside(seen: np.ndarray, range_m: float, rng: np.random.Generator, n: int = N_LIGHTS) -> Placed:
    """Lights half their range from a sample."""
    sample = seen[rng.integers(len(seen), size=n)]
    return sample + _directions(n, rng) * range_m / 2, np.full(n, range_m)


def _around(distance_m: float, range_m: float, rng: np.random.Generator, n: int = N_LIGHTS) -> Placed:
    """Lights around the eye, in all directions, of up to twice a range."""
    return _directions(n, rng) * distance_m, range_m * rng.uniform(0.5, 2, n)


def _around_the_eye(seen: np.ndarray, distance_m: float, extent_m: float, rng: np.random.Generator) -> Placed:
    """An eighth of the lights about the eye, reaching most of what it sees; the others end just beyond a sample."""
    n = N_LIGHTS // 8
    parts = _around(distance_m, 0.6 * extent_m, rng, n), _touching(seen, 1e-7, rng, N_LIGHTS - n)
    position, range_m = zip(*parts, strict=True)
    return np.concatenate(position), np.concatenate(range_m)


def _crowd(seen: np.ndarray, n: int, extent_m: float, rng: np.random.Generator) -> Placed:
    """`n` lights over one sample; the others reach nothing."""
    sample = seen[rng.integers(len(seen))]
    position = sample + _directions(N_LIGHTS, rng) * 0.02 * extent_m
    return position, np.where(np.arange(N_LIGHTS) < n, 0.04 * extent_m, 0.0)


def _mixed(seen: np.ndarray, extent_m: float, rng: np.random.Generator) -> Placed:
    """Lights that end just beyond a sample, lights among the samples, and some around and behind the eye."""
    n = N_LIGHTS // 8
    parts = (
        _touching(seen, 10 ** rng.uniform(-8, -6, 6 * n), rng, 6 * n),
        _beside(seen, 0.05 * extent_m, rng, n),
        _around(0.05 * extent_m, 0.2 * extent_m, rng, n),
    )
    position, range_m = zip(*parts, strict=True)
    return np.concatenate(position), np.concatenate(range_m)
