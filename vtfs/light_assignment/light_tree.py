"""Lights in a Morton-ordered wide tree: O(M log N), for up to millions of lights.

Olsson et al. 2012, Sec. 3.3; van Oosten 2017, chapters 5 to 7. The steps are separate functions, as the
papers time them apart.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

from vtfs.bounds import Aabb, Cone, Sphere, box_of_sphere, boxes_meet
from vtfs.clusters import Clusters
from vtfs.light_culling import Cull, LeafTest, box_rows, may_reach
from vtfs.light_lists import AssignCounts, LightLists, lists_from_pairs
from vtfs.morton import morton_codes
from vtfs.sort_keys import sorted_order
from vtfs.wide_tree import WideTree, build_tree, in_leaf_nodes, walk


class LightTree(eqx.Module):
    """A tree over lights in Morton order.

    - `leaf`: one row a leaf node: x, y, z, radius of its lights; absent ones are at infinity. Where there are spots,
      the five components of `Cone` as well.
    - `light`: which light each place of the order is.
    """

    tree: WideTree
    leaf: Float[Array, "leaves columns branching"]
    light: Int[Array, " lights"]


def reduce_lights(lights: Sphere) -> tuple[Float[Array, 3], Float[Array, 3]]:
    """Box of all lights' centres (lights that reach nothing left out)."""

    def extent(centre_m):
        finite = jnp.isfinite(lights.x_m)
        return (
            jnp.min(jnp.where(finite, centre_m, jnp.inf), initial=jnp.inf),
            jnp.max(jnp.where(finite, centre_m, -jnp.inf), initial=-jnp.inf),
        )

    low, high = zip(*map(extent, (lights.x_m, lights.y_m, lights.z_m)), strict=True)
    return jnp.stack(low), jnp.stack(high)


def sort_lights(*code: UInt32[Array, " lights"]) -> Int[Array, " lights"]:
    """The lights in order of their codes (words, the most significant first); equal codes keep their order."""
    return sorted_order(code)


def order_lights(
    lights: Sphere, old_order: Int[Array, " lights"], frame: Int[Array, ""], resort_every: Int[Array, ""]
) -> Int[Array, " lights"]:
    """Morton order, sorted again in every `resort_every`-th frame only; between them the old order stays.

    Any order is right, as boxes are made anew in every frame: lights that moved far from their neighbours make them
    larger, and the walk longer. In frame 0 `old_order` is not read.
    """

    def sort_again():
        return sort_lights(morton_codes(lights, *reduce_lights(lights)))

    return jax.lax.cond(frame % resort_every == 0, sort_again, lambda: old_order)


def build_light_tree(
    lights: Sphere, order: Int[Array, " lights"], branching: int, cones: Cone | None = None
) -> LightTree:
    """Leaf rows and the boxes of all nodes, of lights in the given order."""
    ordered = Sphere(lights.x_m[order], lights.y_m[order], lights.z_m[order], lights.radius_m[order])
    rows = [in_leaf_nodes(ordered.x_m, branching, jnp.inf)]
    rows += [in_leaf_nodes(c, branching, 0.0) for c in (ordered.y_m, ordered.z_m, ordered.radius_m)]
    rows += [in_leaf_nodes(c[order], branching, 0.0) for c in jax.tree.leaves(cones)]
    return LightTree(build_tree(box_of_sphere(ordered), branching), jnp.stack(rows, axis=1), order)


def light_tree(lights: Sphere, branching: int, cones: Cone | None = None) -> LightTree:
    """All steps: reduce, Morton codes, sort, build."""
    low_m, high_m = reduce_lights(lights)
    return build_light_tree(lights, sort_lights(morton_codes(lights, low_m, high_m)), branching, cones)


def assign_tree(
    lights: LightTree,
    clusters: Clusters,
    capacity: int,
    chunk: int,
    cull: Cull = "box",
    leaf_test: LeafTest = "sphere",
) -> tuple[LightLists, AssignCounts]:
    """Walk the clusters' boxes down the light tree; at the leaves the sphere decides, unless `leaf_test` is `box`.

    Lights are listed in Morton order.
    """

    def descend(cluster, children: Aabb):
        return boxes_meet(children, box_rows(clusters.box, cluster))

    def keep(cluster, node):
        columns = [lights.leaf[node][:, c] for c in range(lights.leaf.shape[1])]
        cone = Cone(*columns[4:]) if len(columns) > 4 else None
        return may_reach(Sphere(*columns[:4]), cone, clusters, cluster, cull, leaf_test)

    found = walk(lights.tree, clusters.n_clusters, descend, keep, capacity, chunk)
    last = max(lights.light.shape[0] - 1, 0)
    index = lights.light[jnp.minimum(found.item, last)]
    lists = lists_from_pairs(found.query, index, found.total, found.overflowed, clusters.key.shape[0])
    return lists, AssignCounts(found.node_rows, found.short_rows, found.leaf_rows, found.short_leaf_rows)
