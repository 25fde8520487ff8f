"""Alpha-masked, blended and coloured casters: what each volume that holds a sample stops of its light.

The same walk as for opaque casters, but no node is accepted: every sample is visited, as what a triangle stops differs
from one to the next (Sintorn et al. 2011, Sec. 5). Where a sample's way to the light meets the triangle is told by the
distances from the three side planes: `d_k = n_k . p` with the unnormalised `n_0 = B x C`, `n_1 = C x A`, `n_2 = A x B`
relative to the light. The way meets the triangle's plane at `q = t p`; `q = a A + b B + c C` with `a + b + c = 1` gives
`d_0 = a V / t` with `V = A . (B x C)`, and likewise for b and c: so `a = d_0 / (d_0 + d_1 + d_2)`, exactly, and the
bias along the way changes nothing. With a directional light `d_k` are areas of triangles in projection, and the same
holds.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.alpha_casters import LARGEST_ALPHA, AlphaSurfaces, Blending
from vtfs.node_lists import owners
from vtfs.random_words import random_words
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes import cluster_hierarchy, ptsv
from vtfs.shadow_volumes.leaf_tests import sample_rows
from vtfs.shadow_volumes.merge import mask_of
from vtfs.shadow_volumes.planes import EdgePlanes, Vector, dot, inside
from vtfs.shadow_volumes.sample_tiles import SampleTiles, in_runs
from vtfs.shadow_volumes.walk import to_items

LOG_STEP = 2.0**-32
"""Logarithms are summed in steps of this: such sums are exact in float64 below 2^20, in whatever order."""

_PAIRS_AT_ONCE = {"cpu": 2**17}
"""Pairs of a triangle and a sample in one chunk: what stays in the caches of a CPU."""


class Transmitted(eqx.Module):
    """What alpha casters leave of a light.

    - `transmittance`: float32, one channel, or red, green and blue; none where blending is stochastic. 1 where nothing
      is tested.
    - `mask`: what a masked surface (or a random one) stops wholly, and what the walk took.
    """

    transmittance: tuple[Float[Array, "runs 32"], ...]
    mask: ShadowMask


def transmit(
    technique: str,
    frame: ShadowFrame,
    surfaces: AlphaSurfaces,
    stream: UInt32[Array, " 2"],
    plan: ShadowPlan,
    blending: Blending,
) -> Transmitted:
    """What the triangles of a frame leave of its light; inside of `jax.enable_x64(True)`.

    **Arguments:**

    - `technique`: whose hierarchy is walked: `ptsv` or `cluster_hierarchy`.
    - `frame`: with the triangles that `surfaces` describes.
    - `stream`: seed, and number of the view: other numbers give other random bits.
    """
    stages = ptsv if technique == "ptsv" else cluster_hierarchy
    volume, hierarchy = stages.shadow_planes(frame, plan), stages.shadow_build(frame, plan)
    # No node lies farther behind a triangle than infinity: none is accepted.
    unaccepting = eqx.tree_at(lambda v: v.bias_m, volume, jnp.full_like(volume.bias_m, jnp.inf))
    at, walk = to_items(unaccepting, hierarchy, plan)
    samples, lists = hierarchy.samples, at.lists
    n_tiles, n_samples = samples.z_m.shape
    n_items = hierarchy.tile_of_item.shape[0]
    capacity, lanes = lists.triangle.shape
    chunk = max(1, min(capacity, _PAIRS_AT_ONCE.get(jax.default_backend(), 2**22) // (lanes * n_samples)))
    n_padded = -(-capacity // chunk) * chunk
    triangle = jnp.pad(lists.triangle, ((0, n_padded - capacity), (0, 0)))
    n_groups = jnp.minimum(lists.n_groups, capacity)
    item_of_group = jnp.minimum(owners(lists.start, n_groups, n_padded), n_items - 1)
    rows, pixel = sample_rows(hierarchy, volume), _pixels(samples)

    def loop(state):
        first, total = state
        group = first + jnp.arange(chunk, dtype=jnp.int32)
        item = jax.lax.dynamic_slice_in_dim(item_of_group, first, chunk)
        tile = hierarchy.tile_of_item[item]
        # A tile is tested as a whole; of what is found, each cluster keeps its own samples.
        own = (hierarchy.item_of_sample[tile] == item[:, None]) & samples.receives[tile]
        chosen = jax.lax.dynamic_slice_in_dim(triangle, first, chunk)
        row = rows[tile]
        position = tuple(row[:, c, None].astype(jnp.float64) - volume.origin_m[c] for c in range(3))
        planes = jax.tree.map(lambda c: c[..., None], volume.edges.at(chosen))
        held = inside(planes, position, row[:, 3, None].astype(jnp.float64)) & own[:, None, :]
        found = _stopped(planes, position, held, surfaces, chosen, pixel[tile][:, None], stream, blending)
        sums = jnp.stack([jnp.sum(jnp.where(held, value, 0), axis=1) for value in found], axis=1)
        return first + chunk, total.at[jnp.where(group < n_groups, tile, n_tiles)].add(sums, mode="drop")

    n_channels = {"grey": 1, "coloured": 3, "stochastic": 0}[blending]
    state = (jnp.int32(0), jnp.zeros((n_tiles, 1 + n_channels, n_samples), jnp.float64))
    _, total = jax.lax.while_loop(lambda state: state[0] < n_groups, loop, state)
    view = samples.viewport, samples.tile_px
    mask = mask_of(total[:, 0] > 0, walk, volume.safe, (volume, surfaces), hierarchy)
    logs = [in_runs(total[:, 1 + c], *view) for c in range(n_channels)]
    return Transmitted(tuple(jnp.where(mask.shadowed, 0, jnp.exp(log)).astype(jnp.float32) for log in logs), mask)


def _stopped(
    planes: EdgePlanes,
    position: Vector,
    held: Bool[Array, "chunk lanes samples"],
    surfaces: AlphaSurfaces,
    triangle: Int[Array, "chunk lanes"],
    pixel: UInt32[Array, "chunk 1 samples"],
    stream: UInt32[Array, " 2"],
    blending: Blending,
) -> list[Array]:
    """Whether triangles stop all light of samples that their volumes hold, and the logarithms of what they let through.

    Float64, of shapes that broadcast to `[chunk, lanes, samples]`; meaningless where `held` is false.
    """
    opacity, cutoff, *absorbed = surfaces.value[:, triangle][..., None]
    alpha = jnp.clip(opacity * _texels(planes, position, held, surfaces, triangle), 0, 1)
    masked = alpha >= cutoff  # false where the triangle blends: its cutoff is NaN
    if blending == "stochastic":
        word = random_words(pixel, surfaces.number[triangle][..., None], stream[0], stream[1])
        blends = jnp.isnan(cutoff) & (word.astype(jnp.float64) < alpha * 2.0**32)
        return [jnp.where(masked | blends, 1.0, 0.0)]
    shares = [alpha] if blending == "grey" else [alpha * share for share in absorbed]
    logs = [jnp.round(jnp.log1p(-jnp.minimum(share, LARGEST_ALPHA)) / LOG_STEP) * LOG_STEP for share in shares]
    return [jnp.where(masked, 1.0, 0.0), *(jnp.where(jnp.isnan(cutoff), log, 0.0) for log in logs)]


def _texels(
    planes: EdgePlanes,
    position: Vector,
    held: Bool[Array, "chunk lanes samples"],
    surfaces: AlphaSurfaces,
    triangle: Int[Array, "chunk lanes"],
) -> Float[Array, ...]:
    """The alpha image where the way to the light meets a triangle: bilinear, repeated, texel centres at (i + 1/2) / n;
    1 without an image."""
    if not surfaces.texels.shape[0]:
        return jnp.ones((1, 1, 1), jnp.float64)
    distance = [dot(normal, position) for normal in planes.normal]
    if planes.offset:
        distance = [d - offset for d, offset in zip(distance, planes.offset, strict=True)]
    share = 1 / jnp.where(held, distance[0] + distance[1] + distance[2], 1.0)
    uv = surfaces.uv[:, triangle][..., None]
    first, width, height = surfaces.size[:, triangle][..., None]

    def axis(k: int, size: Array) -> tuple[Array, Array, Array]:
        """The two texels along an axis, and how far the place lies from the first to the second."""
        at = (distance[0] * uv[k] + distance[1] * uv[k + 1] + distance[2] * uv[k + 2]) * share
        place = (at - jnp.floor(at)) * size - 0.5
        low = jnp.floor(place)
        index = low.astype(jnp.int32)
        n = jnp.maximum(size, 1)
        return jnp.where(index < 0, index + n, index) % n, (index + 1) % n, place - low

    left, right, s = axis(0, width)
    above, below, t = axis(3, height)

    def texel(row: Array, column: Array) -> Array:
        return surfaces.texels[jnp.where(held, first + row * width + column, 0)].astype(jnp.float64)

    upper = texel(above, left) * (1 - s) + texel(above, right) * s
    lower = texel(below, left) * (1 - s) + texel(below, right) * s
    return jnp.where(width > 0, upper * (1 - t) + lower * t, 1.0)


def _pixels(samples: SampleTiles) -> UInt32[Array, "tiles lanes"]:
    """The number of each sample's pixel, row by row: the same whatever the tiles are."""
    n_tiles, n_lanes = samples.z_m.shape
    tile, lane = np.arange(n_tiles)[:, None], np.arange(n_lanes)
    row = tile // samples.columns * samples.tile_px + lane // samples.tile_px
    column = tile % samples.columns * samples.tile_px + lane % samples.tile_px
    return jnp.asarray((row * samples.viewport.width_px + column).astype(np.uint32))
