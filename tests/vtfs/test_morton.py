"""Morton codes against a loop over bits."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests import oracles
from tests.strategies import seeds
from vtfs.bounds import Sphere
from vtfs.morton import morton_codes, morton_codes_fine

some = settings(max_examples=40, deadline=None)
cells = st.integers(0, 1023)
morton_codes_jit, morton_codes_fine_jit = jax.jit(morton_codes), jax.jit(morton_codes_fine)


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


def fine_codes_of(centres, low, high):
    x, y, z = np.asarray(centres, np.float32).T
    words = morton_codes_fine_jit(Sphere(x, y, z, np.zeros_like(x)), np.float32(low), np.float32(high))  # type: ignore[arg-type]
    high_word, low_word = (np.asarray(word).astype(object) for word in words)
    return [int(a) << 32 | int(b) for a, b in zip(high_word, low_word, strict=True)]


fine_cells = st.integers(0, 2**21 - 1)


@given(st.tuples(fine_cells, fine_cells, fine_cells))
@example((2**21 - 1, 0, 0))
@example((0, 2**21 - 1, 0))
@example((0, 0, 2**21 - 1))
@some
def test_21_bits_are_interleaved_in_two_words(cell):
    code = fine_codes_of([cell], [0, 0, 0], [2**21 - 1] * 3)[0]
    assert code == sum((cell[axis] >> s & 1) << 3 * s + axis for axis in range(3) for s in range(21))


def test_fine_codes_tell_apart_what_coarse_ones_do_not():
    centres = [[0.5, 0.5, 0.5], [0.5 + 2**-20, 0.5, 0.5], [1, 1, 1]]
    fine, coarse = fine_codes_of(centres, [0, 0, 0], [1, 1, 1]), codes_of(centres, [0, 0, 0], [1, 1, 1])
    assert coarse[0] == coarse[1] and fine[0] < fine[1] and fine[2] == 2**63 - 1
    assert fine_codes_of([[-9, -9, -9], [np.inf, 9, 9]], [0, 0, 0], [1, 1, 1]) == [0, 2**63 - 1]
    assert fine_codes_of([[1, 2, 3]] * 2, [1, 2, 3], [1, 2, 3]) == [0, 0]
