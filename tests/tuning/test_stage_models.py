import math
import time
import warnings

import numpy as np
import pytest
import scipy.optimize

from tests.tuning.measurements import a_measurement
from tuning.features import STAGE_TERMS
from tuning.measurement import Measurement, Outcome
from tuning.stage_models import fit_models, fit_stage


def measurement(
    counts, frames_ms, outcome: Outcome = "timed", stage="frame", technique="tiled_deferred"
) -> Measurement:
    stages_ms = {stage: tuple(tuple(repeats) for repeats in frames_ms)}
    return a_measurement(technique, len(counts), outcome=outcome, stages_ms=stages_ms, counts=tuple(counts))


DRAWN = ("cells_total", "clusters_occupied", "tree_tests", "lighting_computations")


def made_by(costs, n, seed, noise=0.03, fixed_ms=3.0, outlier=1.0) -> list[Measurement]:
    """Measurements whose times follow a law: all candidate counts of a frame, drawn independently."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(n):
        drawn = np.exp(rng.uniform(np.log(1e4), np.log(1e7), size=(3, 4)))
        drawn[:, 3] *= 10
        counts = [dict(zip(DRAWN, map(int, frame), strict=True)) for frame in drawn]
        times = [fixed_ms + sum(cost * c[name] for name, cost in costs.items()) for c in counts]
        times = [ms * math.exp(noise * rng.normal()) * (outlier if k == 0 else 1.0) for ms in times]
        made.append(measurement(counts, [(ms, ms * 1.01, ms * 0.99) for ms in times]))
    return made


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "costs",
    [
        {"lighting_computations": 1e-6},
        {"lighting_computations": 1e-6, "tree_tests": 1e-5},
        {"cells_total": 1e-5, "clusters_occupied": 3e-5, "lighting_computations": 1e-6},
    ],
    ids=lambda costs: "+".join(costs),
)
def test_the_terms_of_the_law_are_found_and_no_others(costs, seed):
    model = fit_stage(made_by(costs, 15, seed), "tiled_deferred", "frame")
    assert model is not None
    expected = {"tests" if name == "tree_tests" else name: cost for name, cost in costs.items()}
    assert set(model.terms) >= set(expected)
    found = dict(zip(model.terms, model.ms_per_op, strict=True))
    for name, cost in expected.items():
        # 45 rows of 3 % noise; a term is a third of the time or more in a third of them.
        assert found[name] == pytest.approx(cost, rel=0.1)
    assert model.loo_error < 0.04 < 0.3 < model.constant_loo_error
    assert {name for name, _ in model.dropped} | set(model.terms) == {
        "cells_total",
        "clusters_occupied",
        "tests",
        "lighting_computations",
    }
    # One standard error lets a useless term in now and then, not often and not an expensive one.
    counts = [frame for m in made_by(costs, 15, seed) for frame in m.counts]
    useful = sum(found[name] * np.mean([f.get(name, f["tree_tests"]) for f in counts]) for name in expected)
    useless = sum(
        found[name] * np.mean([f.get(name, f["tree_tests"]) for f in counts]) for name in set(found) - set(expected)
    )
    assert useless < 0.02 * useful


@pytest.mark.parametrize("seed", range(20))
def test_where_there_is_only_noise_the_model_is_a_constant(seed):
    model = fit_stage(made_by({}, 12, seed, noise=0.1), "tiled_deferred", "frame")
    assert model is not None
    assert model.terms == ()
    # Relative least squares of 10 % noise lies 1 % low, and 36 rows leave 2 %.
    assert model.fixed_ms == pytest.approx(3.0, rel=0.08)
    assert model.loo_error == model.constant_loo_error
    assert {name for name, _ in model.dropped} == {"cells_total", "clusters_occupied", "tests", "lighting_computations"}
    assert all(error > 0.9 * model.loo_error for _, error in model.dropped)


@pytest.mark.parametrize("n_frames", [1, 3])
def test_the_left_out_error_is_that_of_whole_configurations(n_frames):
    # Frames that agree are no evidence about each other: with them left in the error would be nearly 0.
    made = [measurement([{"samples": 7}] * n_frames, [(ms, ms)] * n_frames) for ms in (2.0, 4.0, 8.0)]
    model = fit_stage(made, "tiled_deferred", "frame")
    assert model is not None
    # The constant of two times is their geometric mean: off by 1.5, 0 and 1.5 octaves. Five Gauss-Newton steps.
    assert model.loo_error == model.constant_loo_error == pytest.approx(math.log(2.0), rel=1e-3)


def left_out_error(made, out, terms) -> float:
    """By SciPy's robust least squares in logs, of costs that are positive as they are exponentials."""
    design, times_ms = rows_of([m for m in made if m is not out], terms)
    asked, asked_ms = rows_of([out], terms)
    start = np.log([3.0, *(1e-6, 1e-9)[: len(terms)]])
    found = scipy.optimize.least_squares(
        lambda x: np.log(design @ np.exp(x) / times_ms), start, loss="soft_l1", f_scale=0.075
    )
    return float(np.mean(np.abs(np.log(asked @ np.exp(found.x) / asked_ms))))


def rows_of(made, terms) -> tuple[np.ndarray, np.ndarray]:
    rows = [(c, ms[0]) for m in made for c, ms in zip(m.counts, m.stages_ms["frame"], strict=True)]
    return np.array([[1.0, *(c[term] for term in terms)] for c, _ in rows]), np.array([ms for _, ms in rows])


def test_what_a_dropped_term_would_give_is_the_error_of_refits_with_it():
    made = made_by({"lighting_computations": 1e-6}, 8, seed=1, noise=0.05)
    model = fit_stage(made, "tiled_deferred", "frame")
    assert model is not None and model.terms == ("lighting_computations",)
    alone, both = (
        float(np.mean([left_out_error(made, out, terms) for out in made]))
        for terms in (("lighting_computations",), ("lighting_computations", "cells_total"))
    )
    # The engine takes the width of its robust loss from the residuals, the oracle the noise it was made with.
    assert model.loo_error == pytest.approx(alone, rel=0.1)
    assert dict(model.dropped)["cells_total"] - model.loo_error == pytest.approx(both - alone, abs=0.05 * alone)


def test_one_disturbed_measurement_does_not_hide_the_law():
    made = made_by({"lighting_computations": 1e-6}, 15, seed=2, outlier=3.0)
    model = fit_stage(made, "tiled_deferred", "frame")
    assert model is not None
    assert model.terms[:1] == ("lighting_computations",)
    assert model.ms_per_op[0] == pytest.approx(1e-6, rel=0.1)


def test_two_rows_get_a_constant_with_an_honest_error():
    counts = [{"samples": 10}]
    two = [measurement(counts, [(2.0,)]), measurement([{"samples": 20}], [(4.0,)])]
    model = fit_stage(two, "tiled_deferred", "frame")
    assert model is not None
    assert (model.terms, model.n, model.n_configurations) == ((), 2, 2)
    # Each is predicted by the other, an octave off.
    assert model.loo_error == pytest.approx(math.log(2))


def test_one_configuration_says_nothing_about_the_error():
    model = fit_stage(made_by({"lighting_computations": 1e-6}, 1, seed=0), "tiled_deferred", "frame")
    assert model is not None
    assert model.terms == ()
    assert model.loo_error == math.inf
    assert model.as_json()["loo_error"] is None


def test_what_failed_or_has_no_sound_time_is_not_fitted():
    sound = made_by({"lighting_computations": 1e-6}, 6, seed=3)
    counts = sound[0].counts
    unsound = [
        measurement(counts, [(1e9,)] * 3, outcome="timeout"),
        measurement(counts, [(math.nan,), (0.0,), (-1.0,)]),
        measurement(counts, [(math.inf,)] * 3),
        measurement((), [], outcome="failed"),
    ]
    model = fit_stage([*unsound, *sound, *unsound], "tiled_deferred", "frame")
    assert model == fit_stage(sound, "tiled_deferred", "frame")
    assert fit_stage(unsound, "tiled_deferred", "frame") is None


def test_counts_that_are_constant_missing_or_not_known_before_are_no_candidates():
    made = made_by({"lighting_computations": 1e-6}, 6, seed=4)
    for k, m in enumerate(made):
        for frame in m.counts:
            frame["samples"] = 7
            if k:
                frame["shading_lanes"] = 3 * frame["lighting_computations"]
    model = fit_stage(made, "tiled_deferred", "frame", available=frozenset({"cells_total", "samples", "leaf_tests"}))
    assert model is not None
    assert {*model.terms, *(name for name, _ in model.dropped)} == {"cells_total"}


def test_each_stage_of_a_technique_gets_a_model_in_the_order_of_the_table():
    made = [
        measurement([{"samples": n, "clusters_occupied": 5 * n**2}], [(1.0 + n,)], stage=stage)
        for stage in ("frame", "clusters", "post_processing")
        for n in (1, 2, 3, 4)
    ]
    others = [measurement([{"samples": 1}], [(1.0,)], technique="forward")]
    models = fit_models([*made, *others], "tiled_deferred")
    assert list(models) == ["clusters", "frame", "post_processing"]
    assert models["clusters"].terms == ("samples",)
    assert models["post_processing"].terms == ()  # no candidates are known for it
    assert fit_models(made, "forward") == {}


def test_equal_columns_are_taken_once():
    rng = np.random.default_rng(0)
    made = []
    for _ in range(10):
        n = int(rng.integers(10**5, 10**7))
        made.append(measurement([{"lighting_computations": n, "shading_lanes": n}], [(1 + 1e-5 * n,)]))
    model = fit_stage(made, "tiled_deferred", "frame")
    assert model is not None
    assert model.terms == ("lighting_computations",)


def test_a_stage_of_a_whole_run_is_fitted_in_a_blink():
    # 40 configurations of all candidates; 60 ms here, 2 s is the limit for all fits of a run.
    rng = np.random.default_rng(0)
    made = []
    for _ in range(40):
        counts = [{name: int(np.exp(rng.uniform(5, 15))) for name in STAGE_TERMS["frame"]}]
        counts[0]["tree_tests"] = counts[0].pop("tests")
        made.append(measurement(counts, [(1.0 + sum(counts[0].values()) * 1e-6,)]))
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_stage(made, "tiled_deferred", "frame")
    assert time.process_time() - started < 1.0
