# NumPy arrays stand for those of the device.
# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
"""Bins and cones of normals: each holds its normals, and no light that is in front of a surface is behind its cone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.strategies import seeds
from vtfs.bounds import Aabb, Sphere, sphere_of_box
from vtfs.normal_cones import (
    NormalCones,
    bin_of_normal,
    bins_per_cell,
    cones_of_bins,
    cones_of_samples,
    may_face,
)

some = settings(max_examples=40, deadline=None)
bins_jit, cones_jit = jax.jit(bin_of_normal), jax.jit(cones_of_bins)
samples_jit = jax.jit(cones_of_samples)
face_jit = jax.jit(lambda cones, box, light: may_face(cones, sphere_of_box(box), light))


def f32(*arrays: Any) -> Any:
    return [np.asarray(array, np.float32) for array in arrays]


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def normals_of_all_kinds(rng, n):
    """Anywhere, along axes, on the edges between faces of the cube and between bins."""
    normal = rng.normal(size=(n, 3))
    normal[: n // 4] = np.roll(rng.integers(-2, 3, (n // 4, 3)) + np.array([0, 0, 3]), rng.integers(3), axis=1)
    normal[n // 4 : n // 2] = rng.integers(-1, 2, (n // 4, 3)) + 1e-8 * rng.normal(size=(n // 4, 3))
    return unit(normal).astype(np.float32)


def test_bins_are_three_by_three_on_six_faces():
    # equations.md, section 2: 3 x 3 cells on 6 faces are 54 bins.
    assert int(bins_per_cell(jnp.int32(3))) == 54 and int(bins_per_cell(jnp.int32(0))) == 1
    normal = normals_of_all_kinds(np.random.default_rng(0), 4096)
    found = np.asarray(bins_jit(np.int32(3), tuple(normal.T)))
    assert set(found) == set(range(54))
    assert (np.asarray(bins_jit(np.int32(0), tuple(normal.T))) == 0).all()


@given(n_bins=st.integers(1, 8), seed=seeds)
@some
def test_each_normal_is_in_the_cone_of_its_bin(n_bins, seed):
    normal = normals_of_all_kinds(np.random.default_rng(seed), 256)
    index = bins_jit(np.int32(n_bins), tuple(normal.T))
    assert (np.asarray(index) >= 0).all() and (np.asarray(index) < 6 * n_bins**2).all()
    cones = cones_jit(np.int32(n_bins), index)
    axis = np.stack([cones.x, cones.y, cones.z], axis=1).astype(np.float64)
    assert np.allclose(np.linalg.norm(axis, axis=1), 1, atol=1e-6)
    cos = (unit(normal.astype(np.float64)) * unit(axis)).sum(1)
    assert (cos >= np.asarray(cones.cos)).all()
    # The widest bin of n x n reaches from the middle of its square to a corner: sqrt(2)/n off at a distance of 1.
    assert (np.asarray(cones.cos) >= np.cos(np.arctan(np.sqrt(2) / n_bins)) - 1e-5).all()


def test_without_bins_the_cone_is_all_directions():
    assert (np.asarray(cones_jit(np.int32(0), jnp.zeros(4, jnp.int32)).cos) == -1).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@given(seed=seeds)
@some
def test_each_normal_is_in_the_cone_of_its_cluster(dtype, seed):
    rng = np.random.default_rng(seed)
    normal = normals_of_all_kinds(rng, 64 * 32).reshape(64, 32, 3)
    spread = 10 ** rng.uniform(-6, 0.5, (64, 1, 1))
    normal = unit(normal[:, :1] + spread * rng.normal(size=normal.shape)).astype(dtype)
    normal[5] = np.where(np.arange(32)[:, None] % 2, 1, -1) * normal[5, :1]  # they cancel
    cluster = np.sort(rng.integers(0, 20, 64)).astype(np.int32)
    cluster[60:] = 64  # unused
    in_block = rng.random((64, 32)) < 0.7
    cones = samples_jit(tuple(np.moveaxis(normal, -1, 0)), in_block, jnp.asarray(cluster))
    axis = np.stack([cones.x, cones.y, cones.z], axis=1).astype(np.float64)
    for b in range(60):
        c = cluster[b]
        if np.asarray(cones.cos)[c] <= -1:
            continue
        cos = unit(normal[b, in_block[b]].astype(np.float64)) @ unit(axis[c])
        assert (cos >= np.asarray(cones.cos)[c]).all()


@given(seed=seeds, spread=st.floats(-7, 0.3), shrink=st.floats(-8, 0))
@some
def test_no_light_in_front_of_a_surface_is_behind_its_cone(seed, spread, shrink):
    """Lights so near to the plane of a sample that rounding could put them behind it."""
    rng = np.random.default_rng(seed)
    n = 128
    size = 10 ** rng.uniform(-3, 1, (n, 1))
    offset = rng.normal(size=(n, 3)) * 10 ** rng.uniform(-1, 3, (n, 1))
    low, high = offset, offset + size * rng.random((n, 3))
    low, high = low.astype(np.float32), high.astype(np.float32)
    axis = unit(rng.normal(size=(n, 3)))
    normal = unit(axis + 10**spread * rng.normal(size=(n, 3)))
    cos = np.minimum((axis * normal).sum(1), 1) - 4e-6  # as cones are made
    # A corner of the box is the sample; the light is beside it, barely in front.
    sample = np.where(rng.random((n, 3)) < 0.5, low, high).astype(np.float64)
    aside = unit(np.cross(normal, rng.normal(size=(n, 3)))) * size * 10 ** rng.uniform(-1, 3, (n, 1))
    light = sample + aside + normal * np.linalg.norm(aside, axis=1, keepdims=True) * 10**shrink
    in_front = ((light.astype(np.float32) - sample) * normal).sum(1) > 0
    cones = NormalCones(*f32(*axis.T, cos))
    faces = face_jit(cones, Aabb(*f32(*low.T, *high.T)), Sphere(*f32(*light.T, np.ones(n))))
    assert np.asarray(faces)[in_front].all()


def test_lights_behind_all_surfaces_are_culled_as_in_the_equation():
    """omega > pi/2 + alpha + delta (Olsson et al. 2012, Sec. 3.3), with a sphere of radius 1 seen from 10 m."""
    alpha, delta = np.radians(20.0), np.arcsin(0.1)
    corner = 1 / np.sqrt(3)
    box = Aabb(*f32(*[[-corner]] * 3, *[[corner]] * 3))
    cones = NormalCones(*f32([0], [0], [1], [np.cos(alpha)]))
    for off, expected in ((-0.001, True), (0.001, False)):
        omega = np.pi / 2 + alpha + delta + off
        light = f32([10 * np.sin(omega)], [0], [10 * np.cos(omega)], [5])
        assert bool(face_jit(cones, box, Sphere(*light))[0]) == expected
