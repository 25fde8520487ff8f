"""No light that reaches a sample is ever missing from its list; and the lists hold no more than they must."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import (
    BRANCHINGS,
    LIGHT_KINDS,
    SMALL,
    a_camera,
    adversarial_lights,
    cameras,
    lights_in_view,
    no_lights,
    random_samples,
    samples_at,
    seeds,
    surface_samples,
)
from vtfs.bounds import Aabb, Sphere
from vtfs.clusters import Clusters
from vtfs.configurations import configuration
from vtfs.frame import run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.input_error import InputError
from vtfs.light_assignment.brute_force import assign_brute_force
from vtfs.light_assignment.light_tree import assign_tree, light_tree, reduce_lights, sort_lights
from vtfs.techniques import REGISTRY

BATCH = 1024  # small chunks: a chunk's cost does not depend on how much of it is used


def listed_lights(config, inputs):
    """Lights of each cluster, bool `[clusters, lights]`, and each pixel's cluster, after checking the lists."""
    env, _ = run_stages(config, inputs, until="assign")
    clusters, lists = env["clusters"], env["assign"]
    n_clusters, n_lights = int(clusters.n_clusters), inputs.n_lights
    offset, count, index = (np.asarray(a) for a in (lists.offset, lists.count, lists.index))
    assert not lists.overflowed and lists.total == count.sum() <= len(index)
    assert (offset == np.cumsum(count) - count).all() and (count[n_clusters:] == 0).all()
    used = index[: int(lists.total)]
    assert ((used >= 0) & (used < max(n_lights, 1))).all()
    listed = np.zeros((n_clusters, n_lights), int)
    np.add.at(listed, (np.repeat(np.arange(len(count)), count), used), 1)
    assert listed.max(initial=0) <= 1  # never twice
    cluster = np.asarray(clusters.block_cluster)[np.asarray(clusters.block_of_sample)]
    return listed > 0, oracles.as_image(cluster, inputs.viewport)


def check_none_is_missing(technique, params, samples, lights, light_cutoff=0.0):
    params = {"batch": BATCH, "light_cutoff": light_cutoff, **params}
    if technique == "volume_tiled_bvh":
        params = {"branching": 8, **params}
    listed, cluster = listed_lights(configuration(technique, params), FrameInputs(samples, lights))
    reaches = oracles.windows(samples, lights) > np.float32(light_cutoff)
    missing = np.argwhere(reaches[samples.valid] & ~listed[cluster[samples.valid]])
    assert not len(missing), f"{len(missing)} missing, first: valid sample {missing[0][0]}, light {missing[0][1]}"


kinds = st.one_of(st.just(LIGHT_KINDS), st.sampled_from([(kind,) for kind in LIGHT_KINDS]))
tiles = st.sampled_from([2, 3, 8, 16, 32, 256])
slices = st.sampled_from([0, 0, 1, 24, 1024])
some = settings(max_examples=30, deadline=None)
few = settings(max_examples=8, deadline=None)


@given(camera=cameras(), tile_px=tiles, kinds=kinds, seed=seeds)
@some
def test_tiled_deferred_misses_no_light(camera, tile_px, kinds, seed):
    samples = random_samples(camera, seed)
    lights = adversarial_lights(samples, 37, kinds, seed)
    check_none_is_missing("tiled_deferred", {"tile_px": tile_px}, samples, lights)


def too_many_cells(camera, tile_px, depth_slices):
    """A narrow view over a long range has more cubic cells than a test should make flags for."""
    far_m = min(camera.far_m, camera.near_m * 1e4)
    _, n_slices = oracles.n_slices(camera, tile_px, depth_slices, far_m)
    return n_slices * (SMALL.width_px // tile_px + 1) * (SMALL.height_px // tile_px + 1) > 2**21


@given(
    camera=cameras(),
    tile_px=tiles,
    depth_slices=slices,
    kinds=kinds,
    bounds=st.sampled_from(["implicit", "explicit"]),
    seed=seeds,
)
@some
def test_volume_tiled_bvh_misses_no_light(camera, tile_px, depth_slices, kinds, bounds, seed):
    assume(not too_many_cells(camera, tile_px, depth_slices))
    samples = random_samples(camera, seed)
    lights = adversarial_lights(samples, 37, kinds, seed)
    params = {"tile_px": tile_px, "depth_slices": depth_slices, "branching": 8, "bounds": bounds}
    check_none_is_missing("volume_tiled_bvh", params, samples, lights)


@pytest.mark.parametrize("branching", [2, 32])
@given(camera=cameras(), kinds=kinds, seed=seeds)
@few
def test_every_branching_misses_no_light(branching, camera, kinds, seed):
    assume(not too_many_cells(camera, 16, 0))
    samples = random_samples(camera, seed)
    lights = adversarial_lights(samples, 200, kinds, seed)
    check_none_is_missing("volume_tiled_bvh", {"tile_px": 16, "branching": branching}, samples, lights)


@pytest.mark.parametrize("technique", ["tiled_deferred", "volume_tiled_bvh"])
@pytest.mark.parametrize("kind", LIGHT_KINDS)
def test_one_light_of_each_kind_is_not_missed(technique, kind):
    samples = random_samples(a_camera(), 5)
    check_none_is_missing(technique, {}, samples, adversarial_lights(samples, 1, (kind,), 7))


@given(light_cutoff=st.floats(0, 0.99), seed=seeds)
@example(light_cutoff=0.99, seed=1)
@few
def test_a_cutoff_drops_no_light_whose_window_is_above_it(light_cutoff, seed):
    """Lights whose window at a sample is just above the cut-off."""
    samples = surface_samples(a_camera(), seed)
    rng = np.random.default_rng(seed)
    seen = samples.position_m[samples.valid].astype(np.float64)
    seen = seen[rng.integers(len(seen), size=37)]
    direction = rng.normal(size=(37, 3))
    distance = 10 ** rng.uniform(-1, 1, 37)
    position = seen + direction * (distance / np.linalg.norm(direction, axis=1))[:, None]
    reach = (1 - np.sqrt(float(np.float32(light_cutoff)))) ** 0.25
    lights = lights_in_view(samples.camera, position, distance / reach * (1 + 10 ** rng.uniform(-8, -6, 37)), rng)
    for bounds in ("implicit", "explicit"):
        params = {"branching": 8, "bounds": bounds}
        check_none_is_missing("volume_tiled_bvh", params, samples, lights, light_cutoff)


@pytest.mark.parametrize("scale_m", [1.0, 1e5])
def test_explicit_bounds_of_single_samples_miss_no_light(scale_m):
    """A box that is one point has no slack of its own: the light's position is rounded to float32 as well."""
    samples = random_samples(a_camera(near_m=scale_m, far_m=2 * scale_m), 0)
    lights = adversarial_lights(samples, 37, ("touching",), 0)
    params = {"tile_px": 2, "depth_slices": 1024, "branching": 8, "bounds": "explicit"}
    check_none_is_missing("volume_tiled_bvh", params, samples, lights)


@pytest.mark.parametrize("fov_y_deg", [0.1, 170, 179, 179.9])
def test_extreme_angles_miss_no_light(fov_y_deg):
    """Slopes of a thousandth or of a thousand: the samples of a wide view are far beside their depth."""
    camera = a_camera(fov_y_deg=fov_y_deg)
    for seed in range(5):
        samples = random_samples(camera, seed)
        lights = adversarial_lights(samples, 37, ("touching", "anywhere"), seed)
        check_none_is_missing("volume_tiled_bvh", {"depth_slices": 24, "branching": 8}, samples, lights)
        check_none_is_missing("tiled_deferred", {"tile_px": 8}, samples, lights)


@pytest.mark.parametrize("technique", ["tiled_deferred", "volume_tiled_bvh"])
def test_samples_of_a_users_gbuffer_at_the_edge_of_their_pixel_miss_no_light(technique):
    """`load_gbuffer` takes positions up to 0.01 pixels outside their pixel; lights end just behind them."""
    camera = a_camera()
    rng = np.random.default_rng(0)
    shape = (SMALL.height_px, SMALL.width_px)
    samples = surface_samples(camera, 0)
    off = rng.choice([-0.509, 0.509], (*shape, 2)) * 2 * camera.tan_half_y / SMALL.height_px
    samples.position_m[..., :2] += (off * -samples.position_m[..., 2:]).astype(np.float32)
    seen = samples.position_m[samples.valid].astype(np.float64)
    seen = seen[rng.integers(len(seen), size=37)]
    # Away from the sample's tile, sideways, in either direction: some lie beyond the tile's edge.
    outward = rng.choice([-1.0, 1.0], (37, 2))
    distance = 10 ** rng.uniform(-3, -1, 37)
    position = seen + np.concatenate([outward * distance[:, None], np.zeros((37, 1))], axis=1)
    lights = lights_in_view(camera, position, distance * np.sqrt(2) * (1 + 1e-4), rng)
    check_none_is_missing(technique, {"tile_px": 2}, samples, lights)


def test_no_lights_and_no_samples_make_empty_lists():
    samples = surface_samples(a_camera(), 0)
    nothing = samples_at(
        samples.camera, np.ones(samples.valid.shape), np.zeros(samples.valid.shape, bool), np.random.default_rng(0)
    )
    for technique in ("tiled_deferred", "volume_tiled_bvh"):
        config = configuration(technique, {"batch": BATCH})
        listed, _ = listed_lights(config, FrameInputs(samples, no_lights()))
        assert listed.shape[1] == 0 and len(listed) > 0
        listed, _ = listed_lights(config, FrameInputs(nothing, adversarial_lights(samples, 37, LIGHT_KINDS, 0)))
        assert listed.shape == (0, 37)


def test_a_grid_with_too_many_cells_is_refused():
    samples = surface_samples(a_camera(fov_y_deg=0.0001, near_m=0.001, far_m=1e6), 0)
    with pytest.raises(InputError, match=r"tile_px=2 with depth_slices=0 makes [\d,]+ cells"):
        run_stages(configuration("volume_tiled_bvh", {"tile_px": 2}), FrameInputs(samples, no_lights()))


# --- the assigners by themselves ---------------------------------------------------------------------------------

N_BOXES, CAPACITY = 50, 2**14


def clusters_of(low, high):
    """Clusters with given boxes, `[B, 3]` float32."""
    zeros = jnp.zeros(len(low), jnp.int32)
    box = Aabb(*(jnp.asarray(a[:, c]) for a in (low, high) for c in range(3)))
    n = jnp.int32(len(low))
    return Clusters(zeros, box, n, zeros, zeros, n, n, jnp.zeros((1, 32), jnp.int32), jnp.bool_(False))


def as_spheres(centre, radius):
    x_m, y_m, z_m = jnp.asarray(centre.T)
    return Sphere(x_m, y_m, z_m, jnp.asarray(radius))


def by_brute_force(spheres, clusters, branching, chunk):
    return assign_brute_force(spheres, clusters, CAPACITY, chunk)


def by_tree(spheres, clusters, branching, chunk):
    return assign_tree(light_tree(spheres, branching), clusters, CAPACITY, chunk)


assign = jax.jit(lambda how, *args: how(*args), static_argnums=(0, 3, 4))


def boxes_and_spheres(n_lights, spread, seed):
    """Boxes and spheres of all sizes, some of which just touch; some spheres meet nothing."""
    rng = np.random.default_rng(seed)
    low = rng.normal(size=(N_BOXES, 3)) * spread
    high = low + 10 ** rng.uniform(-3, 1, (N_BOXES, 3))
    low, high = low.astype(np.float32), high.astype(np.float32)
    centre = (rng.normal(size=(n_lights, 3)) * spread).astype(np.float32)
    box = rng.integers(N_BOXES, size=n_lights)
    outside = np.maximum(np.maximum(low[box] - centre, centre - high[box]), 0).astype(np.float64)
    touching = np.sqrt((outside**2).sum(1)) * (1 + rng.uniform(-2e-6, 2e-6, n_lights))
    radius = np.where(rng.random(n_lights) < 0.5, touching, 10 ** rng.uniform(-2, 1, n_lights)).astype(np.float32)
    centre[rng.random(n_lights) < 0.1, 0] = np.inf
    return low, high, centre, np.where(np.isinf(centre[:, 0]), 0, radius).astype(np.float32)


def lists_of(lists):
    offset, count, index = (np.asarray(a) for a in (lists.offset, lists.count, lists.index))
    return [index[o : o + c] for o, c in zip(offset, count, strict=True)]


@pytest.mark.parametrize("how", [by_brute_force, by_tree], ids=["brute_force", "tree"])
@pytest.mark.parametrize(("n_lights", "branching"), [(1, 2), (37, 64), (200, 8)])
@given(spread=st.sampled_from([0.1, 3.0, 1e5]), seed=seeds)
@few
def test_lists_are_those_of_float64_within_the_slack(how, n_lights, branching, spread, seed):
    low, high, centre, radius = boxes_and_spheres(n_lights, spread, seed)
    spheres = as_spheres(centre, radius)
    lists, _ = assign(how, spheres, clusters_of(low, high), branching, 256)
    must = oracles.spheres_in_boxes(centre, radius, low, high)
    # 1e-6 on the squared radius, and as much for rounding, is 1e-6 on the radius.
    may = oracles.spheres_in_boxes(centre, radius, low, high, share=1 + 1e-6)
    for found, needed, allowed in zip(lists_of(lists), must, may, strict=True):
        assert set(np.flatnonzero(needed)) <= set(found) <= set(np.flatnonzero(allowed))
        assert len(found) == len(set(found))


@pytest.mark.parametrize("how", [by_brute_force, by_tree], ids=["brute_force", "tree"])
@pytest.mark.parametrize("chunk", [32, 2**20])
def test_the_chunk_never_changes_a_list(how, chunk):
    low, high, centre, radius = boxes_and_spheres(200, 3.0, 3)
    spheres, clusters = as_spheres(centre, radius), clusters_of(low, high)
    expected, counts = assign(how, spheres, clusters, 8, 256)
    lists, same_counts = assign(how, spheres, clusters, 8, chunk)
    assert [a.tolist() for a in lists_of(lists)] == [a.tolist() for a in lists_of(expected)]
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), counts, same_counts))


def test_brute_force_lists_in_ascending_order():
    low, high, centre, radius = boxes_and_spheres(200, 3.0, 4)
    lists, _ = assign(by_brute_force, as_spheres(centre, radius), clusters_of(low, high), 32, 256)
    assert all((np.diff(found) > 0).all() for found in lists_of(lists))


def test_more_tests_than_32_bits_count_are_not_taken_for_none():
    """2^18 clusters against 2^18 lights: 2^31 rows of 32 lights."""
    n = 2**18
    zeros, whole = jnp.zeros(n), jnp.zeros(n, jnp.int32)
    box = Aabb(zeros, zeros, zeros, zeros, zeros, zeros)
    clusters = Clusters(
        whole, box, jnp.int32(n), whole, whole, jnp.int32(n), jnp.int32(n), whole[None], jnp.bool_(False)
    )
    try:
        lists, _ = jax.jit(assign_brute_force, static_argnums=(2, 3))(
            Sphere(zeros, zeros, zeros, zeros + 1), clusters, 1024, 1024
        )
    except (InputError, RuntimeError):  # refusing is right too
        return
    assert bool(lists.overflowed)


def test_lights_without_range_do_not_stretch_the_box_of_lights():
    x = jnp.array([jnp.inf, 1.0, 3.0])
    low, high = reduce_lights(Sphere(x, jnp.array([100.0, 2, 5]), jnp.array([-9.0, 7, 6]), jnp.ones(3)))
    assert low.tolist() == [1, 2, 6] and high.tolist() == [3, 5, 7]


@given(st.lists(st.integers(0, 5), min_size=37, max_size=37))
@few
def test_lights_are_sorted_and_equal_codes_keep_their_order(codes):
    order = np.asarray(sort_lights(jnp.array(codes, jnp.uint32)))
    assert order.tolist() == sorted(range(37), key=lambda i: codes[i])


def test_each_technique_of_the_registry_that_lists_lights_is_tested_here():
    """By its lists: what else they have in common with others is tested with the images."""
    listing = [technique for technique in REGISTRY.values() if technique.lists == "clusters"]
    tested = {stage for name in ("tiled_deferred", "volume_tiled_bvh") for stage in REGISTRY[name].stages}
    assert {stage for technique in listing if not technique.casts_shadows for stage in technique.stages} == tested
    for technique in listing:
        names = [stage.name for stage in technique.stages]
        assert set(technique.stages[: names.index("assign") + 1]) <= tested
    assert set(BRANCHINGS) == {2, 8, 32, 64}
