"""Shapes that the built-in scenes are made of: how many triangles each has is known before it is built."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Vertices float64 `[V, 3]`, triangles int64 `[T, 3]`, texture coordinates float64 `[V, 2]`."""

Surface = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray | float, np.ndarray | float, np.ndarray | float]]


@dataclass(frozen=True)
class Part:
    """A shape that is built later: counting comes first, so that a scene can be made to a triangle count."""

    n_triangles: int
    build: Callable[[], Mesh]


def surface(n_u: int, n_v: int, point: Surface) -> Part:
    """A grid of `n_u` by `n_v` quads over u, v in [0, 1]; `point(u, v)` gives x, y, z in metres."""

    def build() -> Mesh:
        u, v = np.meshgrid(np.linspace(0, 1, n_u + 1), np.linspace(0, 1, n_v + 1), indexing="ij")
        x, y, z = (np.broadcast_to(np.asarray(c, np.float64), u.shape) for c in point(u, v))
        corner = (np.arange(n_u)[:, None] * (n_v + 1) + np.arange(n_v)).ravel()
        right, above, across = corner + n_v + 1, corner + 1, corner + n_v + 2
        triangles = np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, above], 1)])
        return np.stack([x, y, z], -1).reshape(-1, 3), triangles, np.stack([u, v], -1).reshape(-1, 2)

    return Part(2 * n_u * n_v, build)


def flat(origin: tuple[float, ...], edge_u: tuple[float, ...], edge_v: tuple[float, ...], n_u: int, n_v: int) -> Part:
    """A parallelogram of `n_u` by `n_v` quads."""
    o, a, b = (np.asarray(c, np.float64) for c in (origin, edge_u, edge_v))
    return surface(n_u, n_v, lambda u, v: tuple(o[k] + u * a[k] + v * b[k] for k in range(3)))  # type: ignore[return-value]


def box(low: tuple[float, ...], high: tuple[float, ...], n: tuple[int, int, int] = (1, 1, 1)) -> Part:
    """An axis-aligned box with `n` quads along x, y and z."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    nx, ny, nz = n
    return joined(
        flat((x0, y0, z1), (dx, 0, 0), (0, dy, 0), nx, ny),
        flat((x1, y0, z0), (-dx, 0, 0), (0, dy, 0), nx, ny),
        flat((x1, y0, z1), (0, 0, -dz), (0, dy, 0), nz, ny),
        flat((x0, y0, z0), (0, 0, dz), (0, dy, 0), nz, ny),
        flat((x0, y1, z1), (dx, 0, 0), (0, 0, -dz), nx, nz),
        flat((x0, y0, z0), (dx, 0, 0), (0, 0, dz), nx, nz),
    )


def turned(profile: list[tuple[float, float]], n_around: int, n_along: int) -> Part:
    """A surface of revolution about y; the profile is `(radius, height)` pairs, joined by `n_along` pieces each."""
    radius, height = np.array(profile, np.float64).T
    at = np.linspace(0, 1, len(profile))

    def point(u: np.ndarray, v: np.ndarray):
        r, angle = np.interp(v, at, radius), -2 * np.pi * u
        return r * np.cos(angle), np.interp(v, at, height), r * np.sin(angle)

    return surface(n_around, n_along * (len(profile) - 1), point)


def ball(radius: float, n: int) -> Part:
    """A sphere of `2n` by `n` quads around the origin."""

    def point(u: np.ndarray, v: np.ndarray):
        angle, tilt = -2 * np.pi * u, np.pi * (v - 0.5)
        return radius * np.cos(angle) * np.cos(tilt), radius * np.sin(tilt), radius * np.sin(angle) * np.cos(tilt)

    return surface(2 * n, n, point)


def arch(width: float, radius: float, height: float, depth: float, n_along: int, n_up: int) -> Part:
    """A wall `height` high with a round opening: x in +-width / 2, y from 0, z in +-depth / 2."""

    def across(u: np.ndarray) -> np.ndarray:
        return (u - 0.5) * width

    def rim(x: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(radius**2 - x**2, 0))

    def face(side: int) -> Surface:
        def point(u: np.ndarray, v: np.ndarray):
            x = side * across(u)
            return x, rim(x) + v * (height - rim(x)), side * depth / 2

        return point

    def soffit(u: np.ndarray, v: np.ndarray):
        return across(u), rim(across(u)), (v - 0.5) * depth

    return joined(surface(n_along, n_up, face(1)), surface(n_along, n_up, face(-1)), surface(n_along, 1, soffit))


def cards(centre_m: np.ndarray, size_m: np.ndarray, rng: np.random.Generator) -> Part:
    """Squares of any orientation, two triangles each: centres `[N, 3]`, sides `[N]`; each shows the whole image."""
    n = len(centre_m)
    seed = int(rng.integers(2**31))

    def build() -> Mesh:
        random = np.random.default_rng(seed)
        normal = _unit(random.normal(size=(n, 3)) + np.array([0, 0.5, 0]))  # leaves look up more often than not
        along = _unit(np.cross(normal, random.normal(size=(n, 3))))
        up = np.cross(normal, along)
        uv = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float64)
        corners = (uv - 0.5)[None, :, :] * size_m[:, None, None]
        vertices = centre_m[:, None] + corners[..., :1] * along[:, None] - corners[..., 1:] * up[:, None]
        first = 4 * np.arange(n)[:, None]
        triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
        return vertices.reshape(-1, 3), triangles, np.tile(uv, (n, 1))

    return Part(2 * n, build)


def joined(*parts: Part) -> Part:
    """Several shapes as one."""

    def build() -> Mesh:
        meshes = [part.build() for part in parts]
        starts = np.cumsum([0, *(len(mesh[0]) for mesh in meshes)])
        return (
            np.concatenate([mesh[0] for mesh in meshes]),
            np.concatenate([mesh[1] + start for mesh, start in zip(meshes, starts[:-1], strict=True)]),
            np.concatenate([mesh[2] for mesh in meshes]),
        )

    return Part(sum(part.n_triangles for part in parts), build)


def copies(part: Part, at_m: np.ndarray, yaw: np.ndarray | float = 0.0, scale: np.ndarray | float = 1.0) -> Part:
    """Copies of a shape: scaled (`[K]` or `[K, 3]`), turned about y (`[K]`, radians), then moved to `[K, 3]`."""
    at_m = np.asarray(at_m, np.float64).reshape(-1, 3)
    n = len(at_m)

    def build() -> Mesh:
        vertices, triangles, uv = part.build()
        angle = np.broadcast_to(np.asarray(yaw, np.float64), n)
        factors = np.asarray(scale, np.float64)
        factors = np.broadcast_to(factors[..., None] if factors.ndim == 1 else factors, (n, 3))
        scaled = vertices[None] * factors[:, None]
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        x, z = scaled[..., 0] * c + scaled[..., 2] * s, scaled[..., 2] * c - scaled[..., 0] * s
        moved = np.stack([x, scaled[..., 1], z], -1) + at_m[:, None]
        index = triangles[None] + len(vertices) * np.arange(n)[:, None, None]
        return moved.reshape(-1, 3), index.reshape(-1, 3), np.tile(uv, (n, 1))

    return Part(n * part.n_triangles, build)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
