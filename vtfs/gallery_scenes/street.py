"""The street: two rows of houses."""

from __future__ import annotations

import numpy as np

from vtfs.camera import CameraPath, Pose
from vtfs.gallery_scenes.layout import CLOTH, FRAMES, IRON, Detail, Layout, floats, path_of
from vtfs.scene import Material
from vtfs.shapes import Part, ball, box, copies, flat, joined, surface, turned

_ASPHALT = Material("asphalt", (0.09, 0.09, 0.10))
_PAVING = Material("paving", (0.36, 0.35, 0.33))
_KERB = Material("kerb", (0.50, 0.49, 0.46))
_LINE = Material("road marking", (0.75, 0.75, 0.70))
_GLASS = Material("window glass", (0.05, 0.07, 0.10), specular=0.4, shininess=128.0)
_FRAME = Material("window frame", (0.70, 0.69, 0.65))
_ROOF = Material("roof", (0.30, 0.13, 0.09))
_DOOR = Material("door", (0.10, 0.16, 0.12))
_LAMP = Material("lamp", (0.9, 0.85, 0.7), emissive=(4.0, 3.4, 2.4))
_TYRE = Material("tyre", (0.03, 0.03, 0.03))
_PLASTER = tuple(
    Material(f"plaster {i}", colour)
    for i, colour in enumerate(
        (
            (0.62, 0.50, 0.33),
            (0.55, 0.30, 0.22),
            (0.50, 0.53, 0.50),
            (0.66, 0.60, 0.50),
            (0.36, 0.42, 0.50),
            (0.60, 0.42, 0.28),
        )
    )
)
_PAINT = tuple(
    Material(f"car paint {i}", colour, specular=0.2, shininess=96.0)
    for i, colour in enumerate(((0.45, 0.03, 0.03), (0.05, 0.10, 0.35), (0.55, 0.55, 0.57), (0.05, 0.05, 0.06)))
)

_STREET = 60.0  # half its length
_FACADE_X = 8.0  # from the middle of the road to the house fronts
_CELL_X, _CELL_Y = 3.0, 3.4  # one window with the wall around it


def street(wanted: int, n: Detail, seed: int) -> Layout:
    """A street between two rows of houses, with lamps, kerbs and parked cars; a house closes either end.

    Fewer triangles: wider houses, windows and gaps between lamps, as each of them costs some tens.
    """
    rng = np.random.default_rng(seed)
    is_plain = wanted < 9_000
    widen = float(np.clip((20_000 / wanted) ** 0.5, 1.0, 4.0))
    widths = (30.0,) if is_plain else (9.0, 12.0, 15.0)
    parts: Layout = []
    for side in (-1, 1):
        z = -_STREET
        while z < _STREET - 1e-9:
            width = min(float(rng.choice(widths)), 2 * _STREET - (z + _STREET))
            where = (side * _FACADE_X, 0.15, z + width / 2)
            parts += _house(n, (width, int(rng.integers(3, 6)), widen, is_plain), rng, where, -side * np.pi / 2)
            z += width
    for end in (-1, 1):
        where = (0.0, 0.0, end * (_STREET + 0.5))
        parts += _house(n, (18.0, 5, widen, is_plain), rng, where, 0.0 if end < 0 else np.pi)
    parts += _road(n)
    # Lamps on both pavements, cars at the kerbs.
    n_lamps = 1 if is_plain else 8
    lamp_z = (np.arange(n_lamps) + 0.5) / n_lamps * 2 * _STREET - _STREET
    at = np.array([(side * 4.7, 0.15, z + 2 * side) for z in lamp_z for side in (-1, 1)])
    yaw = np.array([0.0 if side < 0 else np.pi for _ in lamp_z for side in (-1, 1)])
    post = turned([(0.16, 0.0), (0.10, 0.5), (0.06, 0.6), (0.05, 5.0)], n(10, 3), n(3))
    arm = box((0.0, 4.9, -0.04), (1.3, 5.0, 0.04), (n(4), 1, 1))
    parts.append((IRON, copies(joined(post, arm), at, yaw)))
    bulbs = at + np.stack([1.3 * np.cos(yaw), np.full(len(yaw), 4.75), 0 * yaw], 1)
    parts.append((_LAMP, copies(ball(0.22, n(6, 2)), bulbs)))
    n_cars = 1 if is_plain else 16
    car_z = (np.arange(n_cars) + 0.5) / n_cars * 2 * _STREET - _STREET
    for i, z in enumerate(car_z):
        where = np.array([(-1) ** i * 3.35, 0.0, z + rng.uniform(-0.8, 0.8)])
        parts += _car(n, where, 0.0 if i % 2 else np.pi, _PAINT[int(rng.integers(len(_PAINT)))])
    return parts


def _house(
    n: Detail,
    size: tuple[float, int, float, bool],
    rng: np.random.Generator,
    at: tuple[float, float, float],
    yaw: float,
) -> Layout:
    """A house whose front looks along its own +z: recessed windows with ledges, a door, awnings, roof and chimney.

    `size`: width in metres, storeys, how much wider than usual windows are, and whether all ornament is left out.
    """
    width, n_storeys, widen, is_plain = size
    plaster = _PLASTER[int(rng.integers(len(_PLASTER)))]
    n_across = max(1, round(width / _CELL_X / widen))
    n_up = max(1, round(n_storeys / widen**0.5))
    cell_x, cell_y, height, depth = width / n_across, n_storeys * _CELL_Y / n_up, n_storeys * _CELL_Y, 9.0
    half, door = width / 2, n_across // 2
    inner = half - 0.02  # neighbours' side walls must not lie in one plane
    cells = [(i, j) for i in range(n_across) for j in range(n_up) if is_plain or (i, j) != (door, 0)]
    feet = np.array([((i + 0.5) * cell_x - half, j * cell_y, 0.0) for i, j in cells])
    wall, frame, glass = _window_cell(n, cell_x, cell_y)
    shell = [
        flat((inner, 0, 0), (0, 0, -depth), (0, height, 0), n(4), n(6)),
        flat((-inner, 0, -depth), (0, 0, depth), (0, height, 0), n(4), n(6)),
        copies(wall, feet),
    ]
    ridge = 2.2
    roof = [
        flat((-half, height, 0.4), (width, 0, 0), (0, ridge, -depth / 2 - 0.4), n(6), n(4)),
        flat((half, height, -depth), (-width, 0, 0), (0, ridge, depth / 2), n(6), n(4)),
    ]
    parts: Layout = []
    if not is_plain:
        door_x = (door + 0.5) * cell_x - half
        shell.append(flat((door_x - cell_x / 2, 0, 0), (cell_x, 0, 0), (0, cell_y, 0), n(4), n(4)))
        chimney_x = rng.uniform(-0.6, 0.6) * half
        shell.append(
            box((chimney_x - 0.4, height + 0.8, -4.0), (chimney_x + 0.4, height + 3.2, -3.2), (n(1), n(3), n(1)))
        )
        parts.append((_DOOR, box((door_x - 0.55, 0, 0.0), (door_x + 0.55, 2.3, 0.06), (n(2), n(3), 1))))
        cornice = box((-half, height - 0.25, 0.0), (half, height, 0.35), (n(6), 1, 1))
        step = box((door_x - 0.8, -0.15, 0.0), (door_x + 0.8, 0.08, 0.5), (n(2), 1, n(1)))
        parts.append((_FRAME, joined(copies(frame, feet), cornice, step)))
        if rng.random() < 0.5:  # a shop: awnings over the ground floor
            shops = np.array([((i + 0.5) * cell_x - half, 0.8 * cell_y, 0.0) for i in range(n_across) if i != door])
            awning = flat((-0.42 * cell_x, 0.25, 0.0), (0.84 * cell_x, 0, 0), (0, -0.45, 1.1), n(8), n(3))
            parts.append((CLOTH[int(rng.integers(3))], copies(awning, shops)))
    parts += [(plaster, joined(*shell)), (_GLASS, copies(glass, feet)), (_ROOF, joined(*roof))]
    return [(material, copies(part, np.array(at), yaw)) for material, part in parts]


def _window_cell(n: Detail, width: float, height: float) -> tuple[Part, Part, Part]:
    """Wall around a window, the window's reveal with its ledge, and the glass 0.25 m behind the wall."""
    x0, x1, y0, y1, back = -0.22 * width, 0.22 * width, 0.3 * height, 0.8 * height, -0.25
    half = width / 2
    wall = joined(
        flat((-half, 0, 0), (width, 0, 0), (0, y0, 0), n(4), n(2)),
        flat((-half, y1, 0), (width, 0, 0), (0, height - y1, 0), n(4), n(1)),
        flat((-half, y0, 0), (x0 + half, 0, 0), (0, y1 - y0, 0), n(1), n(2)),
        flat((x1, y0, 0), (half - x1, 0, 0), (0, y1 - y0, 0), n(1), n(2)),
    )
    frame = joined(
        flat((x0, y1, 0), (x1 - x0, 0, 0), (0, 0, back), n(2), 1),
        flat((x0, y0, 0), (0, y1 - y0, 0), (0, 0, back), n(2), 1),
        flat((x1, y0, back), (0, y1 - y0, 0), (0, 0, -back), n(2), 1),
        box((x0 - 0.15, y0 - 0.12, back), (x1 + 0.15, y0, 0.18), (n(3), 1, 1)),
    )
    return wall, frame, flat((x0, y0, back), (x1 - x0, 0, 0), (0, y1 - y0, 0), n(2), n(2))


def _road(n: Detail) -> Layout:
    """The cambered road with its line, kerbs, and pavements."""
    long = 2 * (_STREET + 1)

    def camber(u: np.ndarray, v: np.ndarray):
        return (u - 0.5) * 9, 0.06 * (1 - (2 * u - 1) ** 2), (0.5 - v) * long

    dashes = np.array([(0, 0.066, z) for z in np.arange(-_STREET + 3, _STREET, 10.0)])
    dash = flat((-0.06, 0, 1.5), (0.12, 0, 0), (0, 0, -3.0), 1, n(3))
    parts: Layout = [
        (_ASPHALT, surface(n(12), n(90), camber)),
        (_LINE, copies(dash, dashes)),
    ]
    for side in (-1, 1):
        x0, x1 = sorted((side * 4.2, side * 4.45))
        parts.append((_KERB, box((x0, 0, -long / 2), (x1, 0.16, long / 2), (1, 1, n(80)))))
        x0, x1 = sorted((side * 4.45, side * (_FACADE_X + 0.3)))
        parts.append((_PAVING, flat((x0, 0.15, long / 2), (x1 - x0, 0, 0), (0, 0, -long), n(6), n(90))))
    return parts


def _car(n: Detail, at: np.ndarray, yaw: float, paint: Material) -> Layout:
    """A parked car along z: a rounded body, a glass cabin, four wheels."""

    def shell(length: float, width: float, low: float, high: float, power: float) -> Part:
        def point(u: np.ndarray, v: np.ndarray):
            angle, tilt = -2 * np.pi * u, np.pi * (v - 0.5)
            squash = lambda w: np.sign(w) * np.abs(w) ** power  # noqa: E731  # a superellipsoid: a box with round edges
            x, z = squash(np.cos(angle)) * squash(np.cos(tilt)), squash(np.sin(angle)) * squash(np.cos(tilt))
            return width / 2 * x, (low + high) / 2 + (high - low) / 2 * squash(np.sin(tilt)), length / 2 * z

        return surface(n(24, 4), n(12, 3), point)

    across = turned([(0.0, -0.1), (0.32, -0.1), (0.32, 0.1), (0.0, 0.1)], n(14, 5), 1)

    def on_side() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        vertices, triangles, uv = across.build()
        return vertices[:, [1, 2, 0]], triangles, uv  # the wheel's axis from y to x

    wheel = Part(across.n_triangles, on_side)
    wheels = np.array([(x, 0.32, z) for x in (-0.8, 0.8) for z in (-1.3, 1.3)])
    parts = (
        (paint, shell(4.3, 1.8, 0.2, 0.95, 0.35)),
        (_GLASS, shell(2.4, 1.5, 0.7, 1.45, 0.5)),
        (_TYRE, copies(wheel, wheels)),
    )
    return [(material, copies(part, at, yaw)) for material, part in parts]


def street_path() -> CameraPath:
    """Up the road and back, looking ahead and to the house fronts on either side."""
    poses = []
    for t in 2 * np.pi * np.arange(FRAMES) / FRAMES:
        eye = np.array([0.9 * np.sin(t), 1.9 + 0.5 * np.sin(2 * t), -42 * np.cos(t)])
        yaw = 0.75 * np.sin(3 * t)
        target = eye + np.array([10 * np.sin(yaw), 0.6 + 0.6 * np.cos(2 * t), 10 * np.cos(yaw)])
        poses.append(Pose(floats(eye), floats(target), (0.0, 1.0, 0.0)))
    return path_of(poses, 60.0, 300.0)
