"""Tone mapping, heat maps and PNG files."""

import errno
import io
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from vtfs.image import exposure, heat_map, tone_map, write_png
from vtfs.input_error import InputError

some = settings(max_examples=40, deadline=None)
VALID = np.ones((4, 8), bool)


@given(a=st.floats(0, 2.0**100, width=32), b=st.floats(0, 2.0**100, width=32), scale=st.floats(1e-3, 1e3))
@some
def test_a_brighter_grey_is_never_darker(a, b, scale):
    pixels = tone_map(np.array([[[min(a, b)] * 3, [max(a, b)] * 3]], np.float32), scale)
    assert pixels.dtype == np.uint8 and (pixels[0, 0] <= pixels[0, 1]).all()
    assert np.ptp(pixels.astype(int), axis=2).max() <= 1  # grey stays grey


def test_black_is_black_the_exposed_level_is_middle_and_four_times_it_is_white():
    pixels = tone_map(np.array([[[0, 0, 0], [1, 1, 1], [4, 4, 4], [1e9, 1e9, 1e9]]], np.float32), 1.0)
    srgb = round(255 * (1.055 * (1 * (1 + 1 / 16) / 2) ** (1 / 2.4) - 0.055))  # Reinhard et al. 2002, Eq. 4
    assert pixels[0, :, 0].tolist() == [0, srgb, 255, 255]


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, -1.0, 3e38])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_numbers_that_are_none_make_pixels_all_the_same(odd, scale):
    image = np.full((4, 8, 3), 0.5, np.float32)
    image[0, 0, 1] = odd
    pixels = tone_map(image, scale)
    assert (pixels[1:] == tone_map(np.full((4, 8, 3), 0.5, np.float32), scale)[1:]).all()
    assert pixels.shape == (4, 8, 3) and pixels.dtype == np.uint8


@given(level=st.floats(1e-3, 1e6))
@some
def test_exposure_brings_a_bright_pixel_to_one(level):
    image = np.full((4, 8, 3), level, np.float32)
    image[0, 0] = 1e9  # a single highlight does not darken the rest
    assert exposure(image, VALID) * level == pytest.approx(1, rel=1e-5)


def test_exposure_of_nothing_and_of_black_is_one():
    assert exposure(np.zeros((4, 8, 3)), VALID) == 1
    assert exposure(np.ones((4, 8, 3)), ~VALID) == 1


@given(counts=st.lists(st.integers(0, 2**40), min_size=32, max_size=32))
@some
def test_more_is_brighter_in_a_heat_map(counts):
    values = np.sort(counts).reshape(4, 8)
    pixels = heat_map(values, int(values.max()), VALID).reshape(-1, 3)
    luminance = pixels @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) >= -1).all()  # bytes are rounded
    assert pixels[-1].tolist() == ([253, 231, 37] if values.max() else [68, 1, 84])


def test_a_heat_map_ends_at_its_largest_and_invalid_pixels_are_black():
    values = np.array([[0, 10, 99]])
    pixels = heat_map(values, 10, np.array([[True, True, True]]))
    assert pixels[0].tolist() == [[68, 1, 84], [253, 231, 37], [253, 231, 37]]
    assert (heat_map(values, 0, np.zeros((1, 3), bool)) == 0).all()


def test_a_heat_map_takes_no_count_for_what_it_is():
    values = np.array([[1.0, np.nan]])
    pixels = heat_map(values, 2, np.array([[True, False]]))
    assert pixels[0, 0].any() and not pixels[0, 1].any()


def test_a_png_is_read_back_and_a_full_disk_keeps_the_old_one(tmp_path, monkeypatch):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    path = tmp_path / "a.png"
    write_png(path, pixels)
    before = path.read_bytes()
    assert (np.asarray(Image.open(io.BytesIO(before))) == pixels).all()

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left on device"):
        write_png(path, 255 - pixels)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.png"]
