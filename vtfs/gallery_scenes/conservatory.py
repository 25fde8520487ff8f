"""The conservatory: a glass hall with stained panes, and plants of alpha-tested leaves in it."""

from __future__ import annotations

import itertools

import numpy as np

from vtfs.camera import CameraPath, Pose
from vtfs.gallery_scenes.grove import leaf_alpha
from vtfs.gallery_scenes.layout import FRAMES, IRON, Detail, Layout, bush, floats, path_of
from vtfs.scene import Material
from vtfs.shapes import Part, box, cards, copies, flat, joined, surface, turned

_FLAGS = Material("flagstones", (0.46, 0.43, 0.38), specular=0.06, shininess=48.0)
_LAWN = Material("lawn", (0.10, 0.20, 0.05))
_PLINTH = Material("plinth", (0.52, 0.48, 0.42))
_POT = Material("terracotta", (0.48, 0.21, 0.12))
_HEDGE = Material("hedge", (0.07, 0.17, 0.05))
_LEAVES = tuple(
    Material(f"foliage {i}", colour, alpha_mode="mask", alpha_image=leaf_alpha(), alpha_cutoff=0.5, two_sided=True)
    for i, colour in enumerate(((0.09, 0.28, 0.06), (0.20, 0.34, 0.08)))
)


def _glass(name: str, colour: tuple[float, float, float], opacity: float) -> Material:
    return Material(name, colour, opacity, specular=0.2, shininess=160.0, alpha_mode="blend", two_sided=True)


_CLEAR = _glass("clear glass", (0.70, 0.85, 0.80), 0.12)
_FROSTED = _glass("frosted glass", (0.75, 0.80, 0.82), 0.45)
_STAINED = (
    _glass("ruby glass", (0.75, 0.04, 0.06), 0.65),
    _glass("amber glass", (0.85, 0.45, 0.05), 0.55),
    _glass("cobalt glass", (0.05, 0.10, 0.70), 0.65),
    _glass("emerald glass", (0.05, 0.55, 0.16), 0.60),
)

_HALF_X, _HALF_Z = 20.0, 8.0  # half the hall
_SILL, _EAVES, _RISE = 0.8, 4.0, 4.5  # heights of plinth and walls, and of the vault over the walls
_PLAIN = 6_000  # triangles below which bays are four times as wide


def conservatory(wanted: int, n: Detail, seed: int) -> Layout:
    """A barrel-vaulted glass hall on a plinth: clear walls with stained panes among them, rosettes in both gables, a
    folding screen of coloured glass along the middle, and two beds of plants. Two fifths of the triangles are leaves.
    """
    rng = np.random.default_rng(seed)
    is_plain = wanted < _PLAIN
    edges = np.linspace(-_HALF_X, _HALF_X, 5 if is_plain else 17)
    parts: Layout = [
        (_FLAGS, flat((-_HALF_X, 0, _HALF_Z), (2 * _HALF_X, 0, 0), (0, 0, -2 * _HALF_Z), n(60), n(24))),
        (_LAWN, flat((-45, -0.1, 30), (90, 0, 0), (0, 0, -60), n(36), n(24))),
        (_PLINTH, _plinth(n)),
        (IRON, _frame(n, edges)),
    ]
    parts += _panes(n, edges, rng)
    parts += _screen(n, is_plain)
    parts += _beds(wanted, n, rng)
    hedges = np.array([(x, 0.4, side * 13.0) for x in np.linspace(-24, 24, 2 if is_plain else 13) for side in (-1, 1)])
    sizes = rng.uniform(1.6, 2.6, (len(hedges), 3))
    parts.append((_HEDGE, copies(bush(n, rng), hedges, rng.uniform(0, 6.28, len(hedges)), sizes)))
    return parts


def _plinth(n: Detail) -> Part:
    thick, x, z = 0.3, _HALF_X, _HALF_Z
    along = [box((-x, 0, s * z - thick / 2), (x, _SILL, s * z + thick / 2), (n(40), n(2), 1)) for s in (-1, 1)]
    inner = z - thick / 2
    across = [box((s * x - thick / 2, 0, -inner), (s * x + thick / 2, _SILL, inner), (1, n(2), n(14))) for s in (-1, 1)]
    return joined(*along, *across)


def _vault(angle: np.ndarray, shrink: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Height and z of the vault, from one wall (angle 0) over the ridge to the other (pi)."""
    return _EAVES + (_RISE - shrink) * np.sin(angle), (_HALF_Z - shrink) * np.cos(angle)


def _frame(n: Detail, edges: np.ndarray) -> Part:
    """Posts and vault ribs between the bays, the eaves and the ridge."""
    half = 0.06

    def rib(u: np.ndarray, v: np.ndarray):
        turn = -2 * np.pi * u + np.pi / 4  # a square section
        y, z = _vault(np.pi * v, -half * 1.4 * np.sin(turn))
        return 1.4 * half * np.cos(turn), y, z

    post = box((-half, _SILL, -half), (half, _EAVES, half), (1, n(6), 1))
    feet = np.array([(x, 0, side * _HALF_Z) for x in edges for side in (-1, 1)])
    ridge = box((-_HALF_X, _EAVES + _RISE - half, -half), (_HALF_X, _EAVES + _RISE + half, half), (n(40), 1, 1))
    eaves = box((-_HALF_X, _EAVES - half, -half), (_HALF_X, _EAVES + half, half), (n(40), 1, 1))
    sides = np.array([(0, 0, -_HALF_Z), (0, 0, _HALF_Z)])
    ribs = copies(surface(4, n(24, 4), rib), np.stack([edges, 0 * edges, 0 * edges], 1))
    return joined(copies(post, feet), ribs, ridge, copies(eaves, sides))


def _panes(n: Detail, edges: np.ndarray, rng: np.random.Generator) -> Layout:
    """Walls, vault and gables: single sheets of glass, every third wall pane stained."""
    parts: Layout = []
    sheets: dict[str, list[Part]] = {}
    kinds = {material.name: material for material in (_CLEAR, _FROSTED, *_STAINED)}
    for i, (x0, x1) in enumerate(itertools.pairwise(edges)):
        for side in (-1, 1):
            stained = _STAINED[int(rng.integers(len(_STAINED)))] if (i + (side > 0)) % 3 == 0 else _CLEAR
            wall = flat((x0, _SILL, side * _HALF_Z), (x1 - x0, 0, 0), (0, _EAVES - _SILL, 0), n(6), n(8))
            sheets.setdefault(stained.name, []).append(wall)

        def roof(u: np.ndarray, v: np.ndarray, x0=x0, x1=x1):
            y, z = _vault(np.pi * v)
            return x0 + u * (x1 - x0), y, z

        sheets.setdefault(_CLEAR.name, []).append(surface(n(6), n(32, 4), roof))
    for end in (-1, 1):
        wall = flat((end * _HALF_X, _SILL, -_HALF_Z), (0, 0, 2 * _HALF_Z), (0, _EAVES - _SILL, 0), n(24), n(6))
        sheets.setdefault(_FROSTED.name, []).append(wall)
        for k in range(8):  # a rosette of wedges

            def wedge(u: np.ndarray, v: np.ndarray, end=end, k=k):
                y, z = _vault(np.pi * (k + u) / 8)
                return end * _HALF_X, _EAVES + v * (y - _EAVES), v * z

            sheets.setdefault(_STAINED[k % 4].name, []).append(surface(n(4), n(8), wedge))
    parts += [(kinds[name], joined(*sheet)) for name, sheet in sheets.items()]
    return parts


def _screen(n: Detail, is_plain: bool) -> Layout:
    """A folding screen along the middle of the hall: leaves of coloured glass in iron frames."""
    n_leaves = 4 if is_plain else 12
    x = np.linspace(-9.0, 9.0, n_leaves + 1)
    z = 0.45 * (-1.0) ** np.arange(n_leaves + 1)
    parts: Layout = []
    for i in range(n_leaves):
        along = (x[i + 1] - x[i], 0.0, z[i + 1] - z[i])
        lower = flat((x[i], 0.25, z[i]), along, (0, 1.2, 0), n(6), n(6))
        upper = flat((x[i], 1.45, z[i]), along, (0, 1.35, 0), n(6), n(6))
        parts += [(_STAINED[i % 4], lower), (_STAINED[(i + 2) % 4] if i % 3 else _FROSTED, upper)]
    post = box((-0.04, 0, -0.04), (0.04, 2.9, 0.04), (1, n(6), 1))
    parts.append((IRON, copies(post, np.stack([x, 0 * x, z], 1))))
    return parts


def _beds(wanted: int, n: Detail, rng: np.random.Generator) -> Layout:
    """Potted trees of leaf cards along both walls, some of them before the panes and some beneath the vault."""
    n_plants = int(np.clip(round(24 * (wanted / 60_000) ** 0.5), 4, 48))
    n_cards = max(6, round(0.2 * wanted / n_plants))
    place = np.linspace(-17.5, 17.5, (n_plants + 1) // 2)
    feet = np.array([(x, 0.0, side * 5.9) for x in place for side in (-1, 1)])[:n_plants]
    feet += np.stack([rng.uniform(-0.4, 0.4, n_plants), np.zeros(n_plants), rng.uniform(-0.4, 0.4, n_plants)], 1)
    heights = rng.uniform(2.2, 4.2, n_plants)
    trunk = turned([(0.10, 0.5), (0.06, 0.8), (0.03, 1.0)], n(8, 3), n(2))
    pot = turned([(0.32, 0.0), (0.45, 0.5), (0.38, 0.6)], n(14, 4), n(2))
    parts: Layout = [
        (_POT, copies(pot, feet)),
        (IRON, copies(trunk, feet, 0.0, np.stack([np.ones(n_plants), heights, np.ones(n_plants)], 1))),
    ]
    side_m = float(np.clip(0.34 * (500 / n_cards) ** 0.4, 0.08, 0.9))
    for kind, material in enumerate(_LEAVES):
        mine = np.arange(n_plants) % len(_LEAVES) == kind
        around = np.repeat(feet[mine] + np.stack([0 * heights, heights, 0 * heights], 1)[mine], n_cards, axis=0)
        direction = rng.normal(size=around.shape)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        reach = rng.uniform(0.1, 1, len(around)) ** 0.5
        centre = around + direction * reach[:, None] * np.array([1.3, 1.0, 1.3])
        parts.append((material, cards(centre, rng.uniform(0.7, 1.3, len(centre)) * side_m, rng)))
    return parts


def conservatory_path() -> CameraPath:
    """Once around the screen, looking ahead, through it, and up into the vault."""
    poses = []
    for t in 2 * np.pi * np.arange(FRAMES) / FRAMES:
        eye = np.array([13.5 * np.cos(t), 1.9 + 0.4 * np.sin(2 * t), 2.6 * np.sin(t)])
        target = np.array([10 * np.cos(t + 1.9), 2.2 + 1.0 * np.sin(t), 4.5 * np.sin(t + 1.9)])
        poses.append(Pose(floats(eye), floats(target), (0.0, 1.0, 0.0)))
    return path_of(poses, 65.0, 120.0)
