"""Every bad value is refused by name, with what is allowed."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtfs.input_error import InputError
from vtfs.parameters import PARAMETERS, TECHNIQUES, configuration

NOT_NUMBERS = ["abc", "", math.inf, -math.inf, math.nan, "nan", "inf", True, False, None, [], {}, 1j, 10**400, "1e999"]
OUT_OF_RANGE = {
    "tile_px": [0, 1, 257, -32, 16.5, "16.5", 1e9],
    "depth_slices": [-1, 1025, 0.5],
    "branching": [0, 1, 3, 31, 128, 32.5, -2],
    "batch": [1, 16, 33, -32, 2**25, 1000],
    "light_cutoff": [-0.01, 0.995, 1, 2],
}
BAD_NUMBERS = [(name, value) for name, values in OUT_OF_RANGE.items() for value in [*values, *NOT_NUMBERS]]
BAD_WORDS = [(name, value) for name in ("bounds", "gbuffer") for value in ["", "Implicit", "float64", 32, None, True]]


@pytest.mark.parametrize(("name", "value"), BAD_NUMBERS + BAD_WORDS, ids=str)
def test_a_bad_value_is_refused_by_name_with_what_is_allowed(name, value):
    with pytest.raises(InputError) as caught:
        configuration("volume_tiled_bvh", {name: value})
    message = str(caught.value)
    assert message.startswith(f"parameter `{name}` = ") and PARAMETERS[name].allowed in message and "\n" not in message


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("tile_px", "a whole number from 2 to 256"),
        ("depth_slices", "a whole number from 0 to 1024"),
        ("branching", "2, 4, 8, 16, 32, 64"),
        ("light_cutoff", "a number from 0 to 0.99"),
        ("bounds", "implicit, explicit"),
    ],
)
def test_what_is_allowed_reads_as_the_documentation_says(name, allowed):
    assert PARAMETERS[name].allowed == allowed


@given(tile_px=st.integers(2, 256))
def test_numbers_are_taken_as_text_and_as_whole_floats(tile_px):
    for value in (tile_px, str(tile_px), float(tile_px), f" {tile_px} "):
        config = configuration("tiled_deferred", {"tile_px": value})
        assert config["tile_px"] == tile_px and type(config["tile_px"]) is int


@pytest.mark.parametrize("technique", TECHNIQUES)
def test_every_technique_has_every_default(technique):
    config = configuration(technique)
    assert tuple(config.params) == TECHNIQUES[technique]
    assert config.params == {name: PARAMETERS[name].default for name in TECHNIQUES[technique]}
    assert str(config) == technique
    for value in config.params.values():
        assert type(value) in (int, float, str)


def test_defaults_are_those_of_the_design():
    defaults = {name: parameter.default for name, parameter in PARAMETERS.items()}
    assert defaults == {
        "tile_px": 32, "depth_slices": 0, "branching": 32, "batch": 0, "bounds": "implicit", "gbuffer": "float32",
        "light_cutoff": 0.0, "prepass": "on",
    }  # fmt: skip


def test_configurations_that_do_the_same_are_equal():
    one = configuration("volume_tiled_bvh", {"branching": "8", "tile_px": 32.0, "light_cutoff": 0})
    other = configuration("volume_tiled_bvh", {"light_cutoff": "0.0", "branching": 8})
    assert one == other and hash(one) == hash(other) and str(one) == "volume_tiled_bvh branching=8"
    assert one.replaced(branching=32) == configuration("volume_tiled_bvh") != one


def test_an_unknown_technique_is_refused_with_those_there_are():
    with pytest.raises(InputError, match=r"technique `magic`: unknown; choose from forward, .*volume_tiled_bvh"):
        configuration("magic")


def test_an_unknown_parameter_and_one_of_another_technique_are_refused():
    with pytest.raises(InputError, match=r"parameter `tile`: unknown; `tiled_deferred` has tile_px, batch"):
        configuration("tiled_deferred", {"tile": 16})
    with pytest.raises(InputError, match=r"parameter `branching`: `tiled_deferred` does not have it; it has tile_px"):
        configuration("tiled_deferred", {"branching": 8})
    with pytest.raises(InputError, match=r"parameter `tile_px`: `forward` does not have it"):
        configuration("forward").replaced(tile_px=16)
