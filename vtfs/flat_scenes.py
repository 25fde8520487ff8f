"""Room before a flat scene: in its own plane a light lights nothing, and an eye sees nothing."""

from __future__ import annotations

import numpy as np

FLATTEST = 0.01
"""A box is flat along an axis where it is thinner than this share of its longest side."""

ROOM = 0.1
"""How thick it is made there, as a share of its longest side."""

Box = tuple[np.ndarray, np.ndarray]
"""Low and high corner, float64 `[3]` each."""


def with_room(box_m: Box, seen_from_m: np.ndarray | None = None) -> Box:
    """A scene's box, with room along the axes where it is flat.

    **Arguments:**

    - `seen_from_m`: a point on whose side the room is, above where it lies in the plane; on both sides unless given.
    """
    low, high = box_m
    longest = (high - low).max()
    room = np.where(high - low < FLATTEST * longest, ROOM * longest, 0.0)
    if seen_from_m is None:
        return low - room, high + room
    is_above = seen_from_m >= (low + high) / 2
    return np.where(is_above, low, low - room), np.where(is_above, high + room, high)
