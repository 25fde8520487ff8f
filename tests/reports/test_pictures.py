import base64

import numpy as np
import pytest

from reports.pictures import HEAT_COLOURS, heat_scale, read_pictures
from tests.reports.synthetic_run import complete_run
from vtfs.image import heat_map
from vtfs.input_error import InputError


@pytest.fixture
def files():
    return complete_run()


@pytest.fixture
def pictures(files, tmp_path):
    return read_pictures(files.write(tmp_path) / "pictures", files.result["pictures"][::-1])


def test_a_picture_is_the_file_itself_with_its_size(files, pictures):
    frame = pictures[0]  # first, although it was listed last
    assert (frame.kind, frame.width_px, frame.height_px) == ("frame", 320, 180)
    assert base64.b64decode(frame.uri.removeprefix("data:image/png;base64,")) == files.pictures["frame.png"]


def test_a_heat_map_is_described_in_words(pictures):
    assert pictures[1].alternative.startswith(
        "Heat map of lighting computations per pixel with volume_tiled_bvh: mean "
    )


def test_cells_come_last_and_say_what_they_show(pictures):
    assert [picture.kind for picture in pictures][-3:] == ["false_positives", "slices", "clusters"]  # as listed
    assert pictures[-1].alternative == "The cells that samples lie in. Of clusters."


def test_one_scale_reaches_from_zero_to_the_most_of_all_maps(files, pictures):
    scale = heat_scale(pictures, {})
    assert scale is not None
    most = max(item.get("max_count", 0) for item in files.result["pictures"])
    assert scale.ticks[0] == (0, 0)
    assert scale.ticks[-1] == (100, most)
    assert [count for _, count in scale.ticks] == sorted({count for _, count in scale.ticks})


@pytest.mark.parametrize("top", [1, 2, 7, 10, 143, 1000, 12_345])
def test_ticks_stand_where_their_count_is(pictures, top):
    linear, log = heat_scale(pictures, {"max_count": top}), heat_scale(pictures, {"max_count": top, "scale": "log"})
    assert linear is not None
    assert log is not None
    assert all(place == pytest.approx(100 * count / top) for place, count in linear.ticks)
    assert len(linear.ticks) <= 7
    assert log.is_log
    assert log.ticks[-1][0] == pytest.approx(100)


def test_the_run_may_bring_its_own_colours(pictures):
    scale = heat_scale(pictures, {"colours": ["#000000", "#ffffff"]})
    assert scale is not None
    assert scale.gradient == "linear-gradient(to right, #000000, #ffffff)"
    with pytest.raises(InputError, match="must be `#rrggbb`"):
        heat_scale(pictures, {"colours": ["red; } body { display: none"]})


def test_the_legend_has_the_colours_of_the_maps():
    counts = np.arange(len(HEAT_COLOURS), dtype=np.int64)[None, :]
    drawn = heat_map(counts, len(HEAT_COLOURS) - 1, np.ones(counts.shape, bool))[0]
    assert ["#" + bytes(pixel).hex() for pixel in drawn] == list(HEAT_COLOURS)


def test_without_heat_maps_there_is_no_scale(pictures):
    assert heat_scale(pictures[:1], {"max_count": 5}) is None


@pytest.mark.parametrize("name", ["../result.json", "/etc/hostname", "a/b.png", None])
def test_a_picture_outside_the_folder_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="it must be a file in"):
        read_pictures(tmp_path, [{"file": name}])


@pytest.mark.parametrize("data", [b"", b"GIF89a" + bytes(60), complete_run().pictures["frame.png"][:-20]])
def test_what_is_not_a_whole_png_is_refused(tmp_path, data):
    (tmp_path / "frame.png").write_bytes(data)
    with pytest.raises(InputError, match=r"frame\.png: not a PNG, or cut short"):
        read_pictures(tmp_path, [{"file": "frame.png"}])


def test_a_missing_picture_is_named(tmp_path):
    with pytest.raises(InputError, match=r"frame\.png: cannot be read"):
        read_pictures(tmp_path, [{"file": "frame.png"}])
