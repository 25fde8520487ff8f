"""Capacities of a frame's programs: few sizes, so that few programs are compiled."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from vtfs.input_error import InputError


class CapacityError(InputError):
    """A frame needs more than the largest capacity: it is not run, and nothing is dropped."""


@dataclass(frozen=True)
class Sizes:
    """Capacities that fix array shapes, rounded up to few sizes so that few programs are compiled.

    Loops run as often as there is work, so a generous capacity costs memory and little time.

    - `cells`: of the grid's page table; `blocks`: of clusters and of their blocks; `pairs`: of the
      (cluster, light) pairs and of every level on the way to them.
    - `shadow`: of shadow techniques, see `shadow_sizes`; `alpha`: the same of alpha casters, empty where none cast.
    """

    cells: int
    blocks: int
    pairs: int
    shadow: tuple[int, ...] = ()
    alpha: tuple[int, ...] = ()

    def covering(self, other: Sizes) -> Sizes:
        """What holds both; of the same technique and plan."""
        return Sizes(
            max(self.cells, other.cells),
            max(self.blocks, other.blocks),
            max(self.pairs, other.pairs),
            _covering(self.shadow, other.shadow),
            _covering(self.alpha, other.alpha),
        )


def _covering(a: tuple[int, ...], b: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(itertools.starmap(max, itertools.zip_longest(a, b, fillvalue=0)))


NO_SIZES = Sizes(0, 0, 0)
"""Of techniques without lists."""


_FIRST = Sizes(cells=2**18, blocks=2**10, pairs=2**20)
_RATIO = Sizes(cells=8, blocks=4, pairs=8)
_LARGEST = Sizes(cells=2**30, blocks=2**26, pairs=2**28)


def rounded_up(name: str, needed: int) -> int:
    """The capacity that holds `needed`: the first size times powers of 4 or 8.

    **Raises:** `CapacityError` where no capacity does.
    """
    capacity, ratio, largest = (getattr(sizes, name) for sizes in (_FIRST, _RATIO, _LARGEST))
    while capacity < needed:
        capacity *= ratio
    if needed > largest:
        raise CapacityError(f"{name}: {needed:,} needed, at most {largest:,} fit; use larger tiles or fewer lights.")
    return min(capacity, largest)
