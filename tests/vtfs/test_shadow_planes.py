"""The exact test of a sample: a closed mesh is watertight, and a bad triangle shadows nothing that it should not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from vtfs.shadow_volumes.planes import edge_planes, inside

N_SAMPLES = 20_000


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


def covers(vertex_m, triangles, sample_m, fault):
    """In how many volumes each sample lies, by the test of the algorithms, or by a faulty one."""
    planes, inward = edge_planes(vertex_m, triangles, vertex_m, False, jnp.float64(0), jnp.bool_(False))
    if fault == "float32":
        planes = jax.tree.map(lambda c: c.astype(jnp.float32) if c.dtype == jnp.float64 else c, planes)
        sample_m = tuple(c.astype(jnp.float32) for c in sample_m)
    elif fault == "sign":
        x, y, z = planes.normal[0]
        planes = type(planes)(((-x, -y, -z), *planes.normal[1:]), (), planes.least, (), planes.behind)
    elif fault == "no ties":
        planes = type(planes)(planes.normal, (), tuple(0 * c - 1e-300 for c in planes.least), (), planes.behind)

    def one(total, k):
        plane = jax.tree.map(lambda c: c[k], planes)
        return total + inside(plane, sample_m, jnp.float64(0)).astype(jnp.int32), None

    total, _ = jax.lax.scan(one, jnp.zeros(sample_m[0].shape, jnp.int32), jnp.arange(triangles.shape[0]))
    return total, inward != 0


covers_jit = jax.jit(covers, static_argnums=3)


def leaks_and_doubles(
    kind: str, offset: float, scale: float, directional: bool = False, fault: str = ""
) -> tuple[int, int]:
    rng = np.random.default_rng(0)
    unit, triangles, _ = sphere()
    vertices = (unit * scale + offset).astype(np.float32).astype(np.float64)
    light = vertices.mean(axis=0) + rng.uniform(-0.3, 0.3, 3) * scale
    sample = samples_beyond(kind, vertices, light, rng)
    with jax.enable_x64(True):
        vertex = tuple(jnp.asarray((vertices - light)[:, c]) for c in range(3))
        total, safe = covers_jit(
            vertex, triangles, tuple(jnp.asarray(sample[:, c], jnp.float64) for c in range(3)), fault
        )
        total = np.asarray(total)
        assert bool(safe.all())
    return int((total == 0).sum()), int((total > 1).sum())


@pytest.mark.parametrize("kind", ["vertices", "edges", "interiors"])
@pytest.mark.parametrize(
    ("offset", "scale"),
    [(0.0, 1.0), (1e1, 1.0), (1e3, 1.0), (1e5, 1.0), (1e6, 1.0), (0.0, 1e3), (0.0, 1e6), (0.0, 1e-3)],
)
def test_each_sample_beyond_a_closed_sphere_lies_in_exactly_one_volume(kind, offset, scale):
    assert leaks_and_doubles(kind, offset, scale) == (0, 0)


@pytest.mark.parametrize("fault", ["float32", "sign"])
def test_this_test_fails_for_a_faulty_side_test(fault):
    """A float32 side test and a flipped plane are caught."""
    leaks, doubles = leaks_and_doubles("vertices", 0.0, 1.0, fault=fault)
    assert leaks + doubles > 0


def cube_covers(fault: str) -> np.ndarray:
    """A cube about the light, and points of a grid: every edge and diagonal of the cube holds some exactly."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))], np.int32)
    points = np.stack(np.meshgrid(*[np.arange(-4.0, 5.0)] * 3), axis=-1).reshape(-1, 3)
    points = points[np.abs(points).max(axis=1) > 1]
    with jax.enable_x64(True):
        vertex, point = (tuple(jnp.asarray(values[:, c]) for c in range(3)) for values in (corners, points))
        return np.asarray(covers_jit(vertex, triangles, point, fault)[0])


def test_a_sample_exactly_on_an_edge_lies_in_one_of_its_triangles():
    assert (cube_covers("") == 1).all()
    assert (cube_covers("no ties") > 1).any()  # a closed comparison counts it twice


def test_a_sample_in_front_of_the_triangle_is_lit_and_the_mirrored_cone_is_empty():
    corners = np.array([[1.0, -1.0, -3.0], [1.0, 2.0, -3.0], [-2.0, -1.0, -3.0]])
    inner = corners.mean(axis=0)
    points = np.stack([0.5 * inner, 0.999 * inner, 1.001 * inner, 50 * inner, -inner, -50 * inner])
    with jax.enable_x64(True):
        vertex = tuple(jnp.asarray(corners[:, c]) for c in range(3))
        sample = tuple(jnp.asarray(points[:, c]) for c in range(3))
        for order in ([0, 1, 2], [0, 2, 1], [2, 1, 0]):
            total, _ = covers_jit(vertex, np.array([order], np.int32), sample, "")
            assert np.asarray(total).tolist() == [0, 0, 1, 1, 0, 0]
