"""View samples as the device reads them: components apart, in runs of 32."""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vtfs.camera import Viewport

if TYPE_CHECKING:
    from vtfs.view_samples import ViewSamples

RUN_WIDTH_PX, RUN_HEIGHT_PX = 8, 4
RUN = RUN_WIDTH_PX * RUN_HEIGHT_PX
"""Samples of a run: 8 x 4 pixels, as the warps of a GPU. They are loaded and shaded together, and most
runs lie in one cell, which is what makes light data uniform over a run."""

_DTYPES = {"float32": jnp.float32, "float16": jnp.float16, "bfloat16": jnp.bfloat16}


class Positions(eqx.Module):
    """Where the view samples are: float32, view space, metres. Padding to whole runs is invalid.

    - `place`: which box of 8 x 4 pixels each run covers, counted along the rows of the image.
    """

    x_m: Float[Array, "runs 32"]
    y_m: Float[Array, "runs 32"]
    z_m: Float[Array, "runs 32"]
    valid: Bool[Array, "runs 32"]
    place: Int[Array, " runs"]
    viewport: Viewport = eqx.field(static=True)


class GBuffer(eqx.Module):
    """View samples in runs. The channels have the precision of `gbuffer`, positions never less than float32."""

    positions: Positions
    normal: tuple[Float[Array, "runs 32"], ...]
    base_colour: tuple[Float[Array, "runs 32"], ...]
    specular: Float[Array, "runs 32"]
    shininess: Float[Array, "runs 32"]
    emissive: tuple[Float[Array, "runs 32"], ...]


def runs_across(viewport: Viewport) -> int:
    return -(-viewport.width_px // RUN_WIDTH_PX)


def to_runs(image: np.ndarray) -> np.ndarray:
    """`[h, w]` to `[runs, 32]`, padded with zeros."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % RUN_HEIGHT_PX), (0, -width % RUN_WIDTH_PX)))
    rows, columns = padded.shape[0] // RUN_HEIGHT_PX, padded.shape[1] // RUN_WIDTH_PX
    boxes = padded.reshape(rows, RUN_HEIGHT_PX, columns, RUN_WIDTH_PX).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(boxes.reshape(rows * columns, RUN))


def from_runs(runs: np.ndarray, viewport: Viewport) -> np.ndarray:
    """`[runs, 32]` to `[h, w]`: the inverse of `to_runs`, without the padding."""
    columns = runs_across(viewport)
    boxes = runs.reshape(-1, columns, RUN_HEIGHT_PX, RUN_WIDTH_PX).transpose(0, 2, 1, 3)
    return boxes.reshape(-1, columns * RUN_WIDTH_PX)[: viewport.height_px, : viewport.width_px]


def positions_on_device(samples: ViewSamples) -> Positions:
    """Upload where the view samples are."""
    x_m, y_m, z_m = (jax.device_put(to_runs(samples.position_m[..., c])) for c in range(3))
    place = jax.device_put(np.arange(x_m.shape[0], dtype=np.int32))
    return Positions(x_m, y_m, z_m, jax.device_put(to_runs(samples.valid)), place, samples.camera.viewport)


def gbuffer_on_device(samples: ViewSamples, positions: Positions, precision: str) -> GBuffer:
    """Upload the channels in `precision`: `float32`, `float16` or `bfloat16`."""
    dtype = _DTYPES[precision]
    largest = float(jnp.finfo(dtype).max)

    def channel(image: np.ndarray) -> Array:
        # What a narrower format cannot hold saturates, as it does when a GPU writes the buffer.
        return jax.device_put(np.clip(to_runs(image), -largest, largest).astype(dtype))

    def channels(image: np.ndarray) -> tuple[Array, ...]:
        return tuple(channel(image[..., c]) for c in range(3))

    return GBuffer(
        positions,
        channels(samples.normal),
        channels(samples.base_colour),
        channel(samples.specular),
        channel(samples.shininess),
        channels(samples.emissive),
    )
