"""The stress ladders of shadows: cases that can fail, methods that fail where they must, and no other."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtfs.scene_setup import SceneOptions, set_up
from vtfs.shadow_casters import Casters, ShadowLight
from vtfs.shadow_mask import edge_list, facing_samples
from vtfs.shadow_references import brute_force, is_excused, view_points_m
from vtfs.shadow_volumes.stencil import PolygonCounts, is_set
from vtfs.stability.bad_triangles import KINDS, bad_triangles
from vtfs.stability.own_scene import own_scene
from vtfs.stability.shadow_ladders import N_EDGES, N_TRIANGLES, N_VERTICES, built_in_ladders
from vtfs.stability.shadow_methods import SHADOW_METHODS, ShadowMethod, ShadowRunner, Shapes
from vtfs.stability.shadow_verdicts import ShadowVerdict, judge_shadows
from vtfs.stability.stage import VIEWPORT, default_stage

SHAPES = Shapes(N_TRIANGLES, N_VERTICES, N_EDGES)
LADDERS = {ladder.name: ladder for ladder in built_in_ladders(0)}
EXACT, FLOAT32 = "cluster_hierarchy", "cluster_hierarchy, float32 test"
Z_PASS, TEXTBOOK, WRAPPING = "z_pass", "z_pass, textbook", "z_pass, 8 bits wrapping"


@functools.cache
def runner() -> ShadowRunner:
    """Methods of three programs, compiled once for all tests."""
    kept = ("world", "24-bit", "1 mm", "Embree")
    methods = [
        method
        for method in SHADOW_METHODS
        if method.name in (EXACT, FLOAT32)
        or any(part in method.name for part in kept)
        or (method.technique == "z_pass" and method.precision == "float64")
    ]
    return ShadowRunner(SHAPES, methods)


def case_of(ladder: str, label: str):
    return next(rung for rung in LADDERS[ladder].rungs if rung.label == label).make()


@functools.cache
def judged(ladder: str, label: str):
    return judge_shadows(case_of(ladder, label), runner())


def wrong(ladder: str, label: str) -> dict[str, int]:
    return {name: v.false_light + v.false_shadow for name, v in judged(ladder, label).verdicts.items()}


def test_no_method_is_wrong_where_nothing_is_stressed():
    found = judged("offset", "0")
    assert found.shadowed > 0.1 * (found.lit + found.shadowed) and found.lit > found.shadowed
    assert set(found.verdicts.values()) == {ShadowVerdict()}


@pytest.mark.parametrize(
    ("ladder", "label", "fails", "holds"),
    [
        ("camera_inside", "1", TEXTBOOK, Z_PASS),
        ("nested", "256", WRAPPING, Z_PASS),
        ("nested", "257", "z_pass, 8 bits saturating", WRAPPING),
        ("aim", "1e-10 rad", FLOAT32, EXACT),
        ("offset", "1e6", "cluster_hierarchy, world in float32", EXACT),
        ("near", "1e-6", "cluster_hierarchy, 24-bit depth buffer", EXACT),
        ("scale", "1e6", "cluster_hierarchy, bias of 1 mm", EXACT),
    ],
)
def test_each_method_fails_where_it_must_and_its_sibling_does_not(ladder, label, fails, holds):
    found = wrong(ladder, label)
    assert found[fails] > 0 and found[holds] == 0


def test_a_light_at_or_beside_a_vertex_makes_no_shadow_of_noise():
    """Before their volumes were compared with their rounding, such triangles shadowed everything."""
    for kind in ("light at a vertex", "vertex 1e-14 m from the light"):
        assert wrong("degenerate", kind)[EXACT] == wrong("degenerate", kind)[Z_PASS] == 0
        assert 0 < judged("degenerate", kind).shadowed < judged("degenerate", kind).lit


def test_wrong_masks_are_counted_as_what_they_are():
    """A method that says "lit" everywhere, and one that says "shadow": every sample but those in the bands."""

    class Constant(ShadowRunner):
        def answers(self, case, receives):
            for name, value in (("light", False), ("shadow", True)):
                yield ShadowMethod(name, "ptsv"), np.full(int(receives.sum()), value)
            yield ShadowMethod("none", "ptsv"), "does not fit"

    found = judge_shadows(case_of("offset", "0"), Constant(SHAPES))
    light, shadow = found.verdicts["light"], found.verdicts["shadow"]
    assert light.false_light + light.near_edge + light.near_plane == found.shadowed
    assert shadow.false_shadow + shadow.near_edge + shadow.near_plane == found.lit
    assert light.false_light > 0.95 * found.shadowed and shadow.false_shadow > 0.95 * found.lit
    assert found.verdicts["none"] == ShadowVerdict(refused="does not fit")


@pytest.mark.parametrize("name", LADDERS)
def test_every_ladder_ends_with_cases_that_fit_and_can_fail(name):
    for rung in (LADDERS[name].rungs[0], LADDERS[name].rungs[-1]):
        case = rung.make()
        assert case.casters.n_triangles <= N_TRIANGLES and len(case.casters.vertices_m) <= N_VERTICES
        assert len(edge_list(case.casters.triangles)) <= N_EDGES
        receives = facing_samples(case.samples, case.light) & case.tested
        eye = np.array(case.samples.camera.eye_m)
        shadowed = brute_force(view_points_m(case.samples, receives), case.casters, case.light, case.bias_m, eye)
        assert len(shadowed) > 500
        # A mesh hides the light from all that it is aimed at; a light at the camera lights all that it sees.
        share = {"aim": 1, "t_junctions": 1}.get(name) or (
            0 if rung.label == "0" and name == "light_to_camera" else None
        )
        assert abs(shadowed.mean() - share) < 0.01 if share is not None else 0.05 < shadowed.mean() < 0.6


def test_a_rung_changes_nothing_but_what_it_stresses():
    """Offset and scale: the same image of the same things, as the reference has it."""
    first = judged("offset", "0")
    for ladder, label in (("offset", "1e6"), ("scale", "1e6")):
        found = judged(ladder, label)
        assert (found.lit, found.shadowed) == (first.lit, first.shadowed)


@pytest.mark.parametrize("kind", KINDS)
def test_bad_triangles_are_finite_and_as_many_as_asked(kind):
    corners = bad_triangles(kind, np.array([1.0, 2, 3]), 30, np.random.default_rng(0))
    assert corners.shape == (30, 3, 3) and np.isfinite(corners).all()


# Which mismatches are excused

LIGHT = ShadowLight((0.0, 0.0, 0.0))
# A square two metres below the light, of two triangles, and a floor of two more at ten metres.
SQUARE = Casters(
    np.array([[-1.0, -2, -1], [1, -2, -1], [1, -2, 1], [-1, -2, 1], [-20, -10, -20], [20, -10, -20], [20, -10, 20.0],
              [-20, -10, 20]]),
    np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
)  # fmt: skip
ON_THE_FLOOR = 2  # its first triangle


def excused(point, shadowed: bool, casters: Casters = SQUARE) -> tuple[bool, bool]:
    points = np.array([point], np.float64)
    reference = brute_force(points, casters, LIGHT, 1e-4)
    assert reference[0] != shadowed  # else there is nothing to excuse
    by_edge, by_plane = is_excused(
        points, np.array([shadowed]), casters, LIGHT, 1e-4, np.array([ON_THE_FLOOR], np.int64)
    )
    return bool(by_edge[0]), bool(by_plane[0])


def test_the_border_of_a_shadow_excuses_and_an_edge_inside_of_it_does_not():
    beside = 1e-5 * np.hypot(5, 10) * 0.5  # half of the band, at the floor
    assert excused((5 - beside, -10, 1), False) == (True, False)
    assert excused((5 + beside, -10, 1), True) == (True, False)
    assert excused((5 - 10 * beside, -10, 1), False) == (False, False)
    assert excused((2.0, -10, 2.0), False) == (False, False)  # on the diagonal: a crack


def test_a_surface_that_shadows_itself_is_not_excused_and_a_plane_right_above_is():
    assert excused((9.0, -10, 2.0), True) == (False, False)
    lid = Casters(np.concatenate([SQUARE.vertices_m, [[8, -9.99995, 0], [12, -9.99995, 0], [9, -9.99995, 6]]]),
                  np.concatenate([SQUARE.triangles, [[8, 9, 10]]]))  # fmt: skip
    assert excused((9.0, -10, 2.0), True, lid)[1]


def test_an_edge_on_triangle_excuses_shadow_beside_it():
    thin = Casters(np.concatenate([SQUARE.vertices_m, [[3, -4, 1], [6, -8, 2], [4.5, -6, 1.5 + 1e-9]]]),
                   np.concatenate([SQUARE.triangles, [[8, 9, 10]]]))  # fmt: skip
    assert excused((7.5, -10, 2.5 + 2e-5), True, thin) == (True, False)
    assert excused((7.5, -10, 2.5 + 2e-3), True, thin) == (False, False)


@given(adding=st.integers(0, 600), taking=st.integers(0, 600), eye=st.integers(0, 300))
def test_stencils_are_those_that_count_one_polygon_after_the_other(adding, taking, eye):
    counts = PolygonCounts(np.int32(eye), np.int32([[adding]]), np.int32([[taking]]))  # type: ignore[arg-type]
    for starts in (False, True):
        wrapped = saturated = total = 0
        for step in [1] * (eye * starts + adding) + [-1] * taking:
            total += step
            wrapped = (wrapped + step) % 256
            saturated = min(max(saturated + step, 0), 255)
        assert bool(is_set(counts, "unlimited", starts)[0, 0]) == (total != 0)
        assert bool(is_set(counts, "wrap", starts)[0, 0]) == (wrapped != 0)
        assert bool(is_set(counts, "saturate", starts)[0, 0]) == (saturated != 0)


# A user's scene


def test_ladders_on_a_scene_move_the_same_image():
    own = own_scene(set_up(SceneOptions("street", n_triangles=1000, lights="20")), seed=0)
    assert own.samples.camera.viewport == VIEWPORT and own.description["casters"] == own.casters.n_triangles
    # Each sample lies in the plane of its own triangle.
    points = view_points_m(own.samples, own.samples.valid) + np.array(own.samples.camera.eye_m)
    corners = own.casters.vertices_m[own.casters.triangles[own.own_triangle[own.samples.valid]]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = np.abs(((points - corners[:, 0]) * normal).sum(1)) / np.linalg.norm(normal, axis=1)
    assert away.max() < 1e-5 * own.casters.extent_m
    shares = []
    for ladder in own.shadow_ladders():
        case = ladder.rungs[-1].make()
        receives = facing_samples(case.samples, case.light) & case.tested
        points, eye = view_points_m(case.samples, receives), np.array(case.samples.camera.eye_m)
        shares.append(brute_force(points, case.casters, case.light, case.bias_m, eye).mean())
        assert ladder.source == own.name and len(points) > 500
    offset, scale, at_camera, near, far = shares
    assert 0.05 < offset < 0.95 and abs(offset - scale) < 1e-3 and offset == near == far and at_camera < 0.02
    for ladder in own.light_ladders():
        case = ladder.rungs[-1].make()
        assert case.lights.n_lights == 20 and case.samples.n_valid == own.samples.n_valid


def test_the_stage_is_drawn_by_nearest_triangles():
    stage = default_stage(0)
    samples = stage.case().samples
    rows, columns = np.nonzero(samples.valid)
    x, y = stage.camera.pixel_slopes()
    right, up, backward = stage.camera.view_from_world[:3, :3]
    rng = np.random.default_rng(0)
    for k in rng.choice(len(rows), 40, replace=False):
        ray = x[columns[k]] * right + y[rows[k]] * up - backward
        hits = {}
        for n, t in enumerate(stage.casters.triangles):
            a, b, c = stage.casters.vertices_m[t] - np.array(stage.camera.eye_m)
            solved = np.linalg.lstsq(np.column_stack([b - a, c - a, -ray]), -a, rcond=None)[0]
            if abs(np.linalg.det(np.column_stack([b - a, c - a, -ray]))) > 1e-12:
                u, v, depth = solved
                if u >= 0 and v >= 0 and u + v <= 1 and depth > stage.camera.near_m:
                    hits[n] = depth
        nearest = min(hits, key=lambda n: hits[n])
        assert samples.triangle[rows[k], columns[k]] == nearest
        assert np.isclose(-samples.position_m[rows[k], columns[k], 2], hits[nearest], rtol=1e-6)  # float32
    hidden = replace(stage, camera=replace(stage.camera, near_m=50.0)).case().samples
    assert not hidden.valid.any()
