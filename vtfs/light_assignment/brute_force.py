"""Every light against every cluster: O(M N), and the fastest for a few hundred lights."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from vtfs.bit_lists import WORD_BITS, gather_hits
from vtfs.bounds import Cone, Sphere
from vtfs.clusters import Clusters
from vtfs.light_culling import Cull, may_reach
from vtfs.light_lists import AssignCounts, LightLists, lists_from_pairs
from vtfs.wide_tree import in_leaf_nodes, n_leaf_nodes

_MAX_ROWS = 2**30  # the last chunk starts below 2^31


def assign_brute_force(
    lights: Sphere, clusters: Clusters, capacity: int, chunk: int, cull: Cull = "box", cones: Cone | None = None
) -> tuple[LightLists, AssignCounts]:
    """Test all pairs, 32 lights a word (Olsson and Assarsson 2011; van Oosten 2017, Alg. 8.4).

    Lights are listed in ascending order.
    """
    n_lights = lights.x_m.shape[0]
    n_words = n_leaf_nodes(n_lights, WORD_BITS)
    x_m = in_leaf_nodes(lights.x_m, WORD_BITS, jnp.inf)
    y_m, z_m, radius_m = (in_leaf_nodes(c, WORD_BITS, 0.0) for c in (lights.y_m, lights.z_m, lights.radius_m))
    cones = jax.tree.map(lambda c: in_leaf_nodes(c, WORD_BITS, 0.0), cones)

    def test(row):
        cluster, word = row // n_words, row % n_words
        sphere = Sphere(x_m[word], y_m[word], z_m[word], radius_m[word])
        return may_reach(sphere, jax.tree.map(lambda c: c[word], cones), clusters, cluster, cull, "sphere")

    def emit(row, bit):
        return row // n_words, row % n_words * WORD_BITS + bit

    # More rows than 31 bits count do not fit, like pairs beyond the capacity.
    too_many = clusters.n_clusters > _MAX_ROWS // n_words
    n_rows = jnp.where(too_many, 0, clusters.n_clusters * n_words)
    (cluster, light), total = gather_hits(n_rows, test, emit, 2, capacity, chunk)
    lists = lists_from_pairs(cluster, light, total, (total > capacity) | too_many, clusters.key.shape[0])
    none = jnp.zeros(0, jnp.int32)
    return lists, AssignCounts(none, none, n_rows, clusters.n_clusters)


def every_pair(n_clusters: int, n_lights: int) -> AssignCounts:
    """The counts of testing all pairs, without testing them; host integers."""
    none = np.zeros(0, np.int64)
    rows, short_rows = np.int64(n_clusters) * n_leaf_nodes(n_lights, WORD_BITS), np.int64(n_clusters)
    return AssignCounts(none, none, rows, short_rows)  # type: ignore[arg-type]  # as on the device
