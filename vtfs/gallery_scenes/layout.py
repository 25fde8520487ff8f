"""What the built-in scenes share: how they are written down, some materials and a shape, and their camera paths."""

from __future__ import annotations

import numpy as np

from vtfs.camera import CameraPath, Pose, Viewport
from vtfs.scene import Material
from vtfs.shapes import Part, surface

Layout = list[tuple[Material, Part]]
"""A scene before it is built."""

FRAMES = 60
IRON = Material("iron", (0.06, 0.06, 0.07), specular=0.3, shininess=80.0)
CLOTH = (
    Material("red cloth", (0.50, 0.05, 0.05), two_sided=True),
    Material("green cloth", (0.06, 0.30, 0.10), two_sided=True),
    Material("blue cloth", (0.07, 0.12, 0.42), two_sided=True),
)


class Detail:
    """How finely a scene is tessellated: called with the quads of an edge at level 1, and the fewest it may have."""

    def __init__(self, level: float):
        self.level = level

    def __call__(self, base: float, least: int = 1) -> int:
        return max(least, round(base * self.level))


def bush(n: Detail, rng: np.random.Generator) -> Part:
    """A lumpy ball of foliage."""
    a, b, c = rng.uniform(0, 6.28, 3)

    def point(u: np.ndarray, v: np.ndarray):
        angle, tilt = -2 * np.pi * u, np.pi * (v - 0.5)
        r = 0.5 * (1 + 0.25 * np.cos(tilt) * np.sin(5 * angle + a) * np.sin(7 * tilt + b) + 0.1 * np.sin(11 * tilt + c))
        return r * np.cos(angle) * np.cos(tilt), r * np.sin(tilt), r * np.sin(angle) * np.cos(tilt)

    return surface(n(24, 4), n(16, 2), point)


def path_of(poses: list[Pose], fov_y_deg: float, far_m: float) -> CameraPath:
    return CameraPath(Viewport(1280, 720), fov_y_deg, 0.1, far_m, tuple(poses))


def floats(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
