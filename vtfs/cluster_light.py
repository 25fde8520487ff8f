"""Lights that vary little over a cluster, evaluated once for it instead of once for each of its samples.

Future work of Olsson et al. 2012 (Sec. 7). Only on the chart of speed against error: what it costs in accuracy is
measured, as `error`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vtfs.bit_lists import WORD_BITS, gather_hits, last_not_above
from vtfs.bounds import Aabb, sphere_of_box
from vtfs.clusters import Clusters
from vtfs.gbuffer import GBuffer
from vtfs.light_lists import POINT_COLUMNS, LightLists, lists_from_pairs
from vtfs.normal_cones import NormalCones
from vtfs.shading import MIN_DISTANCE2_M2, ClusterLight, Surface, direction_to_eye, reflected

_ANGLE_SLACK_RAD = 1e-3
"""An arc cosine of a float32 near 1 is off by up to sqrt(2 * 2**-23) = 5e-4; angles are sums of two."""

_TINY = 1e-30  # keeps 0 / 0 away


def split_lists(
    gbuffer: GBuffer,
    clusters: Clusters,
    lists: LightLists,
    light_rows: Float[Array, "lights columns"],
    light_cutoff: Float[Array, ""],
    approximate: Float[Array, ""],
    chunk: int,
) -> tuple[LightLists, ClusterLight]:
    """Take the lights off each list that vary by at most `approximate` over the cluster, and evaluate them once.

    A light's variation is the difference of its greatest and its least irradiance over all positions within the
    cluster's box and all normals within its cone (see `lit_range`), as a share of the irradiance at the centre from
    all lights of the list; irradiances are sums of red, green and blue. So the diffuse light of each sample is off by
    at most `approximate` times that, for each light taken off. A light that reaches no sample varies by 0.

    They are evaluated at the centre of the box, for the axis of the cone: the irradiance, which each sample
    multiplies by its base colour, and the highlight for the samples' mean shininess, which each multiplies by its
    specular. How highlights vary is not bounded.

    **Arguments:**

    - `clusters`: with cones of normals.
    - `approximate`: above 0.
    - `chunk`: pairs at once, a multiple of 32.

    **Returns:** what is left of the lists, in the same order and capacity, and the light of each cluster.
    """
    assert clusters.cones is not None, "without cones of normals every light may vary wholly"
    capacity, n_clusters = lists.index.shape[0], clusters.key.shape[0]
    n_pairs = jnp.where(lists.overflowed, 0, lists.total)
    centre = _centres(gbuffer, clusters)
    black = jnp.zeros(n_clusters)

    def pairs(entry):
        """Cluster and light of each entry of the lists."""
        cluster = last_not_above(lists.offset, entry)
        return cluster, light_rows[lists.index[jnp.minimum(entry, capacity - 1)]]

    def measure(state):
        first, variation, total = state
        entry = first + jnp.arange(chunk, dtype=jnp.int32)
        cluster, light = pairs(entry)
        box, cones = (jax.tree.map(lambda c: c[cluster], shape) for shape in (clusters.box, clusters.cones))
        low, high = lit_range(box, cones, light, light_cutoff)
        brightness = light[:, 4] + light[:, 5] + light[:, 6]
        at_centre = sum(_at_centre(centre, cluster, light, light_cutoff, base=1.0, specular=0.0))
        variation = jax.lax.dynamic_update_slice(variation, (high - low) * brightness, (first,))
        return first + chunk, variation, total.at[_of_pair(cluster, entry, n_pairs)].add(at_centre, mode="drop")

    unknown = jnp.zeros(capacity + chunk)
    _, variation, total = jax.lax.while_loop(lambda s: s[0] < n_pairs, measure, (jnp.int32(0), unknown, black))
    most = approximate * total

    def is_kept(entry):
        return variation[entry] > most[last_not_above(lists.offset, entry)]

    def test(row):
        entry = row[:, None] * WORD_BITS + jnp.arange(WORD_BITS, dtype=jnp.int32)
        return is_kept(entry) & (entry < n_pairs)

    def emit(row, bit):
        entry = row * WORD_BITS + bit
        return last_not_above(lists.offset, entry), lists.index[jnp.minimum(entry, capacity - 1)]

    n_words = -(-n_pairs // WORD_BITS)
    (cluster, light), n_kept = gather_hits(n_words, test, emit, 2, capacity, chunk // WORD_BITS)
    kept = lists_from_pairs(cluster[:capacity], light[:capacity], n_kept, lists.overflowed, n_clusters)

    def evaluate(state):
        first, irradiance, highlight = state
        entry = first + jnp.arange(chunk, dtype=jnp.int32)
        cluster, light = pairs(entry)
        target = jnp.where(is_kept(entry), n_clusters, _of_pair(cluster, entry, n_pairs))
        lit = _at_centre(centre, cluster, light, light_cutoff, base=1.0, specular=0.0)
        glossy = _at_centre(centre, cluster, light, light_cutoff, base=0.0, specular=1.0)
        irradiance, highlight = (
            tuple(t.at[target].add(a, mode="drop") for t, a in zip(totals, added, strict=True))
            for totals, added in ((irradiance, lit), (highlight, glossy))
        )
        return first + chunk, irradiance, highlight

    start = (jnp.int32(0), (black,) * 3, (black,) * 3)
    _, irradiance, highlight = jax.lax.while_loop(lambda s: s[0] < n_pairs, evaluate, start)
    return kept, ClusterLight(irradiance, highlight)


def lit_range(
    box: Aabb, cones: NormalCones, light: Float[Array, "pairs columns"], light_cutoff: Float[Array, ""]
) -> tuple[Float[Array, " pairs"], Float[Array, " pairs"]]:
    """Least and greatest `window * cone * max(0, n.l) / max(d**2, 1e-4)` of a light over a cluster.

    Each factor is monotonous in a distance or an angle whose range is known: distances from the nearest to the
    farthest point of the box; directions within the angle under which the light sees the sphere around the box;
    normals within the cluster's cone.

    **Arguments:** box, cone and light (a row of `ViewLights`) of each pair.
    """
    x_m, y_m, z_m = light[:, 0], light[:, 1], light[:, 2]
    sides = ((x_m, box.low_x_m, box.high_x_m), (y_m, box.low_y_m, box.high_y_m), (z_m, box.low_z_m, box.high_z_m))
    nearest2 = sum((at - jnp.clip(at, low, high)) ** 2 for at, low, high in sides)
    farthest2 = sum(jnp.maximum(at - low, high - at) ** 2 for at, low, high in sides)

    def falloff(distance2):
        ratio2 = distance2 * light[:, 3] * light[:, 3]
        window = jnp.maximum(0, 1 - ratio2 * ratio2) ** 2
        return jnp.where(window > light_cutoff, window, 0) / jnp.maximum(distance2, MIN_DISTANCE2_M2)

    around = sphere_of_box(box)
    to_x, to_y, to_z = x_m - around.x_m, y_m - around.y_m, z_m - around.z_m
    distance = jnp.sqrt(to_x * to_x + to_y * to_y + to_z * to_z) + _TINY
    spread = jnp.where(distance > around.radius_m, jnp.arcsin(jnp.minimum(around.radius_m / distance, 1)), jnp.pi)

    def cosines(axis_x, axis_y, axis_z, spread):
        """Least and greatest cosine of the angle between an axis and directions towards the light."""
        cos = (axis_x * to_x + axis_y * to_y + axis_z * to_z) / distance
        angle, spread = jnp.arccos(jnp.clip(cos, -1, 1)), spread + _ANGLE_SLACK_RAD
        return jnp.cos(jnp.minimum(angle + spread, jnp.pi)), jnp.cos(jnp.maximum(angle - spread, 0))

    half_angle = jnp.arccos(jnp.clip(cones.cos, -1, 1))
    least, greatest = (jnp.maximum(cos, 0) for cos in cosines(cones.x, cones.y, cones.z, spread + half_angle))
    if light.shape[1] > POINT_COLUMNS:
        shares = cosines(-light[:, 8], -light[:, 9], -light[:, 10], spread)
        dimmest, brightest = (jnp.clip((cos - light[:, 12]) * light[:, 11], 0, 1) for cos in shares)
        least, greatest = least * dimmest, greatest * brightest
    return falloff(farthest2) * least, falloff(nearest2) * greatest


def _of_pair(cluster, entry, n_pairs):
    """Where a pair adds; nowhere past the last one."""
    return jnp.where(entry < n_pairs, cluster, jnp.iinfo(jnp.int32).max)


def _centres(gbuffer: GBuffer, clusters: Clusters) -> Surface:
    """The surface that stands for each cluster: centre of its box, axis of its cone, mean shininess."""
    assert clusters.cones is not None
    box, cones, n_clusters = clusters.box, clusters.cones, clusters.key.shape[0]
    used = jnp.arange(n_clusters) < clusters.n_clusters  # boxes of the others may be infinite
    sides = ((box.low_x_m, box.high_x_m), (box.low_y_m, box.high_y_m), (box.low_z_m, box.high_z_m))
    x_m, y_m, z_m = (jnp.where(used, 0.5 * (low + high), 0) for low, high in sides)
    run = clusters.block_run
    block = jnp.arange(run.shape[0], dtype=jnp.int32)
    is_here = (clusters.block_of_sample[run] == block[:, None]) & gbuffer.positions.valid[run]
    target = jnp.where(block < clusters.n_blocks, clusters.block_cluster, n_clusters)
    shininess = jnp.where(is_here, gbuffer.shininess[run].astype(jnp.float32), 0)
    summed, n_samples = (
        jnp.zeros(n_clusters).at[target].add(jnp.sum(values, axis=1), mode="drop")
        for values in (shininess, is_here.astype(jnp.float32))
    )
    white = jnp.ones(n_clusters)
    position_m = (x_m, y_m, z_m)
    return Surface(
        position_m,
        direction_to_eye(position_m, gbuffer.positions.is_parallel),
        (cones.x, cones.y, cones.z),
        (white, white, white),
        white,
        summed / jnp.maximum(n_samples, 1),
    )


def _at_centre(
    centre: Surface, cluster: Int[Array, " pairs"], light, light_cutoff, *, base: float, specular: float
) -> tuple[Float[Array, " pairs"], ...]:
    """What a surface of that base colour and specular at the centre reflects of each pair's light."""
    here = jax.tree.map(lambda channel: channel[cluster], centre)
    here = Surface(
        here.position_m,
        here.to_eye,
        here.normal,
        tuple(base * channel for channel in here.base_colour),
        specular * here.specular,
        here.shininess,
    )
    return reflected(here, light, light_cutoff)
