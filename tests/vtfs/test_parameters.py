"""Every bad value is refused by name, with what is allowed."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vtfs.configurations import ConflictError, configuration
from vtfs.input_error import InputError
from vtfs.parameters import PARAMETERS, TECHNIQUES, default_value

NOT_NUMBERS = ["abc", "", math.inf, -math.inf, math.nan, "nan", "inf", True, False, None, [], {}, 1j, 10**400, "1e999"]
OUT_OF_RANGE = {
    "tile_px": [0, 1, 257, -32, 16.5, "16.5", 1e9],
    "tile_px_x": [1, 257, -32, 16.5],
    "tile_px_y": [1, 257, -32, 16.5],
    "depth_slices": [-1, 1025, 0.5],
    "normal_bins": [-1, 9, 2.5],
    "branching": [0, 1, 3, 31, 128, 32.5, -2],
    "batch": [1, 16, 33, -32, 2**25, 1000],
    "light_cutoff": [-0.01, 0.995, 1, 2],
    "resort_every": [0, -1, 1.5, 65],
    "approximate": [-0.01, 1.01, 2],
}
BAD_NUMBERS = [(name, value) for name, values in OUT_OF_RANGE.items() for value in [*values, *NOT_NUMBERS]]
WORDS = ("bounds", "gbuffer", "cull", "leaf_test", "unique", "depth_scheme", "normal_cones", "grid")
BAD_WORDS = [(name, value) for name in WORDS for value in ["", "Implicit", "float64", 32, None, True]]
BAD_WORDS += [
    ("grid", value) for value in ["16x9", "0x9x24", "16x9x1025", "8193x1x1", "16 x 9 x 24", "16x9x24x2", "-1x9x2"]
]


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
        ("batch", "0, or a power of two from 32 to 16777216"),
        ("light_cutoff", "a number from 0 to 0.99"),
        ("bounds", "implicit, explicit, packed, frustum, depth_range"),
        ("tile_px_x", "a whole number from 2 to 256, or 0: tile_px"),
        ("grid", 'off, or columns x rows x slices as "16x9x24", up to 8192x8192x1024'),
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
    assert config.params == {name: default_value(technique, name) for name in TECHNIQUES[technique]}
    assert str(config) == technique
    for value in config.params.values():
        assert type(value) in (int, float, str)


def test_defaults_are_those_of_the_design():
    defaults = {name: parameter.default for name, parameter in PARAMETERS.items()}
    assert defaults == {
        "tile_px": 32, "tile_px_x": 0, "tile_px_y": 0, "grid": "off", "depth_slices": 0, "depth_scheme": "self_similar",
        "branching": 32, "assigner": "auto", "batch": 0, "bounds": "implicit", "cull": "box", "leaf_test": "sphere",
        "unique": "page_table", "normal_bins": 0, "normal_cones": "implicit", "gbuffer": "float32", "light_cutoff": 0.0,
        "prepass": "on", "approximate": 0.0, "resort_every": 1, "planes": "on", "front_faces": "cast", "feedback": "on",
        "passes": 1, "level": 0, "tree": "compact", "stencil": "unlimited", "around_eye": "on",
        "blending": "grey",
    }  # fmt: skip
    # Tiles had their samples' depths before there was a choice (Olsson and Assarsson 2011).
    own = {(t, n): default_value(t, n) for t, names in TECHNIQUES.items() for n in names}
    assert {key: value for key, value in own.items() if value != defaults[key[1]]} == {
        ("tiled_deferred", "bounds"): "depth_range",
        ("tiled_forward_prez", "bounds"): "depth_range",
        # What tells these apart is how they make their lists.
        **{
            (name, "assigner"): "published"
            for name in ("volume_tiled", "volume_tiled_bvh", "clustered_deferred", "clustered_forward")
        },
        **{(name, "tile_px"): 8 for name in ("z_pass", "z_fail", "ptsv", "cluster_hierarchy")},
        ("cluster_hierarchy", "bounds"): "explicit",
    }


def test_configurations_that_do_the_same_are_equal():
    one = configuration("volume_tiled_bvh", {"branching": "8", "tile_px": 32.0, "light_cutoff": 0})
    other = configuration("volume_tiled_bvh", {"light_cutoff": "0.0", "branching": 8})
    assert one == other and hash(one) == hash(other) and str(one) == "volume_tiled_bvh branching=8"
    assert one.replaced(branching=32) == configuration("volume_tiled_bvh") != one


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"tile_px": 16, "grid": "16x9x24", "depth_slices": 7}, {"grid": "16x9x24"}),
        ({"tile_px_x": 16, "tile_px_y": 16}, {"tile_px": 16}),
        ({"tile_px": 8, "tile_px_x": 64, "tile_px_y": 16}, {"tile_px_x": 64, "tile_px_y": 16}),
        ({"tile_px": 16, "tile_px_x": 64}, {"tile_px_x": 64, "tile_px_y": 16}),
        ({"depth_slices": 1, "depth_scheme": "ndc"}, {"depth_slices": 1}),
        ({"bounds": "frustum"}, {"cull": "frustum"}),
        ({"bounds": "frustum", "cull": "planes"}, {"cull": "planes"}),
        ({"leaf_test": "box", "cull": "planes"}, {"leaf_test": "box"}),
        ({"leaf_test": "box", "bounds": "frustum"}, {"leaf_test": "box", "cull": "frustum"}),
    ],
    ids=str,
)
def test_values_without_effect_make_no_other_configuration(one, other):
    first, second = configuration("volume_tiled_bvh", one), configuration("volume_tiled_bvh", other)
    assert first == second and first.replaced() == first
    assert first != configuration("volume_tiled_bvh")


def test_values_with_an_effect_make_another_configuration():
    changes = [
        {}, {"cull": "planes"}, {"cull": "frustum"}, {"cull": "screen_rect"}, {"bounds": "explicit"}, {"tile_px_x": 16},
        {"bounds": "explicit", "cull": "frustum"}, {"leaf_test": "box"}, {"grid": "16x9x24"}, {"grid": "9x16x24"},
        {"tile_px_y": 16}, {"depth_slices": 24}, {"depth_slices": 24, "depth_scheme": "ndc"}, {"unique": "sort"},
        {"normal_bins": 3}, {"normal_cones": "explicit"},
    ]  # fmt: skip
    assert len({configuration("volume_tiled_bvh", change) for change in changes}) == len(changes)


@pytest.mark.parametrize("scheme", ["linear", "ndc"])
def test_cubic_cells_are_self_similar_only(scheme):
    with pytest.raises(ConflictError, match=f"`depth_scheme` = '{scheme}' with depth_slices=0.*1 or more"):
        configuration("volume_tiled_bvh", {"depth_scheme": scheme})
    assert configuration("volume_tiled_bvh", {"depth_scheme": scheme, "grid": "16x9x24"})["depth_scheme"] == scheme
    assert configuration("volume_tiled_bvh", {"depth_scheme": scheme, "depth_slices": 2})["depth_scheme"] == scheme


def test_the_level_of_a_second_pass_goes_with_two_passes():
    with pytest.raises(ConflictError, match="`level` = 3 with passes=1: has no effect; give passes=2, or leave level"):
        configuration("ptsv", {"level": 3})
    assert configuration("ptsv", {"level": 0, "passes": 1}) == configuration("ptsv")
    assert configuration("ptsv", {"level": 3, "passes": 2})["level"] == 3


def test_a_tiled_technique_takes_a_grid_of_one_slice():
    assert configuration("tiled_deferred", {"grid": "16x9x1"})["grid"] == "16x9x1"
    with pytest.raises(ConflictError, match=r'`grid` = \'16x9x24\': tiles of `tiled_deferred` .*give "16x9x1"'):
        configuration("tiled_deferred", {"grid": "16x9x24"})


def test_an_unknown_technique_is_refused_with_those_there_are():
    with pytest.raises(InputError, match=r"technique `magic`: unknown; choose from forward, .*volume_tiled_bvh"):
        configuration("magic")


def test_an_unknown_parameter_and_one_of_another_technique_are_refused():
    with pytest.raises(InputError, match=r"parameter `tile`: unknown; `tiled_deferred` has tile_px, tile_px_x"):
        configuration("tiled_deferred", {"tile": 16})
    with pytest.raises(InputError, match=r"parameter `branching`: `tiled_deferred` does not have it; it has tile_px"):
        configuration("tiled_deferred", {"branching": 8})
    with pytest.raises(InputError, match=r"parameter `tile_px`: `forward` does not have it"):
        configuration("forward").replaced(tile_px=16)
