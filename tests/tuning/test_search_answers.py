"""What the models of a search answer, on a search whose times follow a law."""

import json

import numpy as np
import pytest

from tests.tuning.synthetic_workload import SMALL, Synthetic
from tuning.answers import answer_lines
from tuning.budget import Budget
from tuning.search_answers import search_answers
from tuning.sweep import search

LAW = {"clusters_occupied": 3e-4, "lighting_computations": 2e-6}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    record = tmp_path_factory.mktemp("search") / "measurements.jsonl"
    return search(SMALL, Synthetic(LAW), record, Budget(measurements=9))


@pytest.fixture(scope="module")
def answered(found):
    return search_answers(found, "max")


def test_slopes_are_those_of_the_prediction(found, answered):
    assert answered["matters"]
    for one in answered["matters"]:
        model = found.models[one["labels"]["technique"]]["frame"]
        for term, slope in one["slopes"].items():
            # A central difference in logarithms; `tests` is a sum of two counts, hence not by way of these.
            prices = dict(zip(model.terms, model.ms_per_op, strict=True))
            total = model.fixed_ms + sum(prices[name] * one["at"][name] for name in prices)
            moved = prices[term] * one["at"][term]
            up, down = (total + moved * (factor - 1) for factor in (1.001, 1 / 1.001))
            assert slope == pytest.approx(np.log(up / down) / (2 * np.log(1.001)), abs=1e-5)


def test_the_best_is_the_fastest_that_is_known_or_predicted(found, answered):
    (best,) = answered["best"]
    least = min(p.predicted_ms if p.measured_ms is None else p.measured_ms for p in found.predictions)
    assert best["time_ms"] == least
    assert best["of"] == len(found.predictions)
    assert 0 <= best["expected_regret"] <= best["worst_regret"]


def test_the_measurement_that_moves_predictions_is_one_that_was_made(found, answered):
    assert answered["influential"]
    made = [m.params for m in found.measurements]
    for one in answered["influential"]:
        assert any(one["row"].items() <= params.items() for params in made)
        # All rows together move predictions by as much as they do themselves.
        assert 0 < one["slope"] <= 1 + 1e-9


def test_they_are_json_and_lines(answered):
    json.dumps(answered, allow_nan=False)
    lines = list(answer_lines(answered))
    assert "Predicted best:" in lines
    assert all("nan" not in line and "None" not in line for line in lines)
