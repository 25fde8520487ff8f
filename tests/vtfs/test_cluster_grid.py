"""Tiles and depth slices: each sample lies in its slice and in the box of its cell."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import SMALL, WIDE, a_camera, cameras, positions_of, random_samples, seeds
from vtfs.camera import Lens, Viewport
from vtfs.cluster_grid import (
    cell_boxes,
    cell_keys,
    cell_sections,
    cluster_grid,
    configured_grid,
    depth_slices,
    n_cells,
    n_keys,
    slice_depth_m,
)
from vtfs.configurations import configuration
from vtfs.input_error import InputError

some = settings(max_examples=60, deadline=None)
slices_jit = jax.jit(depth_slices)
keys_jit, boxes_jit = jax.jit(cell_keys), jax.jit(cell_boxes, static_argnums=1)
tiles = st.integers(2, 256)
all_slices = st.one_of(st.just(0), st.integers(1, 1024))


@given(
    near_m=st.floats(1e-3, 1e3),
    ratio=st.floats(1.001, 1e5),
    fov_y_deg=st.floats(0.1, 170),
    tile_px=tiles,
    n_slices=all_slices,
    share=st.floats(0, 1),
)
@example(near_m=0.1, ratio=1e4, fov_y_deg=60, tile_px=2, n_slices=0, share=0.245)  # lands one off with log for log1p
@example(near_m=0.1, ratio=1e5, fov_y_deg=60, tile_px=32, n_slices=1024, share=1.0)  # the far plane
@example(near_m=0.1, ratio=1e5, fov_y_deg=60, tile_px=32, n_slices=1024, share=0.0)  # the near plane
@some
def test_a_sample_lies_inside_its_slice(near_m, ratio, fov_y_deg, tile_px, n_slices, share):
    camera = a_camera(WIDE, near_m, near_m * ratio, fov_y_deg)
    grid = cluster_grid(camera, tile_px, n_slices, 0.0)
    growth, expected = oracles.n_slices(camera, tile_px, n_slices, camera.far_m)
    assert int(grid.depth_slices) == expected
    depth_m = float(np.float32(near_m * (camera.far_m / near_m) ** share))
    k = int(slices_jit(grid, np.float32(depth_m)))
    slack = 1e-5  # float32 logs of ratios up to 1e5
    assert 0 <= k < expected
    assert near_m * growth**k * (1 - slack) <= depth_m
    assert depth_m <= near_m * growth ** (k + 1) * (1 + slack)


@pytest.mark.parametrize(
    ("viewport", "tile_px", "ratio", "n_slices"),
    [(Viewport(1920, 1080), 32, 1e4, 276), (Viewport(1024, 1024), 8, 1e3, 770)],
)
def test_the_number_of_cubic_slices_is_the_published_one(viewport, tile_px, ratio, n_slices):
    # equations.md, section 1, "Size check"
    grid = cluster_grid(a_camera(viewport, 0.1, 0.1 * ratio, 60.0), tile_px, 0, 0.0)
    assert int(grid.depth_slices) == n_slices
    columns, rows = math.ceil(viewport.width_px / tile_px), math.ceil(viewport.height_px / tile_px)
    assert n_cells(grid, viewport) == columns * rows * n_slices


def test_a_cubic_cell_is_as_deep_as_it_is_high():
    camera = a_camera(Viewport(640, 512), 0.1, 100.0, 60.0)
    grid = cluster_grid(camera, 16, 0, 0.0)
    growth = math.exp(float(grid.log_growth))
    assert 0.1 * (growth - 1) == pytest.approx(2 * 0.1 * math.tan(math.radians(30)) / 32, rel=1e-5)


@pytest.mark.parametrize("n_slices", [0, 24])
def test_an_infinite_far_plane_ends_at_the_deepest_sample(n_slices):
    camera = a_camera(near_m=0.1, far_m=math.inf)
    grid, finite = (
        cluster_grid(camera, 8, n_slices, 50.0),
        cluster_grid(a_camera(near_m=0.1, far_m=50.0), 8, n_slices, 0.0),
    )
    assert [float(a) for a in jax.tree.leaves(grid)] == [float(a) for a in jax.tree.leaves(finite)]
    assert int(cluster_grid(camera, 8, n_slices, 0.1).depth_slices) >= 1  # no sample beyond the near plane


@pytest.mark.parametrize("viewport", [SMALL, WIDE], ids=str)
@given(camera=cameras(), tile_px=tiles, n_slices=all_slices, seed=seeds)
@some
def test_keys_name_tiles_and_slices_and_boxes_hold_their_samples(viewport, camera, tile_px, n_slices, seed):
    camera = a_camera(viewport, camera.near_m, camera.far_m, camera.fov_y_deg)
    samples = random_samples(camera, seed, valid_share=1.0)
    depth_m = -samples.position_m[..., 2]
    try:
        grid = cluster_grid(camera, tile_px, n_slices, float(depth_m.max()))
    except InputError:
        assume(False)
        raise
    columns, rows = math.ceil(viewport.width_px / tile_px), math.ceil(viewport.height_px / tile_px)
    total = columns * rows * int(grid.depth_slices)
    key = oracles.as_image(keys_jit(grid, positions_of(samples)), viewport)
    y, x = np.mgrid[: viewport.height_px, : viewport.width_px]
    assert (key % columns == x // tile_px).all() and (key // columns % rows == y // tile_px).all()
    assert (key // (columns * rows) == slices_jit(grid, depth_m)).all() and ((key >= 0) & (key < total)).all()
    box = boxes_jit(grid, viewport, jnp.asarray(key.ravel()))
    position_m = samples.position_m.reshape(-1, 3)
    for c, (low, high) in enumerate(
        ((box.low_x_m, box.high_x_m), (box.low_y_m, box.high_y_m), (box.low_z_m, box.high_z_m))
    ):
        assert ((low <= position_m[:, c]) & (position_m[:, c] <= high)).all()


@given(camera=cameras(), tile_px=st.integers(2, 40))
@settings(max_examples=20, deadline=None)
def test_boxes_are_no_larger_than_their_cells_with_slack(camera, tile_px):
    """Against the corners of the cell in float64 (van Oosten 2017, Alg. 8.1)."""
    n_slices, far_m = 24, camera.far_m if math.isfinite(camera.far_m) else 1e4 * camera.near_m
    grid = cluster_grid(camera, tile_px, n_slices, far_m)
    columns, rows = math.ceil(SMALL.width_px / tile_px), math.ceil(SMALL.height_px / tile_px)
    key = np.random.default_rng(0).integers(0, columns * rows * n_slices, 64)
    sides = np.array(jax.tree.leaves(boxes_jit(grid, SMALL, jnp.asarray(key, jnp.int32))))
    growth = (far_m / camera.near_m) ** (1 / n_slices)
    for n, (i, j, k) in enumerate(zip(key % columns, key // columns % rows, key // (columns * rows), strict=True)):
        depths = camera.near_m * growth ** float(k), camera.near_m * growth ** float(k + 1)
        edges_x = [
            (2 * min(px, SMALL.width_px) / SMALL.width_px - 1) * camera.tan_half_x
            for px in (i * tile_px, (i + 1) * tile_px)
        ]
        edges_y = [
            (1 - 2 * min(px, SMALL.height_px) / SMALL.height_px) * camera.tan_half_y
            for px in (j * tile_px, (j + 1) * tile_px)
        ]
        corners = np.array([(x * d, y * d, -d) for x in edges_x for y in edges_y for d in depths])
        # Rounding, and 0.03 pixels sideways: a user's samples may lie a little outside their pixel.
        slack = depths[1] * (5e-5 * (1 + camera.tan_half_x) + 0.03 * 2 * camera.tan_half_y / SMALL.height_px)
        low, high = sides[:3, n], sides[3:, n]
        assert (np.abs(low - corners.min(0)) <= slack).all() and (np.abs(high - corners.max(0)) <= slack).all()
        assert (low <= corners.min(0)).all() and (corners.max(0) <= high).all()


def test_more_cells_than_keys_are_refused_with_what_to_change():
    camera = a_camera(Viewport(1920, 1080), 1e-3, 1e5, 10.0)
    with pytest.raises(
        InputError, match=r"tile_px=2 with depth_slices=0 makes [\d,]+ cells.*larger tiles or fewer slices"
    ):
        cluster_grid(camera, 2, 0, 0.0)


planes_jit = jax.jit(slice_depth_m)
sections_jit = jax.jit(cell_sections, static_argnums=1)


def plane_m(scheme, near_m, far_m, n_slices, k):
    """Depth of a slice plane, from what each scheme is equal steps of."""
    share = k / n_slices
    if scheme == "self_similar":
        return math.exp(math.log(near_m) * (1 - share) + math.log(far_m) * share)
    if scheme == "linear":
        return near_m + (far_m - near_m) * share
    ndc = lambda d: far_m / (far_m - near_m) * (1 - near_m / d)  # noqa: E731  # 0 at near, 1 at far
    low, high = near_m, far_m
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if ndc(middle) < share else (low, middle)
    return low


@pytest.mark.parametrize("scheme", ["self_similar", "linear", "ndc"])
@given(
    near_m=st.floats(1e-3, 1e3),
    ratio=st.one_of(st.floats(1.0001, 2), st.floats(1.001, 1e5)),
    n_slices=st.integers(1, 1024),
    share=st.floats(0, 1),
    at_plane=st.booleans(),
)
@example(near_m=0.1, ratio=1e5, n_slices=1024, share=0.9999, at_plane=True)
@some
def test_a_sample_lies_inside_its_slice_in_every_scheme(scheme, near_m, ratio, n_slices, share, at_plane):
    camera = a_camera(WIDE, near_m, near_m * ratio)
    grid = cluster_grid(camera, 32, n_slices, 0.0, scheme)
    far_m = camera.far_m
    depth_m = near_m * ratio**share
    if at_plane:
        depth_m = plane_m(scheme, near_m, far_m, n_slices, int(share * n_slices))
    depth_m = float(np.float32(min(max(depth_m, near_m), far_m)))
    k = int(slices_jit(grid, np.float32(depth_m)))
    slack = 1e-5  # as of `cell_boxes`: the float32 planes are right to 3e-6
    assert 0 <= k < n_slices
    assert plane_m(scheme, near_m, far_m, n_slices, k) * (1 - slack) <= depth_m
    assert depth_m <= plane_m(scheme, near_m, far_m, n_slices, k + 1) * (1 + slack)
    planes = np.asarray(planes_jit(grid, np.array([k, k + 1], np.int32)), np.float64)
    expected = [plane_m(scheme, near_m, far_m, n_slices, k + i) for i in (0, 1)]
    assert np.allclose(planes, expected, rtol=slack / 2)


LENSES = [Lens(), Lens(shift_x=0.25, shift_y=-0.6), Lens(shift_x=-3.0), Lens(orthographic_height_m=12.5)]


@pytest.mark.parametrize("lens", LENSES, ids=str)
@given(
    camera=cameras(),
    tile=st.tuples(tiles, tiles),
    n_slices=st.sampled_from([1, 7, 24, 1024]),
    scheme=st.sampled_from(["self_similar", "linear", "ndc"]),
    seed=seeds,
)
@settings(max_examples=25, deadline=None)
def test_boxes_and_sections_hold_the_samples_of_their_cells(lens, camera, tile, n_slices, scheme, seed):
    camera = replace(camera, lens=lens)
    samples = random_samples(camera, seed, valid_share=1.0)
    slope = np.stack(np.meshgrid(*camera.pixel_slopes()), axis=-1)
    depth_m = -samples.position_m[..., 2]
    width = 1 if camera.is_orthographic else depth_m[..., None].astype(np.float64)
    samples.position_m[..., :2] = slope * width
    grid = cluster_grid(camera, tile, n_slices, float(depth_m.max()), scheme)
    key = oracles.as_image(keys_jit(grid, positions_of(samples)), SMALL)
    columns, rows = math.ceil(SMALL.width_px / tile[0]), math.ceil(SMALL.height_px / tile[1])
    y, x = np.mgrid[: SMALL.height_px, : SMALL.width_px]
    assert (key % columns == x // tile[0]).all() and (key // columns % rows == y // tile[1]).all()
    position_m = samples.position_m.reshape(-1, 3)
    box = boxes_jit(grid, SMALL, jnp.asarray(key.ravel()))
    low, high = (
        np.stack([box.low_x_m, box.low_y_m, box.low_z_m], 1),
        np.stack([box.high_x_m, box.high_y_m, box.high_z_m], 1),
    )
    assert ((low <= position_m) & (position_m <= high)).all()
    section = sections_jit(grid, SMALL, jnp.asarray(key.ravel()))
    at = position_m[:, :2].astype(np.float64) / (1 if camera.is_orthographic else -position_m[:, 2:].astype(np.float64))
    assert ((np.asarray(section.left) <= at[:, 0]) & (at[:, 0] <= np.asarray(section.right))).all()
    assert ((np.asarray(section.bottom) <= at[:, 1]) & (at[:, 1] <= np.asarray(section.top))).all()
    assert ((np.asarray(section.near_m) <= depth_m.ravel()) & (depth_m.ravel() <= np.asarray(section.far_m))).all()


def test_cubic_cells_of_a_parallel_view_are_linear_and_as_deep_as_tall():
    camera = replace(a_camera(Viewport(640, 512), 1.0, 100.0), lens=Lens(orthographic_height_m=64.0))
    grid = cluster_grid(camera, 16, 0, 0.0)
    assert int(grid.depth_slices) == math.ceil(99 / 2)
    planes = np.asarray(planes_jit(grid, np.arange(51, dtype=np.int32)))
    assert np.allclose(planes, 1 + 2.0 * np.arange(51), rtol=1e-6)
    box = boxes_jit(grid, camera.viewport, jnp.array([0], jnp.int32))
    assert float(box.high_y_m[0] - box.low_y_m[0]) == pytest.approx(2, rel=0.01)


@pytest.mark.parametrize(
    ("viewport", "tile", "columns"),
    [
        (Viewport(1280, 720), (80, 80), (16, 9)),
        (Viewport(1366, 768), (86, 86), (16, 9)),
        (Viewport(1920, 1081), (120, 121), (16, 9)),
        (Viewport(33, 17), (3, 2), (11, 9)),
    ],
)
def test_a_named_grid_has_tiles_as_large_as_it_needs(viewport, tile, columns):
    params = configuration("volume_tiled_bvh", {"grid": "16x9x24", "tile_px": 7}).params
    grid = configured_grid(a_camera(viewport), params, 0.0)
    assert (int(grid.tile_px_x), int(grid.tile_px_y), int(grid.depth_slices)) == (*tile, 24)
    assert tuple(map(int, grid.tiles(viewport))) == columns and n_cells(grid, viewport) == columns[0] * columns[1] * 24


def test_bins_of_normals_multiply_keys_not_cells():
    params = configuration("volume_tiled_bvh", {"normal_bins": 3, "depth_slices": 7}).params
    grid = configured_grid(a_camera(), params, 0.0)
    assert n_keys(grid, SMALL) == 54 * n_cells(grid, SMALL) == 54 * 2 * 7
    one = configured_grid(a_camera(), configuration("tiled_deferred", {"tile_px_y": 8}).params, 0.0, one_slice=True)
    assert n_keys(one, SMALL) == n_cells(one, SMALL) == 2 * 3


@pytest.mark.parametrize("scheme", ["linear", "ndc"])
def test_no_slices_of_other_schemes_are_refused(scheme):
    with pytest.raises(InputError, match=f"`depth_scheme` = '{scheme}' with depth_slices=0"):
        cluster_grid(a_camera(), 32, 0, 0.0, scheme)
