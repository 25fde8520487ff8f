"""View samples as the device reads them: components apart, in runs of 32."""

from __future__ import annotations

from collections.abc import Callable
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

    The visible solid samples come first, all runs of the image; then hidden ones and transparent ones, only runs that
    hold any, padded to few sizes.

    - `place`: which box of 8 x 4 pixels each run covers, counted along the rows of the image.
    - `is_parallel`: the eye is at infinity.
    """

    x_m: Float[Array, "runs 32"]
    y_m: Float[Array, "runs 32"]
    z_m: Float[Array, "runs 32"]
    valid: Bool[Array, "runs 32"]
    place: Int[Array, " runs"]
    viewport: Viewport = eqx.field(static=True)
    n_hidden_runs: int = eqx.field(static=True, default=0)
    n_transparent_runs: int = eqx.field(static=True, default=0)
    is_parallel: bool = eqx.field(static=True, default=False)

    @property
    def n_solid_runs(self) -> int:
        return self.place.shape[0] - self.n_transparent_runs

    @property
    def n_visible_runs(self) -> int:
        return self.n_solid_runs - self.n_hidden_runs


class GBuffer(eqx.Module):
    """View samples in runs. The channels have the precision of `gbuffer`, positions never less than float32."""

    positions: Positions
    normal: tuple[Float[Array, "runs 32"], ...]
    base_colour: tuple[Float[Array, "runs 32"], ...]
    specular: Float[Array, "runs 32"]
    shininess: Float[Array, "runs 32"]
    emissive: tuple[Float[Array, "runs 32"], ...]


class LayerTable(eqx.Module):
    """How transparent runs lie over the image.

    - `run`: for each layer, nearest first, and each box of the image: which transparent run, or -1.
    - `opacity`: 0 where there is no sample.
    """

    run: Int[Array, "layers visible_runs"]
    opacity: Float[Array, "transparent_runs 32"]


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


class Fragments:
    """All that is shaded in a frame, on the host: visible solid samples, hidden ones if asked for, transparent ones."""

    def __init__(self, samples: ViewSamples, *, with_hidden: bool):
        hidden = samples.layers.hidden if with_hidden else ()
        self._transparent = samples.layers.transparent
        self.viewport = samples.camera.viewport
        self._is_parallel = samples.camera.is_orthographic
        self.n_visible_runs = runs_across(self.viewport) * -(-self.viewport.height_px // RUN_HEIGHT_PX)
        self._sections = [(samples, np.arange(self.n_visible_runs))]
        self._hidden = [(layer, _runs_with_any(layer.valid)) for layer in hidden]
        self._blended = [(layer.samples, _runs_with_any(layer.samples.valid)) for layer in self._transparent]
        self.n_hidden_runs, self.n_transparent_runs = (
            _rounded_up(sum(len(runs) for _, runs in sections)) for sections in (self._hidden, self._blended)
        )

    @property
    def n_samples(self) -> int:
        """Valid samples of all kinds."""
        sections = (*self._sections, *self._hidden, *self._blended)
        return sum(samples.n_valid for samples, _ in sections)

    @property
    def n_transparent_samples(self) -> int:
        return sum(samples.n_valid for samples, _ in self._blended)

    def channel(self, of: Callable[[ViewSamples], np.ndarray]) -> np.ndarray:
        """`[runs, 32]` of an image `[h, w]` of each section."""
        parts = [to_runs(of(samples))[runs] for samples, runs in self._sections]
        for sections, n_runs in ((self._hidden, self.n_hidden_runs), (self._blended, self.n_transparent_runs)):
            found = [to_runs(of(samples))[runs] for samples, runs in sections]
            n_found = sum(len(part) for part in found)
            parts += [*found, np.zeros((n_runs - n_found, RUN), parts[0].dtype)]
        return np.concatenate(parts)

    def positions(self) -> Positions:
        """Upload where the samples are."""
        place = [np.arange(self.n_visible_runs)]
        for sections, n_runs in ((self._hidden, self.n_hidden_runs), (self._blended, self.n_transparent_runs)):
            found = [runs for _, runs in sections]
            place += [*found, np.zeros(n_runs - sum(map(len, found)), int)]
        x_m, y_m, z_m = (jax.device_put(self.channel(lambda s, c=c: s.position_m[..., c])) for c in range(3))
        valid = jax.device_put(self.channel(lambda s: s.valid))
        places = jax.device_put(np.concatenate(place).astype(np.int32))
        return Positions(
            x_m, y_m, z_m, valid, places, self.viewport, self.n_hidden_runs, self.n_transparent_runs, self._is_parallel
        )

    def gbuffer(self, positions: Positions, precision: str) -> GBuffer:
        """Upload the channels in `precision`: `float32`, `float16` or `bfloat16`."""
        dtype = _DTYPES[precision]
        largest = float(jnp.finfo(dtype).max)

        def channel(of: Callable[[ViewSamples], np.ndarray]) -> Array:
            # What a narrower format cannot hold saturates, as it does when a GPU writes the buffer.
            return jax.device_put(np.clip(self.channel(of), -largest, largest).astype(dtype))

        def channels(of: Callable[[ViewSamples], np.ndarray]) -> tuple[Array, ...]:
            return tuple(channel(lambda s, c=c: of(s)[..., c]) for c in range(3))

        return GBuffer(
            positions,
            channels(lambda s: s.normal),
            channels(lambda s: s.base_colour),
            channel(lambda s: s.specular),
            channel(lambda s: s.shininess),
            channels(lambda s: s.emissive),
        )

    def layer_table(self) -> LayerTable:
        """Upload how the transparent layers lie over the image."""
        n_layers = 1 << (len(self._transparent) - 1).bit_length() if self._transparent else 0
        run = np.full((n_layers, self.n_visible_runs), -1, np.int32)
        opacity = np.zeros((self.n_transparent_runs, RUN), np.float32)
        first = 0
        for layer, (transparent, (_, places)) in enumerate(zip(self._transparent, self._blended, strict=True)):
            here = slice(first, first + len(places))
            run[layer, places] = np.arange(here.start, here.stop)
            opacity[here] = to_runs(transparent.opacity)[places]
            first = here.stop
        return LayerTable(jax.device_put(run), jax.device_put(opacity))


def _runs_with_any(valid: np.ndarray) -> np.ndarray:
    return np.flatnonzero(to_runs(valid).any(axis=1))


def _rounded_up(n_runs: int) -> int:
    """Few sizes, so that few programs are compiled: 0, or 1,024 times powers of 4."""
    capacity = 1024
    while capacity < n_runs:
        capacity *= 4
    return capacity if n_runs else 0
