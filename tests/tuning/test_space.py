import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuning.space import LARGEST_SPACE, Space, accuracy_values, default_space, load_space
from vtfs.configurations import configuration
from vtfs.input_error import InputError
from vtfs.parameters import TECHNIQUES
from vtfs.technique_names import TUNED_TECHNIQUES

ALL = TUNED_TECHNIQUES


@pytest.fixture
def space_file(tmp_path):
    def write(text: str):
        path = tmp_path / "space.toml"
        path.write_text(text, "utf-8")
        return path

    return write


def test_the_default_space_holds_every_default_once_and_only_exact_settings():
    space = default_space(ALL, n_samples=1280 * 720)
    found = space.configurations()
    assert len(found) == len(set(found)) == len(space) == 3 + 4 * 3 + 4 * 4 * 2 * 3
    for technique in ALL:
        assert configuration(technique) in space
    assert {c["gbuffer"] for c in found} == {"float32"}
    assert {c["light_cutoff"] for c in found} == {0.0}
    assert found == default_space(ALL, n_samples=1280 * 720).configurations()


def test_the_default_space_of_shadows_has_values_of_its_own():
    space = default_space(["ptsv", "cluster_hierarchy", "z_fail"], n_samples=1280 * 720)
    found = space.configurations()
    assert len(found) == 6 + 12 + 6 and all(config.is_exact for config in found)
    assert {c["tile_px"] for c in found} == {4, 8, 16}
    assert all(configuration(technique) in space for technique in space.techniques)


@pytest.mark.parametrize(
    ("n_samples", "batches"),
    [(16384, {0}), (16385, {0, 16384}), (65536, {0, 16384}), (65537, {0, 16384, 65536})],
)
def test_batches_that_hold_the_whole_frame_are_left_out_as_they_equal_zero(n_samples, batches):
    assert {c["batch"] for c in default_space(["forward"], n_samples).configurations()} == batches


def test_accuracy_settings_are_valid_and_none_is_exact():
    for setting in accuracy_values():
        technique = "z_fail" if set(setting) <= set(TECHNIQUES["z_fail"]) else "tiled_deferred"
        assert not configuration(technique, setting).is_exact


@given(
    tiles=st.lists(st.integers(2, 256), min_size=1, max_size=5),
    slices=st.lists(st.integers(0, 1024), min_size=1, max_size=5),
    bound=st.integers(0, 262144),
)
def test_constraints_keep_what_an_obvious_loop_keeps(tiles, slices, bound):
    values = {"volume_tiled_bvh": {"tile_px": tuple(tiles), "depth_slices": tuple(slices)}}
    space = Space(("volume_tiled_bvh",), values, (f"tile_px * depth_slices <= {bound}", "not tile_px == 7"))
    expected = {(t, s) for t, s in itertools.product(tiles, slices) if t * s <= bound and t != 7}
    if expected:
        found = [(c["tile_px"], c["depth_slices"]) for c in space.configurations()]
        assert len(found) == len(expected)
        assert set(found) == expected
    else:
        with pytest.raises(InputError, match="no combination"):
            space.configurations()


@pytest.mark.parametrize(
    ("constraint", "kept"),
    [
        ("8 < tile_px <= 32", {16, 32}),
        ("tile_px == 8 or tile_px == 64", {8, 64}),
        ("tile_px ** 2 > 1000 and not tile_px > 32", {32}),
        ("-tile_px + 40 > 0", {8, 16, 32}),
        ("tile_px // 3 % 2 == 0", {8, 32}),  # 2, 5, 10, 21
        ("tile_px / 2 >= 16", {32, 64}),
        ("gbuffer == 'float32' and tile_px < 16", {8}),
        ("gbuffer != 'float32' or tile_px < 16", {8}),
    ],
)
def test_the_language_of_constraints(constraint, kept):
    space = Space(("tiled_deferred",), {"tiled_deferred": {"tile_px": (8, 16, 32, 64)}}, (constraint,))
    assert {c["tile_px"] for c in space.configurations()} == kept


def test_a_file_is_read_and_what_a_technique_lacks_is_ignored_for_it(space_file):
    path = space_file(
        'constraints = ["tile_px * depth_slices <= 512"]\n[parameters]\n'
        "tile_px = [16, 32, 16]\ndepth_slices = [16, 32]\nbatch = [4096]\n"
    )
    found = load_space(path, ALL).configurations()
    assert [str(c) for c in found] == [
        "forward batch=4096",
        # The constraint names `depth_slices`, which tiled shading does not have.
        "tiled_deferred tile_px=16 batch=4096",
        "tiled_deferred batch=4096",
        "volume_tiled_bvh tile_px=16 depth_slices=16 batch=4096",
        "volume_tiled_bvh tile_px=16 depth_slices=32 batch=4096",
        "volume_tiled_bvh depth_slices=16 batch=4096",
    ]


def test_the_level_of_a_second_pass_varies_beside_two_passes_alone(space_file):
    path = space_file("[parameters]\npasses = [1, 2]\nlevel = [1, 2]\n")
    found = load_space(path, ["ptsv", "z_fail"]).configurations()
    assert [str(c) for c in found] == ["ptsv", "ptsv passes=2 level=1", "ptsv passes=2 level=2", "z_fail"]
    assert [str(c) for c in load_space(space_file("[parameters]\nlevel = [0]"), ["ptsv"]).configurations()] == ["ptsv"]
    for passes in ("", "passes = [1]"):
        with pytest.raises(
            InputError, match=r"`parameters.level` = \[0, 2\]: has no effect without passes=2; list 2 in"
        ):
            load_space(space_file(f"[parameters]\nlevel = [0, 2]\n{passes}"), ["ptsv", "cluster_hierarchy"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tile_px = [", "is not TOML"),
        ("[parameters]\ntile_px = 16", r"`parameters.tile_px` = 16: must be a list"),
        ("[parameters]\ntile_px = []", r"`parameters.tile_px` = \[\]: must be a list"),
        ("[parameters]\ntile_px = [0]", "`tile_px` = 0: must be a whole number from 2 to 256"),
        ("[parameters]\ntile_px = [inf]", "`tile_px` = inf: must be a whole number from 2 to 256"),
        ("[parameters]\ntile_px = [nan]", "`tile_px` = nan"),
        ("[parameters]\ntile_px = [true]", "`tile_px` = True"),
        ("[parameters]\ntile_px = [16.5]", "`tile_px` = 16.5"),
        ("[parameters]\ntile_px = [[16]]", r"`tile_px` = \[16\]"),
        ("[parameters]\nbranching = [3]", "`branching` = 3: must be one of 2, 4, 8"),
        ("[parameters]\nbranch = [4]", "`parameters.branch`: unknown; choose from tile_px"),
        ("", "`\\[parameters\\]`: missing"),
        ("[parameters]", "`\\[parameters\\]`: missing or empty"),
        ("[params]\ntile_px = [16]", "`params`: unknown"),
        ("constraints = 'a'\n[parameters]\ntile_px = [16]", "`constraints` = 'a': must be a list"),
        ("constraints = [3]\n[parameters]\ntile_px = [16]", r"`constraints` = \[3\]: must be a list"),
        ("constraints = ['tile_px < 4']\n[parameters]\ntile_px = [16]", "`constraints`: no combination"),
        ("[parameters]\ntile_px = [" + "9" * 5000 + "]", "is not TOML"),
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_names_it(space_file, text, message):
    path = space_file(text)
    with pytest.raises(InputError, match=message) as caught:
        load_space(path, ["tiled_deferred", "volume_tiled_bvh"])
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("constraint", "message"),
    [
        ("tile_px", "compares nothing"),
        ("tile_px <", "not an expression"),
        ("tile_px < 4; 1", "not an expression"),
        ("", "not an expression"),
        ("tile_size < 4", "`tile_size` is unknown"),
        ("__import__('os').system('true') == 0", "not allowed"),
        ("tile_px.real == 3", "not allowed"),
        ("[1][0] == tile_px", "not allowed"),
        ("(lambda: 1)() == 1", "not allowed"),
        ("tile_px in (8, 16)", "not allowed"),
        ("True == True", "not allowed"),
        ("tile_px and 3", "not a truth"),
        ("(tile_px < 3) + 1 > 0", "not a number"),
        ("tile_px == 'float32'", "not a number"),
        ("gbuffer < 'float32'", "not a number"),
        ("gbuffer * 3 == 'a'", "not a number"),
        ("tile_px / (tile_px - 16) > 1", "division by zero, at tile_px = 16"),
        ("9 ** 9 ** 9 > tile_px", "out of bounds"),
        ("(-tile_px) ** 0.5 > 1", "out of bounds"),
        ("tile_px < 1or 2 > 1", "not an expression"),
        ("(" * 180 + "1", "not an expression"),
        ("-" * 180 + "tile_px > 90", "no combination"),
        ("tile_px < 4" + " or tile_px < 4" * 50, "characters; at most 200"),
    ],
)
def test_a_bad_constraint_is_refused_by_its_place(space_file, constraint, message):
    quoted = constraint.replace('"', "'")
    path = space_file(f'constraints = ["tile_px > 0", "{quoted}"]\n[parameters]\ntile_px = [16, 32]\n')
    with pytest.raises(InputError, match=r"`constraints(\[1\])?`.*" + message):
        load_space(path, ["tiled_deferred"])


def test_a_space_too_large_to_count_is_refused_before_it_is_made(space_file):
    path = space_file(
        f"[parameters]\ntile_px = {list(range(2, 257))}\ndepth_slices = {list(range(1025))}\nbranching = [2, 4]\n"
    )
    with pytest.raises(InputError, match=f"{255 * 1025 * 2:,} combinations.*{LARGEST_SPACE:,}"):
        load_space(path, ["volume_tiled_bvh"])


def test_a_parameter_that_no_chosen_technique_has_is_refused(space_file):
    with pytest.raises(InputError, match="forward does not have it; choose from prepass, batch, gbuffer, light_cutoff"):
        load_space(space_file("[parameters]\ntile_px = [16]\n"), ["forward"])


@pytest.mark.parametrize("name", ["missing.toml", "."])
def test_what_cannot_be_read_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="cannot be read"):
        load_space(tmp_path / name, ALL)


def test_a_file_that_is_not_text_is_refused(tmp_path):
    path = tmp_path / "space.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not TOML"):
        load_space(path, ALL)


def test_what_a_space_draws_is_what_its_defaults_draw():
    space = Space(("ptsv",), {"ptsv": {"blending": ("coloured",), "tile_px": (4, 16)}})
    assert space.default("ptsv") == configuration("ptsv", {"blending": "coloured"})
    assert Space(("ptsv",), {"ptsv": {"tile_px": (4,)}}).default("ptsv") == configuration("ptsv")
