"""View samples against rays tested with every triangle in float64, and the cache."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from vtfs.camera import Camera, Lens, Viewport, load_cameras
from vtfs.gallery import build_scene
from vtfs.scene import Material, Scene, load_scene
from vtfs.tracer import Tracer, bilinear
from vtfs.view_samples import trace_view_samples

SHARED = Path(__file__).parents[2].parent / "shared" / "scenes"


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VTFS_CACHE_DIR", str(tmp_path / "cache"))


def frame(scene: Scene, width_px: int, height_px: int, i: int) -> Camera:
    assert scene.cameras is not None
    return scene.cameras.resized(Viewport(width_px, height_px)).camera(i)


def brute_force_hits(scene, camera):
    """Depth and triangle of the nearest surface of each pixel by Moeller-Trumbore, alpha tests by a plain loop."""
    v0, v1, v2 = (scene.vertices_m[scene.triangles[:, k]] for k in range(3))
    e1, e2 = v1 - v0, v2 - v0
    height, width = camera.viewport.height_px, camera.viewport.width_px
    depth, seen = np.full((height, width), np.inf), np.full((height, width), -1)
    origins, directions = camera.primary_rays()
    for row in range(height):
        for column in range(width):
            d = directions[row, column]
            to_start = origins[row, column] - v0
            p, q = np.cross(d, e2), np.cross(to_start, e1)
            with np.errstate(all="ignore"):
                inverse = 1 / (e1 * p).sum(1)
                u, v, t = (to_start * p).sum(1) * inverse, q @ d * inverse, (e2 * q).sum(1) * inverse
                hits = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > camera.near_m))
            for k in hits[np.argsort(t[hits])]:
                material = scene.materials[scene.material_index[k]]
                if material.alpha_mode == "blend":
                    continue
                if material.alpha_mode == "mask":
                    uv = scene.uv[scene.triangles[k]].astype(np.float64)
                    at = (1 - u[k] - v[k]) * uv[0] + u[k] * uv[1] + v[k] * uv[2]
                    if oracle_texel(material.alpha_image, *at) < material.alpha_cutoff:
                        continue
                depth[row, column], seen[row, column] = t[k], k
                break
    return depth, seen


def oracle_texel(image, u, v):
    height, width = image.shape
    x, y = u * width - 0.5, v * height - 0.5
    i, j = math.floor(x), math.floor(y)
    return sum(
        image[(j + b) % height, (i + a) % width] * abs(1 - a - (x - i)) * abs(1 - b - (y - j))
        for a in (0, 1)
        for b in (0, 1)
    )


@pytest.mark.parametrize(
    ("name", "lens"),
    [
        *((name, Lens()) for name in ("atrium", "street", "grove", "conservatory")),
        ("grove", Lens(orthographic_height_m=9.0)),
    ],
    ids=["atrium", "street", "grove", "conservatory", "parallel"],
)
def test_samples_are_where_rays_meet_all_triangles_in_float64(name, lens):
    scene = build_scene(name, 1_500)
    camera = replace(frame(scene, 40, 22, 7), lens=lens)
    samples = trace_view_samples(scene, camera)
    depth, seen = brute_force_hits(scene, camera)
    same = samples.triangle == seen
    # Rays along an edge may take either side of it; all others agree.
    assert same.mean() > 0.995
    found = same & samples.valid
    assert found.any()
    assert_allclose(-samples.position_m[found][:, 2], depth[found], rtol=1e-6)  # the cast to float32
    # Everything lies on the ray of its pixel, whatever triangle it is on.
    x, y = camera.pixel_slopes()
    lies = samples.valid
    width = np.ones_like(samples.specular) if camera.is_orthographic else -samples.position_m[..., 2]
    assert_allclose(samples.position_m[..., 0][lies], (x * width)[lies], rtol=1e-6, atol=1e-7)
    assert_allclose(samples.position_m[..., 1][lies], (y[:, None] * width)[lies], rtol=1e-6, atol=1e-7)
    assert_allclose(np.linalg.norm(samples.normal[lies], axis=-1), 1, rtol=1e-6)
    ray = np.array([0.0, 0.0, -1.0]) if camera.is_orthographic else samples.position_m
    assert ((samples.normal * ray).sum(-1)[lies] <= 1e-6).all()  # facing the eye
    colour = np.array([scene.materials[m].base_colour for m in scene.material_index[samples.triangle[lies]]])
    assert_allclose(samples.base_colour[lies], colour, rtol=1e-6)
    assert (samples.position_m[samples.triangle < 0] == 0).all() and not samples.valid[samples.triangle < 0].any()


def square(depth_m, material, half=10.0):
    """A square across the view, two triangles, at `z = -depth_m`."""
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    vertices = np.column_stack([corners, np.full(4, -depth_m)])
    uv = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32)
    return vertices, np.array([(0, 1, 2), (0, 2, 3)]), uv, material


def stacked(*squares):
    materials = tuple(s[3] for s in squares)
    return Scene(
        "squares",
        np.concatenate([s[0] for s in squares]),
        np.concatenate([s[1] + 4 * i for i, s in enumerate(squares)]),
        np.concatenate([s[2] for s in squares]),
        np.repeat(np.arange(len(squares)), 2),
        materials,
    )


FRONT = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 60.0, 0.1, 50.0, Viewport(16, 16))
SOLID = Material("solid", (0.1, 0.2, 0.3))
HALF = Material(
    "half",
    alpha_mode="mask",
    alpha_image=np.repeat([[0.0], [1.0]], [8, 8], axis=0).astype(np.float32) * np.ones(16, np.float32),
)
BLEND = Material("blend", opacity=0.5, alpha_mode="blend")


def test_a_ray_steps_through_what_the_alpha_test_drops():
    samples = trace_view_samples(stacked(square(2, HALF, 2.0), square(5, SOLID)), FRONT)
    # The image's first row is at v = 0, which the square has at its top.
    assert_allclose(-samples.position_m[:7, :, 2], 5)
    assert_allclose(-samples.position_m[9:, :, 2], 2)


def test_a_hundred_dropped_layers_a_millimetre_apart_are_passed():
    clear = replace(HALF, alpha_image=np.zeros((2, 2), np.float32))
    layers = [square(1 + 0.001 * i, clear) for i in range(100)]
    samples = trace_view_samples(stacked(*layers, square(5, SOLID)), FRONT)
    assert_allclose(-samples.position_m[..., 2], 5)


def test_coincident_layers_are_all_tested():
    clear = replace(HALF, alpha_image=np.zeros((2, 2), np.float32))
    samples = trace_view_samples(stacked(square(3, clear), square(3, clear), square(4, SOLID)), FRONT)
    assert_allclose(-samples.position_m[..., 2], 4)


def test_a_mask_without_an_image_is_all_or_nothing():
    for opacity, depth_m in ((0.4, 4), (0.6, 3)):
        mask = Material("mask", opacity=opacity, alpha_mode="mask")
        samples = trace_view_samples(stacked(square(3, mask), square(4, SOLID)), FRONT)
        assert_allclose(-samples.position_m[..., 2], depth_m)


def test_blended_surfaces_are_not_in_the_opaque_layer():
    samples = trace_view_samples(stacked(square(2, BLEND), square(5, SOLID)), FRONT)
    assert_allclose(-samples.position_m[..., 2], 5)
    assert not trace_view_samples(stacked(square(2, BLEND)), FRONT).valid.any()


def test_near_clips_and_far_is_the_end():
    scene = stacked(square(0.05, SOLID), square(5, SOLID), square(60, SOLID, 1000.0))
    assert_allclose(-trace_view_samples(scene, FRONT).position_m[..., 2], 5)  # what is before near is not there
    assert not trace_view_samples(scene, replace(FRONT, far_m=4.0)).valid.any()  # what is beyond far hides nothing
    assert trace_view_samples(stacked(square(60, SOLID, 1e3)), replace(FRONT, far_m=math.inf)).valid.all()


def test_positions_are_exact_far_from_the_origin():
    # 100 km from the origin float32 has steps of 8 mm; relative to the scene's centre nothing is lost.
    offset = np.array([1e5, 2e5, -1e5])
    scene = stacked(square(5, SOLID, 20.0))
    moved = replace(scene, vertices_m=scene.vertices_m + offset)
    camera = replace(FRONT, eye_m=tuple(offset), target_m=tuple(offset - (0, 0, 1)))
    assert_allclose(-trace_view_samples(moved, camera).position_m[..., 2], 5, rtol=1e-6)


def testbilinear_is_the_plain_sum_of_four_texels():
    rng = np.random.default_rng(0)
    image = rng.random((5, 3)).astype(np.float32)
    u, v = rng.uniform(-3, 3, (2, 100))
    expected = [oracle_texel(image, *at) for at in zip(u, v, strict=True)]
    assert_allclose(bilinear(image, u, v), expected, atol=1e-6)


def test_the_cache_gives_the_same_samples_and_no_second_tracing(monkeypatch):
    scene = build_scene("grove", 1_500)
    camera = frame(scene, 64, 36, 0)
    first = trace_view_samples(scene, camera)
    monkeypatch.setattr(Tracer, "__init__", lambda *_: pytest.fail("traced again"))
    assert trace_view_samples(scene, camera).key == first.key


@pytest.mark.parametrize(
    "damage", [lambda b: b[:100], lambda b: b[:200] + b"\x01" + b[201:], lambda b: b"", lambda b: b * 2]
)
def test_a_damaged_cache_is_replaced(tmp_path, damage):
    scene = build_scene("atrium", 1_500)
    camera = frame(scene, 64, 36, 0)
    first = trace_view_samples(scene, camera)
    (file,) = (tmp_path / "cache" / "view_samples").iterdir()
    good = file.read_bytes()
    file.write_bytes(damage(good))
    assert trace_view_samples(scene, camera).key == first.key
    assert file.read_bytes() == good


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("VTFS_CACHE_DIR", str(tmp_path / "file"))
    assert trace_view_samples(stacked(square(5, SOLID)), FRONT).valid.all()


@pytest.mark.shared
@pytest.mark.parametrize("scene_file", sorted(SHARED.glob("*.glb")), ids=lambda p: p.stem)
def test_real_scenes_are_seen_from_their_cameras(scene_file):
    scene = load_scene(scene_file)
    camera = load_cameras(scene_file.with_suffix(".cameras.json")).resized(Viewport(320, 180)).camera(0)
    samples = trace_view_samples(scene, camera)
    assert samples.valid.mean() > 0.5
    assert np.isfinite(samples.position_m).all()
