"""Our own record as a table."""

import numpy as np

from tests.tuning.measurements import a_measurement
from tuning.formats.measurements import read_measurements
from tuning.formats.registry import recognised
from tuning.measurement import Measurement
from tuning.record import append_measurement


def test_our_own_record_is_a_row_for_each_stage_and_frame(folder):
    path = folder / "measurements.jsonl"
    timed = Measurement(
        "tiled_deferred", {"tile_px": 16, "gbuffer": "float32"}, "scene", (3, 7), 0, "timed", 1.5,
        {"frame": ((5.0, 6.0), (4.0,)), "assign": ((1.0,),)}, ({"samples": 10}, {"samples": 20}), 0.0, 0.0,
        "CPU", {}, 0.1,
    )  # fmt: skip
    failed = Measurement("forward", {}, "scene", (3,), 0, "timeout", 1.0, {}, (), None, None, "CPU", {}, 0.1)
    append_measurement(path, timed)
    append_measurement(path, failed)
    assert recognised(path) == "measurements"
    table = read_measurements(path)
    assert table.repeats_ms == ((5.0, 6.0), (4.0,), (1.0,)) and table.n_untimed == 1
    assert table.labels["stage"] == ("frame", "frame", "assign") and table.labels["gbuffer"] == ("float32",) * 3
    assert table.columns["frame"].tolist() == [3, 7, 3] and table.columns["samples"].tolist() == [10, 20, 10]
    assert table.columns["tile_px"].tolist() == [16, 16, 16] and table.compile_ms == (1500.0,) * 3


def test_levels_that_a_tree_of_our_own_record_does_not_have_took_no_tests(folder):
    path = folder / "levels.jsonl"
    for technique, counts in (("ptsv", {"tests_0": 5, "tests_1": 7}), ("ptsv", {"tests_0": 6}), ("forward", {"n": 1})):
        append_measurement(path, a_measurement(technique, counts=(counts,), stages_ms={"frame": ((1.0,),)}))
    columns = read_measurements(path).columns
    assert columns["tests_1"].tolist()[:2] == [7, 0] and columns["tests_0"].tolist()[:2] == [5, 6]
    assert np.isnan(columns["tests_1"][2]) and np.isnan(columns["n"][:2]).all()  # another technique's
