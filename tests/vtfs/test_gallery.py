"""The built-in scenes: what was asked for, again and again the same, with a camera that keeps clear."""

from dataclasses import replace

import numpy as np
import pytest

from vtfs.camera import Viewport
from vtfs.gallery import GALLERY, build_scene
from vtfs.input_error import InputError
from vtfs.tracer import Tracer
from vtfs.view_samples import trace_view_samples


@pytest.mark.parametrize("name", GALLERY)
@pytest.mark.parametrize("wanted", [1_000, 3_500, 8_999, 9_000, 40_000, 250_000])
def test_a_scene_has_the_triangles_that_were_asked_for(name, wanted):
    assert abs(build_scene(name, wanted).n_triangles / wanted - 1) <= 0.15


@pytest.mark.parametrize("name", GALLERY)
def test_a_scene_is_made_of_what_it_promises(name):
    scene = build_scene(name)
    assert abs(scene.n_triangles / GALLERY[name].default_triangles - 1) <= 0.15
    assert scene.cameras is not None and len(scene.cameras) >= 60 and scene.cameras.viewport == Viewport(1280, 720)
    corners = scene.vertices_m[scene.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (area > 0).mean() > 0.95  # all but the poles of balls
    masked = [material.alpha_image is not None for material in scene.materials]
    assert any(masked) == (name in ("grove", "conservatory"))
    assert any(material.alpha_mode == "blend" for material in scene.materials) == (name == "conservatory")
    if name == "grove":
        assert np.array(masked)[scene.material_index].mean() > 0.6


@pytest.mark.parametrize("name", GALLERY)
def test_the_same_seed_gives_the_same_scene(name):
    assert build_scene(name, 2_000, seed=3).key == build_scene(name, 2_000, seed=3).key
    assert build_scene(name, 2_000, seed=3).key != build_scene(name, 2_000, seed=4).key


@pytest.mark.parametrize("name", GALLERY)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_camera_never_comes_near_a_surface(name, seed):
    scene = build_scene(name, 60_000, seed)
    assert scene.cameras is not None
    eyes = np.array([pose.eye_m for pose in scene.cameras.poses])
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance_m = Tracer(scene).hit_distances_m(np.repeat(eyes, 400, axis=0), np.tile(directions, (60, 1)))
    # Leaves may hang closer: a card is passed, not entered. What is solid stays away.
    assert distance_m.min() > (0.15 if name == "grove" else 0.4)
    step_m = np.linalg.norm(np.diff(eyes, axis=0, append=eyes[:1]), axis=1)
    assert step_m.max() < 5  # a path, closed, without jumps


@pytest.mark.parametrize(
    ("name", "n", "message"),
    [("castle", None, "`castle`: unknown"), ("grove", 999, "= 999"), ("grove", 1_000_001, "= 1000001")],
)
def test_what_is_not_there_is_refused(name, n, message):
    with pytest.raises(InputError, match=message):
        build_scene(name, n)


def test_the_conservatory_shows_blended_samples_along_its_whole_path():
    scene = build_scene("conservatory", 20_000)
    assert scene.cameras is not None
    tracer, shares, most = Tracer(scene), [], 0
    for frame in range(0, len(scene.cameras), 6):
        camera = replace(scene.cameras.camera(frame), viewport=Viewport(64, 36))
        layers = trace_view_samples(scene, camera, tracer).layers.transparent
        shares.append(np.mean(np.any([layer.samples.valid for layer in layers], axis=0)))
        most = max(most, len(layers))
    # From a third of the image where the eye looks along the hall to all of it before the screen.
    assert min(shares) > 0.25 and max(shares) > 0.85 and most >= 3
