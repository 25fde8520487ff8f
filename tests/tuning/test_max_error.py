"""What a search may recommend: exact settings, or those within a permitted error."""

import pytest

from tests.tuning.synthetic_workload import SHADING_BOUND, SMALL, Synthetic, of
from tuning.budget import Budget
from tuning.space import Space
from tuning.sweep import search
from vtfs.configurations import configuration
from vtfs.input_error import InputError


def test_without_a_permitted_error_only_exact_settings_are_best(tmp_path):
    workload = Synthetic(SHADING_BOUND)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=30))
    assert of(result.best).is_exact
    fastest, *_, most_exact = result.pareto
    assert most_exact == result.best
    assert min(fastest.stages_ms["frame"][0]) < min(result.best.stages_ms["frame"][0])


@pytest.mark.parametrize(("max_error", "expected"), [(0.2, 0.1), (0.05, 0.01), (1e-3, 0.0)])
def test_a_permitted_error_is_used_and_kept(tmp_path, max_error, expected):
    # A cut-off of 0.1 saves 30 %, half precision 20 % and a cut-off of 0.01 3 %; they are not combined.
    workload = Synthetic(SHADING_BOUND, noise=0.001)
    result = search(SMALL, workload, tmp_path / "measurements.jsonl", Budget(measurements=40), max_error=max_error)
    assert result.best.error == pytest.approx(expected, abs=0.0011)
    assert (result.best.params["gbuffer"] == "float32") == (expected != 0.01)
    assert result.best.params["light_cutoff"] == (0.1 if expected == 0.1 else 0.0)
    assert result.best.error is not None
    assert result.best.error <= max_error


def test_an_error_that_nothing_keeps_is_refused_with_the_smallest_there_is(tmp_path):
    with pytest.raises(InputError, match=r"max-error 1e-09: .*the smallest error is 1e-07"):
        search(SMALL, Synthetic({}), tmp_path / "measurements.jsonl", Budget(measurements=8), max_error=1e-9)


def test_a_default_outside_the_space_is_measured_and_not_recommended(tmp_path):
    space = Space(("tiled_deferred",), {"tiled_deferred": {"tile_px": (128, 256)}})
    workload = Synthetic(SHADING_BOUND)
    result = search(space, workload, tmp_path / "measurements.jsonl", Budget(measurements=8))
    assert workload.measured[0] == configuration("tiled_deferred")
    assert result.default is not None
    assert result.best.params["tile_px"] == 128


def test_a_space_without_exact_settings_needs_a_permitted_error(tmp_path):
    space = Space(("tiled_deferred",), {"tiled_deferred": {"gbuffer": ("float16",)}})
    path = tmp_path / "measurements.jsonl"
    with pytest.raises(InputError, match="max-error is missing"):
        search(space, Synthetic({}), path, Budget(measurements=8))
    result = search(space, Synthetic({}), path, Budget(measurements=8), max_error=0.05)
    assert result.best.params["gbuffer"] == "float16"
