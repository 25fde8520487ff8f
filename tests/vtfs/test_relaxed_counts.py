"""Relaxed counts: the mean of exact counts over all phases of the grid, and its gradient."""

import dataclasses
import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.strategies import WIDE, a_camera, adversarial_lights, nearby_lights, random_samples, samples_at, seeds
from vtfs.camera import Camera
from vtfs.configurations import configuration
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.input_error import InputError
from vtfs.lights import Lights
from vtfs.relaxed_counts import (
    CandidatePairs,
    cubic_depth_slices,
    expected_lighting_computations,
    expected_list_lengths,
    in_view,
    lighting_computations_at_phase,
    on_screen,
)
from vtfs.relaxed_frame import candidate_pairs, count_variables, relaxed_frame
from vtfs.view_samples import ViewSamples

N_SAMPLES, N_LIGHTS, N_PHASES = 64, 16, 32
CAMERA = a_camera(WIDE, 0.1, 100.0)

few = settings(max_examples=8, deadline=None)
expected = jax.jit(expected_lighting_computations)
gradient = jax.jit(jax.grad(expected_lighting_computations))
lengths = jax.jit(expected_list_lengths)
at_phase = jax.jit(lighting_computations_at_phase)
tiles = st.floats(3, 50)
slices = st.floats(6, 300)


def surface(seed: int) -> ViewSamples:
    """A rough surface between 1 and 40 metres: everything is valid."""
    rng = np.random.default_rng(seed)
    shape = (WIDE.height_px, WIDE.width_px)
    return samples_at(CAMERA, 40 ** rng.uniform(0, 1, shape), np.ones(shape, bool), rng)


def float64(tree):
    """Leaves that are real numbers in double precision; call it where x64 is on."""

    def leaf(array):
        array = np.asarray(array)
        return jnp.asarray(array.astype(np.float64) if array.dtype == np.float32 else array)

    return jax.tree.map(leaf, tree)


def all_pairs(n_samples: int, n_lights: int) -> CandidatePairs:
    sample, light = np.divmod(np.arange(n_samples * n_lights, dtype=np.int32), n_lights)
    return CandidatePairs(jnp.asarray(sample), jnp.asarray(light), jnp.ones(len(sample), bool))


def listed_by_oracle(variables, frame, phase, radius_scale: np.ndarray | float = 1.0) -> np.ndarray:
    """Brute force, bool `[samples, lights]`: the corners of each sample's cell, their box, and the sphere.

    `phase`: how much of its cell lies left of, above and nearer than each sample, `[3]` or `[3, samples, 1]`.
    """
    rotation = np.asarray(frame.view_from_world, np.float64)
    x, y, z = rotation @ np.array([frame.x_m, frame.y_m, frame.z_m], np.float64)
    lights = rotation @ np.array([variables.light_x_m, variables.light_y_m, variables.light_z_m], np.float64)
    width, height = frame.viewport.width_px, frame.viewport.height_px
    top = float(variables.tan_half_y)
    per_px = 2 * top / height
    column, row = (x / -z / per_px + width / 2)[:, None], (height / 2 - y / -z / per_px)[:, None]
    u, v, w = phase
    tile_x, tile_y = float(variables.tile_px_x), float(variables.tile_px_y)
    slack_px = 0.02  # boxes are wider by this on purpose, for samples beside their pixel
    columns = [np.clip(column + s * tile_x, 0, width) for s in (-u, 1 - u)]
    rows = [np.clip(row + s * tile_y, 0, height) for s in (-v, 1 - v)]
    columns, rows = (columns[0] - slack_px, columns[1] + slack_px), (rows[0] - slack_px, rows[1] + slack_px)
    near, far = float(variables.near_m), float(frame.far_m)
    depths = [np.full_like(column, near), np.full_like(column, far)]
    if variables.depth_slices is not None:
        growth = (far / near) ** (1 / float(variables.depth_slices))
        depths = [-z[:, None] * growth**-w, -z[:, None] * growth ** (1 - w)]
    corners = [
        np.broadcast_arrays((c * per_px - width / 2 * per_px) * d, (height / 2 - r) * per_px * d, -d)
        for c in columns
        for r in rows
        for d in depths
    ]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    outside = np.maximum(np.maximum(low - lights[:, None, :], lights[:, None, :] - high), 0)
    return (outside**2).sum(0) <= (np.asarray(variables.light_range_m, np.float64) * radius_scale) ** 2


def mean_by_oracle(variables, frame, temperature: float, seed: int) -> np.ndarray:
    """List lengths `[samples]`, averaged over a shifted grid of 10 x 10 x 10 phases of each sample."""
    rng = np.random.default_rng(seed)
    total, steps = np.zeros(frame.n_samples), [(k + 0.5) / 10 for k in range(10)]
    for u in steps:
        for v in steps:
            for w in steps:
                jitter = rng.uniform(-0.05, 0.05, (3, frame.n_samples, 1))
                scale = 1 + temperature * (2 * rng.uniform(0, 1, (frame.n_samples, 1)) - 1)
                phase = np.array([u, v, w])[:, None, None] + jitter
                total += listed_by_oracle(variables, frame, phase, scale).sum(1)
    return total / 1000


def small_case(seed: int, tile_px: float, depth_slices: float | None, wider: float = 1.0):
    samples = surface(seed)
    lights = nearby_lights(samples, N_LIGHTS, seed)
    variables = count_variables(CAMERA, lights, tile_px, depth_slices)
    variables = eqx.tree_at(lambda v: v.tile_px_x, variables, variables.tile_px_x * wider)
    return variables, relaxed_frame(samples, N_SAMPLES, N_PHASES)


@pytest.mark.parametrize("is_tiled", [False, True], ids=["clustered", "tiled"])
@given(seed=seeds, tile_px=tiles, n_slices=slices, temperature=st.sampled_from([0.0, 0.4]), wider=st.floats(0.5, 2))
@settings(max_examples=5, deadline=None)
def test_it_is_the_mean_over_the_phases(is_tiled, seed, tile_px, n_slices, temperature, wider):
    variables, frame = small_case(seed, tile_px, None if is_tiled else n_slices, wider)
    slow = mean_by_oracle(variables, frame, temperature, seed)
    with jax.enable_x64(True):
        fast = np.asarray(lengths(*float64((variables, frame)), all_pairs(N_SAMPLES, N_LIGHTS), temperature))
    # 32 points of each sample against 1,000: a pair that half of the phases count is off by 0.03, a sample's 16 by
    # 0.1 (one standard deviation), the sum of 64 samples by less than 1, of some 400.
    assert np.abs(fast - slow).max() < 0.75
    assert fast.sum() == pytest.approx(slow.sum(), rel=0.01)


def difference(variables, frame, pairs, temperature, name: str, direction: np.ndarray, step: float) -> float:
    """Central difference along a direction of one variable."""
    ends = []
    for sign in (1, -1):
        moved = eqx.tree_at(lambda v: getattr(v, name), variables, getattr(variables, name) + sign * step * direction)
        ends.append(float(expected(moved, frame, pairs, temperature)))
    return (ends[0] - ends[1]) / (2 * step)


VARIABLES = [field.name for field in dataclasses.fields(count_variables(CAMERA, nearby_lights(surface(0), 1, 0)))]


@pytest.mark.parametrize("temperature", [0.0, 0.2])
@pytest.mark.parametrize("is_tiled", [False, True], ids=["clustered", "tiled"])
@given(seed=seeds, tile_px=tiles, n_slices=slices)
@settings(max_examples=4, deadline=None)
def test_the_gradient_is_that_of_central_differences(is_tiled, temperature, seed, tile_px, n_slices):
    variables, frame = small_case(seed, tile_px, None if is_tiled else n_slices)
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        variables, frame = float64((variables, frame))
        pairs = all_pairs(N_SAMPLES, N_LIGHTS)
        slope = gradient(variables, frame, pairs, temperature)
        count = float(expected(variables, frame, pairs, temperature))
        for name in VARIABLES:
            value = getattr(variables, name)
            if value is None:
                continue
            scale = float(np.abs(value).max()) or 1.0
            direction = rng.normal(size=value.shape)
            direction *= scale / np.linalg.norm(direction)
            by_gradient = float((np.asarray(getattr(slope, name)) * direction).sum())
            by_difference = difference(variables, frame, pairs, temperature, name, direction, 1e-7)
            # The gradient of float64 is good to 1e-5; a difference over 1e-7 to 1e-8 of the count. Slopes near zero
            # count as a thousandth of the count.
            assert by_gradient == pytest.approx(by_difference, rel=1e-3, abs=1e-6 * count), name


def test_a_single_precision_gradient_is_as_good():
    variables, frame = small_case(5, 12.0, 40.0)
    pairs = all_pairs(N_SAMPLES, N_LIGHTS)
    single = gradient(variables, frame, pairs, 0.0)
    with jax.enable_x64(True):
        double = gradient(*float64((variables, frame)), pairs, 0.0)
    for name in VARIABLES:
        largest = float(np.abs(getattr(double, name)).max())
        assert np.abs(np.asarray(getattr(single, name)) - np.asarray(getattr(double, name))).max() < 1e-3 * largest, (
            name
        )


@given(seed=seeds, tile_px=tiles, n_slices=slices, is_tiled=st.booleans(), phase=st.tuples(*[st.floats(0, 0.999)] * 3))
@example(
    seed=583, tile_px=42.310546875, n_slices=300.0, is_tiled=False, phase=(0.055, 0.0, 0.5496436160663739)
)  # three pairs within the slack
@few
def test_an_exact_count_at_a_phase_is_that_of_brute_force(seed, tile_px, n_slices, is_tiled, phase):
    variables, frame = small_case(seed, tile_px, None if is_tiled else n_slices)
    with jax.enable_x64(True):
        double = float64((variables, frame))
        found = int(at_phase(*double, all_pairs(N_SAMPLES, N_LIGHTS), jnp.asarray(phase)))
        x_px, from_bottom_px, depth_m = (np.asarray(c)[:, None] for c in on_screen(*double))
    y_px = WIDE.height_px - from_bottom_px
    before = [(x_px / float(variables.tile_px_x) + phase[0]) % 1, (y_px / float(variables.tile_px_y) + phase[1]) % 1]
    log_growth = math.log(float(frame.far_m) / float(variables.near_m)) / (n_slices if not is_tiled else 1)
    before.append((np.log(depth_m / float(variables.near_m)) / log_growth + phase[2]) % 1)
    # Boxes are wider by 1e-5 of their depth on each axis, on purpose.
    slack_m = math.sqrt(3) * 1.1e-5 * (float(frame.far_m) if is_tiled else depth_m * math.exp(log_growth))
    wider = 1 + slack_m / np.maximum(np.asarray(variables.light_range_m, np.float64), 1e-9)
    at_least = listed_by_oracle(variables, frame, before).sum()
    assert at_least <= found <= listed_by_oracle(variables, frame, before, wider).sum()


@pytest.mark.parametrize("tile_px", [5, 16])
def test_phase_zero_is_the_grid_of_the_pipeline(tile_px):
    samples = random_samples(CAMERA, 3)
    lights = nearby_lights(samples, 37, 3)
    config = configuration("volume_tiled_bvh", {"tile_px": tile_px, "depth_slices": 24})
    counts, _ = count(config, FrameInputs(samples, lights))
    variables = count_variables(CAMERA, lights, tile_px, 24)
    frame = relaxed_frame(samples, n_samples=10**6)
    found = int(at_phase(variables, frame, candidate_pairs(variables, frame), jnp.zeros(3)))
    exact = counts.technique["lighting_computations"]
    # Samples within rounding of a slice plane, and pairs that touch within rounding.
    assert frame.n_samples == samples.n_valid and float(frame.weight) == 1
    assert abs(found - exact) <= max(40, 1e-3 * exact)


@pytest.mark.parametrize("is_tiled", [False, True], ids=["clustered", "tiled"])
@given(
    seed=seeds,
    tile_px=tiles,
    n_slices=slices,
    kind=st.sampled_from(["touching", "behind", "around_eye", "huge", "one_point", "anywhere"]),
    phase=st.tuples(*[st.floats(0, 0.999)] * 3),
)
@settings(max_examples=6, deadline=None)
def test_candidates_hold_every_pair_that_counts(is_tiled, seed, tile_px, n_slices, kind, phase):
    samples = surface(seed)
    lights = adversarial_lights(samples, N_LIGHTS, (kind,), seed)
    variables = count_variables(CAMERA, lights, tile_px, None if is_tiled else n_slices)
    frame = relaxed_frame(samples, N_SAMPLES)
    pairs = candidate_pairs(variables, frame, margin=0.1)
    found = set(
        zip(*(np.asarray(a)[np.asarray(pairs.in_use)].tolist() for a in (pairs.sample, pairs.light)), strict=True)
    )
    assert len(found) == np.asarray(pairs.in_use).sum()
    larger = eqx.tree_at(
        lambda v: (v.tile_px_x, v.tile_px_y, v.light_range_m),
        variables,
        (variables.tile_px_x * 1.09, variables.tile_px_y * 1.09, variables.light_range_m * 1.09),
    )
    for grown in (variables, larger):
        counted = set(zip(*(a.tolist() for a in np.nonzero(listed_by_oracle(grown, frame, phase))), strict=True))
        assert counted <= found


def test_lights_without_range_and_no_lights_cost_nothing():
    samples = surface(0)
    some = nearby_lights(samples, N_LIGHTS, 0)
    dark = dataclasses.replace(some, range_m=np.zeros(N_LIGHTS))
    none = Lights(*(getattr(some, f.name)[:0] for f in dataclasses.fields(some)))
    frame = relaxed_frame(samples, N_SAMPLES)
    for lights in (dark, none):
        variables = count_variables(CAMERA, lights)
        pairs = candidate_pairs(variables, frame)
        assert not pairs.in_use.any()
        assert float(expected(variables, frame, pairs, 0.0)) == 0
        slope = gradient(variables, frame, pairs, 0.0)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slope))


def test_samples_are_distinct_spread_evenly_and_stand_for_all():
    samples = random_samples(CAMERA, 1)
    frame = relaxed_frame(samples, 400)
    assert float(frame.weight) * 400 == pytest.approx(samples.n_valid)
    variables = count_variables(CAMERA, nearby_lights(samples, 1, 0))
    x_px, y_px, depth_m = (np.asarray(c) for c in on_screen(variables, frame))
    column, row = np.floor(x_px).astype(int), WIDE.height_px - 1 - np.floor(y_px).astype(int)
    assert len(set(zip(column, row, strict=True))) == 400
    np.testing.assert_allclose(depth_m, -samples.position_m[row, column, 2], rtol=1e-5)
    valid_left = samples.valid[:, : WIDE.width_px // 2].sum() / samples.n_valid
    assert (column < WIDE.width_px // 2).mean() == pytest.approx(valid_left, abs=0.02)
    assert ((np.asarray(frame.phase) > 0) & (np.asarray(frame.phase) < 1)).all()


def test_a_moved_camera_sees_what_a_camera_there_sees():
    samples = surface(2)
    lights = nearby_lights(samples, N_LIGHTS, 2)
    frame = relaxed_frame(samples, N_SAMPLES)
    variables = count_variables(CAMERA, lights)
    moved_m, turn_rad = np.array([0.3, -0.2, 0.5]), 1e-3
    # To the left about its own up axis: the target moves to the left.
    right, up, backward = CAMERA.view_from_world[:3, :3]
    eye_m = np.asarray(CAMERA.eye_m) + moved_m
    ahead = -backward * math.cos(turn_rad) - right * math.sin(turn_rad)
    there = Camera(
        tuple(eye_m), tuple(eye_m + ahead), tuple(up), CAMERA.fov_y_deg, CAMERA.near_m, CAMERA.far_m, CAMERA.viewport
    )
    world_m = np.stack([frame.x_m, frame.y_m, frame.z_m], axis=1).astype(np.float64) + CAMERA.eye_m
    wanted = world_m @ there.view_from_world[:3, :3].T + there.view_from_world[:3, 3]
    moved = eqx.tree_at(
        lambda v: (v.eye_m, v.turn_rad), variables, (jnp.asarray(moved_m), jnp.asarray([0.0, turn_rad, 0.0]))
    )
    found = np.stack(in_view(moved, frame, frame.x_m, frame.y_m, frame.z_m), axis=1) * (1, 1, -1)
    np.testing.assert_allclose(found, wanted, atol=2e-5)  # float32 at 40 metres


def test_cubic_slices_follow_the_tile():
    frame = relaxed_frame(surface(0), N_SAMPLES)
    variables = count_variables(CAMERA, nearby_lights(surface(0), 1, 0), tile_px=10, depth_slices=0)
    by_hand = math.log(1000) / math.log(1 + 2 * math.tan(math.radians(30)) / 4)  # 4 rows of 10 pixels
    assert variables.depth_slices is not None and float(variables.depth_slices) == pytest.approx(by_hand, rel=1e-6)
    follows = functools.partial(
        cubic_depth_slices, near_m=variables.near_m, tan_half_y=variables.tan_half_y, frame=frame
    )
    assert float(follows(variables.tile_px_y)) == pytest.approx(by_hand, rel=1e-5)
    assert float(jax.grad(lambda t: follows(t))(variables.tile_px_y)) < 0


def test_bad_values_are_refused_by_name():
    samples, lights = surface(0), nearby_lights(surface(0), 1, 0)
    endless = dataclasses.replace(CAMERA, far_m=math.inf)
    empty = dataclasses.replace(samples, valid=np.zeros_like(samples.valid))
    for refused, words in (
        (lambda: relaxed_frame(samples, 0), r"relaxed_frame\(n_samples=0\)"),
        (lambda: relaxed_frame(samples, 1, 0), r"relaxed_frame\(n_phases=0\)"),
        (lambda: relaxed_frame(empty), "no valid sample"),
        (lambda: count_variables(CAMERA, lights, 0.0), "`tile_px` = 0"),
        (lambda: count_variables(CAMERA, lights, 32, -1), "`depth_slices` = -1"),
        (lambda: count_variables(endless, lights, 32, 0), "give `far_m`"),
    ):
        with pytest.raises(InputError, match=words):
            refused()
    assert count_variables(endless, lights, 32, 0, far_m=100.0).depth_slices == pytest.approx(
        float(count_variables(CAMERA, lights, 32, 0).depth_slices)  # type: ignore[arg-type]
    )
