"""Boxes and spheres: touching counts, rounding errs on its side, and what is empty meets nothing."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests import oracles
from vtfs.bounds import (
    SLACK,
    Aabb,
    Cone,
    Sphere,
    box_of_sphere,
    boxes_meet,
    sphere_meets_box,
    sphere_meets_cone,
    sphere_of_box,
)

some = settings(max_examples=60, deadline=None)
coordinates = st.floats(-1e5, 1e5, width=32, allow_subnormal=False)  # XLA flushes those to 0
points = st.tuples(coordinates, coordinates, coordinates)
lengths = st.one_of(st.just(0.0), st.floats(2**-10, 1e6, width=32))


def f32(*values):
    return [np.array([value], np.float32) for value in values]


def box_from(corner, size):
    low = np.array(corner, np.float32)
    return low, (low + np.array(size, np.float32)).astype(np.float32)


def meets(centre, radius, low, high):
    return bool(sphere_meets_box(Sphere(*f32(*centre, radius)), Aabb(*f32(*low, *high)))[0])  # type: ignore[arg-type]


@given(centre=points, radius=lengths, corner=points, size=st.tuples(lengths, lengths, lengths))
@some
def test_spheres_meet_boxes_as_in_float64(centre, radius, corner, size):
    low, high = box_from(corner, size)
    arrays = np.array([centre], np.float32), np.array([radius], np.float32), low[None], high[None]
    if oracles.spheres_in_boxes(*arrays)[0, 0]:
        assert meets(centre, radius, low, high)
    outside = np.maximum(low - arrays[0], arrays[0] - high)
    if outside.max() > 1e-18 and not oracles.spheres_in_boxes(*arrays, share=1 + SLACK)[0, 0]:
        assert not meets(centre, radius, low, high)


@given(centre=points, direction=points, size=lengths, excess=st.floats(-1e-5, 1e-5))
@example(centre=(0, 0, 0), direction=(0, 0, 5.4e-27), size=0, excess=-8e-6)
@some
def test_a_sphere_that_just_reaches_a_corner_meets_it(centre, direction, size, excess):
    """The radius is the distance to the corner, give or take a little: the hardest case for rounding."""
    corner = np.array(centre, np.float32) + np.array(direction, np.float32)
    low = np.minimum(corner, corner + np.sign(direction).astype(np.float32) * np.float32(size))
    high = np.maximum(corner, corner + np.sign(direction).astype(np.float32) * np.float32(size))
    centre = np.array(centre, np.float32)
    outside = np.maximum(np.maximum(low - centre, centre - high), 0).astype(np.float64)
    radius = np.float32(np.sqrt((outside**2).sum()) * (1 + excess))
    arrays = centre[None], np.array([radius]), low[None], high[None]
    if oracles.spheres_in_boxes(*arrays)[0, 0]:
        assert meets(centre, radius, low, high)
    # Of distances below 1e-18 m the squares underflow: such a sphere touches.
    if outside.max() > 1e-18 and not oracles.spheres_in_boxes(*arrays, share=1 + SLACK)[0, 0]:
        assert not meets(centre, radius, low, high)


def test_touching_counts():
    assert meets((2, 0, 0), 1, (-1, -1, -1), (1, 1, 1))
    assert not meets((2.001, 0, 0), 1, (-1, -1, -1), (1, 1, 1))
    assert meets((0.5, 0, 0), 0, (-1, -1, -1), (1, 1, 1))  # no range, but inside


@pytest.mark.parametrize("radius", [0.0, 1.0, 1e18])
def test_a_sphere_at_infinity_meets_nothing(radius):
    assert not meets((np.inf, 0, 0), radius, (-1e6, -1e6, -1e6), (1e6, 1e6, 1e6))
    box = box_of_sphere(Sphere(*f32(np.inf, 0, 0, radius)))  # type: ignore[arg-type]
    everywhere = Aabb(*f32(-1e6, -1e6, -1e6, 1e6, 1e6, 1e6))  # type: ignore[arg-type]
    assert not boxes_meet(box, everywhere)[0] and not boxes_meet(everywhere, box)[0]


@given(centre=points, radius=lengths)
@some
def test_the_box_of_a_sphere_holds_it(centre, radius):
    box = box_of_sphere(Sphere(*f32(*centre, radius)))  # type: ignore[arg-type]
    low = np.array([box.low_x_m, box.low_y_m, box.low_z_m], np.float64)[:, 0]
    high = np.array([box.high_x_m, box.high_y_m, box.high_z_m], np.float64)[:, 0]
    exact, reach = np.array(centre, np.float32).astype(np.float64), np.float64(np.float32(radius))
    assert (low <= exact - reach).all() and (exact + reach <= high).all()
    assert (high - low <= 2 * (reach + 3e-6 * (np.abs(exact) + reach))).all()


@given(a=points, size_a=st.tuples(lengths, lengths, lengths), b=points, size_b=st.tuples(lengths, lengths, lengths))
@some
def test_boxes_meet_as_intervals_do(a, size_a, b, size_b):
    (low_a, high_a), (low_b, high_b) = box_from(a, size_a), box_from(b, size_b)
    expected = all(max(low_a[i], low_b[i]) <= min(high_a[i], high_b[i]) for i in range(3))
    one, other = Aabb(*f32(*low_a, *high_a)), Aabb(*f32(*low_b, *high_b))  # type: ignore[arg-type]
    assert bool(boxes_meet(one, other)[0]) == bool(boxes_meet(other, one)[0]) == expected


def test_an_empty_box_meets_nothing():
    empty = Aabb(*(jnp.array([jnp.inf]),) * 3, *(jnp.array([-jnp.inf]),) * 3)
    assert not boxes_meet(empty, Aabb(*f32(-9, -9, -9, 9, 9, 9)))[0]  # type: ignore[arg-type]


@given(corner=points, size=st.tuples(lengths, lengths, lengths))
@some
def test_the_sphere_of_a_box_holds_its_corners(corner, size):
    low, high = box_from(corner, size)
    sphere = sphere_of_box(Aabb(*f32(*low, *high)))  # type: ignore[arg-type]
    centre = np.array([sphere.x_m, sphere.y_m, sphere.z_m], np.float64)[:, 0]
    farthest = np.maximum(np.abs(low - centre), np.abs(high - centre))
    assert np.linalg.norm(farthest) <= sphere.radius_m[0]
    assert (
        sphere.radius_m[0]
        <= np.linalg.norm((high.astype(np.float64) - low) / 2) * 1.00001 + 1e-5 * np.abs([*low, *high]).sum()
    )


@given(
    half_deg=st.one_of(st.sampled_from([0.5, 1.0, 45.0, 89.999, 90.0, 90.001, 179.9]), st.floats(0.5, 180)),
    apex=points,
    seed=st.integers(0, 2**32 - 1),
    excess=st.one_of(st.floats(-1e-6, 1e-2), st.floats(-0.9, -1e-4)),
)
@some
def test_spheres_meet_cones_as_in_float64(half_deg, apex, seed, excess):
    """Spheres that reach the cone, or its apex from behind, by less than rounding."""
    rng = np.random.default_rng(seed)
    apex = np.array(apex, np.float32).astype(np.float64)
    axis = rng.normal(size=3)
    axis = (axis / np.linalg.norm(axis)).astype(np.float32)
    half = math.radians(half_deg)
    centre = (apex + rng.normal(size=3) * 10 ** rng.uniform(-3, 5)).astype(np.float32).astype(np.float64)
    if rng.random() < 0.2:
        centre = (apex - axis * 10 ** rng.uniform(-2, 2)).astype(np.float32).astype(np.float64)
    exact_axis = axis.astype(np.float64) / np.linalg.norm(axis.astype(np.float64))
    distance = oracles.distance_to_cone(centre, apex, exact_axis, half)
    radius = float(np.float32(distance * (1 + excess)))
    cone = Cone(*f32(*axis, math.cos(half), math.sin(half)))  # type: ignore[arg-type]
    found = bool(sphere_meets_cone(Sphere(*f32(*centre, radius)), Sphere(*f32(*apex, 1.0)), cone)[0])  # type: ignore[arg-type]
    if distance <= radius:
        assert found
    slack = 3 * SLACK * (np.abs(centre).sum() + np.abs(apex).sum() + radius)
    if found:
        assert distance <= radius + slack


def test_a_light_that_shines_everywhere_has_a_cone_of_all_directions():
    cone = Cone(*f32(0, 0, -1, -1, 0))  # type: ignore[arg-type]
    for centre in ((0, 0, 5), (0, 0, -5), (3, 0, 0), (0, 0, 0)):
        assert sphere_meets_cone(Sphere(*f32(*centre, 0.0)), Sphere(*f32(0, 0, 0, 1)), cone)[0]  # type: ignore[arg-type]
