"""The ladders of the shadow methods, on the built-in stage or on a user's scene."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vtfs.camera import Camera
from vtfs.stability.bad_triangles import KINDS, bad_triangles, tilted_triangles
from vtfs.stability.canopies import under_lattice, under_t_junctions
from vtfs.stability.ladder import Ladder, Rung, power_of_ten
from vtfs.stability.stage import ShadowCase, Stage, default_stage

N_TRIANGLES, N_VERTICES, N_EDGES = 640, 2048, 2048
"""Shapes that hold every rung of the built-in ladders, so that each method is compiled once."""

_BUILT_IN = "built-in"
_N_BAD = 100
OFFSET_WAY = np.array([1.0, -0.3, 0.8])
"""In which offsets go, over their size."""

ShadowLadder = Ladder[ShadowCase]


def built_in_ladders(seed: int) -> tuple[ShadowLadder, ...]:
    """All ladders on the built-in stage."""
    stage = default_stage(seed)

    def of(name: str, title: str, rungs: list[tuple[str, Callable[[], Stage]]]) -> ShadowLadder:
        return Ladder(name, title, _BUILT_IN, tuple(Rung(label, _case(make)) for label, make in rungs))

    def rng() -> np.random.Generator:
        return np.random.default_rng(seed + 1)

    light = np.array(stage.light.position_m)
    exponents = (0, -2, -4, -6, -8, -9, -10, -12)
    misses = [*((power_of_ten(e), 10.0**e) for e in (-2, -4, -6, -7, -8, -10, -12, -14, -15)), ("0", 0.0)]
    shares = [*((power_of_ten(e), 10.0**e) for e in exponents), ("0", 0.0)]
    return (
        *_moved_ladders(stage),
        of(
            "aim",
            "Samples beside a vertex of a closed mesh, angle at the light",
            [(f"{label} rad", lambda m=miss: under_lattice(stage, m, rng())) for label, miss in misses],
        ),
        of(
            "edge_on",
            "Triangles edge-on to the light, sine of their tilt",
            [
                (label, lambda s=share: stage.with_triangles(tilted_triangles(light, _air(rng()), s, 0.5, rng())))
                for label, share in shares
            ],
        ),
        of(
            "slivers",
            "Slivers, width over length",
            [
                (label, lambda s=share: stage.with_triangles(tilted_triangles(light, _air(rng()), 0.7, s, rng())))
                for label, share in shares
            ],
        ),
        of(
            "light_to_plane",
            "Light over a table top, height over the extent",
            [(label, lambda s=share: _over_table(stage, s)) for label, share in shares],
        ),
        *_view_ladders(stage),
        of("nested", "Nested volumes over a sample", [(str(n), lambda n=n: _nested(stage, n, False)) for n in _COUNTS]),
        of(
            "camera_inside",
            "Volumes around the camera",
            [(str(n), lambda n=n: _nested(stage, n, True)) for n in (0, *_COUNTS)],
        ),
        of(
            "t_junctions",
            "T-junctions, vertices on each edge",
            [(str(n), lambda n=n: under_t_junctions(stage, n)) for n in (0, 1, 3, 7)],
        ),
        of(
            "duplicates",
            "The same triangles several times",
            [
                *((f"{n}×", lambda n=n: _copied(stage, n, False)) for n in (1, 2, 3, 5)),
                ("2×, one turned", lambda: _copied(stage, 2, True)),
            ],
        ),
        of(
            "degenerate",
            "Degenerate triangles",
            [(kind, lambda k=kind: stage.with_triangles(bad_triangles(k, light, _N_BAD, rng()))) for kind in KINDS],
        ),
        of(
            "discontinuities",
            "Posts before the camera, in each tile",
            [(str(n), lambda n=n: stage.with_triangles(posts(stage.camera, n))) for n in (0, 1, 2, 4)],
        ),
    )


def _moved_ladders(stage: Stage) -> tuple[ShadowLadder, ...]:
    """Offsets and scales of a whole view."""
    # A scene of a metre across a kilometre off is one of a hundred metres a hundred kilometres off.
    unit = stage.extent_m / 10
    nothing = np.zeros(3)

    def offset(e: int) -> np.ndarray:
        return OFFSET_WAY * unit * 10.0**e

    return (
        Ladder(
            "offset",
            "Offset from the origin, over a tenth of the extent",
            _BUILT_IN,
            (
                Rung("0", _case(lambda: stage)),
                *(Rung(power_of_ten(e), _case(lambda e=e: stage.moved(1.0, offset(e)))) for e in range(7)),
            ),
        ),
        Ladder(
            "scale",
            "Scale of everything",
            _BUILT_IN,
            tuple(Rung(power_of_ten(e), _case(lambda e=e: stage.moved(10.0**e, nothing))) for e in range(-3, 7)),
        ),
    )


def _view_ladders(stage: Stage) -> tuple[ShadowLadder, ...]:
    """A light that comes to the camera; near and far planes."""
    eye = np.array(stage.camera.eye_m)
    way = np.array([0.3, 0.8, 0.5])

    def lens(near_m: float, far_m: float) -> Stage:
        return replace(stage, camera=replace(stage.camera, near_m=near_m, far_m=far_m))

    extent_m, near_m, far_m = stage.extent_m, stage.camera.near_m, stage.camera.far_m
    return (
        Ladder(
            "light_to_camera",
            "Light at the camera, distance over the extent",
            _BUILT_IN,
            (
                *(
                    Rung(power_of_ten(e), _case(lambda e=e: stage.lit_from(eye + way * extent_m * 10.0**e)))
                    for e in (0, -1, -2, -4, -6, -8)
                ),
                Rung("0", _case(lambda: stage.lit_from(eye))),
            ),
        ),
        Ladder(
            "near",
            "Near plane, over the extent",
            _BUILT_IN,
            tuple(
                Rung(power_of_ten(e), _case(lambda e=e: lens(extent_m * 10.0**e, far_m)))
                for e in (-2, -3, -4, -5, -6, -8, -10, -20)
            ),
        ),
        Ladder(
            "far",
            "Far plane, over the extent",
            _BUILT_IN,
            (
                *(
                    Rung(power_of_ten(e), _case(lambda e=e: lens(near_m, extent_m * 10.0**e)))
                    for e in (1, 2, 4, 6, 9, 12)
                ),
                Rung("infinite", _case(lambda: lens(near_m, math.inf))),
            ),
        ),
    )


def _case(make: Callable[[], Stage]) -> Callable[[], ShadowCase]:
    return lambda: make().case()


def _air(rng: np.random.Generator) -> np.ndarray:
    """Points among the things on the stage, `[n, 3]`."""
    return rng.uniform([-5, 0.5, -5], [5, 4, 4], (_N_BAD, 3))


def _over_table(stage: Stage, height: float) -> Stage:
    """A table top to the left, and the light beside it at its height, or a little above."""
    top = np.array([[-4.5, 2.0, -3.0], [-1.5, 2.0, -3.0], [-1.5, 2.0, 2.0], [-4.5, 2.0, 2.0]])
    lit = stage.lit_from(np.array([5.0, 2.0 + height * 0.4 * stage.extent_m, -0.4]))
    return lit.with_mesh(top, np.array([[0, 2, 1], [0, 3, 2]]))


_COUNTS = (1, 2, 16, 128, 255, 256, 257, 300)


def _nested(stage: Stage, n: int, around_eye: bool) -> Stage:
    """Triangles one behind the other near the light, their shadows from one to two metres wide, over a place on the
    floor or over the eye."""
    light = np.array(stage.light.position_m)
    target = np.array(stage.camera.eye_m) if around_eye else np.array([-0.5, 0.0, 4.0])
    way = target - light
    along = np.cross(way, [0.0, 1.0, 0.0])
    along /= np.linalg.norm(along)
    up = np.cross(along, way)
    up /= np.linalg.norm(up)
    k = np.arange(n)
    share, reach = 0.12 + 0.06 * k / 300, (0.6 if around_eye else 1.0) * (1 + k / 300)
    angle = np.array([0.5, 0.5 + 2 / 3, 0.5 + 4 / 3]) * np.pi
    corner = np.cos(angle)[:, None] * along + np.sin(angle)[:, None] * up
    corners = light + share[:, None, None] * (way + reach[:, None, None] * corner)
    return stage.with_triangles(corners)


def _copied(stage: Stage, n: int, turned: bool) -> Stage:
    """All boxes and leaves `n` times, on the same vertices."""
    triangles = stage.casters.triangles
    once = np.concatenate([triangles[48:84], triangles[-40:]])
    again = once[:, ::-1] if turned else once
    return replace(stage, casters=replace(stage.casters, triangles=np.concatenate([triangles, *[again] * (n - 1)])))


def posts(camera: Camera, n_per_tile: int, tile_px: int = 8, depth_m: float = 3.0) -> np.ndarray:
    """Upright strips before the camera, `n_per_tile` across each tile, every other column of pixels at most: corners
    `[2 n, 3, 3]`."""
    if not n_per_tile:
        return np.zeros((0, 3, 3))
    matrix = camera.view_from_world[:3, :3]
    x, _ = camera.pixel_slopes()
    pitch = (x[1] - x[0]) * tile_px / n_per_tile
    left = x[0] - (x[1] - x[0]) / 2 + pitch * np.arange(n_per_tile * camera.viewport.width_px // tile_px)
    right, top, bottom = left + pitch / 2, 0.6 * camera.tan_half_y, -0.6 * camera.tan_half_y
    quads = [
        np.stack([a, np.full_like(a, b), -np.ones_like(a)], axis=1) * depth_m
        for a, b in ((left, bottom), (right, bottom), (right, top), (left, top))
    ]
    corners = np.concatenate([np.stack([quads[k] for k in t], axis=1) for t in ((0, 1, 2), (0, 2, 3))])
    return corners @ matrix + np.array(camera.eye_m)
