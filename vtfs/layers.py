"""What a pixel shows besides its nearest solid surface: transparent layers before it, and overdraw behind it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vtfs.cache import cached
from vtfs.camera import Camera

if TYPE_CHECKING:
    from vtfs.tracer import Planes, Tracer
    from vtfs.view_samples import ViewSamples


@dataclass(frozen=True)
class TransparentLayer:
    """One blended surface a pixel, before the solid one.

    - `opacity`: float32 `[h, w]`, 0 where the layer has no sample.
    """

    samples: ViewSamples
    opacity: np.ndarray


class Layers:
    """The layers of a view, made when they are asked for.

    - `transparent`: nearest first; a pixel's k-th blended surface is in the k-th layer.
    - `hidden`: what a renderer without depth pre-pass shades in vain: fragments that pass the depth test when they are
      submitted (in order of triangles) and are hidden in the end. A pixel's k-th of them is in the k-th layer.
    """

    def __init__(
        self,
        transparent: Callable[[], tuple[TransparentLayer, ...]] = tuple,
        hidden: Callable[[], tuple[ViewSamples, ...]] = tuple,
    ):
        self._make_transparent, self._make_hidden = transparent, hidden

    @cached_property
    def transparent(self) -> tuple[TransparentLayer, ...]:
        return self._make_transparent()

    @cached_property
    def hidden(self) -> tuple[ViewSamples, ...]:
        return self._make_hidden()


def transparent_triangles(
    tracer: Callable[[], Tracer], planes: Planes, camera: Camera, until_m: np.ndarray, key: str
) -> np.ndarray:
    """The blended triangles of each pixel before `until_m`, nearest first: int32 `[layers, h, w]`, -1 for none.

    **Arguments:**

    - `tracer`: makes the scene's, where the cache has no answer for `key`.
    """

    def peel() -> dict[str, np.ndarray]:
        pixel, triangle, _ = tracer().all_hits(camera, planes, until_m, blended=True)
        return {"triangle": _layered(pixel, triangle, camera)}

    return cached("transparent_layers", (key,), peel)["triangle"]


def hidden_triangles(tracer: Callable[[], Tracer], planes: Planes, camera: Camera, key: str) -> np.ndarray:
    """The solid triangles of each pixel that pass the depth test in submission order and are hidden later, in that
    order: int32 `[layers, h, w]`, -1 for none."""

    def peel() -> dict[str, np.ndarray]:
        far_m = np.full((camera.viewport.height_px, camera.viewport.width_px), camera.far_m)
        pixel, triangle, depth_m = tracer().all_hits(camera, planes, far_m, blended=False)
        order = np.lexsort((triangle, pixel))
        pixel, triangle, depth_m = pixel[order], triangle[order], depth_m[order]
        passes = _passes_depth_test(pixel, depth_m)
        pixel, triangle = pixel[passes], triangle[passes]
        # The last fragment that passes is the one that is seen.
        is_seen = np.append(pixel[1:] != pixel[:-1], True) if len(pixel) else np.empty(0, bool)
        return {"triangle": _layered(pixel[~is_seen], triangle[~is_seen], camera)}

    return cached("hidden_layers", (key,), peel)["triangle"]


def _passes_depth_test(pixel: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Is each fragment nearer than all of its pixel that were submitted before? Fragments of a pixel lie together."""
    rank = _rank_in_pixel(pixel)
    passes = np.zeros(len(pixel), bool)
    nearest_m = np.full(int(pixel.max(initial=-1)) + 1, np.inf)
    for k in range(int(rank.max(initial=-1)) + 1):
        here = np.flatnonzero(rank == k)
        passes[here] = depth_m[here] < nearest_m[pixel[here]]
        nearest_m[pixel[here]] = np.minimum(nearest_m[pixel[here]], depth_m[here])
    return passes


def _rank_in_pixel(pixel: np.ndarray) -> np.ndarray:
    """0, 1, ... for the entries of each pixel, which lie together."""
    starts = np.flatnonzero(np.append(True, pixel[1:] != pixel[:-1])) if len(pixel) else np.empty(0, int)
    lengths = np.diff(np.append(starts, len(pixel)))
    return np.arange(len(pixel)) - np.repeat(starts, lengths)


def _layered(pixel: np.ndarray, triangle: np.ndarray, camera: Camera) -> np.ndarray:
    rank = _rank_in_pixel(pixel)
    height, width = camera.viewport.height_px, camera.viewport.width_px
    layers = np.full((int(rank.max(initial=-1)) + 1, height * width), -1, np.int32)
    layers[rank, pixel] = triangle
    return layers.reshape(-1, height, width)


def composite(solid: np.ndarray, transparent: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
    """Blend layers over the solid image, farthest first: `opacity * colour + (1 - opacity) * behind`.

    **Arguments:**

    - `solid`: `[h, w, 3]`; `transparent`: image and opacity `[h, w]` of each layer, nearest first.
    """
    image = solid
    for colour, opacity in reversed(transparent):
        image = opacity[..., None] * colour + (1 - opacity[..., None]) * image
    return image
