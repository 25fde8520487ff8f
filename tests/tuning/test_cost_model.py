import math
from dataclasses import replace

import pytest
from numpy.testing import assert_allclose

from tuning.cost_model import CostModel
from tuning.features import operations, with_derived

MODEL = CostModel(
    technique="volume_tiled_bvh",
    stage="frame",
    terms=("tests", "samples"),
    fixed_ms=2.0,
    ms_per_op=(1e-3, 1e-2),
    loo_error=0.04,
    constant_loo_error=0.5,
    dropped=(("cells_total", 0.05), ("shading_steps", math.inf)),
    n=12,
    n_configurations=4,
)


def test_a_prediction_is_the_sum_of_the_costs():
    frames = ({"tree_tests": 1000, "leaf_tests": 500, "samples": 100}, {"tree_tests": 0, "leaf_tests": 0, "samples": 0})
    assert_allclose(MODEL.predict(frames), [2.0 + 1.5 + 1.0, 2.0])
    assert replace(MODEL, terms=(), ms_per_op=()).predict(frames).tolist() == [2.0, 2.0]


def test_a_missing_count_is_no_zero():
    with pytest.raises(KeyError, match="tests"):
        MODEL.predict([{"samples": 3}])


def test_derived_counts():
    known = with_derived({"lights": 1024, "tree_tests": 5})
    assert known["lights_log_lights"] == 1024 * 10
    assert known["tests"] == 5
    assert with_derived({"lights": 0})["lights_log_lights"] == 0
    assert "tests" not in with_derived({"samples": 1})
    assert operations([{"samples": 2**53}], ["samples"])[0, 0] == 2**53


def test_the_interval_widens_with_the_error_and_with_fewer_configurations():
    # t(0.95, 3 degrees of freedom) = 2.3534, from a table
    assert_allclose(MODEL.factor, 1 + 2.3534 * 0.04 * math.sqrt(math.pi / 2), rtol=1e-4)
    assert MODEL.factor < replace(MODEL, n_configurations=2).factor
    assert MODEL.factor < replace(MODEL, loo_error=0.05).factor
    assert replace(MODEL, loo_error=math.inf).factor == math.inf


def test_the_json_form_names_every_term_and_has_no_infinity():
    assert MODEL.as_json() == {
        "technique": "volume_tiled_bvh",
        "stage": "frame",
        "terms": ["tests", "samples"],
        "dropped": [{"term": "cells_total", "loo_error": 0.05}, {"term": "shading_steps", "loo_error": None}],
        "coefficients": {"fixed_ms": 2.0, "tests": 1e-3, "samples": 1e-2},
        "loo_error": 0.04,
        "constant_loo_error": 0.5,
        "interval_factor": MODEL.factor,
        "n": 12,
    }
    assert replace(MODEL, loo_error=math.inf).as_json()["interval_factor"] is None
