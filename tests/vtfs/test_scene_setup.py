"""What the user names is what a command works on: scene, camera path, lights, frames."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vtfs.camera import Viewport, save_cameras
from vtfs.gallery import build_scene
from vtfs.gbuffer_files import save_gbuffer
from vtfs.input_error import InputError
from vtfs.lights import point_lights, save_lights
from vtfs.scene import Material, Scene, save_scene
from vtfs.scene_setup import DEFAULT_LIGHTS, SceneOptions, set_up

SIZE = Viewport(64, 36)
SMALL = SceneOptions("street", viewport=SIZE, lights="20", n_triangles=1000)
ONE_LIGHT = point_lights(np.zeros((1, 3)), np.ones(1), np.ones((1, 3)))


def with_frames(n):
    setup = set_up(SMALL)
    setup.cameras = replace(setup.cameras, poses=setup.cameras.poses[:n])
    return setup


def test_a_built_in_scene_brings_its_cameras_and_gets_a_thousand_lights():
    setup = set_up(replace(SMALL, lights=None))
    assert setup.name == "street" and setup.n_frames == 60 and setup.cameras.viewport == SIZE
    assert setup.n_triangles == pytest.approx(1000, rel=0.15)
    assert setup.lights.n_lights == DEFAULT_LIGHTS == 1000
    assert set_up(replace(SMALL, viewport=None)).cameras.viewport == Viewport(1280, 720)


def test_a_scene_s_own_lights_come_before_scattered_ones_and_given_ones_before_both(tmp_path):
    scene = replace(build_scene("street", 1000), lights=ONE_LIGHT)
    save_scene(scene, tmp_path / "s.glb")
    own = SceneOptions(str(tmp_path / "s.glb"), viewport=SIZE)
    assert set_up(own).lights.n_lights == 1
    assert set_up(replace(own, lights="3")).lights.n_lights == 3
    assert set_up(replace(own, lights="0")).lights.n_lights == 0
    save_lights(tmp_path / "l.csv", point_lights(np.zeros((2, 3)), np.ones(2), np.ones((2, 3))))
    assert set_up(replace(own, lights=str(tmp_path / "l.csv"))).lights.n_lights == 2


@pytest.mark.parametrize("n", [1, 2, 11, 12, 13, 60])
def test_at_most_twelve_frames_are_counted_evenly_from_the_first_to_the_last(n):
    frames = with_frames(n).counted_frames
    assert len(frames) == min(n, 12) and frames[0] == 0 and frames[-1] == n - 1
    steps = np.diff(frames)
    assert (steps >= 1).all() and (not len(steps) or steps.max() - steps.min() <= 1)


@pytest.mark.parametrize("frame", [-1, 60, 9999])
def test_a_frame_that_is_not_there_is_refused(frame):
    with pytest.raises(InputError, match=rf"frame {frame}: the camera path has frames 0 to 59"):
        set_up(SMALL).samples(frame)


def test_frames_are_asked_for_once_each_and_all_by_default():
    setup = with_frames(4)
    assert setup.chosen_frames(None) == (0, 1, 2, 3) and setup.chosen_frames([2, 0, 2]) == (2, 0)
    with pytest.raises(InputError, match="frame 4: the camera path has frames 0 to 3"):
        setup.chosen_frames([0, 4])


def test_a_size_in_triangles_is_of_a_built_in_scene(tmp_path):
    save_scene(build_scene("street", 1000), tmp_path / "s.glb")
    with pytest.raises(InputError, match=r"--triangles 2000: .*s\.glb has its own; .*: atrium, street"):
        set_up(SceneOptions(str(tmp_path / "s.glb"), n_triangles=2000))


def test_lights_reach_a_visible_sample_as_often_as_is_asked():
    """In the median over the visible samples of the counted frames, which are not the ones the range was found from:
    512 a frame are known to a few percent."""
    for asked in (5, 20):
        setup = set_up(replace(SMALL, lights="200", lights_per_sample=asked))
        reached = []
        for frame in setup.counted_frames:
            positions = setup.samples(frame).world_positions_m()
            gap = np.linalg.norm(positions[:, None] - setup.lights.position_m, axis=-1)
            reached.append((gap <= setup.lights.range_m).sum(axis=1))
        assert np.median(np.concatenate(reached)) == pytest.approx(asked, abs=1)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_flat_scene_is_lit_and_seen_from_the_side_of_the_eye(tmp_path, axis, side):
    """A square across an axis: in its own plane every light would be edge-on."""
    corners = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    vertices = np.insert(corners, axis, 7.0, axis=1)
    normal = np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0])[axis]
    triangles = np.array([[0, 1, 2], [0, 2, 3]])[:, :: int(side * np.sign(normal))]
    scene = Scene("flat", vertices, triangles, None, np.zeros(2, int), (Material(name="flat"),))
    save_scene(scene, tmp_path / "flat.glb")
    setup = set_up(SceneOptions(str(tmp_path / "flat.glb"), viewport=SIZE, lights="200"))
    assert max(setup.samples(frame).n_valid for frame in setup.counted_frames) > 100
    assert side * (setup.cameras.poses[0].eye_m[axis] - 7) > 0
    heights = side * (setup.lights.position_m[:, axis] - 7)
    assert heights.min() >= 0 and heights.mean() == pytest.approx(0.2, rel=0.2)  # of 0 to 0.4


def test_lights_are_the_same_for_the_same_seed_and_only_for_that():
    first, again, other = (set_up(replace(SMALL, seed=seed)).lights for seed in (0, 0, 1))
    assert first.key == again.key != other.key


def test_a_key_depends_on_scene_cameras_size_and_lights(tmp_path):
    cameras = build_scene("street", 1000).cameras
    assert cameras is not None
    save_cameras(tmp_path / "c.json", replace(cameras, poses=cameras.poses[:2]))
    changes = (
        {},
        {"scene": "grove"},
        {"n_triangles": 1200},
        {"cameras": tmp_path / "c.json"},
        {"viewport": Viewport(64, 37)},
        {"lights": "21"},
        {"seed": 1},
        {"lights_per_sample": 10},
        {"density": "fixed"},
    )
    keys = [set_up(replace(SMALL, **change)).key for change in changes]
    assert len(set(keys)) == len(keys)
    assert set_up(SMALL).key == keys[0]


def test_a_scene_without_cameras_gets_a_turn(tmp_path):
    save_scene(replace(build_scene("street", 1000), cameras=None), tmp_path / "s.glb")
    setup = set_up(SceneOptions(str(tmp_path / "s.glb"), viewport=SIZE, lights="5"))
    assert setup.n_frames == 60 and setup.cameras.viewport == SIZE
    assert len({pose.eye_m for pose in setup.cameras.poses}) == 1
    assert setup.samples(0).n_valid > 0


# View samples of the user's own renderer


@pytest.fixture
def own(tmp_path):
    """Two frames and their cameras."""
    setup = with_frames(2)
    (tmp_path / "gbuffers").mkdir()
    for frame in range(2):
        save_gbuffer(tmp_path / "gbuffers" / f"{frame}.npz", setup.samples(frame))
    save_cameras(tmp_path / "c.json", setup.cameras)
    return SceneOptions(str(tmp_path / "gbuffers"), cameras=tmp_path / "c.json", lights="20")


def test_own_samples_are_read_frame_by_frame(own):
    setup, traced = set_up(own), with_frames(2)
    assert setup.name == "gbuffers" and setup.n_frames == 2 and setup.n_triangles == 0
    for frame in range(2):
        assert np.array_equal(setup.samples(frame).valid, traced.samples(frame).valid)
        assert np.array_equal(setup.samples(frame).position_m, traced.samples(frame).position_m)
    single = set_up(replace(own, scene=str(own.scene) + "/1.npz"))
    assert single.name == "1" and single.n_frames == 1
    assert setup.lights.n_lights == 20 and set_up(replace(own, lights=None)).lights.n_lights == 1000


def test_own_samples_that_changed_have_another_key(own):
    own = replace(own, lights="0")
    before = set_up(own).key
    assert set_up(own).key == before
    Path(str(own.scene), "1.npz").write_bytes(Path(str(own.scene), "0.npz").read_bytes())
    assert set_up(own).key != before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": None}, "a G-buffer needs --cameras"),
        ({"viewport": Viewport(32, 18)}, "--size cannot change a G-buffer"),
        ({"scene": "none.npz"}, r"none\.npz: no such file"),
    ],
)
def test_own_samples_with_what_does_not_fit_are_refused(own, change, message):
    with pytest.raises(InputError, match=message):
        set_up(replace(own, **change))


def test_fewer_cameras_than_own_samples_are_refused(own):
    content = json.loads(Path(own.cameras).read_text())
    Path(own.cameras).write_text(json.dumps(content | {"frames": content["frames"][:1]}))
    with pytest.raises(InputError, match="has 1 frames for 2 G-buffers"):
        set_up(own)


def test_a_folder_without_samples_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"a folder without \.npz files"):
        set_up(SceneOptions(str(tmp_path)))


@pytest.mark.parametrize("lights", ["-5", "10000001", "1" * 30])
def test_a_number_of_lights_out_of_range_is_refused(lights):
    with pytest.raises(
        InputError, match=rf"lights {lights}: must be a lights\.csv, or a number of lights from 0 to 10,000,000"
    ):
        set_up(replace(SMALL, lights=lights))
