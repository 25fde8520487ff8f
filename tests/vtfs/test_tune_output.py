"""What `vtfs tune` prints: the recommendation of the report, in a few lines."""

import json

from reports.recommendation import recommend
from reports.run_folder import read_run_folder
from tests.reports.synthetic_run import complete_run, run_inside_the_noise, run_of_one
from vtfs.cli.tune import _recommendation


def printed(files, tmp_path):
    folder = files.write(tmp_path)
    result = json.loads((folder / "result.json").read_text())
    return result, _recommendation(result, recommend(read_run_folder(folder))).splitlines()


def test_a_clear_gain_is_said(tmp_path):
    result, lines = printed(complete_run(), tmp_path)
    assert lines[0].startswith(f"{result['best']['technique']} depth_slices=")
    assert "times as fast as its default (" in lines[1]
    assert "times as fast as the fastest default (" in lines[2]


def test_what_is_slower_in_turns_is_not_recommended(tmp_path):
    files = run_inside_the_noise()
    files.result["gain"] |= {"over_fastest_default": 0.93, "over_fastest_default_interval": [0.90, 0.95]}
    result, lines = printed(files, tmp_path)
    default = result["fastest_default"]
    assert lines[0].startswith(f"keep the default, {default['technique']}, defaults: {default['time_ms']:.1f} ms")
    assert lines[1].startswith(f"  fastest in the search: {result['best']['technique']} ")
    assert "  0.93 times as fast as the fastest default (0.90 to 0.95), measured in turns" in lines


def test_a_default_that_nothing_beats_is_no_gain_of_one(tmp_path):
    _, lines = printed(run_of_one(), tmp_path)
    assert lines[0].startswith("keep the default, ")
    assert lines[1] == "  nothing that was measured is faster"
    assert not any("times as fast" in line for line in lines)
