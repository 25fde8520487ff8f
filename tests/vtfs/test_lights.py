"""Lights: their records, `lights.csv`, and scattering."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from vtfs.camera import Camera, Viewport
from vtfs.input_error import InputError
from vtfs.lights import Lights, cone_cosines, load_lights, point_lights, save_lights, scatter_lights

SPOTS = "x,y,z,range,r,g,b,dx,dy,dz,inner_deg,outer_deg\n1,2,3,4,1,1,1,0,-2,0,20,40\n0,0,0,5,1,0,0,,,,,\n"


def test_points_and_spots_are_read(tmp_path):
    (tmp_path / "l.csv").write_text(SPOTS)
    lights = load_lights(tmp_path / "l.csv")
    assert lights.n_lights == 2 and lights.is_spot.tolist() == [True, False]
    assert_allclose(lights.direction[0], [0, -1, 0])
    assert_allclose([lights.cos_inner[0], lights.cos_outer[0]], np.cos(np.radians([20, 40])))
    assert (lights.cos_inner[1], lights.cos_outer[1]) == (-1, -2)


@given(cosine=st.floats(-1, 1))
def test_a_point_light_shines_everywhere(cosine):
    lights = point_lights(np.zeros((1, 3)), np.ones(1), np.ones((1, 3)))
    weight = np.clip((cosine - lights.cos_outer) / (lights.cos_inner - lights.cos_outer), 0, 1)
    assert weight == 1


@given(outer=st.floats(0.01, 180), share=st.floats(0, 1))
def test_cone_cosines_never_divide_by_zero(outer, share):
    inner_cos, outer_cos = cone_cosines(outer * share, outer)
    assert inner_cos - outer_cos >= 0.9e-6


def test_lights_survive_their_file(tmp_path):
    (tmp_path / "l.csv").write_text(SPOTS)
    lights = load_lights(tmp_path / "l.csv")
    save_lights(tmp_path / "m.csv", lights)
    again = load_lights(tmp_path / "m.csv")
    for name in ("position_m", "range_m", "colour"):
        assert (getattr(again, name) == getattr(lights, name)).all()
    assert_allclose(again.cos_outer, lights.cos_outer, rtol=1e-12)  # through degrees and back


HEAD = "x,y,z,range,r,g,b\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: column `x` is missing"),
        ("x,y,z,r,g,b\n", "line 1: column `range` is missing"),
        ("x,y,z,range,r,g,b,dx\n", "line 1: column `dy` is missing"),
        ("x,y,z,range,r,g,b,power\n", "line 1: column `power` is unknown"),
        ("x,x,y,z,range,r,g,b\n", "line 1: column `x` is there 2 times"),
        (HEAD + "0,0,0,1,1,1,1\n0,0,zero,1,1,1,1\n", "line 3: column `z` = 'zero': must be a number"),
        (HEAD + "0,0,0,-1,1,1,1\n", "line 2: column `range` = -1: must be 0 or more"),
        (HEAD + "0,0,0,nan,1,1,1\n", "line 2: column `range` = 'nan': must be finite"),
        (HEAD + "0,0,0,1,inf,1,1\n", "line 2: column `r` = 'inf': must be finite"),
        (HEAD + "0,0,0,1,-1,1,1\n", "line 2: column `r` = -1"),
        (HEAD + "0,0,0,1,1,1\n", "line 2: has 6 values"),
        (SPOTS + "0,0,0,1,1,1,1,0,1,0,50,40\n", "line 4: column `inner_deg` = 50"),
        (SPOTS + "0,0,0,1,1,1,1,0,0,0,10,40\n", "line 4: columns `dx,dy,dz`"),
        (SPOTS + "0,0,0,1,1,1,1,0,1,0,0,0\n", "line 4: column `outer_deg` = 0"),
        (SPOTS + "0,0,0,1,1,1,1,0,1,,10,40\n", "line 4: column `dz` = ''"),
    ],
)
def test_a_wrong_light_file_is_refused_by_line_and_column(tmp_path, text, message):
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        load_lights(tmp_path / "l.csv")
    assert "\n" not in str(caught.value)


def test_what_is_no_text_is_refused(tmp_path):
    (tmp_path / "l.csv").write_bytes(b"x,y,z,range,r,g,b\n\xff\xfe\n")
    with pytest.raises(InputError, match="byte 18 is not UTF-8"):
        load_lights(tmp_path / "l.csv")
    with pytest.raises(InputError, match="no such file"):
        load_lights(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("range_m", np.array([-1.0]), "light 0 `range_m`"),
        ("position_m", np.array([[0, np.nan, 0]]), "light 0 `position_m`"),
        ("colour", np.zeros((2, 3)), "has shape"),
        ("cos_inner", np.array([-3.0]), "light 0 `cos_inner`"),
    ],
)
def test_wrong_lights_are_refused_by_name(field, value, message):
    good = point_lights(np.zeros((1, 3)), np.ones(1), np.ones((1, 3)))
    with pytest.raises(InputError, match=message):
        Lights(**(vars(good) | {field: value}))


def test_lights_in_view_space_keep_distances():
    camera = Camera((1.0, 2.0, 3.0), (4.0, 1.0, 0.0), (0.0, 1.0, 0.0), 60, 0.1, 10, Viewport(4, 4))
    lights = scatter_lights((np.zeros(3), np.ones(3)), 10, 0, np.random.default_rng(0).random((50, 3)))
    seen = lights.relative_to(camera.view_from_world)
    from_eye = np.linalg.norm(lights.position_m - camera.eye_m, axis=1)
    assert_allclose(np.linalg.norm(seen.position_m, axis=1), from_eye)
    assert lights.key != seen.key


@pytest.mark.parametrize("lights_per_sample", [1, 20, 500])
@pytest.mark.parametrize("density", ["constant", "fixed"])
def test_a_visible_sample_is_reached_by_as_many_lights_as_asked(lights_per_sample, density):
    rng = np.random.default_rng(1)
    low, high = np.array([-2.0, 0, -4]), np.array([3.0, 2, 9])
    visible_m = rng.uniform(low, high, (300, 3))
    lights = scatter_lights((low, high), 200, 3, visible_m, lights_per_sample, density)
    distance_m = np.linalg.norm(visible_m[:, None] - lights.position_m, axis=2)
    reaching = (distance_m <= lights.range_m * (1 + 1e-12)).sum(axis=1)
    assert np.median(reaching) == pytest.approx(min(lights_per_sample, 200), abs=1)
    assert lights.key == scatter_lights((low, high), 200, 3, visible_m, lights_per_sample, density).key
    assert lights.key != scatter_lights((low, high), 200, 4, visible_m, lights_per_sample, density).key


def test_fixed_density_means_a_cubic_metre_each():
    lights = scatter_lights((np.zeros(3), np.array([1.0, 2, 4])), 20_000, 0, np.zeros((1, 3)), density="fixed")
    size = lights.position_m.max(axis=0) - lights.position_m.min(axis=0)
    assert np.prod(size) == pytest.approx(20_000, rel=0.01)  # the outermost lights lie just inside the box
    assert_allclose(size / size[0], [1, 2, 4], rtol=0.01)


def test_no_lights_is_a_number_and_fewer_is_not():
    assert scatter_lights((np.zeros(3), np.ones(3)), 0, 0, np.zeros((1, 3))).n_lights == 0
    with pytest.raises(InputError, match="`lights` = -1"):
        scatter_lights((np.zeros(3), np.ones(3)), -1, 0, np.zeros((1, 3)))
