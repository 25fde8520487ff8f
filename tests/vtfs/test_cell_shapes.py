# NumPy arrays stand for those of the device.
# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
"""Spheres against the cells themselves: the exact test is that of float64 geometry, the others keep all it keeps."""

import math
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import seeds
from vtfs.bounds import Aabb, Sphere
from vtfs.cell_shapes import (
    CellSections,
    sphere_meets_planes,
    sphere_meets_screen_rect,
    sphere_meets_section,
    within_box,
)

some = settings(max_examples=60, deadline=None)
N = 64
TESTS = [sphere_meets_section, sphere_meets_planes, sphere_meets_screen_rect]
jitted = {test: jax.jit(test) for test in TESTS}
SLACK = 3e-6  # three times the bound of `bounds.SLACK`, relative to all magnitudes: what a test may accept besides


def f32(*values: float) -> Any:
    return [np.float32(value) for value in values]


def a_section(rng, parallel) -> Any:
    """Edges of a tile anywhere on an image of up to 170 degrees, thin and thick slices, near 0.01 to 10 m."""
    size = 10 ** rng.uniform(-4, 1, 2)
    left, bottom = rng.normal(size=2) * 10 ** rng.uniform(-2, 1)
    near_m = 10 ** rng.uniform(-2, 1)
    far_m = near_m * (1 + 10 ** rng.uniform(-3, 3))
    edges = tuple(float(np.float32(e)) for e in (left, left + size[0], bottom, bottom + size[1]))
    near_m, far_m, view_near_m = (float(np.float32(d)) for d in (near_m, far_m, near_m * rng.choice([1, 0.1])))
    section = CellSections(*f32(*edges, near_m, far_m, not parallel, view_near_m))
    return section, edges, near_m, far_m, view_near_m


def spheres_about(corners, rng):
    """Centres in the cell, near its corners, edges and faces, around the eye, behind it, and anywhere."""
    share = rng.dirichlet(np.full(8, 0.3), N)
    scale = np.abs(corners).max()
    centre = share @ corners + rng.normal(size=(N, 3)) * scale * 10 ** rng.uniform(-4, 1, (N, 1))
    centre[: N // 8] = rng.normal(size=(N // 8, 3)) * scale * 10 ** rng.uniform(-3, 0, (N // 8, 1))
    centre[N // 8 : N // 4, 2] *= -1
    centre[N // 4 : N // 3] = corners[rng.integers(8, size=N // 3 - N // 4)]
    return centre.astype(np.float32).astype(np.float64)


def met(test, centre, radius, section):
    sphere: Any = [*centre.astype(np.float32).T, radius.astype(np.float32)]
    return np.asarray(jitted[test](Sphere(*sphere), section))


def magnitude(centre, edges, far_m, parallel):
    slope = np.abs(edges).reshape(2, 2).max(1).sum()
    return np.abs(centre).sum(1) + far_m + slope * (1 if parallel else far_m)


@pytest.mark.parametrize("parallel", [False, True], ids=["perspective", "parallel"])
@given(seed=seeds)
@example(seed=0)
@some
def test_the_exact_test_is_the_distance_to_the_cell(parallel, seed):
    rng = np.random.default_rng(seed)
    section, edges, near_m, far_m, _ = a_section(rng, parallel)
    corners = oracles.cell_corners(edges, near_m, far_m, parallel)
    centre = spheres_about(corners, rng)
    distance = oracles.distances_to_cell(centre, corners)
    # Reaching the cell, or not, by less than rounding; and any radius.
    near_miss = distance * (1 + rng.choice([-1, 1], N) * 10 ** rng.uniform(-8, -2, N))
    radius = np.where(rng.random(N) < 0.7, near_miss, 10 ** rng.uniform(-3, 3, N)).astype(np.float32).astype(np.float64)
    found = met(sphere_meets_section, centre, radius, section)
    allowed = distance <= radius + SLACK * magnitude(centre, edges, far_m, parallel) + 1e-18
    assert found[distance <= radius].all()
    assert allowed[found].all()
    for test in (sphere_meets_planes, sphere_meets_screen_rect):
        assert met(test, centre, radius, section)[distance <= radius].all()


@given(seed=seeds)
@some
def test_the_planes_are_those_of_the_cell(seed):
    rng = np.random.default_rng(seed)
    section, edges, near_m, far_m, _ = a_section(rng, False)
    corners = oracles.cell_corners(edges, near_m, far_m)
    centre = spheres_about(corners, rng)
    middle = corners.mean(axis=0)
    beyond = np.full(N, -np.inf)
    for a, b, d in ((0, 1, 2), (4, 5, 6), (0, 1, 4), (2, 3, 6), (0, 2, 4), (1, 3, 5)):
        normal = np.cross(corners[b] - corners[a], corners[d] - corners[a])
        normal *= np.sign(normal @ (corners[a] - middle)) / np.linalg.norm(normal)
        beyond = np.maximum(beyond, (centre - corners[a]) @ normal)
    radius = np.abs(beyond) * (1 + rng.choice([-1, 1], N) * 10 ** rng.uniform(-8, -2, N))
    radius = radius.astype(np.float32).astype(np.float64)
    slack = SLACK * magnitude(centre, edges, far_m, False)
    found = met(sphere_meets_planes, centre, radius, section)
    assert found[beyond <= radius - slack].all() and (beyond <= radius + slack)[found].all()


@given(seed=seeds)
@some
def test_the_screen_rectangle_is_that_of_the_tangents(seed):
    rng = np.random.default_rng(seed)
    section, edges, near_m, far_m, view_near_m = a_section(rng, False)
    corners = oracles.cell_corners(edges, near_m, far_m)
    centre = spheres_about(corners, rng)
    radius = (np.abs(centre).max(1) * 10 ** rng.uniform(-3, 1, N)).astype(np.float32).astype(np.float64)
    found = met(sphere_meets_screen_rect, centre, radius, section)
    slack = SLACK * (magnitude(centre, edges, far_m, False) + radius)

    def overlaps(n, extra):
        depth_m, grown = -centre[n, 2], max(radius[n] + extra, 0)
        if not (depth_m - grown <= far_m and near_m <= depth_m + grown):
            return False
        for axis, (low, high) in enumerate((edges[:2], edges[2:])):
            interval = oracles.projected_interval(centre[n, axis], depth_m, grown, view_near_m)
            if interval is None or interval[1] < low or high < interval[0]:
                return False
        return True

    for n in range(N):
        if overlaps(n, 0):
            assert found[n]
        if found[n]:
            assert overlaps(n, slack[n])


@pytest.mark.parametrize("test", TESTS, ids=lambda f: f.__name__)
def test_a_light_at_infinity_meets_nothing_and_a_huge_one_everything(test):
    section = CellSections(*f32(-0.5, 0.0, 0.0, 0.5, 1.0, 2.0, 1, 1.0))
    for x, radius, expected in ((np.inf, 0.0, False), (np.inf, 1e18, False), (3.0, 1e15, True), (-0.3, 0.0, True)):
        centre = np.array([[x, 0.2, -1.5]])
        assert met(test, centre, np.array([radius]), section).tolist() == [expected]


@given(seed=seeds, parallel=st.booleans())
@some
def test_a_section_within_a_box_holds_what_is_in_both(seed, parallel):
    rng = np.random.default_rng(seed)
    section, edges, near_m, far_m, _ = a_section(rng, parallel)
    depth_m = rng.uniform(near_m, far_m, 20)
    width = 1 if parallel else depth_m
    point = np.stack(
        [rng.uniform(edges[0], edges[1], 20) * width, rng.uniform(edges[2], edges[3], 20) * width, -depth_m], axis=1
    ).astype(np.float32)
    few = point[: rng.integers(1, 20)]
    low, high = few.min(0), few.max(0)
    part = within_box(section, Aabb(*f32(*low, *high)))
    depth_m = -few[:, 2].astype(np.float64)
    slope = few[:, :2] / (np.ones((len(few), 1)) if parallel else depth_m[:, None])
    rounding = 3e-7 * np.abs(slope)  # the sample's own float32 may lie outside the cell
    assert (float(part.near_m) <= depth_m).all() and (depth_m <= float(part.far_m)).all()
    for k, (start, end) in enumerate(((part.left, part.right), (part.bottom, part.top))):
        assert (float(start) - rounding[:, k] <= slope[:, k]).all()
        assert (slope[:, k] <= float(end) + rounding[:, k]).all()
    assert float(part.left) >= float(section.left) and float(part.far_m) - float(part.near_m) <= far_m - near_m


def test_the_distances_of_the_oracle_are_right_where_they_are_known():
    cube = oracles.cell_corners((-1, 1, -1, 1), 2.0, 4.0, parallel=True)
    points = np.array([[0, 0, -3], [3, 0, -3], [2, 2, -3], [2, 2, -1], [0, 0.5, -9]], float)
    assert np.allclose(oracles.distances_to_cell(points, cube), [0, 2, math.sqrt(2), math.sqrt(3), 5])
    interval: Any = oracles.projected_interval(0, 2, 1, 0.1)
    assert np.allclose(interval, [-1 / math.sqrt(3), 1 / math.sqrt(3)])
