"""The atrium: a two-storey courtyard."""

from __future__ import annotations

import numpy as np

from vtfs.camera import CameraPath, Pose
from vtfs.gallery_scenes.layout import CLOTH, FRAMES, IRON, Detail, Layout, bush, path_of
from vtfs.scene import Material
from vtfs.shapes import Part, arch, ball, box, copies, flat, joined, surface, turned

_STONE = Material("stone", (0.55, 0.48, 0.38))
_PALE = Material("pale stone", (0.68, 0.62, 0.52))
_BRICK = Material("brick", (0.42, 0.27, 0.20))
_TILE = Material("floor tiles", (0.38, 0.35, 0.32), specular=0.08, shininess=64.0)
_DARK_TILE = Material("dark floor tiles", (0.16, 0.14, 0.13), specular=0.08, shininess=64.0)
_WOOD = Material("wood", (0.24, 0.13, 0.06))
_CLAY = Material("clay", (0.45, 0.20, 0.11))
_PLANT = Material("plant", (0.10, 0.28, 0.06), two_sided=True)
_FLAME = Material("flame", (0.9, 0.5, 0.2), emissive=(2.0, 1.1, 0.4))

_COURT_X, _COURT_Z, _AISLE = 15.0, 6.0, 4.0  # half the open court, and the width of the aisles around it
_STOREY = 5.0


def atrium(wanted: int, n: Detail, seed: int) -> Layout:
    """A two-storey courtyard after the manner of Sponza: open above, aisles behind columns and arches.

    Below 8,000 triangles its bays are twice as wide, and there are neither balusters nor bases of columns.
    """
    rng = np.random.default_rng(seed)
    is_plain = wanted < 8_000
    bay = 6.0 if is_plain else 3.0
    outer_x, outer_z = _COURT_X + _AISLE, _COURT_Z + _AISLE
    parts: Layout = []
    columns, bays, yaws = _ring(bay)
    for storey in range(2):
        y = storey * _STOREY
        lift = np.array([0, y + (0.15 if storey else 0), 0])
        parts.append((_PALE, copies(_column(n, is_plain), columns + lift)))
        spandrel = arch(bay, 0.4 * bay if bay < 4 else 1.7, 1.75, 0.6, n(20, 2 if is_plain else 4), n(2))
        parts.append((_PALE, copies(spandrel, bays + lift + np.array([0, 3.1, 0]), yaws)))
    parts += _atrium_shell(n, outer_x, outer_z)
    # Railings between the upper columns: a rail on balusters.
    level = np.array([0, _STOREY + 0.15, 0])
    if not is_plain:
        per_bay = int(np.clip(round(9 * n.level), 2, 12))
        along = (np.arange(per_bay) + 0.5) / per_bay * (bay - 0.7) - (bay - 0.7) / 2
        across = np.stack([np.cos(yaws), np.zeros_like(yaws), -np.sin(yaws)], 1)
        feet = (bays[:, None] + along[None, :, None] * across[:, None]).reshape(-1, 3) + level
        profile = [(0.05, 0.0), (0.03, 0.15), (0.07, 0.4), (0.03, 0.7), (0.05, 0.9)]
        parts.append((IRON, copies(turned(profile, n(6, 3), n(1)), feet)))
    rail = box((-bay / 2 + 0.2, 0.9, -0.07), (bay / 2 - 0.2, 1.0, 0.07), (n(6), 1, 1))
    parts.append((_WOOD, copies(rail, bays + level, yaws)))
    # Curtains: some bays of both storeys, each cloth a little different.
    hung = [i for i in range(len(bays)) if (i // 2) % 2 == 0 or rng.random() < 0.25]
    for i in hung:
        for y, drop in ((3.35, rng.uniform(2.0, 2.9)), (_STOREY + 3.5, rng.uniform(1.2, 2.2))):
            cloth = _curtain(n, bay - 0.7, drop, rng)
            inward = np.array([np.sin(yaws[i]), 0, np.cos(yaws[i])])
            at = bays[i] + np.array([0, y, 0]) - 0.45 * inward
            parts.append((CLOTH[(i // 2) % 3], copies(cloth, at, yaws[i])))
    # Pots with plants along the long sides, and braziers on iron stands along the middle.
    pots = np.array([(x, 0, z) for x in (-12.0, -6.0, 0.0, 6.0, 12.0) for z in (-4.9, 4.9)])
    pots = pots[::3] if is_plain else pots
    parts.append((_CLAY, copies(turned([(0.3, 0.0), (0.5, 0.5), (0.38, 0.75)], n(14, 4), n(3)), pots)))
    plants = pots + np.array([0, 1.0, 0])
    parts.append((_PLANT, copies(bush(n, rng), plants, rng.uniform(0, 6.28, len(pots)))))
    stands = np.array([(-9.0, 0, 0), (0.0, 0, 0), (9.0, 0, 0)])[: 1 if is_plain else 3]
    parts.append((IRON, copies(turned([(0.25, 0), (0.05, 0.1), (0.05, 0.8), (0.3, 1.0)], n(12, 4), n(2)), stands)))
    parts.append((_FLAME, copies(ball(0.2, n(6, 2)), stands + np.array([0, 1.05, 0]))))
    return parts


def _ring(bay: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Feet of the columns and of the bays around the court, `[K, 3]` each, and the bays' yaw: +z looks inward."""
    xs = np.arange(-_COURT_X, _COURT_X + 0.1, bay)
    zs = np.arange(-_COURT_Z, _COURT_Z + 0.1, bay)
    columns = [(x, 0, z) for x in xs for z in (-_COURT_Z, _COURT_Z)]
    columns += [(x, 0, z) for z in zs[1:-1] for x in (-_COURT_X, _COURT_X)]
    bays, yaws = [], []
    for x in (xs[:-1] + xs[1:]) / 2:
        bays += [(x, 0, -_COURT_Z), (x, 0, _COURT_Z)]
        yaws += [0.0, np.pi]
    for z in (zs[:-1] + zs[1:]) / 2:
        bays += [(-_COURT_X, 0, z), (_COURT_X, 0, z)]
        yaws += [np.pi / 2, -np.pi / 2]
    return np.array(columns), np.array(bays), np.array(yaws)


def _column(n: Detail, is_plain: bool) -> Part:
    """A round column 3.3 m high, with base and capital unless it is plain."""
    if is_plain:
        return turned([(0.30, 0.0), (0.26, 3.3)], n(16, 4), n(6))
    shaft = turned([(0.30, 0.25), (0.31, 1.2), (0.27, 2.2), (0.24, 2.8), (0.36, 3.1)], n(30, 5), n(3))
    edge = (n(2), n(1), n(2))
    return joined(shaft, box((-0.4, 0, -0.4), (0.4, 0.25, 0.4), edge), box((-0.4, 3.1, -0.4), (0.4, 3.3, 0.4), edge))


def _atrium_shell(n: Detail, outer_x: float, outer_z: float) -> Layout:
    """Floor, outer walls, the floor of the balcony and the roof of the aisles."""
    top = 2 * _STOREY
    parts: Layout = [
        (_TILE, flat((-outer_x, 0, outer_z), (2 * outer_x, 0, 0), (0, 0, -2 * outer_z), n(28), n(15))),
        (_DARK_TILE, flat((-12.5, 0.004, 3.2), (25, 0, 0), (0, 0, -6.4), n(20), n(5))),
    ]
    for z, side in ((-outer_z, 1), (outer_z, -1)):
        parts.append((_BRICK, _wall((-side * outer_x, 0, z), (2 * side * outer_x, 0, 0), top, n(40), n(12))))
    for x, side in ((-outer_x, -1), (outer_x, 1)):
        parts.append((_BRICK, _wall((x, 0, -side * outer_z), (0, 0, 2 * side * outer_z), top, n(22), n(12))))
    rim = 0.35  # slabs reach a little over the columns
    for y0, y1, material in ((_STOREY - 0.15, _STOREY + 0.15, _STONE), (top, top + 0.3, _PALE)):
        inner_x, inner_z = _COURT_X - rim, _COURT_Z - rim
        for z0, z1 in ((-outer_z, -inner_z), (inner_z, outer_z)):
            parts.append((material, box((-outer_x, y0, z0), (outer_x, y1, z1), (n(20), 1, n(3)))))
        for x0, x1 in ((-outer_x, -inner_x), (inner_x, outer_x)):
            parts.append((material, box((x0, y0, -inner_z), (x1, y1, inner_z), (n(3), 1, n(8)))))
    return parts


def _wall(origin: tuple[float, ...], along: tuple[float, float, float], height: float, n_u: int, n_v: int) -> Part:
    """An upright wall with shallow relief, so that many triangles are not all in one plane."""
    length = float(np.hypot(along[0], along[2]))
    inward = np.array([along[2], 0, -along[0]]) / length

    def point(u: np.ndarray, v: np.ndarray):
        relief = 0.03 * np.sin(u * length * 4) * np.sin(v * height * 5)
        return (
            origin[0] + u * along[0] + relief * inward[0], origin[1] + v * height,
            origin[2] + u * along[2] + relief * inward[2],
        )  # fmt: skip

    return surface(n_u, n_v, point)


def _curtain(n: Detail, width: float, drop: float, rng: np.random.Generator) -> Part:
    """A hanging cloth whose folds widen downward; its top edge is at y = 0."""
    folds, phase, gather = rng.uniform(5, 8), rng.uniform(0, 6.28), rng.uniform(0.0, 0.25)

    def point(u: np.ndarray, v: np.ndarray):
        deep = 0.05 + 0.12 * v
        x = (u - 0.5) * width * (1 - gather * v * (1 - v) * 2)
        z = deep * np.sin(2 * np.pi * folds * u + phase + 0.6 * v) + 0.04 * np.sin(9 * v + 5 * u)
        return x, -drop * v - 0.05 * np.sin(2 * np.pi * u) * v, z

    return surface(n(48, 2), n(20), point)


def atrium_path() -> CameraPath:
    """Once around the court, rising to the balcony and back, looking across it."""
    poses = []
    for t in 2 * np.pi * np.arange(FRAMES) / FRAMES:
        eye = (11.5 * np.cos(t), 3.2 - 1.5 * np.cos(t), 3.4 * np.sin(t))
        target = (11.5 * np.cos(t + 2.2), 3.4 - 0.8 * np.cos(2 * t), 5.0 * np.sin(t + 2.2))
        poses.append(Pose(eye, target, (0.0, 1.0, 0.0)))
    return path_of(poses, 65.0, 100.0)
