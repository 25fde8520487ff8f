"""Morton codes against a loop over bits."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import seeds
from vtfs.bounds import Sphere
from vtfs.morton import morton_codes

some = settings(max_examples=40, deadline=None)
cells = st.integers(0, 1023)
morton_codes_jit = jax.jit(morton_codes)


def codes_of(centres, low, high):
    x, y, z = np.asarray(centres, np.float32).T
    return np.asarray(morton_codes_jit(Sphere(x, y, z, np.zeros_like(x)), np.float32(low), np.float32(high)))  # type: ignore[arg-type]


@given(st.tuples(cells, cells, cells))
@some
def test_bits_are_interleaved(cell):
    assert codes_of([cell], [0, 0, 0], [1023, 1023, 1023])[0] == oracles.morton_code(*cell)


@given(seed=seeds, scale=st.sampled_from([1e-3, 1.0, 1e5]), offset=st.sampled_from([0.0, -7.0, 1e5]))
@some
def test_positions_are_quantised_and_truncated(seed, scale, offset):
    rng = np.random.default_rng(seed)
    low, high = np.float32(offset - scale * rng.random(3)), np.float32(offset + scale * rng.random(3))
    centres = np.float32(low + (high - low) * rng.random((37, 3)))
    extent = np.maximum(high.astype(np.float64) - low, 1e-30)
    cell = (centres.astype(np.float64) - low) / extent * 1023
    codes = codes_of(centres, low, high)
    for axis in range(3):
        found = np.array([sum((int(code) >> 3 * s + axis & 1) << s for s in range(10)) for code in codes])
        # Truncation of a value that float32 rounds may go either way within a thousandth of a whole number.
        assert ((found >= np.floor(cell[:, axis] - 1e-3)) & (found <= np.floor(cell[:, axis] + 1e-3))).all()


def test_the_box_itself_gets_the_first_and_the_last_code_and_outside_is_clamped():
    low, high = [-3.0, 1.0, 5.0], [-1.0, 1.5, 100.0]
    assert codes_of([low, high], low, high).tolist() == [0, 2**30 - 1]
    assert codes_of([[-9, -9, -9], [999, 999, 999]], low, high).tolist() == [0, 2**30 - 1]


def test_an_axis_without_extent_counts_for_nothing():
    codes = codes_of([[0, 5, 0], [1023, 5, 1023]], [0, 5, 0], [1023, 5, 1023])
    assert codes.tolist() == [0, oracles.morton_code(1023, 0, 1023)]
    assert codes_of([[1, 2, 3]] * 2, [1, 2, 3], [1, 2, 3]).tolist() == [0, 0]


def test_lights_at_infinity_do_not_disturb_the_others():
    centres = [[0, 0, 0], [np.inf, 1, 1], [1023, 1023, 1023]]
    codes = codes_of(centres, [0, 0, 0], [1023, 1023, 1023])
    assert codes[0] == 0 and codes[2] == 2**30 - 1
    assert jnp.asarray(codes).dtype == jnp.uint32
