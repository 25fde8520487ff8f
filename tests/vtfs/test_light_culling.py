"""No bounds, cull, scheme, lens or cone loses a light that lights a sample; the exact cull lists few others."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import (
    LIGHT_KINDS,
    a_camera,
    adversarial_lights,
    cameras,
    lights_in_view,
    random_samples,
    samples_at,
    seeds,
    surface_samples,
    through,
)
from tests.vtfs.test_light_assignment import listed_lights
from vtfs.camera import Lens, Viewport
from vtfs.configurations import configuration
from vtfs.false_positives import ListedPairs, listed_pairs
from vtfs.frame import run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.lights import Lights, cone_cosines
from vtfs.view_samples import ViewSamples

VOLUME = {"branching": 8, "batch": 1024}
CASES = {
    "exact": ("volume_tiled_bvh", {**VOLUME, "cull": "frustum", "unique": "sort"}, False),
    "explicit_rect": ("volume_tiled_bvh", {**VOLUME, "bounds": "explicit", "cull": "screen_rect"}, False),
    "packed_boxes": ("volume_tiled_bvh", {**VOLUME, "bounds": "packed", "leaf_test": "box"}, False),
    "tiled_planes": ("tiled_deferred", {"batch": 1024, "cull": "planes"}, False),
    "normal_bins": ("volume_tiled_bvh", {**VOLUME, "normal_bins": 2}, True),
    "explicit_cones": (
        "tiled_deferred",
        {"batch": 1024, "bounds": "explicit", "cull": "frustum", "normal_cones": "explicit"},
        True,
    ),
}
GRIDS = [
    {},
    {"tile_px_x": 8, "tile_px_y": 3},
    {"grid": "5x3x24"},
    {"depth_slices": 24, "depth_scheme": "linear"},
    {"depth_slices": 24, "depth_scheme": "ndc"},
    {"depth_slices": 1, "tile_px": 256},
]
LENSES = [Lens(), Lens(shift_x=0.3, shift_y=-0.7), Lens(orthographic_height_m=7.5)]


def as_spots(samples: ViewSamples, lights: Lights, seed: int) -> Lights:
    """Cones of 0.5 to 90 degrees whose edge passes just behind a sample; every fifth light stays a point."""
    rng = np.random.default_rng(seed)
    seen = oracles.in_world_space(samples.camera, samples.position_m[samples.valid])
    if not len(seen):
        return lights
    to_sample = seen[rng.integers(len(seen), size=lights.n_lights)] - lights.position_m
    to_sample += 1e-9 * rng.normal(size=to_sample.shape)  # a light may be in the sample
    to_sample /= np.linalg.norm(to_sample, axis=1, keepdims=True)
    aside = np.cross(to_sample, rng.normal(size=to_sample.shape))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    half_deg = rng.choice([0.5, 1.0, 20.0, 45.0, 89.0, 90.0], lights.n_lights)
    angle = np.radians(half_deg)[:, None] * (1 - 10 ** rng.uniform(-4, -1, (lights.n_lights, 1)))
    cosines = np.array([cone_cosines(0.9 * half, half) for half in half_deg])
    point = np.arange(lights.n_lights) % 5 == 0
    return replace(
        lights,
        direction=np.cos(angle) * to_sample + np.sin(angle) * aside,
        cos_inner=np.where(point, -1.0, cosines[:, 0]),
        cos_outer=np.where(point, -2.0, cosines[:, 1]),
    )


def reaching(samples: ViewSamples, lights: Lights, facing: bool) -> np.ndarray:
    """Lights within range of each pixel, their cones and (where `facing`) the surface's side included, `[h, w, N]`."""
    reaches = oracles.windows(samples, lights) > 0
    rotation = samples.camera.view_from_world[:3, :3]
    for n, light_m in enumerate(oracles.in_view_space(samples.camera, lights.position_m)):
        to_light = light_m - samples.position_m.astype(np.float64)
        distance = np.linalg.norm(to_light, axis=-1)
        if lights.is_spot[n]:
            reaches[..., n] &= -(to_light @ (rotation @ lights.direction[n])) > lights.cos_outer[n] * distance
        if facing:
            reaches[..., n] &= (to_light * samples.normal).sum(-1) > 0
    return reaches


@pytest.mark.parametrize("case", CASES)
@given(
    camera=cameras(),
    lens=st.sampled_from(LENSES),
    grid=st.sampled_from(GRIDS),
    kinds=st.one_of(st.just(LIGHT_KINDS), st.sampled_from([(kind,) for kind in LIGHT_KINDS])),
    seed=seeds,
)
@settings(max_examples=12, deadline=None)
def test_no_light_that_lights_a_sample_is_missed(case, camera, lens, grid, kinds, seed):
    technique, params, spots = CASES[case]
    if technique == "tiled_deferred":
        grid = {name: value for name, value in grid.items() if name.startswith("tile")}
    elif grid.get("depth_slices", 0) == 0:
        grid = {"depth_slices": 24, **grid}  # cubic cells of a narrow view are too many for a test
    samples = through(random_samples(camera, seed), lens)
    lights = adversarial_lights(samples, 37, kinds, seed)
    if spots:
        lights = as_spots(samples, lights, seed)
    listed, cluster = listed_lights(configuration(technique, {**params, **grid}), FrameInputs(samples, lights))
    needed = reaching(samples, lights, facing=spots)[samples.valid]
    missing = np.argwhere(needed & ~listed[cluster[samples.valid]])
    assert not len(missing), f"{len(missing)} missing, first: valid sample {missing[0][0]}, light {missing[0][1]}"


def counted_slowly(samples: ViewSamples, lights: Lights, config) -> ListedPairs:
    listed, cluster = listed_lights(config, FrameInputs(samples, lights))
    reaches = reaching(samples, lights, facing=False)
    needed = np.zeros_like(listed)
    for y, x in np.argwhere(samples.valid):
        needed[cluster[y, x]] |= reaches[y, x]
    return ListedPairs(int(listed.sum()), int((needed & listed).sum()))


@pytest.mark.parametrize("case", ["exact", "explicit_cones"])
def test_pairs_that_reach_are_those_of_a_loop_over_samples(case):
    technique, params, spots = CASES[case]
    config = configuration(technique, params)
    samples = surface_samples(a_camera(), 3)
    lights = adversarial_lights(samples, 37, ("anywhere", "behind"), 3)
    lights = as_spots(samples, lights, 3) if spots else lights
    inputs = FrameInputs(samples, lights)
    env, _ = run_stages(config, inputs, until="assign")
    found = listed_pairs(env["positions"], env["clusters"], env["assign"], inputs.lights)
    expected = counted_slowly(samples, lights, config)
    # Spots whose edge passes a sample by 1e-4 of their angle: float32 directions decide a few of them.
    assert found.listed == expected.listed and abs(found.reaching - expected.reaching) <= (2 if spots else 0)
    assert 0 < found.reaching < found.listed and found.ratio == found.listed / found.reaching


def test_nothing_listed_is_nothing_in_vain():
    assert ListedPairs(0, 0).ratio == 1 and ListedPairs(3, 0).ratio == math.inf and ListedPairs(6, 3).ratio == 2


def test_the_exact_cull_lists_at_most_one_percent_more_than_exact_geometry():
    """Cells are 0.02 pixels and 1e-5 of their depth larger than they are: 0.3 % of a cell of 32 pixels."""
    rng = np.random.default_rng(0)
    camera = a_camera(Viewport(256, 144), 0.5, 50.0)
    samples = samples_at(camera, rng.uniform(1, 30, (144, 256)), rng.random((144, 256)) < 0.02, rng)
    seen = samples.position_m[samples.valid].astype(np.float64)
    position_m = seen[rng.integers(len(seen), size=200)] + rng.normal(size=(200, 3))
    lights = lights_in_view(camera, position_m, rng.uniform(0.3, 3, 200), rng)
    inputs = FrameInputs(samples, lights)
    env, _ = run_stages(configuration("volume_tiled_bvh", {**VOLUME, "cull": "frustum"}), inputs, until="assign")
    key = np.asarray(env["clusters"].key)[: int(env["clusters"].n_clusters)]
    growth, _ = oracles.n_slices(camera, 32, 0, camera.far_m)
    px = 2 * camera.tan_half_y / 144
    exact = 0
    for k, j, i in zip(key // 40, key // 8 % 5, key % 8, strict=True):
        left, right = (-camera.tan_half_x + min(32 * column, 256) * px for column in (i, i + 1))
        top, bottom = (camera.tan_half_y - min(32 * row, 144) * px for row in (j, j + 1))
        corners = oracles.cell_corners((left, right, bottom, top), *(0.5 * growth ** float(s) for s in (k, k + 1)))
        exact += int((oracles.distances_to_cell(position_m, corners) <= lights.range_m).sum())
    total = int(env["assign"].total)
    assert exact > 1000 and exact <= total <= 1.01 * exact
