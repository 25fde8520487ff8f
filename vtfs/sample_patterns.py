"""Several samples a pixel: where they lie, what they see, and how they make one value.

Each sub-sample of a pattern is a view of its own, shifted by a part of a pixel; shadows are cast on it as on any view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vtfs.camera import Camera, Lens
from vtfs.input_error import InputError
from vtfs.layers import Layers
from vtfs.tracer import Tracer
from vtfs.view_samples import ViewSamples, trace_view_samples

if TYPE_CHECKING:
    from vtfs.scene import Scene

PATTERNS: dict[int, tuple[tuple[int, int], ...]] = {
    1: ((0, 0),),
    4: ((-2, -6), (6, -2), (-6, 2), (2, 6)),
    8: ((1, -3), (-1, 3), (5, 1), (-3, -5), (-5, 5), (-7, -1), (3, 7), (7, -7)),
    16: (
        (1, 1), (-1, -3), (-3, 2), (4, -1), (-5, -2), (2, 5), (5, 3), (3, -5),
        (-2, 6), (0, -7), (-4, -6), (-6, 4), (-8, 0), (7, -4), (6, 7), (-7, -8),
    ),
}  # fmt: skip
"""Standard patterns of Direct3D 11 (`D3D11_STANDARD_MULTISAMPLE_PATTERN`) by their number of samples: offsets from the
pixel's centre in sixteenths of a pixel, to the right and down."""


def pattern(n_samples: int) -> tuple[tuple[int, int], ...]:
    """**Raises:** `InputError` where there is no pattern of so many samples."""
    if n_samples not in PATTERNS:
        raise InputError(f"samples per pixel = {n_samples}: must be one of {', '.join(map(str, PATTERNS))}.")
    return PATTERNS[n_samples]


def shifted_camera(camera: Camera, offset: tuple[int, int]) -> Camera:
    """The view whose pixel centres lie at an offset from those of another, in sixteenths of a pixel."""
    right, down = offset
    viewport, lens = camera.viewport, camera.lens
    shift_x = lens.shift_x + right / 16 / viewport.width_px
    shift_y = lens.shift_y - down / 16 / viewport.height_px
    return replace(camera, lens=Lens(shift_x, shift_y, lens.orthographic_height_m))


def traced_sub_samples(
    scene: Scene, camera: Camera, n_samples: int, tracer: Tracer | None = None
) -> tuple[ViewSamples, ...]:
    """What each sub-sample sees, with its own ray.

    **Raises:** `InputError` where there is no pattern of so many samples.
    """
    tracer = tracer or Tracer(scene)
    return tuple(trace_view_samples(scene, shifted_camera(camera, offset), tracer) for offset in pattern(n_samples))


def extrapolated_sub_samples(samples: ViewSamples, n_samples: int) -> tuple[ViewSamples, ...]:
    """Sub-samples on the plane of the surface that the pixel's centre sees, as the derivatives of its depth give it.

    One ray a pixel instead of many: within a triangle this is exact, at its edges it is not. Where the plane is seen
    edge-on, or leaves the view's range of depths, a sub-sample keeps the centre's depth.

    **Raises:** `InputError` where there is no pattern of so many samples.
    """
    position, normal = samples.position_m.astype(np.float64), samples.normal.astype(np.float64)
    along = (normal * position).sum(axis=-1)
    views = []
    for offset in pattern(n_samples):
        camera = shifted_camera(samples.camera, offset)
        x, y = camera.pixel_slopes()
        aside = normal[..., 0] * x + normal[..., 1] * y[:, None]
        if camera.is_orthographic:
            offset, facing = aside - along, normal[..., 2]
        else:
            offset, facing = along, aside - normal[..., 2]
        depth_m = np.divide(offset, facing, out=np.full(along.shape, np.nan), where=facing != 0)
        leaves = ~((depth_m >= camera.near_m) & (depth_m <= camera.far_m))
        depth_m = np.where(leaves, -position[..., 2], depth_m)
        width = camera.width_at(depth_m)
        moved = np.stack([x * width, y[:, None] * width, -depth_m], axis=-1)
        moved[~samples.valid] = 0
        views.append(replace(samples, camera=camera, position_m=moved.astype(np.float32), layers=Layers()))
    return tuple(views)


def resolved(values: Sequence[np.ndarray], views: Sequence[ViewSamples]) -> np.ndarray:
    """The mean of each pixel's valid sub-samples, float64 `[h, w]` or `[h, w, channels]`; 0 where none is valid.

    **Arguments:**

    - `values`: of each view: whether it is lit, or how much light is left.
    """
    total, n_valid = 0.0, np.zeros(views[0].valid.shape)
    for value, view in zip(values, views, strict=True):
        mask = view.valid if value.ndim == 2 else view.valid[..., None]
        total = total + np.where(mask, value, 0)
        n_valid += view.valid
    total = np.asarray(total, np.float64)
    weight = 1 / np.maximum(n_valid, 1)
    return total * (weight if total.ndim == 2 else weight[..., None])
