"""Edges of casters; and casters, lights and arguments that are refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from tests.strategies import SMALL, a_camera, surface_samples
from tests.vtfs.shadow_cases import TILES, soup
from vtfs.input_error import InputError
from vtfs.shadow_casters import Casters, ShadowLight, welded
from vtfs.shadow_mask import ShadowPlan, default_bias_m, edge_list
from vtfs.shadow_techniques import cast_by_bias, cast_shadows


def test_each_edge_is_listed_once_with_its_two_triangles():
    #  0-1-2 and 0-2-3 share 0-2; 4 hangs on 0-2 too; 2, 2, 3 is no triangle
    triangles = np.array([[0, 1, 2], [0, 2, 3], [2, 0, 4], [2, 2, 3]], np.int32)
    edges = edge_list(triangles)
    assert edges.dtype == np.int32
    found = {tuple(edge) for edge in edges.tolist()}
    assert {(0, 1, 0, -1), (1, 2, 0, -1), (0, 3, 3, -1), (0, 4, 4, -1), (2, 4, 5, -1), (2, 3, 2, 6)} < found
    shared = sorted(edge for edge in found if edge[:2] == (0, 2))
    assert [edge[2:] for edge in shared] in ([(1, 2), (5, -1)], [(1, 2), (4, -1)])
    ball = trimesh.creation.icosphere(subdivisions=2)
    closed = edge_list(np.array(ball.faces, np.int32))
    assert len(closed) == len(ball.edges_unique) and (closed[:, 2:] >= 0).all()
    assert ((closed[:, 2] + closed[:, 3]) % 2 == 1).all()  # neighbours run along their edge in opposite directions
    # Where each triangle has vertices of its own, as at the seams of textures, the edges are the same.
    order = np.random.default_rng(0).permutation(ball.faces.size)
    split = np.empty((ball.faces.size, 3))
    split[order] = ball.vertices[ball.faces.ravel()]
    split[split == 0] = -0.0  # a place all the same
    split[: len(split) // 2] += 0.0
    alone = order.reshape(-1, 3)
    assert (edge_list(alone)[:, 3] < 0).all()
    joined = edge_list(welded(split, alone))
    assert len(joined) == len(closed) and (joined[:, 2:] >= 0).all()
    assert (split[welded(split, alone)] == ball.vertices[ball.faces]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_casters_that_are_not_finite_are_refused_by_name(value):
    corners = np.eye(3)
    corners[1, 2] = value
    with pytest.raises(InputError, match=r"casters `triangles`: triangle 0 .*NaN or infinite"):
        Casters(corners, np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Casters(np.eye(3), np.array([[0, 1, 3]])), "index 3 is out of range"),
        (lambda: ShadowLight((0.0, np.nan, 0.0)), "position_m"),
        (lambda: ShadowLight((0.0, 0.0, 0.0), directional=True), "needs a direction"),
    ],
)
def test_bad_input_is_refused_by_name(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize("position", ["abc", None, (0.0, 1.0), (0.0, 1.0, np.nan), ((1.0,), 2.0, 3.0)])
def test_a_light_without_a_place_is_refused(position):
    with pytest.raises(InputError, match=r"`position_m` = .*: must be three finite numbers"):
        ShadowLight(position)


def test_a_light_is_refused_where_rounding_would_decide_more_than_the_bands_excuse():
    """A large triangle and one that is a little wider than the bands, which is left out where it is seen too narrow."""
    camera = a_camera(SMALL)
    samples = surface_samples(camera, 0)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 0.1], [0.20004, 0.2, 0.1], [0.2, 0.20004, 0.1]])
    casters = Casters(corners, np.arange(6).reshape(2, 3))

    def n_cast(distance_m: float, casters: Casters, directional: bool = False) -> int:
        light = ShadowLight((0.1 * distance_m, 0.1 * distance_m, distance_m), directional)
        return cast_shadows("ptsv", TILES, samples, casters, light).counts["casters"]

    assert n_cast(1e5, casters) == 2
    assert n_cast(1e6, casters, directional=True) == 2
    far = ShadowLight((1e5, 1e5, 1e6))
    unchecked = cast_by_bias("ptsv", TILES, samples, casters, far, 0, "cast", None, default_bias_m(casters))
    assert unchecked.counts["casters"] == 1
    for distance_m in (2e5, 1e30, 1e300):
        with pytest.raises(
            InputError, match=r"must be within 100000 of their extents, .*; make it a directional light"
        ):
            n_cast(distance_m, casters)
    assert n_cast(1e30, Casters(np.zeros((0, 3)), np.zeros((0, 3), np.int32))) == 0
    with pytest.raises(InputError, match=r"`position_m`: a coordinate of 1e\+37 m is beyond 1e36"):
        n_cast(1e37, Casters(corners * 1e35, casters.triangles))  # boxes about it would overflow


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("receives", np.ones((3, 5), bool), r"`receives`: is bool of shape \(3, 5\); must be bool of shape \(17, 33\)"),
        ("receives", np.ones((17, 33)), "`receives`: is float64 of shape"),
        ("bias_m", float("nan"), "`bias_m` = nan: must be a finite number"),
        ("bias_m", -1e-3, "`bias_m` = -0.001: must be a finite number"),
        ("front_faces", "cull", "`front_faces='cull'`: must be one of cast, culled"),
        ("depth_slices", -1, "`depth_slices` = -1: must be a whole number from 0 to 8,192"),
        ("depth_slices", 2.5, "`depth_slices` = 2.5: must be"),
    ],
)
def test_what_shadows_are_cast_with_is_checked(argument, value, message):
    camera = a_camera(SMALL)
    samples, casters = surface_samples(camera, 0), soup(camera, np.random.default_rng(0))
    with pytest.raises(InputError, match=message):
        cast_shadows("ptsv", ShadowPlan(), samples, casters, ShadowLight((0.0, 9.0, 0.0)), **{argument: value})
