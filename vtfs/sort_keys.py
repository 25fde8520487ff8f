"""Sorting keys: XLA's sort, a radix sort digit by digit, and van Oosten's (2017, ch. 5) runs merged by merge path.

All three are stable and give the same order; which is fastest depends on the device.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from vtfs.bit_lists import n_bits_set, starts_of

RUN = 256
"""Keys that are sorted together before runs are merged (van Oosten 2017, ch. 5)."""

DIGIT_BITS = 4
_BLOCK = 32  # keys that one count of digits covers

Words = tuple[UInt32[Array, " keys"], ...]
"""Keys of one or more 32-bit words, the most significant first."""

Method = Literal["xla", "radix", "merge_path"]


def sorted_order(keys: Words, method: Method | None = None) -> Int[Array, " keys"]:
    """Places of the keys in ascending order; equal keys keep theirs.

    **Arguments:**

    - `method`: `FASTEST` of the device unless given.
    """
    return SORTS[method or FASTEST.get(jax.default_backend(), "xla")](keys)


def xla_order(keys: Words) -> Int[Array, " keys"]:
    """XLA's own sort, with the place as payload."""
    place = jnp.arange(keys[0].shape[0], dtype=jnp.int32)
    return jax.lax.sort((*keys, place), num_keys=len(keys), is_stable=True)[-1]


def radix_order(keys: Words) -> Int[Array, " keys"]:
    """Least significant digit first, four bits a pass: counts of each block of 32 keys, a scan, and a scatter.

    A pass is skipped where all keys have the same digit, as in the upper bits of 30-bit codes.
    """
    n_keys = keys[0].shape[0]
    if n_keys < 2:
        return jnp.arange(n_keys, dtype=jnp.int32)
    words = jnp.stack(keys)
    last = len(keys) - 1
    passes = 32 // DIGIT_BITS

    def sort_by_digit(k, order):
        word = words[last - k // passes]
        digit = (word >> (k % passes * DIGIT_BITS).astype(jnp.uint32)) & jnp.uint32(2**DIGIT_BITS - 1)
        return jax.lax.cond(
            jnp.all(digit == digit[0]), lambda: order, lambda: _scattered_by(digit[order].astype(jnp.int32), order)
        )

    return jax.lax.fori_loop(0, len(keys) * passes, sort_by_digit, jnp.arange(n_keys, dtype=jnp.int32))


def _scattered_by(digit: Int[Array, " keys"], order: Int[Array, " keys"]) -> Int[Array, " keys"]:
    """One stable counting sort."""
    n_keys, n_digits = digit.shape[0], 2**DIGIT_BITS
    n_blocks = -(-n_keys // _BLOCK)
    # Padding has the largest digit and comes last: it stays at the end and is cut off.
    block = jnp.pad(digit, (0, n_blocks * _BLOCK - n_keys), constant_values=n_digits - 1).reshape(n_blocks, _BLOCK)
    lane = jnp.arange(_BLOCK, dtype=jnp.uint32)
    # Bit i of a word: key i of the block has this digit.
    is_digit = block[:, None, :] == jnp.arange(n_digits)[:, None]
    words = jnp.sum(is_digit.astype(jnp.uint32) << lane, axis=2, dtype=jnp.uint32)
    start, _ = starts_of(n_bits_set(words).T.reshape(-1))
    start = start.reshape(n_digits, n_blocks)
    row = jnp.arange(n_blocks, dtype=jnp.int32)[:, None]
    before = words[row, block] & ((jnp.uint32(1) << lane) - jnp.uint32(1))
    target = (start[block, row] + n_bits_set(before)).reshape(-1)[:n_keys]
    return jnp.zeros_like(order).at[target].set(order, unique_indices=True)


def merge_path_order(keys: Words) -> Int[Array, " keys"]:
    """Runs of 256 keys by counting how many come before each, then merges of neighbouring runs.

    Merge path: each place of a merged run finds by bisection how many of its predecessors come from the left run
    (van Oosten 2017, Alg. 5.2 and 5.3, with `<=`, without which the merge is not stable).
    """
    n_keys = keys[0].shape[0]
    if n_keys < 2:
        return jnp.arange(n_keys, dtype=jnp.int32)
    n_runs = 1 << (-(-n_keys // RUN) - 1).bit_length()
    # Padding has the largest key and comes last: stability keeps it at the end.
    largest = jnp.uint32(2**32 - 1)
    padded = tuple(jnp.pad(word, (0, n_runs * RUN - n_keys), constant_values=largest) for word in keys)
    order = _sorted_runs(tuple(word.reshape(n_runs, RUN) for word in padded)).reshape(-1)
    sorted_keys = tuple(word[order] for word in padded)

    def merge(level, state):
        order, sorted_keys = state
        source = _merge_sources(sorted_keys, jnp.int32(RUN) << level, RUN.bit_length() + level)
        return order[source], tuple(word[source] for word in sorted_keys)

    order, _ = jax.lax.fori_loop(0, n_runs.bit_length() - 1, merge, (order, sorted_keys))
    return order[:n_keys]


def _sorted_runs(runs: tuple[UInt32[Array, "runs 256"], ...]) -> Int[Array, "runs 256"]:
    """Each run by itself: a key's place is the number of keys that come before it."""
    n_runs = runs[0].shape[0]
    lane = jnp.arange(RUN, dtype=jnp.int32)

    def place_of(words: tuple[UInt32[Array, " 256"], ...]) -> Int[Array, " 256"]:
        mine, others = tuple(word[:, None] for word in words), tuple(word[None, :] for word in words)
        comes_before = _less(others, mine) | (~_less(mine, others) & (lane[None, :] < lane[:, None]))
        return jnp.sum(comes_before, axis=1, dtype=jnp.int32)

    place = jax.lax.map(place_of, runs, batch_size=min(n_runs, 64))
    first = jnp.arange(n_runs, dtype=jnp.int32)[:, None] * RUN
    inverse = jnp.zeros(n_runs * RUN, jnp.int32)
    return inverse.at[(first + place).reshape(-1)].set((first + lane).reshape(-1), unique_indices=True).reshape(-1, RUN)


def _merge_sources(keys: Words, run: Int[Array, ""], n_steps: Int[Array, ""]) -> Int[Array, " keys"]:
    """Where each place of the merged pairs of runs takes its key from; `n_steps` halve a run to nothing."""
    n_keys = keys[0].shape[0]
    place = jnp.arange(n_keys, dtype=jnp.int32)
    left = place // (2 * run) * (2 * run)
    right, rank = left + run, place - left

    def at(index):
        return tuple(word[jnp.clip(index, 0, n_keys - 1)] for word in keys)

    def halve(_, bounds):
        low, high = bounds
        middle = (low + high) // 2
        # More than `middle` of the first `rank` keys are from the left if its next is not above the last right one.
        from_left = ~_less(at(right + rank - 1 - middle), at(left + middle))
        searching = low < high
        return jnp.where(searching & from_left, middle + 1, low), jnp.where(searching & ~from_left, middle, high)

    bounds = jnp.maximum(rank - run, 0), jnp.minimum(rank, run)
    n_left, _ = jax.lax.fori_loop(0, n_steps, halve, bounds)
    a, b = left + n_left, right + rank - n_left
    take_left = (n_left < run) & ((rank - n_left >= run) | ~_less(at(b), at(a)))
    return jnp.where(take_left, a, b)


def _less(a: tuple[UInt32[Array, "*n"], ...], b: tuple[UInt32[Array, "*n"], ...]) -> Bool[Array, "*n"]:
    """Lexicographic."""
    less = a[-1] < b[-1]
    for word_a, word_b in zip(a[-2::-1], b[-2::-1], strict=True):
        less = (word_a < word_b) | ((word_a == word_b) & less)
    return less


SORTS: dict[str, Callable[[Words], Int[Array, " keys"]]] = {
    "xla": xla_order,
    "radix": radix_order,
    "merge_path": merge_path_order,
}

FASTEST: dict[str, Method] = {"cpu": "radix", "gpu": "xla"}
"""As measured by `benchmarks/light_assignment.py`."""
