"""Shading: Blinn-Phong under lights that end at their range, in linear HDR."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from vtfs.clusters import Clusters
from vtfs.fast_power import power
from vtfs.gbuffer import RUN, GBuffer, LayerTable
from vtfs.light_lists import POINT_COLUMNS, LightLists
from vtfs.light_shadows import LightShadows

MIN_DISTANCE2_M2 = 1e-4
_TINY = 1e-30  # keeps 0 / 0 away; far below any product of lengths that matters

Image = tuple[Float[Array, "runs 32"], ...]


class Surface(eqx.Module):
    """What is lit: components apart, any shapes that broadcast with the lights' columns."""

    position_m: tuple[Float[Array, "*s"], ...]
    to_eye: tuple[Float[Array, "*s"], ...]
    normal: tuple[Float[Array, "*s"], ...]
    base_colour: tuple[Float[Array, "*s"], ...]
    specular: Float[Array, "*s"]
    shininess: Float[Array, "*s"]


class ClusterLight(eqx.Module):
    """What lights add that are evaluated once a cluster: irradiance and highlight; red, green and blue of each."""

    irradiance: tuple[Float[Array, " clusters"], ...]
    highlight: tuple[Float[Array, " clusters"], ...]

    def reflected_by(self, part: GBuffer, cluster: Int[Array, " blocks"]) -> tuple[Float[Array, "blocks 32"], ...]:
        """Red, green and blue that the samples of each block reflect."""
        return tuple(
            base.astype(jnp.float32) * irradiance[cluster][:, None]
            + part.specular.astype(jnp.float32) * highlight[cluster][:, None]
            for base, irradiance, highlight in zip(part.base_colour, self.irradiance, self.highlight, strict=True)
        )


def direction_to_eye(position_m: tuple[Float[Array, "*s"], ...], is_parallel: bool) -> tuple[Float[Array, "*s"], ...]:
    """Unit vectors to the eye: the origin of view space, or in a parallel view at infinity along z."""
    x_m, y_m, z_m = position_m
    if is_parallel:
        return jnp.zeros_like(x_m), jnp.zeros_like(y_m), jnp.ones_like(z_m)
    inverse = -jax.lax.rsqrt(x_m * x_m + y_m * y_m + z_m * z_m + _TINY)
    return x_m * inverse, y_m * inverse, z_m * inverse


def surface_of(part: GBuffer) -> Surface:
    """What is lit, in the precision of the channels."""
    position_m = (part.positions.x_m, part.positions.y_m, part.positions.z_m)
    to_eye = direction_to_eye(position_m, part.positions.is_parallel)
    return Surface(position_m, to_eye, part.normal, part.base_colour, part.specular, part.shininess)


def reflected(
    surface: Surface,
    light: Float[Array, "*l columns"],
    light_cutoff: Float[Array, ""],
    listed: Bool[Array, "*l"] | bool = True,
) -> tuple[Float[Array, "*s"], ...]:
    """Light that a surface reflects towards the eye, from one light each: red, green, blue.

    `colour * falloff * max(0, n.l) * (base + specular * max(0, n.h)**shininess)`, Blinn (1977), with
    `falloff = max(0, 1 - (d/range)**4)**2 / max(d**2, 1e-4)`. Black where the window (the numerator) is not
    above `light_cutoff`. Any float precision.

    **Arguments:**

    - `light`: rows of `ViewLights`; the leading axes broadcast against the surface.
    - `listed`: the light counts; else black.
    """
    x_m, y_m, z_m = surface.position_m
    to_x, to_y, to_z = light[..., 0] - x_m, light[..., 1] - y_m, light[..., 2] - z_m
    distance2 = to_x * to_x + to_y * to_y + to_z * to_z
    distance = jnp.sqrt(distance2)
    ratio2 = distance2 * light[..., 3] * light[..., 3]
    falloff = jnp.maximum(0, 1 - ratio2 * ratio2) ** 2
    # Masked here, once, and not in each of the three sums.
    falloff = jnp.where((falloff > light_cutoff) & listed, falloff, 0)
    n_dot_to, gloss = _facing(surface, (to_x, to_y, to_z), distance)
    # One division for the light's direction and its distance.
    lit = falloff * n_dot_to / (distance * jnp.maximum(distance2, MIN_DISTANCE2_M2) + _TINY)
    if light.shape[-1] > POINT_COLUMNS:
        along = -(to_x * light[..., 8] + to_y * light[..., 9] + to_z * light[..., 10])
        cos_cone = along / (distance + _TINY)
        lit = lit * jnp.clip((cos_cone - light[..., 12]) * light[..., 11], 0, 1)
    return tuple(lit * light[..., 4 + c] * (base + gloss) for c, base in enumerate(surface.base_colour))


def _facing(
    surface: Surface, to: tuple[Float[Array, "*s"], ...], distance: Float[Array, "*s"] | float
) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """`max(0, n.l)` times the distance, and `specular * max(0, n.h)**shininess` of light that comes from `to`."""
    n_x, n_y, n_z = surface.normal
    to_x, to_y, to_z = to
    n_dot_to = jnp.maximum(n_x * to_x + n_y * to_y + n_z * to_z, 0)
    # h = l / |l| + e, here times |l|. Only its angle counts, so that the root of |h| is spared:
    # (n.h / |h|)**s = ((n.h)**2 / h.h)**(s / 2).
    e_x, e_y, e_z = surface.to_eye
    h_x, h_y, h_z = to_x + e_x * distance, to_y + e_y * distance, to_z + e_z * distance
    n_dot_h = jnp.maximum(n_x * h_x + n_y * h_y + n_z * h_z, 0)
    cos2 = jnp.maximum(n_dot_h * n_dot_h / (h_x * h_x + h_y * h_y + h_z * h_z + _TINY), _TINY)
    return n_dot_to, jnp.where(n_dot_h > 0, surface.specular * power(cos2, surface.shininess * 0.5), 0)


def reflected_suns(surface: Surface, shadows: LightShadows) -> tuple[Float[Array, "runs 32"], ...]:
    """Light of all directional lights that a surface reflects towards the eye, where it is not in their shadow."""

    def add(sun, sums):
        row = shadows.slots.sun_row[sun]
        n_dot_to, gloss = _facing(surface, (row[0], row[1], row[2]), 1.0)
        lit = jnp.where(shadows.sun_lit(sun), n_dot_to, 0)
        added = tuple(lit * row[3 + c] * (base + gloss) for c, base in enumerate(surface.base_colour))
        return tuple(s + a for s, a in zip(sums, shadows.sun_left(sun, added), strict=True))

    black = tuple(jnp.zeros_like(channel) for channel in surface.base_colour)
    n_suns = shadows.slots.sun_row.shape[0]
    return jax.lax.fori_loop(0, n_suns, add, black) if n_suns else black


_CPU_SAMPLES_AT_ONCE = 4096


def chunk_blocks(capacity: int, batch: int) -> int:
    """Blocks shaded at once, where `batch` counts samples and 0 means all.

    All at once is what a GPU wants. On a CPU every step would stream the G-buffer through memory, four times as slow
    (a frame of the atrium: 1.8 s against 0.4 s), so there 0 takes as many as stay in its cache. A batch of all
    samples is taken at its word.
    """
    if not batch and jax.default_backend() == "cpu":
        batch = _CPU_SAMPLES_AT_ONCE
    return min(capacity, max(1, batch // RUN)) if batch else capacity


def _lights_a_step() -> int:
    """Lights that a step adds. On a GPU a step is a launch of some 40 us, whatever it does; a CPU gains nothing."""
    return 1 if jax.default_backend() == "cpu" else 4


def _step_widths(chunk: int, capacity: int) -> tuple[int, ...]:
    """Widths of the steps of a chunk. Lists of a small part of all blocks, in order, are about equally long;
    of all at once a few are many times longer than most."""
    if chunk < capacity:
        return (chunk,)
    return tuple(width for width in (chunk, chunk // 4, chunk // 16) if width)


def chunk_work(of_block: np.ndarray, batch: int, capacity: int) -> tuple[int, int]:
    """Lanes and steps that `shade` takes for blocks with lists of these lengths (host, exact)."""
    chunk = chunk_blocks(capacity, batch)
    longest_first = np.zeros(-(-max(len(of_block), 1) // chunk) * chunk + 1, np.int64)
    longest_first[: len(of_block)] = -np.sort(-of_block)
    widths = _step_widths(chunk, capacity)
    a_step = _lights_a_step()
    if len(widths) == 1:
        steps = int((-(-longest_first[:-1:chunk] // a_step)).sum())
        return steps * a_step * chunk * RUN, steps
    lanes = steps = done = 0
    for width, narrower in zip(widths, (*widths[1:], 0), strict=True):
        more = max(0, -(-(int(longest_first[narrower]) - done) // a_step))
        lanes, steps, done = lanes + more * a_step * width * RUN, steps + more, done + more * a_step
    return lanes, steps


def longest_first(
    count: Int[Array, " blocks"], first_block: Int[Array, ""], end_block: Int[Array, ""]
) -> Int[Array, " blocks"]:
    """Blocks of `[first_block, end_block)` in order of the lengths of their lists, so that a chunk's lists are about
    equally long; then the others.

    Length and block are packed in one word: XLA on a CPU sorts pairs six times slower. Very long lists
    count as equal.
    """
    capacity = count.shape[0]
    block_bits = max(1, (capacity - 1).bit_length())
    longest = (1 << (32 - block_bits)) - 2
    block = jnp.arange(capacity, dtype=jnp.uint32)
    shortness = longest - jnp.minimum(count, longest).astype(jnp.uint32)
    is_shaded = (block >= first_block.astype(jnp.uint32)) & (block < end_block.astype(jnp.uint32))
    shortness = jnp.where(is_shaded, shortness, jnp.uint32(longest + 1))
    word: UInt32[Array, " blocks"] = jnp.sort((shortness << block_bits) | block)
    return (word & jnp.uint32((1 << block_bits) - 1)).astype(jnp.int32)


def shade(
    gbuffer: GBuffer,
    clusters: Clusters,
    lists: LightLists,
    light_rows: Float[Array, "lights columns"],
    light_cutoff: Float[Array, ""],
    batch: int,
    transparent: bool = False,
    shadows: LightShadows | None = None,
    cluster_light: ClusterLight | None = None,
) -> Image:
    """Shade every valid sample with its cluster's lights: linear red, green and blue, 0 where invalid.

    Blocks are shaded in chunks, those with the longest lists first. A step adds one light to every block of
    the chunk; steps go on with the first quarter once the others are done, and so on.

    **Arguments:**

    - `transparent`: shade the transparent runs, and return those; else the solid ones, and return the visible.
    - `shadows`: a light adds nothing where a sample lies in its shadow, and what alpha casters leave of it elsewhere;
      directional lights shine too.
    - `cluster_light`: what is not on the lists but adds to all samples of a cluster.
    """
    capacity = clusters.block_run.shape[0]
    chunk = chunk_blocks(capacity, batch)
    block_count = lists.count[clusters.block_cluster]
    block_offset = lists.offset[clusters.block_cluster]
    # Padded, so that the last chunk's slice is not moved.
    first_block = clusters.n_solid_blocks if transparent else jnp.int32(0)
    end_block = clusters.n_blocks if transparent else clusters.n_solid_blocks
    n_blocks = jnp.minimum(end_block - first_block, capacity)
    order = jnp.pad(longest_first(block_count, first_block, end_block), (0, chunk - 1))
    widths = _step_widths(chunk, capacity)

    def add_lights(part, shade_of, offset, count, k, sums, width, until):
        """Steps `k` to `until` of the first `width` blocks."""
        part, offset, count = jax.tree.map(lambda channel: channel[:width], (part, offset, count))
        surface = surface_of(part)

        def step(state):
            k, sums = state
            for _ in range(_lights_a_step()):
                k, sums = add_light(k, sums)
            return k, sums

        def add_light(k, sums):
            index = lists.index[offset + k]
            light = light_rows[index][:, None, :]
            listed = (k < count)[:, None]
            if shade_of is not None:
                listed = listed & shade_of.lit(index)
            # Narrow channels are widened here and not before the loop: they are read at every step.
            widened = jax.tree.map(lambda channel: channel.astype(jnp.float32), surface)
            added = reflected(widened, light, light_cutoff, listed)
            if shade_of is not None:
                added = shade_of.left_of(index, added)
            return k + 1, tuple(s + a for s, a in zip(sums, added, strict=True))

        first_sums = tuple(s[:width] for s in sums)
        k, first_sums = jax.lax.while_loop(lambda state: state[0] < until, step, (k, first_sums))
        return k, tuple(s.at[:width].set(first) for s, first in zip(sums, first_sums, strict=True))

    def shade_chunk(state):
        first, image = state
        block = jax.lax.dynamic_slice(order, (first,), (chunk,))
        in_use = first + jnp.arange(chunk, dtype=jnp.int32) < n_blocks
        run = clusters.block_run[block]
        offset, count = block_offset[block], jnp.where(in_use, block_count[block], 0)
        part = jax.tree.map(lambda channel: channel[run], gbuffer)
        sums = tuple(e.astype(jnp.float32) for e in part.emissive)
        shade_of = shadows.of_runs(run) if shadows is not None else None
        if shade_of is not None:
            surface = jax.tree.map(lambda channel: channel.astype(jnp.float32), surface_of(part))
            sums = tuple(s + a for s, a in zip(sums, reflected_suns(surface, shade_of), strict=True))
        if cluster_light is not None:
            once = cluster_light.reflected_by(part, clusters.block_cluster[block])
            sums = tuple(s + a for s, a in zip(sums, once, strict=True))
        k = jnp.int32(0)
        for width, narrower in zip(widths, (*widths[1:], 0), strict=True):
            # Not the first one's length: very long lists are not in order among themselves.
            longest = jnp.max(count[narrower:width])
            k, sums = add_lights(part, shade_of, offset, count, k, sums, width, longest)
        image = tuple(
            jax.lax.dynamic_update_slice(channel, s, (first, 0)) for channel, s in zip(image, sums, strict=True)
        )
        return first + chunk, image

    blank = tuple(jnp.zeros((capacity + chunk - 1, RUN), jnp.float32) for _ in range(3))
    _, image = jax.lax.while_loop(lambda state: state[0] < n_blocks, shade_chunk, (jnp.int32(0), blank))
    positions = gbuffer.positions
    runs = np.s_[positions.n_solid_runs :] if transparent else np.s_[: positions.n_visible_runs]
    place = jnp.zeros(capacity, jnp.int32).at[order[:capacity]].set(jnp.arange(capacity, dtype=jnp.int32))
    pixel = place[clusters.block_of_sample[runs]] * RUN + jnp.arange(RUN, dtype=jnp.int32)
    return tuple(jnp.where(positions.valid[runs], channel.reshape(-1)[pixel], 0) for channel in image)


def blend_layers(solid: Image, colour: Image, layers: LayerTable) -> Image:
    """Blend transparent layers over the solid image, farthest first.

    **Arguments:** `solid` of the visible runs, `colour` of the transparent runs.
    """

    def blend(i, image):
        run = layers.run[layers.run.shape[0] - 1 - i]
        opacity = jnp.where((run >= 0)[:, None], layers.opacity[jnp.maximum(run, 0)], 0)
        return tuple(
            opacity * c[jnp.maximum(run, 0)] + (1 - opacity) * behind for c, behind in zip(colour, image, strict=True)
        )

    return jax.lax.fori_loop(0, layers.run.shape[0], blend, solid)
