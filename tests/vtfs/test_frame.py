"""Capacities that grow, counts against slow loops, and what compiles a program and what does not."""

import jax
import numpy as np
import pytest
from jax._src import monitoring

from tests import oracles
from tests.strategies import (
    SMALL,
    a_camera,
    lights_in_view,
    nearby_lights,
    no_lights,
    samples_in_slices,
    surface_samples,
)
from vtfs import frame, frame_sizes
from vtfs.configurations import configuration
from vtfs.frame import image_on_host, render, run_stages
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_sizes import CapacityError, Sizes, rounded_up

BATCH = 1024


def a_config(technique, **params):
    narrow = {"branching": 8} if technique == "volume_tiled_bvh" else {}
    return configuration(technique, {"batch": BATCH, **narrow, **params})


LISTED = ("tiled_deferred", "volume_tiled_bvh")


def a_frame(seed=0, viewport=SMALL, n_lights=37, **camera):
    samples = surface_samples(a_camera(viewport, **camera), seed)
    return samples, nearby_lights(samples, n_lights, seed)


# --- capacities --------------------------------------------------------------------------------------------------


def test_capacities_are_few_and_hold_what_is_needed():
    assert [rounded_up("pairs", n) for n in (0, 2**20, 2**20 + 1, 2**23 + 1)] == [2**20, 2**20, 2**23, 2**26]
    assert [rounded_up("blocks", n) for n in (1, 2**10, 2**10 + 1)] == [2**10, 2**10, 2**12]
    assert all(rounded_up("cells", n) % 32 == 0 for n in (0, 2**18 + 1))
    with pytest.raises(CapacityError, match="pairs: 268,435,457 needed"):
        rounded_up("pairs", 2**28 + 1)


@pytest.mark.parametrize("name", ["cells", "blocks", "pairs"])
def test_a_capacity_is_refused_only_where_none_holds_what_is_needed(name):
    assert rounded_up(name, getattr(frame_sizes._LARGEST, name) // 2) >= getattr(frame_sizes._LARGEST, name) // 2


@pytest.mark.parametrize("technique", LISTED)
def test_what_does_not_fit_is_run_again_and_is_the_same(technique, monkeypatch):
    inputs = FrameInputs(*a_frame())
    config = a_config(technique, tile_px=4)
    expected, roomy = run_stages(config, inputs)[0], count(config, inputs)[0].technique
    image = image_on_host(expected["shade_opaque"], inputs)
    monkeypatch.setattr(frame_sizes, "_FIRST", Sizes(cells=32, blocks=64, pairs=256))
    env, sizes = run_stages(config, inputs)
    lists, same = env["assign"], expected["assign"]
    n_clusters, total = int(env["clusters"].n_clusters), int(lists.total)
    assert sizes.pairs >= total > 256 and sizes.blocks >= int(env["clusters"].n_blocks)
    assert sizes.blocks in [64 * 4**k for k in range(9)] and sizes.pairs in [256 * 8**k for k in range(9)]
    assert not env["clusters"].overflowed and not lists.overflowed
    assert n_clusters == int(expected["clusters"].n_clusters)
    assert (lists.count[:n_clusters] == same.count[:n_clusters]).all() and (
        lists.index[:total] == same.index[:total]
    ).all()
    assert np.abs(image_on_host(env["shade_opaque"], inputs) - image).max() <= 1e-6 * image.max()
    counts = count(config, inputs, sizes)[0].technique
    assert {n: c for n, c in counts.items() if n != "memory"} == {n: c for n, c in roomy.items() if n != "memory"}


@pytest.mark.parametrize("technique", ["tiled_deferred"])
def test_a_program_with_too_little_room_says_so(technique):
    inputs = FrameInputs(*a_frame())
    config = a_config(technique, tile_px=4)
    sizes = run_stages(config, inputs)[1]
    for wrong, overflows in (
        (Sizes(sizes.cells, sizes.blocks, 64), True),
        (Sizes(sizes.cells, 2, sizes.pairs), True),
        (sizes, False),
    ):
        program = frame.frame_program(technique, frame.planned(config, wrong), False)
        assert bool(program(inputs.environment(config))[1]) == overflows


def test_sizes_that_are_given_are_kept_where_they_fit():
    inputs = FrameInputs(*a_frame())
    given = Sizes(2**21, 2**12, 2**23)
    assert run_stages(configuration("tiled_deferred", {"batch": BATCH}), inputs, given, until="clusters")[1] == given


# --- counts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("technique", "branching"), [("tiled_deferred", 0), ("volume_tiled_bvh", 8)])
def test_all_counts_of_a_frame_against_slow_loops(technique, branching):
    tile_px, n_slices = 8, 1 if technique == "tiled_deferred" else 7
    samples, slices = samples_in_slices(SMALL, n_slices, 0)
    lights = nearby_lights(samples, 37, 1)
    params = {"tile_px": tile_px, "batch": BATCH}
    if branching:
        params |= {"depth_slices": n_slices, "branching": branching, "bounds": "explicit"}
    config, inputs = configuration(technique, params), FrameInputs(samples, lights)
    counts, lengths = count(config, inputs)
    found = counts.at_batch(BATCH)

    cells = oracles.cells(samples, tile_px, slices)
    keys = sorted(cells)
    centre = oracles.in_view_space(samples.camera, lights.position_m)
    inside = [samples.position_m[tuple(np.transpose(cells[key]))] for key in keys]
    low, high = (
        np.array([bound(axis=0) for bound in bounds]) for bounds in ([p.min for p in inside], [p.max for p in inside])
    )
    if technique == "tiled_deferred":  # whole tiles, between the nearest and the farthest sample
        low, high = tile_boxes(samples, tile_px, keys, low, high)
    meets = oracles.spheres_in_boxes(centre, lights.range_m, low, high)
    assert_sure = oracles.spheres_in_boxes(centre, lights.range_m, low - 1e-3, high + 1e-3)
    of_sample = np.zeros(samples.valid.shape, int)
    for n, key in enumerate(keys):
        of_sample[tuple(np.transpose(cells[key]))] = meets[n].sum()
    # Pairs within a millimetre of touching may be decided either way by float32.
    spare = int((assert_sure & ~meets).sum())
    assert abs(found["light_cluster_pairs"] - int(meets.sum())) <= spare
    columns, rows = -(-SMALL.width_px // tile_px), -(-SMALL.height_px // tile_px)
    assert found["cells_total"] == columns * rows * n_slices
    assert found["clusters_occupied"] == len(keys) and found["samples"] == samples.valid.sum()
    if spare == 0:
        assert found["lighting_computations"] == of_sample.sum() and (lengths.of_sample == of_sample).all()
        assert found["divergence"] == oracles.divergence(of_sample, tile_px)
        assert found["longest_list"] == meets.sum(1).max()
        assert found["dropped_at_cap_32"] == np.maximum(meets.sum(1) - 32, 0).sum()
    assert found["lighting_computations"] == lengths.of_sample.sum()
    of_block = lengths.of_block.tolist()
    assert (found["shading_lanes"], found["shading_steps"]) == oracles.shading_work(
        of_block, BATCH // 32, counts.sizes.blocks
    )
    assert found["bytes_moved"] == samples.valid.sum() * (12 + 1 + 11 * 4 + 12) + 8 * found["light_cluster_pairs"]
    if technique == "tiled_deferred":
        assert found["leaf_tests"] == len(keys) * 37 and found["tree_tests"] == 0
        assert found["assign_steps"] == -(-len(keys) * 2 // BATCH)
    else:
        walked = walk_of_lights(samples, lights, low, high, branching)
        assert found["tree_tests"] == walked.child_tests and found["leaf_tests"] == walked.item_tests
    assert all(type(value) is int for value in found.values())


def tile_boxes(samples, tile_px, keys, low, high):
    camera, viewport = samples.camera, samples.camera.viewport
    corners = []
    for n, (_, j, i) in enumerate(keys):
        x = [
            (2 * min(px, viewport.width_px) / viewport.width_px - 1) * camera.tan_half_x
            for px in (i * tile_px, (i + 1) * tile_px)
        ]
        y = [
            (1 - 2 * min(px, viewport.height_px) / viewport.height_px) * camera.tan_half_y
            for px in (j * tile_px, (j + 1) * tile_px)
        ]
        depths = -high[n, 2], -low[n, 2]
        corners.append([(a * d, b * d, -d) for a in x for b in y for d in depths])
    return np.min(corners, axis=1), np.max(corners, axis=1)


def walk_of_lights(samples, lights, low, high, branching):
    """Lights in Morton order of float32 centres, walked down slowly with each cluster's box."""
    centre = oracles.in_view_space(samples.camera, lights.position_m).astype(np.float32)
    first, last = centre.min(0), centre.max(0)
    cell = np.clip((centre - first) * (np.float32(1023) / (last - first)), 0, 1023).astype(int)
    order = sorted(range(37), key=lambda n: oracles.morton_code(*map(int, cell[n])))
    light_low, light_high = centre[order] - lights.range_m[order, None], centre[order] + lights.range_m[order, None]

    def descend(cluster, items):
        return bool(
            (low[cluster] <= light_high[items].max(0)).all() and (light_low[items].min(0) <= high[cluster]).all()
        )

    return oracles.walk(37, branching, len(low), descend, lambda cluster, light: False)


def test_without_lights_nothing_is_tested_or_listed():
    samples, _ = a_frame()
    for technique in LISTED:
        counts = count(a_config(technique), FrameInputs(samples, no_lights()))[0].technique
        for name in ("light_cluster_pairs", "lighting_computations", "leaf_tests", "tree_tests", "lights"):
            assert counts[name] == 0, (technique, name)


def test_a_batch_changes_only_the_counts_of_chunks():
    inputs = FrameInputs(*a_frame())
    one, other = (count(a_config("volume_tiled_bvh", batch=batch), inputs)[0].at_batch(batch) for batch in (BATCH, 32))
    assert {name for name in one if one[name] != other[name]} <= {
        "shading_lanes",
        "shading_steps",
        "assign_steps",
        "memory",
    }


# --- programs ----------------------------------------------------------------------------------------------------


class Compiles:
    """Counts the programs that the backend compiles while it is active."""

    def __enter__(self):
        self.n = 0
        jax.monitoring.register_event_duration_secs_listener(self._hear)
        return self

    def _hear(self, event, *_, **__):
        self.n += event == "/jax/core/compile/backend_compile_duration"

    def __exit__(self, *_):
        monitoring.unregister_event_duration_listener(self._hear)


@pytest.mark.parametrize("technique", ["forward", "volume_tiled_bvh"])
def test_values_that_fix_no_shape_compile_nothing(technique):
    config = a_config(technique)
    render(config, FrameInputs(*a_frame()))
    count(config, FrameInputs(*a_frame()))
    with Compiles() as compiled:
        for name, values in (("tile_px", (16, 17, 200)), ("depth_slices", (1, 24)), ("light_cutoff", (0.1, 0.5))):
            if name in config.params:
                for value in values:
                    render(config.replaced(**{name: value}), FrameInputs(*a_frame()))
                    count(config.replaced(**{name: value}), FrameInputs(*a_frame()))
        render(config, FrameInputs(*a_frame(seed=9)))
        render(config, FrameInputs(*a_frame(fov_y_deg=20.0, near_m=0.5, far_m=np.inf, eye_m=(50.0, 0.0, 0.0))))
    assert compiled.n == 0


@pytest.mark.parametrize(
    ("name", "value"), [("branching", 4), ("batch", 2048), ("bounds", "packed"), ("gbuffer", "float16")]
)
def test_values_that_fix_a_shape_compile_their_stages_and_no_others(name, value):
    config = a_config("volume_tiled_bvh")
    inputs = FrameInputs(*a_frame())
    run_stages(config, inputs)
    inputs.gbuffer("float16", with_hidden=False)
    depends = {
        "branching": {"build_tree", "assign"},
        "batch": {"assign", "shade_opaque"},
        "bounds": {"clusters"},
        "gbuffer": {"shade_opaque"},
    }
    with Compiles() as compiled:
        run_stages(config.replaced(**{name: value}), inputs)
    assert compiled.n == len(depends[name])
    with Compiles() as compiled:
        run_stages(config.replaced(**{name: value}), inputs)
    assert compiled.n == 0


def test_a_point_light_and_a_spot_have_rows_of_their_own():
    samples, lights = a_frame()
    rng = np.random.default_rng(0)
    spots = lights_in_view(samples.camera, np.zeros((3, 3)), np.ones(3), rng, spots=True)
    assert FrameInputs(samples, lights).lights.row.shape[1] == 8
    assert FrameInputs(samples, spots).lights.row.shape[1] == 16
