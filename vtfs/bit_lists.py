"""Lists of set bits: how everything here that is sparse becomes dense again.

XLA on a CPU takes 23 ns to scatter an element and 24 ns to scan one, but next to nothing to compare
one. So a predicate over rows of up to 64 children is packed into words, one scan runs over the rows,
and each place of the output finds its row by bisection and its bit by counting: 20 ns for each element
that is *found*, nothing for the many that are not.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

WORD_BITS = 32

_SATURATED = 2**30


def pack_bits(mask: Bool[Array, "*rows bits"]) -> UInt32[Array, "*rows words"]:
    """Bits of each row as 32-bit words, lowest first; `bits` is at most 32, or a multiple of 32."""
    n_bits = mask.shape[-1]
    width = min(n_bits, WORD_BITS)
    words = mask.reshape(*mask.shape[:-1], n_bits // width, width).astype(jnp.uint32)
    return jnp.sum(words << jnp.arange(width, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)


def n_bits_set(words: UInt32[Array, "*n"]) -> Int[Array, "*n"]:
    return jax.lax.population_count(words).astype(jnp.int32)


def bits_below(bit: Int[Array, "*n"]) -> UInt32[Array, "*n"]:
    """A word with all bits below `bit` set; `bit` in `[0, 31]`."""
    return (jnp.uint32(1) << bit.astype(jnp.uint32)) - jnp.uint32(1)


def nth_bit_set(word: UInt32[Array, "*n"], n: Int[Array, "*n"]) -> Int[Array, "*n"]:
    """Position of the `n`-th set bit (from 0); meaningless where there are not so many."""
    position = jnp.zeros_like(n)
    for width in (16, 8, 4, 2, 1):
        below = n_bits_set((word >> position.astype(jnp.uint32)) & jnp.uint32((1 << width) - 1))
        further = n >= below
        n = jnp.where(further, n - below, n)
        position = jnp.where(further, position + width, position)
    return position


def last_not_above(ascending: Int[Array, " rows"], value: Int[Array, "*n"]) -> Int[Array, "*n"]:
    """Index of the last entry that is at most `value`, where the first one is. Bisection."""
    n_steps = max((ascending.shape[0] - 1).bit_length(), 1)

    def halve(i, low):
        candidate = low + (1 << (n_steps - 1 - i))
        value_there = ascending[jnp.minimum(candidate, ascending.shape[0] - 1)]
        return jnp.where((candidate < ascending.shape[0]) & (value_there <= value), candidate, low)

    # A GPU runs the unrolled steps as one kernel; on a CPU they would only take seconds to compile.
    unroll = jax.default_backend() != "cpu"
    return jax.lax.fori_loop(0, n_steps, halve, jnp.zeros_like(value), unroll=unroll)


_WINDOW = 32
_WINDOWS_AT_MOST = 3  # of 32 compares each: beyond, bisecting is faster


def last_not_above_in_order(ascending: Int[Array, " rows"], value: Int[Array, " n"]) -> Int[Array, " n"]:
    """`last_not_above` of values that ascend too, for a CPU: every 32nd value is bisected, and those between compare
    themselves with the few entries between. 9 ns a value for 19, where there are some ten rows to 32 values.
    """
    value = value.reshape(-1, _WINDOW)
    heads = last_not_above(ascending, jnp.concatenate([value[:, 0], value[-1:, -1]]))
    low, span = heads[:-1], jnp.max(heads[1:] - heads[:-1])
    padded = jnp.concatenate([ascending, jnp.full(_WINDOW, jnp.iinfo(jnp.int32).max)])

    def add_window(k, row):
        first = jnp.minimum(low + 1 + k * _WINDOW, ascending.shape[0])
        window = padded[first[:, None] + jnp.arange(_WINDOW)]
        return row + jnp.sum(window[:, None, :] <= value[:, :, None], axis=2, dtype=jnp.int32)

    def by_windows():
        n_windows = (span + _WINDOW - 1) // _WINDOW
        return jax.lax.fori_loop(0, n_windows, add_window, jnp.broadcast_to(low[:, None], value.shape))

    return jax.lax.cond(
        span <= _WINDOWS_AT_MOST * _WINDOW, by_windows, lambda: last_not_above(ascending, value)
    ).reshape(-1)


def starts_of(counts: Int[Array, " rows"]) -> tuple[Int[Array, " rows"], Int[Array, ""]]:
    """Exclusive scan and total."""
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    return ends - counts, ends[-1]


def set_bits(
    words: UInt32[Array, "rows words"], start: Int[Array, " rows"], place: Int[Array, " places"]
) -> tuple[Int[Array, " places"], Int[Array, " places"]]:
    """Row and bit of the set bits number `place`, in order of rows and of bits within a row.

    `start` is `starts_of` the rows' counts; `place` ascends. Places past the end give some valid row and bit.
    """
    in_windows = jax.default_backend() == "cpu" and place.shape[0] % _WINDOW == 0
    row = (last_not_above_in_order if in_windows else last_not_above)(start, place)
    n = place - start[row]
    bit = jnp.zeros_like(n)
    word = words[row, 0]
    for w in range(1, words.shape[1]):
        before = n_bits_set(word)
        here = n >= before
        n = jnp.where(here, n - before, n)
        word = jnp.where(here, words[row, w], word)
        bit = jnp.where(here, w * WORD_BITS, bit)
    return row, bit + jnp.minimum(nth_bit_set(word, n), WORD_BITS - 1)


Columns = tuple[Int[Array, " capacity"], ...]


def gather_hits(
    n_rows: Int[Array, ""],
    test: Callable[[Int[Array, " chunk"]], Bool[Array, "chunk bits"]],
    emit: Callable[[Int[Array, " chunk"], Int[Array, " chunk"]], Columns],
    n_columns: int,
    capacity: int,
    chunk: int,
) -> tuple[Columns, Int[Array, ""]]:
    """Test rows in chunks, and list what passes, in order.

    The loops run as often as there are rows and hits: a capacity costs memory, not time.

    **Arguments:**

    - `test`: which bits of the given rows pass.
    - `emit`: what to write for each hit, from its row and its bit.

    **Returns:**

    Columns of `capacity + chunk` entries, and how many hits there are, also where that is more than
    `capacity`: then the columns are meaningless.
    """

    def words_of(row):
        mask = test(jnp.minimum(row, n_rows - 1)) & (row < n_rows)[:, None]
        return pack_bits(mask), (row,)

    columns, total, _ = list_bits(
        n_rows, words_of, lambda row, bit: emit(row[0], bit), n_columns, jnp.zeros(0, jnp.int32), capacity, chunk
    )
    return columns, total


def list_bits(
    n_rows: Int[Array, ""],
    words_of: Callable[[Int[Array, " chunk"]], tuple[UInt32[Array, "chunk words"], Columns]],
    emit: Callable[[Columns, Int[Array, " chunk"]], Columns],
    n_columns: int,
    mark: Int[Array, " marks"],
    capacity: int,
    chunk: int,
    most_rows: int | None = None,
) -> tuple[Columns, Int[Array, ""], Int[Array, " marks"]]:
    """List the bits that are set in the words of rows, in order.

    Where `chunk` holds all rows and all hits there is no loop: on a GPU each step of a loop waits for the host.

    **Arguments:**

    - `words_of`: words of the given rows, zero past `n_rows`, and what is to be known of a row where it is listed.
    - `emit`: what to write for each hit, from what is known of its row and from its bit.
    - `mark`: rows whose place in the lists is wanted.
    - `most_rows`: static bound of `n_rows`.

    **Returns:**

    Columns of `capacity + chunk` entries (`capacity` without loops); the hits there are, also where they are more
    than `capacity`: then the rest is meaningless; the hits in rows before each mark.
    """

    def words_and_starts(row):
        words, known = words_of(row)
        start, n_hits = starts_of(jnp.sum(n_bits_set(words), axis=-1, dtype=jnp.int32))
        return words, known, start, n_hits

    def hits(words, known, start, n_hits, place):
        row, bit = set_bits(words, start, jnp.minimum(place, jnp.maximum(n_hits - 1, 0)))
        return emit(tuple(column[row] for column in known), bit)

    def hits_before(mark, start, n_hits):
        inside = jnp.minimum(mark, start.shape[0] - 1)
        return jnp.where(mark < start.shape[0], start[inside], n_hits)

    if most_rows is not None and max(most_rows, capacity) <= chunk:
        words, known, start, n_hits = words_and_starts(jnp.arange(most_rows, dtype=jnp.int32))
        columns = hits(words, known, start, n_hits, jnp.arange(capacity, dtype=jnp.int32))
        return columns, n_hits, hits_before(mark, start, n_hits)

    lane = jnp.arange(chunk, dtype=jnp.int32)

    def list_chunk(state):
        first, columns, total, before = state
        words, known, start, n_hits = words_and_starts(first + lane)

        def write(state):
            done, columns = state
            values = hits(words, known, start, n_hits, done + lane)
            # Starts are within the capacity and columns a chunk longer, so no write is clamped.
            columns = tuple(
                jax.lax.dynamic_update_slice(column, value, (total + done,))
                for column, value in zip(columns, values, strict=True)
            )
            return done + chunk, columns

        # What does not fit is counted, not written: the caller throws the result away.
        end = jnp.minimum(n_hits, capacity - total)
        _, columns = jax.lax.while_loop(lambda state: state[0] < end, write, (jnp.int32(0), columns))
        before = jnp.where(mark >= first, total + hits_before(jnp.maximum(mark - first, 0), start, n_hits), before)
        # Saturates: past 2^31 a total would be negative, and look as if it fitted.
        return first + chunk, columns, jnp.minimum(total, _SATURATED) + n_hits, before

    empty = tuple(jnp.zeros(capacity + chunk, jnp.int32) for _ in range(n_columns))
    _, columns, total, before = jax.lax.while_loop(
        lambda state: state[0] < n_rows, list_chunk, (jnp.int32(0), empty, jnp.int32(0), jnp.zeros_like(mark))
    )
    return columns, total, before
