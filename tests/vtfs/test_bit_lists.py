"""Bits packed, counted and listed, against Python loops; what does not fit is counted, never written."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.strategies import seeds
from vtfs.bit_lists import (
    bits_below,
    gather_hits,
    last_not_above,
    n_bits_set,
    nth_bit_set,
    pack_bits,
    set_bits,
    starts_of,
)

some = settings(max_examples=40, deadline=None)
words = st.integers(0, 2**32 - 1)
nth_bit_set_jit, last_not_above_jit = jax.jit(nth_bit_set), jax.jit(last_not_above)


@pytest.mark.parametrize("n_bits", [2, 8, 32, 64])
def test_bits_are_packed_lowest_first(n_bits):
    mask = np.random.default_rng(0).random((5, n_bits)) < 0.5
    packed = np.asarray(pack_bits(jnp.asarray(mask))).astype(object)
    for row, bits in zip(packed, mask, strict=True):
        assert sum(int(word) << 32 * w for w, word in enumerate(row)) == sum(1 << int(b) for b in np.flatnonzero(bits))


@given(word=words)
@example(word=0)
@example(word=2**32 - 1)
@example(word=2**31)
@some
def test_the_nth_set_bit_is_found(word):
    bits = [b for b in range(32) if word >> b & 1]
    assert int(n_bits_set(jnp.uint32(word))) == len(bits)
    found = nth_bit_set_jit(jnp.full(32, word, jnp.uint32), jnp.arange(32))
    assert found[: len(bits)].tolist() == bits


def test_bits_below():
    assert bits_below(jnp.arange(32)).tolist() == [2**b - 1 for b in range(32)]


@pytest.mark.parametrize("n_rows", [1, 2, 37, 64])
@given(seed=seeds)
@some
def test_the_last_entry_not_above_is_found(n_rows, seed):
    rng = np.random.default_rng(seed)
    ascending = np.concatenate([[0], np.sort(rng.integers(0, 20, n_rows - 1))])
    values = np.arange(25)
    expected = [max(i for i in range(n_rows) if ascending[i] <= value) for value in values]
    found = last_not_above_jit(jnp.asarray(ascending, jnp.int32), jnp.asarray(values, jnp.int32))
    assert found.tolist() == expected


@jax.jit
def all_set_bits(mask):
    packed = pack_bits(mask)
    start, total = starts_of(jnp.sum(n_bits_set(packed), axis=1))
    return *set_bits(packed, start, jnp.arange(mask.size + 5)), total


@pytest.mark.parametrize("n_bits", [8, 64])
@given(seed=seeds, share=st.sampled_from([0.0, 0.02, 0.5, 1.0]))
@some
def test_set_bits_are_listed_in_order(n_bits, seed, share):
    mask = np.random.default_rng(seed).random((37, n_bits)) < share
    rows, bits, total = all_set_bits(jnp.asarray(mask))
    expected = np.argwhere(mask)
    assert int(total) == len(expected)
    assert np.array_equal(np.stack([rows, bits], axis=1)[: len(expected)], expected)
    assert ((rows >= 0) & (rows < 37) & (bits >= 0) & (bits < max(n_bits, 32))).all()  # also past the end


@jax.jit
def hits_of(mask, n_rows):
    return gather_hits(n_rows, lambda row: mask[row], lambda row, bit: (row, bit), 2, capacity=256, chunk=64)


@given(seed=seeds, n_rows=st.integers(0, 300), share=st.sampled_from([0.0, 0.05, 0.1, 0.5, 1.0]))
@example(seed=0, n_rows=32, share=1.0)  # fills the capacity exactly
@example(seed=0, n_rows=64, share=1.0)  # one chunk that is more than the capacity
@some
def test_hits_are_gathered_in_order_or_counted(seed, n_rows, share):
    mask = np.random.default_rng(seed).random((300, 8)) < share
    (row, bit), total = hits_of(jnp.asarray(mask), jnp.int32(n_rows))
    expected = np.argwhere(mask[:n_rows])
    assert int(total) == len(expected)
    if len(expected) <= 256:
        assert np.array_equal(np.stack([row, bit], axis=1)[: len(expected)], expected)


def test_more_hits_than_32_bits_count_do_not_look_like_few():
    """2^31 + 128 hits: a wrapped total is negative, and "does not fit" would not be seen."""

    def all_pass(row):
        return jnp.ones((row.shape[0], 64), bool)

    gather = jax.jit(lambda n: gather_hits(n, all_pass, lambda row, bit: (row,), 1, capacity=64, chunk=2**20)[1])
    assert int(gather(jnp.int32(2**25 + 2))) > 64
