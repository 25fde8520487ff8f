"""Every way to sort gives NumPy's stable order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.strategies import seeds
from vtfs.bounds import Sphere
from vtfs.light_assignment.light_tree import light_tree, order_lights, sort_lights
from vtfs.morton import morton_codes
from vtfs.sort_keys import FASTEST, SORTS, sorted_order

some = settings(max_examples=15, deadline=None)

jitted = {name: jax.jit(sort) for name, sort in SORTS.items()}


def keys_of(kind, n_keys, n_words, rng):
    whole = rng.integers(0, 2**32, (n_words, n_keys), dtype=np.uint32)
    if kind == "few":
        return whole % 3
    if kind == "one point":
        return np.broadcast_to(whole[:, :1], whole.shape).copy()
    if kind == "extremes":
        return np.where(whole % 2, np.uint32(2**32 - 1), np.uint32(0))
    if kind == "descending":
        return np.sort(whole, axis=1)[:, ::-1].copy()
    return whole


def expected_order(keys):
    return np.lexsort(keys[::-1])  # stable; its last key counts most


@pytest.mark.parametrize("method", list(SORTS))
@pytest.mark.parametrize(("n_keys", "n_words"), [(2, 1), (256, 1), (1111, 2)])
@given(kind=st.sampled_from(["any", "few", "one point", "extremes", "descending"]), seed=seeds)
@example(kind="extremes", seed=0)  # keys as large as the padding
@some
def test_the_order_is_numpys_and_stable(method, n_keys, n_words, kind, seed):
    keys = keys_of(kind, n_keys, n_words, np.random.default_rng(seed))
    assert np.array_equal(jitted[method](tuple(jnp.asarray(word) for word in keys)), expected_order(keys))


@pytest.mark.parametrize("method", list(SORTS))
@pytest.mark.parametrize("n_keys", [0, 1])
def test_one_key_and_none(method, n_keys):
    assert jitted[method]((jnp.zeros(n_keys, jnp.uint32),)).tolist() == list(range(n_keys))


@pytest.mark.parametrize("method", ["xla", "radix"])
def test_a_million_keys(method):
    """Merging takes seconds for so many on a CPU; 1,111 keys have taken it through three levels."""
    keys = np.random.default_rng(0).integers(0, 2**30, 10**6, dtype=np.uint32)
    assert np.array_equal(jitted[method]((jnp.asarray(keys),)), np.argsort(keys, kind="stable"))


def test_a_million_lights_in_one_point_keep_their_order():
    codes = np.full(10**6, 123456789, np.uint32)
    assert np.array_equal(jitted["radix"]((jnp.asarray(codes),)), np.arange(10**6))


def test_the_devices_method_is_one_of_them():
    assert set(FASTEST.values()) <= set(SORTS)
    keys = jnp.array([3, 1, 2, 1], jnp.uint32)
    assert sorted_order((keys,)).tolist() == [1, 3, 2, 0]


# --- what is sorted for the light tree ----------------------------------------


@jax.jit
def ordered(lights, old_order, frame, resort_every):
    return order_lights(lights, old_order, frame, resort_every)


def test_lights_are_sorted_again_in_every_kth_frame_only():
    rng = np.random.default_rng(0)
    lights = Sphere(*(jnp.asarray(rng.random(37), jnp.float32) for _ in range(4)))
    low, high = (jnp.stack([f(c) for c in (lights.x_m, lights.y_m, lights.z_m)]) for f in (jnp.min, jnp.max))
    expected = sort_lights(morton_codes(lights, low, high)).tolist()
    old = jnp.arange(37)[::-1]
    for frame in range(7):
        order = ordered(lights, old, jnp.int32(frame), jnp.int32(3)).tolist()
        assert order == (expected if frame % 3 == 0 else old.tolist())


@pytest.mark.parametrize("n_lights", [0, 1, 300])
def test_duplicate_positions_keep_their_order_in_the_tree(n_lights):
    same = jnp.full(n_lights, 2.5)
    tree = light_tree(Sphere(same, same, same, same), 8)
    assert tree.light.tolist() == list(range(n_lights))
