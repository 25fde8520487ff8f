"""The user's own G-buffer: what is written is read again, layers too, and what is wrong is refused by its key."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.strategies import a_camera, layered_samples, nearby_lights
from tests.vtfs.test_view_samples import FRONT, SOLID, frame, square, stacked
from vtfs.camera import Lens
from vtfs.frame_inputs import FrameInputs
from vtfs.gallery import build_scene
from vtfs.gbuffer_files import load_gbuffer, save_gbuffer
from vtfs.input_error import InputError
from vtfs.reference import forward_reference
from vtfs.view_samples import trace_view_samples


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VTFS_CACHE_DIR", str(tmp_path / "cache"))


@pytest.mark.parametrize("lens", [Lens(), Lens(0.2, 0.1), Lens(orthographic_height_m=9.0)], ids=str)
def test_a_gbuffer_survives_its_file(tmp_path, lens):
    scene = build_scene("street", 1_500)
    samples = trace_view_samples(scene, replace(frame(scene, 64, 36, 0), lens=lens))
    save_gbuffer(tmp_path / "g.npz", samples)
    again = load_gbuffer(tmp_path / "g.npz", samples.camera)
    assert again.valid.any()
    assert_array_equal(again.valid, samples.valid)
    assert_array_equal(again.triangle[samples.valid], samples.triangle[samples.valid])
    assert_allclose(again.position_m[samples.valid], samples.position_m[samples.valid], rtol=1e-6)
    assert_allclose(again.normal, samples.normal * samples.valid[..., None], atol=1e-6)


def gbuffer(**changes):
    shape = (16, 16)
    arrays = {
        "depth": np.full(shape, 5.0, np.float32),
        "normal": np.tile(np.array([0, 0, 1], np.float32), (*shape, 1)),
        "base_colour": np.full((*shape, 3), 0.5, np.float32),
    }
    return {key: value for key, value in (arrays | changes).items() if value is not None}


def test_depth_and_a_layer_axis_are_enough(tmp_path):
    np.savez(tmp_path / "g.npz", **{key: value[None] for key, value in gbuffer().items()})
    samples = load_gbuffer(tmp_path / "g.npz", FRONT)
    expected = trace_view_samples(stacked(square(5, SOLID)), FRONT)
    assert_allclose(samples.position_m, expected.position_m, rtol=1e-6)
    assert samples.valid.all() and (samples.shininess == 32).all()


def shifted():
    x, y = FRONT.pixel_slopes()
    position = np.stack(
        [np.broadcast_to(x * 5, (16, 16)), np.broadcast_to(y[:, None] * 5, (16, 16)), np.full((16, 16), -5.0)], -1
    )
    position[3, 4, 0] += 5 * (x[1] - x[0])
    return position


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normal": None}, "key `normal`: is missing"),
        ({"depth": None}, "key `position` or `depth`: is missing"),
        ({"depth": np.ones((8, 8))}, r"key `depth`: has shape \(8, 8\)"),
        ({"depth": np.ones((2, 16, 16))}, "key `depth`: has shape"),
        ({"depth": np.ones((16, 16), int)}, "key `depth`: has dtype int64; must be floats"),
        ({"valid": np.ones((16, 16))}, "key `valid`: has dtype float64; must be booleans"),
        ({"primitive": np.ones((16, 16))}, "key `primitive`: has dtype float64"),
        ({"normal": np.zeros((16, 16, 3))}, "key `normal` at row 0, column 0: has length 0"),
        ({"base_colour": np.full((16, 16, 3), -1.0)}, "key `base_colour` at row 0.*0 or more"),
        ({"specular": np.full((16, 16), np.nan)}, "key `specular` at row 0.*finite"),
        ({"position": shifted()}, "key `position` at row 3, column 4: projects 1 pixels"),
        ({"depth": np.array([{}] * 256).reshape(16, 16)}, "dtype object"),
    ],
)
def test_a_wrong_gbuffer_is_refused_by_key(tmp_path, changes, message):
    np.savez(tmp_path / "g.npz", **gbuffer(**changes))
    with pytest.raises(InputError, match=message) as caught:
        load_gbuffer(tmp_path / "g.npz", FRONT)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"no archive at all"])
def test_what_is_no_gbuffer_is_refused(tmp_path, content):
    (tmp_path / "g.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"is not an \.npz"):
        load_gbuffer(tmp_path / "g.npz", FRONT)
    with pytest.raises(InputError, match="no such file"):
        load_gbuffer(tmp_path / "none.npz", FRONT)


def test_damaged_gbuffers_are_refused_or_read(tmp_path):
    np.savez(tmp_path / "g.npz", **gbuffer())
    good = (tmp_path / "g.npz").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(150):
        bad = bytearray(good)
        bad[rng.integers(len(bad))] ^= 1 << rng.integers(8)
        (tmp_path / "b.npz").write_bytes(bad[: rng.integers(1, len(bad) + 1)] if rng.random() < 0.5 else bad)
        try:
            load_gbuffer(tmp_path / "b.npz", FRONT)
        except InputError as error:
            assert "\n" not in str(error)


# --- transparent layers ---------------------------------------------------------------------------------------------


def test_layers_survive_their_file_and_make_the_same_image(tmp_path):
    samples = layered_samples(a_camera(), 3)
    save_gbuffer(tmp_path / "g.npz", samples)
    again = load_gbuffer(tmp_path / "g.npz", samples.camera)
    assert len(again.layers.transparent) == len(samples.layers.transparent) == 3
    for layer, expected in zip(again.layers.transparent, samples.layers.transparent, strict=True):
        assert_array_equal(layer.samples.valid, expected.samples.valid)
        assert_array_equal(layer.opacity, expected.opacity)
        assert_allclose(layer.samples.position_m, expected.samples.position_m, rtol=1e-6)
    lights = nearby_lights(samples, 7, 3)
    assert_allclose(forward_reference(again, lights), forward_reference(samples, lights), rtol=1e-5, atol=1e-7)
    assert FrameInputs(again, lights).has_transparent and again.layers.hidden == ()


def layered(n_layers=2, **changes):
    shape = (n_layers, 16, 16)
    arrays = {
        "transparent_depth": np.linspace(2, 4, n_layers, dtype=np.float32)[:, None, None] * np.ones(shape, np.float32),
        "transparent_normal": np.tile(np.array([0, 0, 1], np.float32), (*shape, 1)),
        "transparent_base_colour": np.full((*shape, 3), 0.5, np.float32),
        "transparent_opacity": np.full(shape, 0.25, np.float32),
    }
    return gbuffer(**(arrays | changes))


@pytest.mark.parametrize("n_layers", [1, 3])
def test_depth_normal_colour_and_opacity_make_a_layer(tmp_path, n_layers):
    np.savez(tmp_path / "g.npz", **layered(n_layers))
    layers = load_gbuffer(tmp_path / "g.npz", FRONT).layers.transparent
    assert len(layers) == n_layers
    assert all((layer.opacity == 0.25).all() and (layer.samples.specular == 0.04).all() for layer in layers)
    assert layers[0].samples.position_m[8, 8, 2] == -2


def at(value, changed, layer=1):
    """Two layers of a value, one pixel of one of them changed."""
    array = np.full((2, 16, 16), value, np.float32)
    array[layer, 3, 4] = changed
    return array


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transparent_opacity": None}, "key `transparent_opacity`: is missing"),
        ({"transparent_normal": None}, "layer 0: key `transparent_normal`: is missing; the file has transparent_depth"),
        ({"transparent_depth": None}, "layer 0: key `transparent_position` or `transparent_depth`: is missing"),
        (
            {"transparent_opacity": np.ones((16, 16))},
            r"`transparent_opacity`: has shape \(16, 16\); must be 1 to 64",
        ),
        ({"transparent_opacity": np.ones((65, 16, 16))}, "1 to 64 layers"),
        (
            {"transparent_depth": np.ones((1, 16, 16))},
            "`transparent_depth`: has 1 layers; `transparent_opacity` has 2",
        ),
        ({"transparent_valid": np.ones((2, 16, 16))}, "key `transparent_valid`: has dtype float64; must be booleans"),
        (
            {"transparent_opacity": at(0.5, 1.5)},
            "1: key `transparent_opacity` at row 3, column 4 = 1.5: must be 0 to",
        ),
        ({"transparent_opacity": at(0.5, np.nan)}, "layer 1: key `transparent_opacity` at row 3, column 4 = nan"),
        ({"transparent_depth": at(3, 6)}, "layer 1: key `transparent_depth` at row 3, column 4 = 6.0: must be before"),
        ({"transparent_depth": at(3, 2)}, "layer 1: key `transparent_depth` at row 3, column 4 = 2.0: must be nearest"),
        ({"transparent_specular": at(0.1, -1, 0)}, "layer 0: key `transparent_specular` at row 3, column 4 = -1.0"),
    ],
)
def test_a_wrong_layer_is_refused_by_number_and_key(tmp_path, changes, message):
    np.savez(tmp_path / "g.npz", **layered(**changes))
    with pytest.raises(InputError, match=message) as caught:
        load_gbuffer(tmp_path / "g.npz", FRONT)
    assert "\n" not in str(caught.value)
