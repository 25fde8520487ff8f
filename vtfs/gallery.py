"""Built-in scenes: an atrium, a street and a grove, made to any triangle count from 1k to 1M.

Each scene is a function from a level of detail to parts; the level is searched so that the count comes out, and only
then are the parts built. Metres, y up; the same seed gives the same scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vtfs.camera import CameraPath, Pose, Viewport
from vtfs.input_error import InputError
from vtfs.scene import Material, Scene
from vtfs.shapes import Part, arch, ball, box, cards, copies, flat, joined, surface, turned

_FRAMES = 60
_FEWEST, _MOST = 1_000, 1_000_000


@dataclass(frozen=True)
class _Layout:
    """A scene before it is built: parts with their materials."""

    parts: list[tuple[Material, Part]]

    @property
    def n_triangles(self) -> int:
        return sum(part.n_triangles for _, part in self.parts)


@dataclass(frozen=True)
class Builtin:
    """A built-in scene: how it is laid out for a level of detail, and where its camera goes."""

    description: str
    default_triangles: int
    layout: Callable[[float, int], _Layout]
    path: Callable[[], CameraPath]


def build_scene(name: str, n_triangles: int | None = None, seed: int = 0) -> Scene:
    """A built-in scene with its camera path.

    **Arguments:**

    - `n_triangles`: 1,000 to 1,000,000; the scene has that many within 15 %. Each scene has its default.

    **Raises:** `InputError` for an unknown name or a count out of range.
    """
    if name not in GALLERY:
        raise InputError(f"scene `{name}`: unknown; built-in scenes are {', '.join(GALLERY)}.")
    builtin = GALLERY[name]
    wanted = builtin.default_triangles if n_triangles is None else n_triangles
    if not _FEWEST <= wanted <= _MOST:
        raise InputError(f"scene `{name}` `n_triangles` = {wanted}: must be from {_FEWEST} to {_MOST}.")
    layout = _with_count(builtin, wanted, seed)
    vertices, triangles, uvs, index, materials, n_vertices = [], [], [], [], [], 0
    for material, part in layout.parts:
        corner, faces, uv = part.build()
        vertices.append(corner)
        triangles.append(faces + n_vertices)
        uvs.append(uv)
        if material not in materials:
            materials.append(material)
        index.append(np.full(len(faces), materials.index(material), np.int32))
        n_vertices += len(corner)
    return Scene(
        name, np.concatenate(vertices), np.concatenate(triangles), np.concatenate(uvs).astype(np.float32),
        np.concatenate(index), tuple(materials), builtin.path(),
    )  # fmt: skip


def _with_count(builtin: Builtin, wanted: int, seed: int) -> _Layout:
    """The layout whose count comes closest, by bisection of the level of detail on a log scale."""
    low, high = 0.02, 64.0
    best = builtin.layout(low, seed)
    for _ in range(24):
        middle = (low * high) ** 0.5
        layout = builtin.layout(middle, seed)
        if abs(layout.n_triangles - wanted) < abs(best.n_triangles - wanted):
            best = layout
        low, high = (middle, high) if layout.n_triangles < wanted else (low, middle)
    return best


def _count(base: float, detail: float, least: int = 1) -> int:
    """How many quads along an edge that has `base` of them at detail 1."""
    return max(least, round(base * detail))


# --- atrium ---------------------------------------------------------------------------------------------------------

_STONE = Material("stone", (0.55, 0.48, 0.38))
_PALE = Material("pale stone", (0.68, 0.62, 0.52))
_BRICK = Material("brick", (0.42, 0.27, 0.20))
_TILE = Material("floor tiles", (0.38, 0.35, 0.32), specular=0.08, shininess=64.0)
_DARK_TILE = Material("dark floor tiles", (0.16, 0.14, 0.13), specular=0.08, shininess=64.0)
_IRON = Material("iron", (0.06, 0.06, 0.07), specular=0.3, shininess=80.0)
_WOOD = Material("wood", (0.24, 0.13, 0.06))
_CLOTH = (
    Material("red cloth", (0.50, 0.05, 0.05), two_sided=True),
    Material("green cloth", (0.06, 0.30, 0.10), two_sided=True),
    Material("blue cloth", (0.07, 0.12, 0.42), two_sided=True),
)
_CLAY = Material("clay", (0.45, 0.20, 0.11))
_PLANT = Material("plant", (0.10, 0.28, 0.06), two_sided=True)
_FLAME = Material("flame", (0.9, 0.5, 0.2), emissive=(2.0, 1.1, 0.4))

_COURT_X, _COURT_Z, _AISLE = 15.0, 6.0, 4.0  # half the open court, and the width of the aisles around it
_STOREY = 5.0
_BAY = 3.0


def _atrium(detail: float, seed: int) -> _Layout:
    """A two-storey courtyard after the manner of Sponza: open above, aisles behind columns and arches."""
    rng = np.random.default_rng(seed)
    n = lambda base, least=1: _count(base, detail, least)  # noqa: E731
    outer_x, outer_z = _COURT_X + _AISLE, _COURT_Z + _AISLE
    parts: list[tuple[Material, Part]] = []
    columns, bays, yaws = _ring()
    for storey in range(2):
        y = storey * _STOREY
        lift = np.array([0, y + (0.15 if storey else 0), 0])
        parts.append((_PALE, copies(_column(n), columns + lift)))
        parts.append((_PALE, copies(arch(_BAY, 1.2, 1.75, 0.6, n(10, 4), n(3)), bays + lift + (0, 3.1, 0), yaws)))
    parts += _atrium_shell(n, outer_x, outer_z)
    # Railings between the upper columns: a rail on balusters.
    per_bay = max(1, min(12, round(9 * detail)))
    along = (np.arange(per_bay) + 0.5) / per_bay * 2.3 - 1.15
    turned_along = np.stack([np.cos(yaws), np.zeros_like(yaws), -np.sin(yaws)], 1)
    feet = (bays[:, None] + along[None, :, None] * turned_along[:, None]).reshape(-1, 3) + (0, _STOREY + 0.15, 0)
    profile = [(0.05, 0.0), (0.03, 0.15), (0.07, 0.4), (0.03, 0.7), (0.05, 0.9)]
    parts.append((_IRON, copies(turned(profile, n(6, 3), n(1)), feet)))
    rail = box((-1.3, 0.9, -0.07), (1.3, 1.0, 0.07), (n(6), 1, 1))
    parts.append((_WOOD, copies(rail, bays + (0, _STOREY + 0.15, 0), yaws)))
    # Curtains: some bays of both storeys, each cloth a little different.
    hung = [i for i in range(len(bays)) if i % 2 == 0 or rng.random() < 0.2]
    for i in hung:
        for y, drop in ((3.35, rng.uniform(2.0, 2.9)), (_STOREY + 3.5, rng.uniform(1.2, 2.2))):
            cloth = _curtain(n, 2.3, drop, rng)
            inward = np.array([np.sin(yaws[i]), 0, np.cos(yaws[i])])
            at = bays[i] + (0, y, 0) - 0.45 * inward
            parts.append((_CLOTH[(i // 2) % 3], copies(cloth, at, yaws[i])))
    # Pots with plants along the middle, under the path of the camera, and braziers on iron stands.
    pots = np.array([(x, 0, z) for x in (-12.0, -6.0, 0.0, 6.0, 12.0) for z in (-4.9, 4.9)])
    parts.append((_CLAY, copies(turned([(0.3, 0.0), (0.5, 0.5), (0.38, 0.75)], n(12, 4), n(3)), pots)))
    parts.append((_PLANT, copies(_bush(n, rng), pots + (0, 1.0, 0), rng.uniform(0, 6.28, len(pots)))))
    stands = np.array([(-9.0, 0, 0), (0.0, 0, 0), (9.0, 0, 0)])
    parts.append((_IRON, copies(turned([(0.25, 0), (0.05, 0.1), (0.05, 0.8), (0.3, 1.0)], n(10, 4), n(2)), stands)))
    parts.append((_FLAME, copies(ball(0.2, n(5, 2)), stands + (0, 1.05, 0))))
    return _Layout(parts)


def _ring() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Feet of the columns and of the bays around the court, `[K, 3]` each, and the bays' yaw: +z looks inward."""
    xs = np.arange(-_COURT_X, _COURT_X + 0.1, _BAY)
    zs = np.arange(-_COURT_Z, _COURT_Z + 0.1, _BAY)
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


def _column(n: Callable[..., int]) -> Part:
    """A round column with base and capital, 3.3 m high."""
    shaft = turned([(0.30, 0.25), (0.31, 1.2), (0.27, 2.2), (0.24, 2.8), (0.36, 3.1)], n(16, 4), n(3))
    return joined(shaft, box((-0.4, 0, -0.4), (0.4, 0.25, 0.4), (n(2),) * 3), box((-0.4, 3.1, -0.4), (0.4, 3.3, 0.4), (n(2),) * 3))


def _atrium_shell(n: Callable[..., int], outer_x: float, outer_z: float) -> list[tuple[Material, Part]]:
    """Floor, outer walls, the floor of the balcony and the roof of the aisles."""
    top = 2 * _STOREY
    parts: list[tuple[Material, Part]] = [
        (_TILE, flat((-outer_x, 0, outer_z), (2 * outer_x, 0, 0), (0, 0, -2 * outer_z), n(40), n(22))),
        (_DARK_TILE, flat((-12.5, 0.004, 3.2), (25, 0, 0), (0, 0, -6.4), n(24), n(6))),
    ]
    for z, side in ((-outer_z, 1), (outer_z, -1)):
        parts.append((_BRICK, _wall((-side * outer_x, 0, z), (2 * side * outer_x, 0, 0), top, n(60), n(18))))
    for x, side in ((-outer_x, -1), (outer_x, 1)):
        parts.append((_BRICK, _wall((x, 0, -side * outer_z), (0, 0, 2 * side * outer_z), top, n(32), n(18))))
    rim = 0.35  # slabs reach a little over the columns
    for y0, y1, material in ((_STOREY - 0.15, _STOREY + 0.15, _STONE), (top, top + 0.3, _PALE)):
        inner_x, inner_z = _COURT_X - rim, _COURT_Z - rim
        for z0, z1 in ((-outer_z, -inner_z), (inner_z, outer_z)):
            parts.append((material, box((-outer_x, y0, z0), (outer_x, y1, z1), (n(30), 1, n(5)))))
        for x0, x1 in ((-outer_x, -inner_x), (inner_x, outer_x)):
            parts.append((material, box((x0, y0, -inner_z), (x1, y1, inner_z), (n(5), 1, n(12)))))
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


def _curtain(n: Callable[..., int], width: float, drop: float, rng: np.random.Generator) -> Part:
    """A hanging cloth whose folds widen downward; its top edge is at y = 0."""
    folds, phase, gather = rng.uniform(5, 8), rng.uniform(0, 6.28), rng.uniform(0.0, 0.25)

    def point(u: np.ndarray, v: np.ndarray):
        deep = 0.05 + 0.12 * v
        x = (u - 0.5) * width * (1 - gather * v * (1 - v) * 2)
        z = deep * np.sin(2 * np.pi * folds * u + phase + 0.6 * v) + 0.04 * np.sin(9 * v + 5 * u)
        return x, -drop * v - 0.05 * np.sin(2 * np.pi * u) * v, z

    return surface(n(48, 2), n(20), point)


def _bush(n: Callable[..., int], rng: np.random.Generator) -> Part:
    """A lumpy ball of foliage."""
    a, b, c = rng.uniform(0, 6.28, 3)

    def point(u: np.ndarray, v: np.ndarray):
        angle, tilt = -2 * np.pi * u, np.pi * (v - 0.5)
        r = 0.5 * (1 + 0.25 * np.cos(tilt) * np.sin(5 * angle + a) * np.sin(7 * tilt + b) + 0.1 * np.sin(11 * tilt + c))
        return r * np.cos(angle) * np.cos(tilt), r * np.sin(tilt), r * np.sin(angle) * np.cos(tilt)

    return surface(n(24, 4), n(16, 2), point)


def _atrium_path() -> CameraPath:
    """Once around the court, rising to the balcony and back, looking across it."""
    poses = []
    for t in 2 * np.pi * np.arange(_FRAMES) / _FRAMES:
        eye = (11.5 * np.cos(t), 3.2 - 1.5 * np.cos(t), 3.4 * np.sin(t))
        target = (11.5 * np.cos(t + 2.2), 3.4 - 0.8 * np.cos(2 * t), 5.0 * np.sin(t + 2.2))
        poses.append(Pose(eye, target, (0.0, 1.0, 0.0)))
    return _path(poses, 65.0, 100.0)


# --- street ---------------------------------------------------------------------------------------------------------

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
        ((0.62, 0.50, 0.33), (0.55, 0.30, 0.22), (0.50, 0.53, 0.50), (0.66, 0.60, 0.50), (0.36, 0.42, 0.50), (0.60, 0.42, 0.28))
    )
)
_PAINT = tuple(
    Material(f"car paint {i}", colour, specular=0.2, shininess=96.0)
    for i, colour in enumerate(((0.45, 0.03, 0.03), (0.05, 0.10, 0.35), (0.55, 0.55, 0.57), (0.05, 0.05, 0.06)))
)

_STREET = 60.0  # half its length
_FACADE_X = 8.0  # from the middle of the road to the house fronts
_CELL_X, _CELL_Y = 3.0, 3.4  # one window with the wall around it


def _street(detail: float, seed: int) -> _Layout:
    """A street between two rows of houses, with lamps, kerbs and parked cars; a house closes either end."""
    rng = np.random.default_rng(seed)
    n = lambda base, least=1: _count(base, detail, least)  # noqa: E731
    # Few triangles: fewer and wider windows, as every one costs some twenty.
    widen = float(np.clip(0.45 / detail, 1.0, 4.0))
    parts: list[tuple[Material, Part]] = []
    for side in (-1, 1):
        z = -_STREET
        while z < _STREET - 1e-9:
            width = min(float(rng.choice([9.0, 12.0, 15.0])), _STREET - z)
            parts += _house(n, width, int(rng.integers(3, 6)), widen, rng, (side * _FACADE_X, 0.15, z + width / 2), -side * np.pi / 2)
            z += width
    for end in (-1, 1):
        parts += _house(n, 18.0, 5, widen, rng, (0.0, 0.0, end * (_STREET + 0.5)), 0.0 if end < 0 else np.pi)
    parts += _road(n)
    # Lamps on both pavements, cars at the kerbs.
    n_lamps = max(3, min(8, round(8 * detail**0.5)))
    lamp_z = (np.arange(n_lamps) + 0.5) / n_lamps * 2 * _STREET - _STREET
    at = np.array([(side * 4.7, 0.15, z + 2 * side) for z in lamp_z for side in (-1, 1)])
    yaw = np.array([0.0 if side < 0 else np.pi for _ in lamp_z for side in (-1, 1)])
    post = turned([(0.16, 0.0), (0.10, 0.5), (0.06, 0.6), (0.05, 5.0)], n(10, 3), n(3))
    arm = box((0.0, 4.9, -0.04), (1.3, 5.0, 0.04), (n(4), 1, 1))
    parts.append((_IRON, copies(joined(post, arm), at, yaw)))
    parts.append((_LAMP, copies(ball(0.22, n(5, 2)), at + np.stack([1.3 * np.cos(yaw), np.full(len(yaw), 4.75), 0 * yaw], 1))))
    n_cars = max(2, min(18, round(14 * detail**0.5)))
    car_z = (np.arange(n_cars) + 0.5) / n_cars * 2 * _STREET - _STREET
    for i, z in enumerate(car_z):
        where = np.array([(-1) ** i * 3.35, 0.0, z + rng.uniform(-0.8, 0.8)])
        parts += _car(n, where, 0.0 if i % 2 else np.pi, _PAINT[int(rng.integers(len(_PAINT)))])
    return _Layout(parts)


def _house(
    n: Callable[..., int], width: float, n_storeys: int, widen: float, rng: np.random.Generator,
    at: tuple[float, float, float], yaw: float,
) -> list[tuple[Material, Part]]:  # fmt: skip
    """A house whose front looks along its own +z, with recessed windows, ledges, a door and a roof."""
    plaster = _PLASTER[int(rng.integers(len(_PLASTER)))]
    n_across = max(1, round(width / _CELL_X / widen))
    n_up = max(1, round(n_storeys / widen**0.5))
    cell_x, cell_y, height, depth = width / n_across, n_storeys * _CELL_Y / n_up, n_storeys * _CELL_Y, 9.0
    cells = np.array([((i + 0.5) * cell_x - width / 2, j * cell_y, 0.0) for i in range(n_across) for j in range(n_up)])
    wall, frame, glass = _window_cell(n, cell_x, cell_y)
    half = width / 2
    door_x = (n_across // 2 + 0.5) * cell_x - half
    shell = joined(
        flat((half, 0, 0), (0, 0, -depth), (0, height, 0), n(4), n(6)),
        flat((-half, 0, -depth), (0, 0, depth), (0, height, 0), n(4), n(6)),
        copies(wall, cells),
    )
    ridge = 2.2
    roof = joined(
        flat((-half, height, 0.4), (width, 0, 0), (0, ridge, -depth / 2 - 0.4), n(6), n(4)),
        flat((half, height, -depth), (-width, 0, 0), (0, ridge, depth / 2), n(6), n(4)),
    )
    cornice = box((-half, height - 0.25, 0.0), (half, height, 0.35), (n(6), 1, 1))
    door = box((door_x - 0.6, 0, 0.0), (door_x + 0.6, min(2.3, 0.24 * cell_y * 2.2), 0.08), (n(2), n(3), 1))
    materials = ((plaster, shell), (_FRAME, joined(copies(frame, cells), cornice)), (_GLASS, copies(glass, cells)),
                 (_ROOF, roof), (_DOOR, door))  # fmt: skip
    return [(material, copies(part, np.array(at), yaw)) for material, part in materials]


def _window_cell(n: Callable[..., int], width: float, height: float) -> tuple[Part, Part, Part]:
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


def _road(n: Callable[..., int]) -> list[tuple[Material, Part]]:
    """The cambered road with its line, kerbs, and pavements."""
    long = 2 * (_STREET + 1)

    def camber(u: np.ndarray, v: np.ndarray):
        return (u - 0.5) * 9, 0.06 * (1 - (2 * u - 1) ** 2), (0.5 - v) * long

    dashes = np.array([(0, 0.066, z) for z in np.arange(-_STREET + 3, _STREET, 10.0)])
    parts: list[tuple[Material, Part]] = [
        (_ASPHALT, surface(n(12), n(90), camber)),
        (_LINE, copies(box((-0.06, 0, -1.5), (0.06, 0.004, 1.5), (1, 1, n(3))), dashes)),
    ]
    for side in (-1, 1):
        x0, x1 = sorted((side * 4.2, side * 4.45))
        parts.append((_KERB, box((x0, 0, -long / 2), (x1, 0.16, long / 2), (1, 1, n(80)))))
        x0, x1 = sorted((side * 4.45, side * (_FACADE_X + 0.3)))
        parts.append((_PAVING, flat((x0, 0.15, long / 2), (x1 - x0, 0, 0), (0, 0, -long), n(6), n(90))))
    return parts


def _car(n: Callable[..., int], at: np.ndarray, yaw: float, paint: Material) -> list[tuple[Material, Part]]:
    """A parked car along z: a rounded body, a glass cabin, four wheels."""

    def shell(length: float, width: float, low: float, high: float, power: float) -> Part:
        def point(u: np.ndarray, v: np.ndarray):
            angle, tilt = -2 * np.pi * u, np.pi * (v - 0.5)
            squash = lambda w: np.sign(w) * np.abs(w) ** power  # noqa: E731  # a superellipsoid: a box with round edges
            x, z = squash(np.cos(angle)) * squash(np.cos(tilt)), squash(np.sin(angle)) * squash(np.cos(tilt))
            return width / 2 * x, (low + high) / 2 + (high - low) / 2 * squash(np.sin(tilt)), length / 2 * z

        return surface(n(24, 4), n(12, 3), point)

    across = turned([(0.0, -0.1), (0.32, -0.1), (0.32, 0.1), (0.0, 0.1)], n(12, 5), 1)

    def on_side() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        vertices, triangles, uv = across.build()
        return vertices[:, [1, 2, 0]], triangles, uv  # the wheel's axis from y to x

    wheel = Part(across.n_triangles, on_side)
    wheels = np.array([(x, 0.32, z) for x in (-0.8, 0.8) for z in (-1.3, 1.3)])
    parts = ((paint, shell(4.3, 1.75, 0.3, 0.95, 0.45)), (_GLASS, shell(2.3, 1.5, 0.8, 1.45, 0.55)), (_TYRE, copies(wheel, wheels)))
    return [(material, copies(part, at, yaw)) for material, part in parts]


def _street_path() -> CameraPath:
    """Up the road and back, looking ahead and to the house fronts on either side."""
    poses = []
    for t in 2 * np.pi * np.arange(_FRAMES) / _FRAMES:
        eye = np.array([0.9 * np.sin(t), 1.9 + 0.5 * np.sin(2 * t), -42 * np.cos(t)])
        yaw = 0.75 * np.sin(3 * t)
        target = eye + (10 * np.sin(yaw), 0.6 + 0.6 * np.cos(2 * t), 10 * np.cos(yaw))
        poses.append(Pose(_floats(eye), _floats(target), (0.0, 1.0, 0.0)))
    return _path(poses, 60.0, 300.0)


# --- grove ----------------------------------------------------------------------------------------------------------

_SOIL = Material("forest floor", (0.16, 0.13, 0.07))
_BARK = Material("bark", (0.20, 0.14, 0.09))
_ROCK = Material("rock", (0.33, 0.32, 0.30))
_GROVE = 40.0  # half its side
_PATH_M = 13.0  # radius of the camera's circle


def leaf_alpha(n_px: int = 64) -> np.ndarray:
    """A twig with leaflets on both sides, float32 `[n, n]`, soft edges, about two fifths of it opaque."""
    y, x = (np.mgrid[0:n_px, 0:n_px] + 0.5) / n_px
    alpha = np.clip((0.015 - np.abs(x - 0.5)) * n_px + 0.5, 0, 1) * (y > 0.12)
    for i in range(6):
        side, at = (-1) ** i, 0.22 + 0.13 * i
        dx, dy = (x - 0.5) * side, y - at
        along, across = dx * 0.86 - dy * 0.5, dx * 0.5 + dy * 0.86
        leaflet = 1 - ((along - 0.19) / 0.2) ** 2 - (across / 0.085) ** 2
        alpha = np.maximum(alpha, np.clip(leaflet * 0.085 * n_px / 2 + 0.5, 0, 1))
    tip = 1 - ((x - 0.5) / 0.08) ** 2 - ((y - 0.13) / 0.13) ** 2
    return np.maximum(alpha, np.clip(tip * 0.08 * n_px / 2 + 0.5, 0, 1)).astype(np.float32)


def _leaf_materials() -> tuple[Material, ...]:
    image = leaf_alpha()
    colours = ((0.10, 0.26, 0.04), (0.17, 0.32, 0.05), (0.30, 0.28, 0.05))
    return tuple(
        Material(f"leaves {i}", colour, alpha_mode="mask", alpha_image=image, alpha_cutoff=0.5, two_sided=True)
        for i, colour in enumerate(colours)
    )


_LEAVES = _leaf_materials()


def _ground_m(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Height of the grove's floor."""
    return 0.9 * np.sin(0.11 * x + 0.4) * np.cos(0.09 * z) + 0.25 * np.sin(0.43 * x) * np.sin(0.37 * z + 1) + 0.05 * np.sin(1.9 * x + 1.3 * z)


def _grove(detail: float, seed: int) -> _Layout:
    """Trees whose crowns are thousands of alpha-tested cards, on uneven ground."""
    rng = np.random.default_rng(seed)
    n = lambda base, least=1: _count(base, detail, least)  # noqa: E731
    n_trees = max(10, min(56, round(48 * detail**0.5)))
    trees = _spots(n_trees, 2.6, rng)
    heights = rng.uniform(5.5, 9.5, n_trees)
    yaws, leans = rng.uniform(0, 6.28, n_trees), rng.uniform(0.8, 1.25, n_trees)
    trunk = turned([(0.38, -0.6), (0.24, 0.4), (0.17, 3.5), (0.10, 6.0), (0.02, 8.0)], n(10, 3), n(3))
    thick = np.stack([leans, heights / 8, leans], 1)
    parts: list[tuple[Material, Part]] = [
        (_SOIL, surface(n(70, 4), n(70, 4), _ground)),
        (_BARK, copies(trunk, trees, yaws, thick)),
    ]
    branch = turned([(0.07, 0.0), (0.045, 0.9), (0.01, 2.0)], n(5, 3), n(2))
    per_tree = max(1, min(9, round(6 * detail**0.5)))
    parts.append((_BARK, _branches(branch, trees, heights, per_tree, rng)))
    rocks = _spots(max(4, min(40, round(30 * detail**0.5))), 1.6, rng)
    parts.append((_ROCK, copies(_bush(n, rng), rocks, rng.uniform(0, 6.28, len(rocks)), rng.uniform(0.6, 1.5, (len(rocks), 3)))))
    n_cards = round(830 * detail**2)
    for material, kind in zip(_LEAVES, range(len(_LEAVES)), strict=True):
        mine = np.arange(n_trees) % len(_LEAVES) == kind
        parts.append((material, _crowns(trees[mine], heights[mine], max(4, n_cards), detail, rng)))
    return _Layout(parts)


def _ground(u: np.ndarray, v: np.ndarray):
    x, z = (u - 0.5) * 2 * _GROVE, (0.5 - v) * 2 * _GROVE
    return x, _ground_m(x, z), z


def _spots(n: int, clear_m: float, rng: np.random.Generator) -> np.ndarray:
    """Places on the ground, `[n, 3]`, none within `clear_m` of the camera's circle."""
    spots = np.zeros((0, 3))
    while len(spots) < n:
        x, z = rng.uniform(-0.95 * _GROVE, 0.95 * _GROVE, (2, 4 * n))
        far = np.abs(np.hypot(x, z) - _PATH_M) > clear_m
        # Denser near the path: half of what is beyond twice its radius goes.
        far &= (np.hypot(x, z) < 2 * _PATH_M) | (rng.uniform(size=4 * n) < 0.5)
        spots = np.concatenate([spots, np.stack([x, _ground_m(x, z), z], 1)[far]])
    return spots[:n]


def _branches(branch: Part, trees: np.ndarray, heights: np.ndarray, per_tree: int, rng: np.random.Generator) -> Part:
    """Branches that leave the trunks upward at 45 degrees."""

    def leaning() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        vertices, triangles, uv = branch.build()
        x, y, z = vertices.T
        return np.stack([x + 0.7 * y, 0.7 * y, z], 1), triangles, uv

    n = len(trees) * per_tree
    up = np.repeat(heights, per_tree) * rng.uniform(0.45, 0.8, n)
    at = np.repeat(trees, per_tree, axis=0) + np.stack([np.zeros(n), up, np.zeros(n)], 1)
    return copies(Part(branch.n_triangles, leaning), at, rng.uniform(0, 6.28, n), rng.uniform(0.8, 1.3, n))


def _crowns(trees: np.ndarray, heights: np.ndarray, n_cards: int, detail: float, rng: np.random.Generator) -> Part:
    """Leaf cards in lumpy crowns, `n_cards` a tree; fewer cards are larger ones."""
    n = len(trees) * n_cards
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = rng.uniform(0.25, 1, n) ** 0.5  # most leaves are near the surface of the crown
    size = np.stack([np.full(len(trees), 2.3), 0.30 * heights, np.full(len(trees), 2.3)], 1)
    middle = trees + np.stack([np.zeros(len(trees)), 0.72 * heights, np.zeros(len(trees))], 1)
    centre = np.repeat(middle, n_cards, axis=0) + direction * radius[:, None] * np.repeat(size, n_cards, axis=0)
    side = float(np.clip(0.42 / max(detail, 0.02) ** 0.7, 0.1, 1.4))
    return cards(centre, rng.uniform(0.7, 1.3, n) * side, rng)


def _grove_path() -> CameraPath:
    """A walk in a circle at eye height, looking ahead and a little inward and up."""
    poses = []
    for t in 2 * np.pi * np.arange(_FRAMES) / _FRAMES:
        x, z = _PATH_M * np.cos(t), _PATH_M * np.sin(t)
        eye = np.array([x, float(_ground_m(x, z)) + 1.7, z])
        target = eye + (-4 * np.sin(t) - 2.5 * np.cos(t), 0.7, 4 * np.cos(t) - 2.5 * np.sin(t))
        poses.append(Pose(_floats(eye), _floats(target), (0.0, 1.0, 0.0)))
    return _path(poses, 65.0, 250.0)


def _path(poses: list[Pose], fov_y_deg: float, far_m: float) -> CameraPath:
    return CameraPath(Viewport(1280, 720), fov_y_deg, 0.1, far_m, tuple(poses))


def _floats(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


GALLERY: dict[str, Builtin] = {
    "atrium": Builtin("two-storey courtyard with colonnades, curtains and a balcony", 60_000, _atrium, _atrium_path),
    "street": Builtin("street with house fronts, windows, lamps, kerbs and cars", 60_000, _street, _street_path),
    "grove": Builtin("trees of alpha-tested leaf cards on uneven ground", 100_000, _grove, _grove_path),
}
"""The built-in scenes, in the order in which they are shown; the first is the default."""
