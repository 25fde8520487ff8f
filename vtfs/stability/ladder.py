"""Ladders: one kind of stress, harder from rung to rung."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Case = TypeVar("Case")


@dataclass(frozen=True)
class Rung(Generic[Case]):
    """One case of a ladder, made when it is run. `label`: what is stressed, with its unit."""

    label: str
    make: Callable[[], Case]


@dataclass(frozen=True)
class Ladder(Generic[Case]):
    """Rungs of one kind of stress, the easiest first.

    - `name`: stable, in records; `title`: for a reader; `source`: `built-in`, or the user's scene by name.
    """

    name: str
    title: str
    source: str
    rungs: tuple[Rung[Case], ...]


def power_of_ten(exponent: int) -> str:
    return f"1e{exponent}" if exponent else "1"
