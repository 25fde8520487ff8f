"""A closed sphere about the light: beyond it each sample lies in exactly one volume, also on vertices and edges."""

from __future__ import annotations

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from vtfs.shadow_volumes.planes import edge_planes, inside

N_SAMPLES = 20_000
KINDS = ("vertices", "edges", "interiors")
PLACES = ((0.0, 1.0), (1e1, 1.0), (1e3, 1.0), (1e5, 1.0), (1e6, 1.0), (0.0, 1e3), (0.0, 1e6), (0.0, 1e-3))
"""Offset from the origin, and scale."""

Fault = Literal["", "float32", "sign", "no ties"]
"""What is wrong with the test: nothing, its precision, a plane that is turned round, or samples on edges."""


def sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, triangles and edges of 320 triangles."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    return np.array(ball.vertices), np.array(ball.faces, np.int32), np.array(ball.edges_unique)


def samples_beyond(kind: str, vertices: np.ndarray, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points outside, on lines from the light through vertices, edges or interiors; float32 relative to the light."""
    _, triangles, edges = sphere()
    if kind == "vertices":
        target = vertices[rng.integers(0, len(vertices), N_SAMPLES)]
    elif kind == "edges":
        edge = vertices[edges[rng.integers(0, len(edges), N_SAMPLES)]]
        t = rng.integers(1, 16, (N_SAMPLES, 1)) / 16
        target = edge[:, 0] * (1 - t) + edge[:, 1] * t
    else:
        weight = rng.dirichlet([1, 1, 1], N_SAMPLES)[:, :, None]
        target = (vertices[triangles[rng.integers(0, len(triangles), N_SAMPLES)]] * weight).sum(axis=1)
    return ((target - light) * 2.0 ** rng.integers(1, 4, (N_SAMPLES, 1))).astype(np.float32)


@functools.partial(jax.jit, static_argnames="fault")
def covers(vertex_m, triangles, sample_m, fault: Fault):
    """In how many volumes each sample lies, by the test of the algorithms, or by a faulty one."""
    planes, inward = edge_planes(vertex_m, triangles, vertex_m, False, jnp.float64(0), jnp.bool_(False))
    if fault == "float32":
        planes = jax.tree.map(lambda c: c.astype(jnp.float32) if c.dtype == jnp.float64 else c, planes)
        sample_m = tuple(c.astype(jnp.float32) for c in sample_m)
    elif fault == "sign":
        x, y, z = planes.normal[0]
        planes = type(planes)(((-x, -y, -z), *planes.normal[1:]), (), planes.least, planes.face, planes.behind)
    elif fault == "no ties":
        planes = type(planes)(
            planes.normal, (), tuple(0 * c - 1e-300 for c in planes.least), planes.face, planes.behind
        )

    def one(total, k):
        plane = jax.tree.map(lambda c: c[k], planes)
        return total + inside(plane, sample_m, jnp.float64(0)).astype(jnp.int32), None

    total, _ = jax.lax.scan(one, jnp.zeros(sample_m[0].shape, jnp.int32), jnp.arange(triangles.shape[0]))
    return total, inward[:-1] != 0


def leaks_and_doubles(kind: str, offset: float, scale: float, fault: Fault = "") -> tuple[int, int]:
    """Samples that lie in no volume, and in more than one."""
    rng = np.random.default_rng(0)
    unit, triangles, _ = sphere()
    vertices = (unit * scale + offset).astype(np.float32).astype(np.float64)
    light = vertices.mean(axis=0) + rng.uniform(-0.3, 0.3, 3) * scale
    sample = samples_beyond(kind, vertices, light, rng)
    with jax.enable_x64(True):
        vertex = tuple(jnp.asarray((vertices - light)[:, c]) for c in range(3))
        total, safe = covers(vertex, triangles, tuple(jnp.asarray(sample[:, c], jnp.float64) for c in range(3)), fault)
        total = np.asarray(total)
        assert bool(safe.all())
    return int((total == 0).sum()), int((total > 1).sum())


def all_spheres() -> list[dict]:
    """Leaks and double counts of every kind and place; and of two faulty tests, which must have some."""
    lines = []
    for fault in ("", "float32", "sign"):
        for kind in KINDS:
            for offset, scale in PLACES if not fault else PLACES[:1]:
                leaks, doubles = leaks_and_doubles(kind, offset, scale, fault)
                lines.append(
                    {"fault": fault, "kind": kind, "offset": offset, "scale": scale, "samples": N_SAMPLES}
                    | {"leaks": leaks, "doubles": doubles}
                )
    return lines
