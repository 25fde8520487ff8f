"""The exact test of a sample: a closed mesh is watertight, and a bad triangle shadows nothing that it should not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.closed_sphere import KINDS, PLACES, covers, leaks_and_doubles, sphere
from vtfs.shadow_casters import Casters
from vtfs.shadow_mask import casters_on_device
from vtfs.shadow_volumes.planes import edge_planes, inside


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("offset", "scale"), PLACES)
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
        return np.asarray(covers(vertex, triangles, point, fault)[0])


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
            total, _ = covers(vertex, np.array([order], np.int32), sample, "")
            assert np.asarray(total).tolist() == [0, 0, 1, 1, 0, 0]


def leaks_and_doubles_below_a_sheet(weld: bool) -> tuple[int, int]:
    """A wavy sheet before a directional light, each triangle with vertices of its own, in any order; below it samples
    behind its edges."""
    rng, n = np.random.default_rng(0), 12
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    vertices = np.stack([x, y, rng.normal(size=x.shape) * 0.2], axis=-1).reshape(-1, 3) + rng.normal(size=3) * 10
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    corners = np.concatenate([first[:, None] + np.array(c) for c in ([0, 1, n + 2], [0, n + 2, n + 1])])
    light = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    diagonal = rng.choice(first, 20_000)  # of a square: always inside of the sheet
    share = rng.integers(1, 16, (len(diagonal), 1)) / 16
    on_edge = vertices[diagonal] * (1 - share) + vertices[diagonal + n + 2] * share
    samples = on_edge - light * rng.uniform(1, 5, (len(diagonal), 1))
    order = rng.permutation(corners.size)
    split = np.empty((corners.size, 3))
    split[order] = vertices[corners.ravel()]
    triangles = order.reshape(-1, 3).astype(np.int32)
    with jax.enable_x64(True):
        if weld:
            triangles = casters_on_device(Casters(split, triangles)).triangles
        vertex, sample, way = (
            tuple(jnp.asarray(c) for c in values) for values in (split.T.copy(), samples.T.copy(), light)
        )
        total = np.asarray(_covers_from_afar(vertex, triangles, sample, way))
    return int((total == 0).sum()), int((total > 1).sum())


@jax.jit
def _covers_from_afar(vertex, triangles, sample, way):
    planes, _ = edge_planes(vertex, triangles, way, True, jnp.float64(0), jnp.bool_(False))

    def one(total, k):
        plane = jax.tree.map(lambda c: c[k], planes)
        return total + inside(plane, sample, jnp.float64(0)).astype(jnp.int32), None

    return jax.lax.scan(one, jnp.zeros(sample[0].shape, jnp.int32), jnp.arange(triangles.shape[0]))[0]


def test_an_edge_is_watertight_where_each_triangle_has_vertices_of_its_own():
    assert leaks_and_doubles_below_a_sheet(weld=True) == (0, 0)
    assert min(leaks_and_doubles_below_a_sheet(weld=False)) > 100  # told apart by their numbers, both are there


@pytest.mark.parametrize("distance", [3.0, 1e2, 1e4, 1e6])
def test_however_far_the_light_a_surface_shadows_what_is_behind_it_and_not_itself(distance):
    """A sphere of radius 1 before a light outside: a bias of 1e-5 before the face of each of its triangles and behind
    it. A light 1e4 radii away once had rounding of more than that, and all in shadow."""
    vertices, triangles, _ = sphere()
    light = distance * np.array([2.0, 6.0, 3.0]) / 7
    corner = vertices[triangles]
    centre, normal = corner.mean(axis=1), np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    way = light - centre
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    facing = (normal * way).sum(axis=1) > 0.2 * np.linalg.norm(normal, axis=1)
    centre, way = centre[facing], way[facing]
    with jax.enable_x64(True):
        vertex = tuple(jnp.asarray((vertices - light)[:, c]) for c in range(3))
        for step, expected in ((1e-5, 0), (-1e-5, 1)):
            sample = centre + step * way - light
            total, _ = covers(vertex, triangles, tuple(jnp.asarray(sample[:, c]) for c in range(3)), "")
            assert len(sample) > 50 and (np.asarray(total) == expected).all()
