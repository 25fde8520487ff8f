"""Configurations that fail, lose or have no time, in a search that goes on."""

import dataclasses
import math

import numpy as np
import pytest

from tests.tuning.synthetic_workload import SHADING_BOUND, SMALL, WHOLE, Synthetic, of
from tuning.budget import Budget
from tuning.choose import initial_design
from tuning.record import read_measurements
from tuning.sweep import search
from vtfs.configurations import configuration
from vtfs.input_error import InputError


def test_failed_configurations_are_recorded_and_neither_fitted_nor_retried(tmp_path):
    path = tmp_path / "measurements.jsonl"
    workload = Synthetic(SHADING_BOUND, fails=lambda c: c.params.get("tile_px", 32) in (8, 16))
    result = search(WHOLE, workload, path, Budget(measurements=40))
    assert len(workload.measured) == len(set(workload.measured))
    outcomes = [m.outcome for m in read_measurements(path)]
    assert {"timed", "out_of_memory"} == set(outcomes)
    assert result.best.outcome == "timed"
    fitted = [of(m) for m in result.measurements if m.outcome == "timed" and of(m) in WHOLE]
    n_fitted = sum(candidate.technique == "volume_tiled_bvh" for candidate in fitted)
    assert result.models["volume_tiled_bvh"]["frame"].n == 3 * n_fitted
    possible = [c for c in WHOLE.configurations() if c.params.get("tile_px", 32) not in (8, 16)]
    assert max(workload.true_ms(of(result.best))) <= 1.05 * min(max(workload.true_ms(c)) for c in possible)


def test_a_default_that_fails_does_not_end_the_search(tmp_path):
    workload = Synthetic(SHADING_BOUND, fails=lambda c: c == configuration(c.technique))
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=12))
    assert result.default is None
    assert result.fastest_default is None
    assert result.best.outcome == "timed"


def test_where_everything_fails_one_line_says_so(tmp_path):
    path = tmp_path / "measurements.jsonl"
    workload = Synthetic({}, fails=lambda _: True)
    # The whole design is tried, and nothing after it: there is no time to go by.
    design = list(initial_design(SMALL, workload.counts))
    message = rf"none of {len(design)} configurations .*out_of_memory: 9 GB needed.*smaller size"
    with pytest.raises(InputError, match=message):
        search(SMALL, workload, path, Budget(measurements=len(design) + 2))
    assert set(workload.measured) == set(design)
    assert len(read_measurements(path)) == len(design)


def test_a_configuration_that_lost_on_the_first_frame_is_not_timed_on_the_others_and_still_counts(tmp_path):
    class Impatient(Synthetic):
        def measure(self, configuration, best_ms, /):
            whole = super().measure(configuration, best_ms)
            first_ms = whole.stages_ms["frame"][0]
            if best_ms is None or min(first_ms) <= 1.2 * best_ms:
                return whole
            return dataclasses.replace(whole, stages_ms={"frame": (first_ms, (), ())})

    path = tmp_path / "measurements.jsonl"
    workload = Impatient(SHADING_BOUND)
    result = search(WHOLE, workload, path, Budget(measurements=30))
    lost = [m for m in read_measurements(path) if not m.stages_ms["frame"][1]]
    assert lost
    assert max(workload.true_ms(of(result.best))) <= 1.05 * workload.least_ms(WHOLE)
    assert result.best not in lost
    # Their first frame is fitted, and is their measured time in the chart of predictions.
    fitted = [m for m in result.measurements if m.technique == "volume_tiled_bvh" and of(m) in WHOLE]
    n_rows = sum(len(repeats) > 0 for m in fitted for repeats in m.stages_ms["frame"])
    assert result.models["volume_tiled_bvh"]["frame"].n == n_rows
    told = {p.configuration: p.measured_ms for p in result.predictions}
    shown = [m for m in lost if of(m) in told]
    assert shown
    assert all(told[of(m)] == np.median(m.stages_ms["frame"][0]) for m in shown)


@pytest.mark.parametrize("broken_ms", [math.nan, math.inf])
def test_a_time_that_is_no_number_is_never_best(tmp_path, broken_ms):
    class Broken(Synthetic):
        def measure(self, configuration, best_ms, /):
            sound = super().measure(configuration, best_ms)
            if configuration["tile_px"] != 16:
                return sound
            return dataclasses.replace(sound, stages_ms={"frame": ((broken_ms,), (1e-9,), (1e-9,))})

    result = search(SMALL, Broken(SHADING_BOUND), tmp_path / "measurements.jsonl", Budget(measurements=20))
    assert result.best.params["tile_px"] != 16
    assert all(m.params["tile_px"] != 16 for m in result.pareto)
