"""Cameras: what a view is, and what is refused by name."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from vtfs.camera import Camera, CameraPath, Lens, Pose, Viewport, default_cameras, load_cameras, save_cameras
from vtfs.gallery import build_scene
from vtfs.input_error import InputError

GOOD: dict[str, Any] = {
    "eye_m": (1.0, 2.0, 3.0),
    "target_m": (0.0, 1.0, -4.0),
    "up": (0.0, 1.0, 0.0),
    "fov_y_deg": 60.0,
    "near_m": 0.1,
    "far_m": 100.0,
    "viewport": Viewport(64, 36),
}
coordinates = st.floats(-100, 100)


@pytest.mark.parametrize("field", ["width_px", "height_px"])
def test_an_empty_viewport_is_refused_by_name(field):
    with pytest.raises(ValueError, match=rf"Viewport\({field}=0\)"):
        Viewport(**({"width_px": 64, "height_px": 64} | {field: 0}))


@given(eye=st.tuples(coordinates, coordinates, coordinates), yaw=st.floats(0, 6.28), tilt=st.floats(-1.5, 1.5))
def test_a_view_keeps_lengths_and_looks_down_minus_z(eye, yaw, tilt):
    forward = np.array([math.sin(yaw) * math.cos(tilt), math.sin(tilt), -math.cos(yaw) * math.cos(tilt)])
    target = tuple(np.add(eye, 5 * forward))
    view = Camera(**(GOOD | {"eye_m": eye, "target_m": target})).view_from_world
    tolerance = 1e-12  # rounding of float64 coordinates of 100 m
    assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=tolerance)
    assert np.linalg.det(view[:3, :3]) == pytest.approx(1)  # right-handed
    assert_allclose(view @ [*target, 1], [0, 0, -5, 1], atol=100 * tolerance)


def test_directions_have_depth_one_and_row_zero_is_the_top():
    camera = Camera(**GOOD)
    direction = camera.primary_rays()[1] @ camera.view_from_world[:3, :3].T
    assert direction.shape == (36, 64, 3)
    assert_allclose(direction[..., 2], -1, atol=1e-12)
    # Pixel centres: half a pixel inside the edges of the image.
    assert direction[0, 0, 1] == pytest.approx(math.tan(math.radians(30)) * (1 - 1 / 36))
    assert direction[0, 0, 0] == pytest.approx(-camera.tan_half_x * (1 - 1 / 64))
    assert camera.tan_half_x == pytest.approx(camera.tan_half_y * 64 / 36)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target_m": (1.0, 2.0, 3.0)}, "`target`.*is where the eye is"),
        ({"up": (1.0, 1.0, 7.0)}, "`up`.*parallel to the view direction"),
        ({"up": (0.0, 0.0, 0.0)}, "`up`.*zero"),
        ({"near_m": 0.0}, "`near` = 0:"),
        ({"near_m": -1.0}, "`near` = -1:"),
        ({"near_m": math.nan}, "`near` = nan"),
        ({"near_m": 100.0}, "`far` = 100: must be beyond near"),
        ({"far_m": math.nan}, "`far` = nan"),
        ({"fov_y_deg": 0.0}, "`fov_y_deg` = 0:"),
        ({"fov_y_deg": 180.0}, "`fov_y_deg` = 180:"),
        ({"fov_y_deg": math.nan}, "`fov_y_deg` = nan"),
        ({"eye_m": (math.inf, 0.0, 0.0)}, "`eye_m`.*finite"),
    ],
)
def test_a_degenerate_camera_is_refused_by_name(change, message):
    with pytest.raises(InputError, match=message):
        Camera(**(GOOD | change))


def test_far_may_be_infinite_and_the_key_tells_views_apart():
    assert replace(Camera(**GOOD), far_m=math.inf).far_m == math.inf
    assert Camera(**GOOD).key == Camera(**GOOD).key
    assert len({Camera(**GOOD).key, replace(Camera(**GOOD), near_m=0.2).key}) == 2


@pytest.mark.parametrize("far_m", [250.0, math.inf])
def test_a_path_survives_its_file(tmp_path, far_m):
    poses = tuple(Pose((i * 0.1, 1.0, 2.0), (0.0, 1.0, -4.0 / 3), (0.0, 1.0, 0.1)) for i in range(3))
    path = CameraPath(Viewport(320, 200), 47.5, 0.05, far_m, poses)
    save_cameras(tmp_path / "c.json", path)
    assert load_cameras(tmp_path / "c.json") == path
    assert path.resized(Viewport(10, 20)).camera(1).viewport == Viewport(10, 20)
    assert path.key == load_cameras(tmp_path / "c.json").key != path.resized(Viewport(10, 20)).key


def test_a_shifted_image_is_a_part_of_a_larger_one():
    """The right half of a view is a view half as wide, shifted by half of its own width."""
    whole = Camera(**GOOD)
    half = replace(whole, viewport=Viewport(32, 36), lens=Lens(shift_x=0.5))
    (x, y), (part_x, part_y) = whole.pixel_slopes(), half.pixel_slopes()
    assert_allclose(part_x, x[32:], atol=1e-12)
    assert_allclose(part_y, y)
    assert half.slope_left == pytest.approx(0) and half.slope_top == whole.slope_top == pytest.approx(whole.tan_half_y)
    up = replace(whole, lens=Lens(shift_y=0.5))
    assert up.pixel_slopes()[1].min() > 0  # positive shifts show what is above and to the right


def test_a_parallel_view_has_metres_for_slopes_and_rays_of_one_direction():
    camera = replace(Camera(**GOOD), lens=Lens(orthographic_height_m=9.0))
    x, y = camera.pixel_slopes()
    assert x[0] == pytest.approx(-8 + 0.125) and y[0] == pytest.approx(4.5 - 0.125)
    origin, direction = (rays @ camera.view_from_world[:3, :3].T for rays in camera.primary_rays())
    assert_allclose(direction, np.broadcast_to([0, 0, -1], direction.shape), atol=1e-12)
    assert_allclose(origin[..., :2] + camera.view_from_world[:2, 3], np.stack(np.meshgrid(x, y), -1), atol=1e-9)


def test_lenses_change_keys_but_none_that_was_there_before():
    camera = Camera(**GOOD)
    assert camera.key == "3456a23c58d2b303187aa3e46eadb9096c7960e7a196b04a9ffb145be567d186"
    others = [replace(camera, lens=lens).key for lens in (Lens(0.5), Lens(0, 0.5), Lens(0, 0, 2.0))]
    assert len({camera.key, *others}) == 4


@pytest.mark.parametrize("lens", [Lens(0.25, -1.5), Lens(orthographic_height_m=3.5), Lens(0.5, 0, 7.0)], ids=str)
def test_a_lens_survives_its_file(tmp_path, lens):
    path = CameraPath(
        Viewport(320, 200), 60.0, 0.05, 9.0, (Pose((0.0, 1.0, 2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),), lens
    )
    save_cameras(tmp_path / "c.json", path)
    assert load_cameras(tmp_path / "c.json") == path
    assert path.camera(0).lens == path.resized(Viewport(3, 2)).camera(0).lens == lens


RECORD = {
    "width": 64,
    "height": 36,
    "fov_y_deg": 60,
    "near": 0.1,
    "far": 10,
    "frames": [{"eye": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0]}],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": "wide"}, "key `width` = 'wide': must be a number"),
        ({"width": 0}, "width_px=0"),
        ({"width": 1e9}, "at most"),
        ({"height": 1.5}, "key `height` = 1.5: must be a whole number"),
        ({"near": None}, "key `near` = None"),
        ({"fov_y_deg": True}, "key `fov_y_deg` = True"),
        ({"far": 0.1}, "frame 0: camera `far`"),
        ({"shift_x": "left"}, "key `shift_x` = 'left': must be a number"),
        ({"shift_y": 1e3}, "camera `shift_y` = 1000: must lie between -100 and 100"),
        ({"shift_x": math.nan}, "camera `shift_x` = nan"),
        ({"orthographic_height_m": 5}, "`fov_y_deg` and `orthographic_height_m`: a view has one"),
        ({"orthographic_height_m": 0}, "`orthographic_height_m` = 0: must be above 0"),
        ({"orthographic_height_m": -1}, "`orthographic_height_m` = -1: must be above 0"),
        ({"frames": []}, "at least one frame"),
        ({"frames": {"eye": 1}}, "`frames` = .*must be a list"),
        ({"frames": [7]}, r"`frames\[0\]` = 7"),
        ({"frames": [{"eye": [0, 0, 5], "up": [0, 1, 0]}]}, r"`frames\[0\].target` is missing"),
        ({"frames": [{"eye": [0, 0], "target": [0, 0, 0], "up": [0, 1, 0]}]}, r"`frames\[0\].eye`"),
        ({"frames": [{"eye": [0, 0, "x"], "target": [0, 0, 0], "up": [0, 1, 0]}]}, r"`frames\[0\].eye`"),
        ({"frames": [{"eye": [0, 0, 0], "target": [0, 0, 0], "up": [0, 1, 0]}]}, "frame 0: camera `target`"),
    ],
)
def test_a_wrong_camera_file_is_refused_in_one_line(tmp_path, change, message):
    (tmp_path / "c.json").write_text(json.dumps(RECORD | change))
    with pytest.raises(InputError, match=message) as caught:
        load_cameras(tmp_path / "c.json")
    assert str(caught.value).startswith(str(tmp_path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["width", "height", "fov_y_deg", "near", "frames"])
def test_a_missing_key_is_named(tmp_path, key):
    (tmp_path / "c.json").write_text(json.dumps({k: v for k, v in RECORD.items() if k != key}))
    with pytest.raises(InputError, match=f"`{key}`"):
        load_cameras(tmp_path / "c.json")


@pytest.mark.parametrize("text", ["", "{", "[1]", "\x80", "[" * 100_000, "nul", '{"width": 1e999}'])
def test_what_is_no_camera_file_is_refused(tmp_path, text):
    (tmp_path / "c.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"c\.json: "):
        load_cameras(tmp_path / "c.json")


def test_a_missing_camera_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_cameras(tmp_path / "none.json")


def test_default_cameras_stand_inside_and_see_the_scene():
    scene = build_scene("atrium", 2000)
    path = default_cameras(scene, Viewport(32, 18), seed=0)
    low, high = scene.bounds_m
    eye = np.array(path.poses[0].eye_m)
    assert len(path) == 60 and (eye > low).all() and (eye < high).all()
    assert path.near_m == pytest.approx(scene.diagonal_m / 1e4) and path.far_m == pytest.approx(2 * scene.diagonal_m)
    assert default_cameras(scene, Viewport(32, 18), seed=0) == path
