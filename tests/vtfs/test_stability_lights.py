"""The stress ladders of light tests."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from tests import oracles
from vtfs.stability.light_ladders import light_ladders
from vtfs.stability.light_methods import LIGHT_METHODS, N_LIGHTS, judge_lights

LADDERS = {ladder.name: ladder for ladder in light_ladders(0)}
TIGHT = tuple(method for method in LIGHT_METHODS if "explicit" in method.name)  # one pair of programs


@functools.cache
def case_of(ladder: str, label: str):
    return next(rung for rung in LADDERS[ladder].rungs if rung.label == label).make()


@pytest.mark.parametrize(
    ("ladder", "label", "fails"),
    [("crowd", "33", "at most 32"), ("offset", "1e6", "float32"), ("crowd", "32", None), ("offset", "0", None)],
)
def test_each_light_test_misses_where_it_must_and_nowhere_else(ladder, label, fails):
    found = judge_lights(case_of(ladder, label), TIGHT)
    for name, verdict in found.verdicts.items():
        assert (verdict.missed > 0) == (fails is not None and fails in name), (name, verdict)
        assert verdict.listed >= verdict.proven > 0 and not verdict.refused


def test_pairs_that_must_be_listed_are_those_of_the_slow_loop():
    case = case_of("offset", "1e3")
    expected = oracles.windows(case.samples, case.lights) > 0
    assert judge_lights(case, ()).reaching == expected.sum() > 1000


def test_a_light_test_that_uses_half_the_range_is_caught(monkeypatch):
    case = case_of("offset", "0")
    halved = replace(case.lights, range_m=case.lights.range_m / 2)
    monkeypatch.setattr("vtfs.stability.light_methods._moved_in_float32", lambda case: halved)
    found = judge_lights(case, TIGHT[1:2])
    assert next(iter(found.verdicts.values())).missed > 100


@pytest.mark.parametrize("name", LADDERS)
def test_every_ladder_has_lights_that_reach_and_some_that_do_not(name):
    for rung in (LADDERS[name].rungs[0], LADDERS[name].rungs[-1]):
        case = rung.make()
        reaching = judge_lights(case, ()).reaching
        assert case.lights.n_lights == N_LIGHTS and 0 < reaching <= case.samples.n_valid * N_LIGHTS
        assert np.isfinite(case.lights.position_m).all()
