"""The grove: trees and ferns of alpha-tested cards."""

from __future__ import annotations

import numpy as np

from vtfs.camera import CameraPath, Pose
from vtfs.gallery_scenes.layout import FRAMES, Detail, Layout, bush, floats, path_of
from vtfs.scene import Material
from vtfs.shapes import Part, cards, copies, surface, turned

_SOIL = Material("forest floor", (0.16, 0.13, 0.07))
_BARK = Material("bark", (0.20, 0.14, 0.09))
_ROCK = Material("rock", (0.33, 0.32, 0.30))
_GROVE = 30.0  # half its side
_PATH_M = 11.0  # radius of the camera's circle


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
    return (
        0.9 * np.sin(0.11 * x + 0.4) * np.cos(0.09 * z)
        + 0.25 * np.sin(0.43 * x) * np.sin(0.37 * z + 1)
        + 0.05 * np.sin(1.9 * x + 1.3 * z)
    )


def grove(wanted: int, n: Detail, seed: int) -> Layout:
    """Trees and ferns of alpha-tested cards, on uneven ground. Three quarters of the triangles are cards."""
    rng = np.random.default_rng(seed)
    n_trees = int(np.clip(round(70 * (wanted / 100_000) ** 0.5), 6, 90))
    n_ferns = int(np.clip(round(260 * (wanted / 100_000) ** 0.5), 6, 600))
    n_cards = max(6, round(0.32 * wanted / n_trees))
    per_fern = max(2, round(0.055 * wanted / n_ferns))
    trees = _spots(n_trees, 2.2, rng)
    heights = rng.uniform(5.5, 9.5, n_trees)
    yaws, girth = rng.uniform(0, 6.28, n_trees), rng.uniform(0.8, 1.25, n_trees)
    trunk = turned([(0.38, -0.6), (0.24, 0.4), (0.17, 3.5), (0.10, 6.0), (0.02, 8.0)], n(12, 3), n(3))
    parts: Layout = [
        (_SOIL, surface(n(70, 4), n(70, 4), _ground)),
        (_BARK, copies(trunk, trees, yaws, np.stack([girth, heights / 8, girth], 1))),
    ]
    branch = turned([(0.07, 0.0), (0.045, 0.9), (0.01, 2.0)], n(6, 3), n(2))
    parts.append((_BARK, _branches(branch, trees, heights, 1 if wanted < 5_000 else 6, rng)))
    rocks = _spots(max(2, n_trees // 2), 1.6, rng)
    sizes = rng.uniform(0.6, 1.5, (len(rocks), 3)) * np.array([1, 0.6, 1])
    parts.append((_ROCK, copies(bush(n, rng), rocks, rng.uniform(0, 6.28, len(rocks)), sizes)))
    side = float(np.clip(0.42 * (830 / n_cards) ** 0.4, 0.1, 1.6))
    for kind, material in enumerate(_LEAVES):
        mine = np.arange(n_trees) % len(_LEAVES) == kind
        parts.append((material, _crowns(trees[mine], heights[mine], n_cards, side, rng)))
    ferns = np.repeat(_spots(n_ferns, 0.9, rng), per_fern, axis=0)
    ferns += rng.normal(0, 0.22, ferns.shape) + np.array([0, 0.3, 0])
    parts.append((_LEAVES[0], cards(ferns, rng.uniform(0.35, 0.6, len(ferns)), rng)))
    return parts


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


def _crowns(trees: np.ndarray, heights: np.ndarray, n_cards: int, side_m: float, rng: np.random.Generator) -> Part:
    """Leaf cards in round crowns, `n_cards` a tree, above the head of who walks by."""
    n = len(trees) * n_cards
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = rng.uniform(0.25, 1, n) ** 0.5  # most leaves are near the surface of the crown
    size = np.stack([0.33 * heights, 0.30 * heights, 0.33 * heights], 1)
    middle = trees + np.stack([np.zeros(len(trees)), 0.75 * heights, np.zeros(len(trees))], 1)
    centre = np.repeat(middle, n_cards, axis=0) + direction * radius[:, None] * np.repeat(size, n_cards, axis=0)
    return cards(centre, rng.uniform(0.7, 1.3, n) * side_m, rng)


def grove_path() -> CameraPath:
    """A walk in a circle at eye height, looking ahead and a little inward and up."""
    poses = []
    for t in 2 * np.pi * np.arange(FRAMES) / FRAMES:
        x, z = _PATH_M * np.cos(t), _PATH_M * np.sin(t)
        eye = np.array([x, float(_ground_m(x, z)) + 1.7, z])
        target = eye + np.array([-4 * np.sin(t) - 2.5 * np.cos(t), 0.5, 4 * np.cos(t) - 2.5 * np.sin(t)])
        poses.append(Pose(floats(eye), floats(target), (0.0, 1.0, 0.0)))
    return path_of(poses, 65.0, 250.0)
