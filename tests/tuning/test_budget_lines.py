"""What `vtfs fit` says of 60 and 30 frames a second."""

import numpy as np
import pytest

from tuning.budget_lines import sizes_within
from tuning.law import Law
from tuning.table_model import TableModel
from tuning.terms import CONSTANT, Factor, Term
from tuning.time_model import PlausibleLaw, TimeModel

LIGHTS = Term((Factor("num_lights"),))


def frame(ms_per_light: float, fewest: float = 100.0) -> TimeModel:
    """1 ms, and so much for each light, fitted to so many up to 5,000 lights, without an error."""
    law = Law((CONSTANT, LIGHTS), (1.0, ms_per_light), (0, 0))
    hull = {"num_lights": np.array([fewest, 5000.0])}
    return TimeModel((PlausibleLaw(law, 1.0, np.zeros((2, 2)), 1e-9),), 30, 1e-9, 1.0, hull, {}, (), ())


@pytest.mark.parametrize(
    ("ms_per_light", "sizes"),
    [
        # (16.67 - 1) / 0.01 and (33.33 - 1) / 0.01
        (0.01, ("1,567 (1,567 to 1,567) within 16.7 ms", "3,233 (3,233 to 3,233) within 33.3 ms")),
        (0.0005, ("over 2e+04 within 16.7 ms", "over 2e+04 within 33.3 ms")),
        (1.0, ("below 100 within 16.7 ms", "below 100 within 33.3 ms")),
    ],
)
def test_the_lights_that_fit_in_a_frame(ms_per_light, sizes):
    models = {("forward", "frame"): frame(ms_per_light), ("forward", "sort"): frame(9.0)}
    (found,) = sizes_within(TableModel(("technique", "stage"), models, {}))
    assert found.line == f"forward, frame: num_lights {', '.join(sizes)}"


def test_lights_beyond_the_table_say_so():
    (found,) = sizes_within(TableModel((), {(): frame(0.004)}, {}))
    assert found.line.startswith("num_lights 3,917 (3,917 to 3,917) within 16.7 ms, 8,083 (")  # fitted to 5,000
    assert found.line.endswith(", extrapolated) within 33.3 ms")


def test_a_table_that_begins_without_lights():
    (found,) = sizes_within(TableModel((), {(): frame(0.01, fewest=0.0)}, {}))
    assert found.line == "num_lights 1,567 (1,567 to 1,567) within 16.7 ms, 3,233 (3,233 to 3,233) within 33.3 ms"


def test_a_frame_of_two_sizes_needs_more_than_one_number():
    law = Law((LIGHTS, Term((Factor("samples"),))), (0.1, 0.1), (0, 0))
    hull = {name: np.array([1.0, 9.0]) for name in law.columns}
    two = TimeModel((PlausibleLaw(law, 1.0, np.zeros((2, 2)), 1e-9),), 30, 1e-9, 1.0, hull, {}, (), ())
    assert not list(sizes_within(TableModel((), {(): two}, {})))


@pytest.mark.parametrize("column", ["tile_px", "shading_steps"])
def test_a_tile_has_a_best_size_and_work_is_no_size(column):
    law = Law((Term((Factor(column),)),), (0.1,), (0,))
    hull = {column: np.array([8.0, 64.0])}
    one = TimeModel((PlausibleLaw(law, 1.0, np.zeros((1, 1)), 1e-9),), 30, 1e-9, 1.0, hull, {}, (), ())
    assert not list(sizes_within(TableModel((), {(): one}, {})))
