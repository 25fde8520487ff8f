"""Lights on the device, and lists made from ordered pairs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import a_camera, lights_in_view, no_lights, seeds
from vtfs.light_lists import lists_from_pairs, reach_of_cutoff, view_lights

some = settings(max_examples=40, deadline=None)
lists_jit = jax.jit(lists_from_pairs, static_argnums=4)


@given(lengths=st.lists(st.integers(0, 9), min_size=13, max_size=13), seed=seeds)
@some
def test_each_list_is_its_clusters_pairs(lengths, seed):
    rng = np.random.default_rng(seed)
    cluster = np.repeat(np.arange(13), lengths)
    total = len(cluster)
    light = rng.integers(0, 99, 128)
    garbage = rng.integers(-5, 20, 128)  # what lies behind the last pair is anything
    ordered = np.where(np.arange(128) < total, np.resize(cluster, 128) if total else 0, garbage)
    lists = lists_jit(jnp.asarray(ordered, jnp.int32), jnp.asarray(light), jnp.int32(total), jnp.bool_(False), 13)
    assert lists.count.tolist() == lengths and lists.offset.tolist() == (np.cumsum(lengths) - lengths).tolist()
    assert (lists.index == light).all()


@given(light_cutoff=st.floats(0, 0.99))
@some
def test_the_window_at_the_reach_of_a_cutoff_is_the_cutoff(light_cutoff):
    share = float(reach_of_cutoff(np.float32(light_cutoff)))  # type: ignore[arg-type]
    assert (1 - share**4) ** 2 == pytest.approx(light_cutoff, rel=1e-4, abs=1e-6)


def test_lights_are_in_view_space_relative_to_the_eye():
    """100 km from the origin, float32 world coordinates would be off by millimetres."""
    camera = a_camera(eye_m=(1e5, -3e4, 1e5))
    rng = np.random.default_rng(0)
    lights = lights_in_view(camera, rng.normal(size=(37, 3)), rng.uniform(1, 2, 37), rng, spots=True)
    row = np.asarray(view_lights(lights, camera).row)
    assert row.shape == (37, 16) and row.dtype == np.float32
    assert np.abs(row[:, :3] - oracles.in_view_space(camera, lights.position_m)).max() < 1e-6
    assert np.abs(row[:, 8:11] - lights.direction @ camera.view_from_world[:3, :3].T).max() < 1e-6
    assert np.allclose(row[:, 7] * row[:, 3], 1, rtol=1e-6) and np.allclose(row[:, 4:7], lights.colour, rtol=1e-6)


@pytest.mark.parametrize("light_cutoff", [0.0, 0.5, 0.99])
def test_a_light_without_range_meets_nothing_and_is_black(light_cutoff):
    camera, rng = a_camera(), np.random.default_rng(0)
    lights = lights_in_view(camera, rng.normal(size=(3, 3)), np.array([0.0, 1.0, 1e-30]), rng)
    device = view_lights(lights, camera)
    spheres = device.spheres(np.float32(light_cutoff))  # type: ignore[arg-type]
    assert np.isinf(np.asarray(spheres.x_m)).tolist() == [True, False, False]
    row = np.asarray(device.row)
    assert np.isfinite(row).all() and (row[0, 4:7] == 0).all() and (row[1, 4:7] > 0).any()


def test_no_lights_are_one_black_light_that_meets_nothing():
    device = view_lights(no_lights(), a_camera())
    assert device.n_lights == 1 and (np.asarray(device.row)[0, 4:7] == 0).all()
    assert np.isinf(np.asarray(device.spheres(np.float32(0)).x_m)).all()  # type: ignore[arg-type]
