import pytest

from reports.recommendation import comparison, recommend, setting_text
from reports.run_folder import read_run_folder
from tests.reports.synthetic_run import complete_run, run_inside_the_noise, run_of_one, run_without_times


def read(files, tmp_path):
    return read_run_folder(files.write(tmp_path))


def test_a_clear_gain_is_recommended(tmp_path):
    run = read(complete_run(), tmp_path)
    found = recommend(run)
    assert (found.verdict, found.chosen) == ("tuned", run.best)
    assert [setting.name for setting in found.changed] == ["depth_slices", "branching"]
    assert [over for _, over in found.gains] == ["its own defaults", "the fastest default, that of tiled_deferred"]
    assert found.failures == (("out of memory", 1), ("failed", 1))
    assert not found.has_error


def test_the_bars_mark_what_is_recommended(tmp_path):
    bars = comparison(read(complete_run(), tmp_path))
    assert [(bar.label, bar.is_chosen) for bar in bars] == [
        ("default", False),
        ("fastest default", False),
        ("best found", True),
    ]
    assert max(bar.share for bar in bars) == 100


def test_a_gain_inside_the_noise_keeps_the_default(tmp_path):
    run = read(run_inside_the_noise(), tmp_path)
    found = recommend(run)
    assert (found.verdict, found.chosen) == ("keep_default", run.fastest_default)
    assert found.changed == ()
    assert [bar.is_chosen for bar in comparison(run)] == [True, False]


def test_a_gain_over_its_own_default_alone_keeps_the_fastest_default(tmp_path):
    files = complete_run()
    files.result["gain"] |= {"over_fastest_default": 1.01, "over_fastest_default_interval": [0.97, 1.05]}
    found = recommend(read(files, tmp_path))
    assert found.verdict == "keep_default"
    assert found.chosen is not None
    assert found.chosen.technique == "tiled_deferred"
    assert found.gains[0][0].inside_noise
    assert not found.gains[1][0].inside_noise


def test_one_measurement_keeps_the_default(tmp_path):
    run = read(run_of_one(), tmp_path)
    assert recommend(run).verdict == "keep_default"
    assert len(comparison(run)) == 1


def test_without_times_there_is_no_recommendation(tmp_path):
    run = read(run_without_times(), tmp_path)
    found = recommend(run)
    assert (found.verdict, found.chosen, found.settings) == ("none", None, ())
    assert found.failures == (("out of memory", 24),)
    assert comparison(run) == ()


def test_an_image_that_differs_is_said(tmp_path):
    files = complete_run()
    files.result["best"]["error"] = 3e-4
    assert recommend(read(files, tmp_path)).has_error


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"tile_px": 32, "light_cutoff": 0.0}, "tiled_deferred, defaults"),
        ({"tile_px": 16, "light_cutoff": 0.02}, "tiled_deferred tile_px=16 light_cutoff=0.02"),
        ({"tile_px": 32, "a_new_one": 5}, "tiled_deferred, defaults"),
    ],
)
def test_a_configuration_in_one_line(params, text):
    assert setting_text("tiled_deferred", params) == text
