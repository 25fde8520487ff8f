"""What casts shadows: triangles in world space, and the light that they stand before."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from vtfs.input_error import InputError

if TYPE_CHECKING:
    from vtfs.scene import Scene

BIAS = 1e-5
"""Samples move toward the light by this share of the casters' extent before the test against a triangle's own plane;
within the window (1e-6 to 1e-4) in which self-shadowing was measured to vanish. Never an absolute length."""

FARTHEST_EXTENTS = 1e5
"""A point light further than so many extents from its casters is refused. Triangles narrower than 1e-10 rad are left
out, as float64 cannot tell on which side of them the light is; from there on these are wider than the 1e-5 of the
extent within which rounding may decide. A directional light then casts the same shadow, within these 1e-5."""

LARGEST_M = 1e36
"""Of a coordinate: boxes about a point light are float32, in which twice that distance and its rounding must fit."""

FrontFaces = Literal["cast", "culled"]


@dataclass(frozen=True)
class Casters:
    """Triangles that cast shadows, in world space.

    - `vertices_m`: float64 `[V, 3]`; `triangles`: int32 `[T, 3]`. Vertices at one place need not be shared (`welded`).

    **Raises:** `InputError` where a vertex of a triangle is not finite or an index is out of range.
    """

    vertices_m: np.ndarray
    triangles: np.ndarray

    def __post_init__(self):
        object.__setattr__(self, "vertices_m", np.ascontiguousarray(self.vertices_m, np.float64).reshape(-1, 3))
        object.__setattr__(self, "triangles", np.ascontiguousarray(self.triangles, np.int32).reshape(-1, 3))
        if len(self.triangles) == 0:
            return
        low, high = int(self.triangles.min()), int(self.triangles.max())
        if low < 0 or high >= len(self.vertices_m):
            wrong = low if low < 0 else high
            raise InputError(f"casters `triangles`: index {wrong} is out of range; there are {len(self.vertices_m)}.")
        bad = np.flatnonzero(~np.isfinite(self.vertices_m[self.triangles]).all(axis=(1, 2)))
        if len(bad):
            raise InputError(
                f"casters `triangles`: triangle {bad[0]} ({len(bad)} in all) has a vertex that is NaN or infinite; "
                "repair the mesh."
            )
        largest = float(np.abs(self.vertices_m[self.triangles]).max())
        if largest > LARGEST_M:
            raise InputError(f"casters `vertices_m`: a coordinate of {largest:g} m is beyond 1e36; scale the scene.")

    @property
    def n_triangles(self) -> int:
        return len(self.triangles)

    @cached_property
    def box_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Low and high corner of the box of all vertices that triangles use; the origin without any."""
        if not len(self.triangles):
            return np.zeros(3), np.zeros(3)
        used = self.vertices_m[self.triangles.ravel()]
        return used.min(axis=0), used.max(axis=0)

    @property
    def extent_m(self) -> float:
        """Diagonal of the box; what the bias is a share of."""
        low, high = self.box_m
        return float(np.linalg.norm(high - low))


def welded(vertices_m: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The same triangles, each corner by the first vertex at its place, int32 `[T, 3]`.

    A mesh has several vertices at one place where normals, texture coordinates or materials differ. Only by its place
    do both triangles of an edge see that it is one: they get the same planes, and a stencil draws no side there.
    """
    place = vertices_m + 0.0  # -0 is 0
    order = np.lexsort(place.T)  # stable: of one place the first vertex comes first
    is_first = np.ones(len(order), bool)
    is_first[1:] = (place[order[1:]] != place[order[:-1]]).any(axis=1)
    first = np.empty(len(order), np.int32)
    first[order] = order[is_first][np.cumsum(is_first) - 1]
    return first[triangles]


@dataclass(frozen=True)
class ShadowLight:
    """A point light, or a directional one, in world space.

    - `position_m`: where a point light is; for a directional light a vector toward it, of any length.

    **Raises:** `InputError` where it is not finite, or a direction is zero.
    """

    position_m: tuple[float, float, float]
    directional: bool = False

    def __post_init__(self):
        try:
            position = np.asarray(self.position_m, np.float64)
        except (TypeError, ValueError):  # no numbers, or of ragged shape
            position = np.zeros(0)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError(f"shadow light `position_m` = {self.position_m!r}: must be three finite numbers.")
        if self.directional and not np.any(self.position_m):
            raise InputError("shadow light `position_m` = (0, 0, 0): a directional light needs a direction toward it.")

    @property
    def homogeneous(self) -> np.ndarray:
        """float64 `[4]`: position and 1, or unit direction toward the light and 0."""
        position = np.asarray(self.position_m, np.float64)
        if self.directional:
            scaled = position / np.abs(position).max()  # so that no square overflows or vanishes
            return np.append(scaled / np.linalg.norm(scaled), 0.0)
        return np.append(position, 1.0)


def require_near(light: ShadowLight, casters: Casters) -> None:
    """**Raises:** `InputError` for a point light further than `FARTHEST_EXTENTS` from casters that have an extent, or
    beyond `LARGEST_M`."""
    if light.directional or not casters.extent_m:
        return
    low, high = casters.box_m
    place = np.asarray(light.position_m, np.float64)
    distance_m = math.hypot(*(place - np.clip(place, low, high)))  # whose squares may not overflow
    if distance_m > FARTHEST_EXTENTS * casters.extent_m:
        raise InputError(
            f"shadow light `position_m` = ({', '.join(f'{c:g}' for c in place)}): is {distance_m:g} m from casters of "
            f"{casters.extent_m:g} m, and must be within {FARTHEST_EXTENTS:g} of their extents, beyond which float64 "
            "cannot tell small triangles apart; make it a directional light."
        )
    if np.abs(place).max() > LARGEST_M:
        raise InputError(
            f"shadow light `position_m`: a coordinate of {np.abs(place).max():g} m is beyond 1e36; scale the scene."
        )


def opaque_casters(scene: Scene) -> Casters:
    """The triangles of a scene's `opaque` materials; those of `mask` and `blend` cast other shadows."""
    opaque = np.array([material.alpha_mode == "opaque" for material in scene.materials])
    return Casters(scene.vertices_m, scene.triangles[opaque[scene.material_index]])
