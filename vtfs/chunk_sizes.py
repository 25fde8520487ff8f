"""How much of a stage is done at once: by `batch`, or where that is 0 as suits the device."""

from __future__ import annotations

import jax

from vtfs.bit_lists import WORD_BITS
from vtfs.frame_plan import Walked
from vtfs.shading import chunk_blocks

_TESTS_AT_ONCE = {"cpu": 2**19, "gpu": 2**22}
"""`batch = 0` means all queries at once, as far as their rows of boxes stay in the cache of a CPU (12 MB) or leave
the memory of a GPU to others (100 MB)."""

_WORDS_AT_ONCE = {"cpu": 2**14, "gpu": 2**23}
"""The same, in words of 32 tests, where lists are refined: one light is loaded for all cells of a group."""

_MAX_TESTS_AT_ONCE = 2**24  # their boxes take 400 MB
_MAX_VOLUME_RUNS = 2**16  # runs whose G-buffer is gathered at once: 100 MB
_PAIRS_AT_ONCE = {"cpu": 2**15, "gpu": 2**20}


def walk_chunk(batch: int, branching: int, pairs: int) -> int:
    """(cluster, node) pairs tested at once."""
    if batch:
        return min(batch, _MAX_TESTS_AT_ONCE // branching)
    return min(pairs, _TESTS_AT_ONCE.get(jax.default_backend(), 2**22) // branching)


def assign_chunk(walked: Walked, batch: int, branching: int, pairs: int) -> int:
    """Rows tested at once: (cluster, node) pairs, or words of 32 (cluster, light) pairs."""
    if walked == "groups":
        return batch or _WORDS_AT_ONCE.get(jax.default_backend(), 2**23)
    return walk_chunk(batch, branching if walked == "tree" else WORD_BITS, pairs)


def volume_chunk(pairs: int, batch: int) -> int:
    """(light, run) pairs shaded at once."""
    return min(chunk_blocks(pairs, batch), _MAX_VOLUME_RUNS)


def approximate_chunk(pairs: int) -> int:
    """(cluster, light) pairs whose variation is bounded at once."""
    return min(pairs, _PAIRS_AT_ONCE.get(jax.default_backend(), 2**20))
