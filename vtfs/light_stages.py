"""The stages of light lists and of shading, each of them a function by itself; those of casting: `shadow_stages.py`."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from vtfs.chunk_sizes import approximate_chunk, assign_chunk, volume_chunk, walk_chunk
from vtfs.cluster_grid import ClusterGrid
from vtfs.cluster_light import split_lists
from vtfs.clusters import Clusters, everything, form_clusters
from vtfs.frame_plan import Plan, Stage, Walked
from vtfs.gbuffer import GBuffer, LayerTable, Positions
from vtfs.light_assignment.brute_force import assign_brute_force
from vtfs.light_assignment.coarse_to_fine import GROUP, assign_coarse_to_fine
from vtfs.light_assignment.light_tree import (
    LightTree,
    assign_tree,
    build_light_tree,
    order_lights,
    reduce_lights,
    sort_lights,
)
from vtfs.light_lists import AssignCounts, LightLists, ViewLights
from vtfs.light_shadows import CastMask, LightShadows, ShadowSlots, shadow_bits
from vtfs.light_volumes import LightPixels, draw_light_volumes, shade_light_volumes
from vtfs.morton import morton_codes
from vtfs.normal_cones import Components
from vtfs.shading import ClusterLight, Image, blend_layers, shade

_FEW_LIGHTS = {"cpu": 512, "gpu": 256}
"""Up to so many lights `auto` tests all pairs; see `benchmarks/light_assignment.py`."""

Assigned = tuple[LightLists, AssignCounts]


def _clusters(plan: Plan, positions: Positions, grid: ClusterGrid, normals: Components | None) -> Clusters:
    return form_clusters(
        positions,
        grid,
        plan.bounds,
        plan.cells,
        plan.blocks,
        plan.unique,
        plan.sections,
        normals,
        plan.normal_cones,
        plan.two_lists and positions.n_transparent_runs > 0,
    )


def _assign_brute_force(plan: Plan, lights: ViewLights, light_cutoff, clusters: Clusters) -> Assigned:
    chunk = walk_chunk(plan.batch, 32, plan.pairs)
    return assign_brute_force(lights.spheres(light_cutoff), clusters, plan.pairs, chunk, plan.cull, lights.cones)


def fastest_for(n_lights: int) -> Walked:
    """How `auto` makes lists of so many lights on this device."""
    return "all_pairs" if n_lights <= _FEW_LIGHTS.get(jax.default_backend(), 0) else "groups"


def _assign_otherwise(plan: Plan, lights: ViewLights, light_cutoff, clusters: Clusters) -> Assigned:
    """Not as published: no tree of lights."""
    if plan.assigner == "auto" and fastest_for(lights.n_lights) == "all_pairs":
        return _assign_brute_force(plan, lights, light_cutoff, clusters)
    spheres, chunk = lights.spheres(light_cutoff), assign_chunk("groups", plan.batch, plan.branching, plan.pairs)
    branching = plan.branching or GROUP
    return assign_coarse_to_fine(spheres, clusters, plan.pairs, chunk, branching, plan.cull, lights.cones)


def _assign_tree(plan: Plan, tree: LightTree, clusters: Clusters) -> Assigned:
    chunk = walk_chunk(plan.batch, plan.branching, plan.pairs)
    return assign_tree(tree, clusters, plan.pairs, chunk, plan.cull, plan.leaf_test)


def _reduce(plan: Plan, lights: ViewLights, light_cutoff):
    return reduce_lights(lights.spheres(light_cutoff))


def _morton(plan: Plan, lights: ViewLights, light_cutoff, box):
    return morton_codes(lights.spheres(light_cutoff), *box)


def _sort(plan: Plan, codes):
    return sort_lights(codes)


def _sort_or_keep(plan: Plan, lights: ViewLights, light_cutoff, old_order, frame, resort_every):
    return order_lights(lights.spheres(light_cutoff), old_order, frame, resort_every)


def _build_tree(plan: Plan, lights: ViewLights, light_cutoff, order) -> LightTree:
    return build_light_tree(lights.spheres(light_cutoff), order, plan.branching, lights.cones)


def _draw_volumes(stencil: bool, plan: Plan, positions: Positions, grid: ClusterGrid, lights: ViewLights, light_cutoff):
    chunk = walk_chunk(plan.batch, 32, plan.pairs)
    spheres = lights.spheres(light_cutoff)
    return draw_light_volumes(spheres, positions, grid, stencil, plan.pairs, chunk), None


def _shade_volumes(plan: Plan, gbuffer: GBuffer, lights: ViewLights, light_cutoff, pixels: LightPixels) -> Image:
    chunk = volume_chunk(pixels.light.shape[0], plan.batch)
    return shade_light_volumes(gbuffer, pixels, lights.row, light_cutoff, chunk)


def _approximate(
    plan: Plan,
    gbuffer: GBuffer,
    lights: ViewLights,
    light_cutoff,
    approximate,
    clusters: Clusters,
    lists: LightLists,
) -> tuple[LightLists, ClusterLight]:
    chunk = approximate_chunk(plan.pairs)
    return split_lists(gbuffer, clusters, lists, lights.row, light_cutoff, approximate, chunk)


def _shade(
    plan: Plan,
    gbuffer: GBuffer,
    lights: ViewLights,
    light_cutoff,
    clusters: Clusters,
    lists: LightLists,
    cluster_light: ClusterLight | None = None,
    shadows: LightShadows | None = None,
) -> Image:
    return shade(
        gbuffer, clusters, lists, lights.row, light_cutoff, plan.batch, cluster_light=cluster_light, shadows=shadows
    )


def _shade_transparent(
    plan: Plan,
    gbuffer: GBuffer,
    layers: LayerTable,
    lights: ViewLights,
    light_cutoff,
    solid: Image,
    clusters: Clusters,
    lists: LightLists,
    cluster_light: ClusterLight | None = None,
    shadows: LightShadows | None = None,
) -> Image:
    rows, batch = lights.row, plan.batch
    colour = shade(gbuffer, clusters, lists, rows, light_cutoff, batch, True, shadows, cluster_light)
    return blend_layers(solid, colour, layers)


def _shadow_bits(plan: Plan, masks: list[CastMask], slots: ShadowSlots, layers: LayerTable) -> LightShadows:
    return shadow_bits(masks, slots, layers)


def _shade_forward(plan: Plan, gbuffer: GBuffer, lights: ViewLights, light_cutoff) -> Image:
    clusters = everything(gbuffer.positions)
    return _shade(plan, gbuffer, lights, light_cutoff, clusters, _all_lights(lights, clusters))


def _shade_transparent_forward(
    plan: Plan, gbuffer: GBuffer, layers: LayerTable, lights: ViewLights, light_cutoff, solid: Image
) -> Image:
    clusters = everything(gbuffer.positions)
    lists = _all_lights(lights, clusters)
    return _shade_transparent(plan, gbuffer, layers, lights, light_cutoff, solid, clusters, lists)


def _all_lights(lights: ViewLights, clusters: Clusters) -> LightLists:
    n_lights = lights.n_lights
    zeros = jnp.zeros_like(clusters.key)
    return LightLists(zeros, zeros + n_lights, jnp.arange(n_lights), jnp.int32(n_lights), jnp.bool_(False))


CLUSTERS = Stage(
    "clusters",
    _clusters,
    ("positions", "grid", "normals"),
    ("bounds", "two_lists", "cells", "blocks", "unique", "sections", "normal_cones"),
)
ASSIGN_BRUTE_FORCE = Stage(
    "assign", _assign_brute_force, ("lights", "light_cutoff", "clusters"), ("batch", "pairs", "cull")
)
SORT = Stage("sort", _sort, ("morton",))
SORT_OR_KEEP = Stage("sort", _sort_or_keep, ("lights", "light_cutoff", "old_order", "frame", "resort_every"))
BUILD_TREE = Stage("build_tree", _build_tree, ("lights", "light_cutoff", "sort"), ("branching",))
ASSIGN_BY_TREE = (
    Stage("reduce", _reduce, ("lights", "light_cutoff")),
    Stage("morton", _morton, ("lights", "light_cutoff", "reduce")),
    SORT,
    BUILD_TREE,
    Stage("assign", _assign_tree, ("build_tree", "clusters"), ("branching", "batch", "pairs", "cull", "leaf_test")),
)
ASSIGN_OTHERWISE = Stage(
    "assign",
    _assign_otherwise,
    ("lights", "light_cutoff", "clusters"),
    ("assigner", "branching", "batch", "pairs", "cull"),
)
_LIGHTS = ("lights", "light_cutoff")
APPROXIMATE = Stage("approximate", _approximate, ("gbuffer", *_LIGHTS, "approximate", "clusters", "listed"), ("pairs",))
SHADE = (
    Stage("shade_opaque", _shade, ("gbuffer", *_LIGHTS, "clusters", "assign", "cluster_light"), ("batch",)),
    Stage(
        "shade_transparent",
        _shade_transparent,
        ("gbuffer", "layers", *_LIGHTS, "shade_opaque", "clusters", "assign", "cluster_light"),
        ("batch",),
    ),
)
SHADE_TRANSPARENT_FORWARD = Stage(
    "shade_transparent", _shade_transparent_forward, ("gbuffer", "layers", *_LIGHTS, "shade_opaque"), ("batch",)
)
SHADE_FORWARD = (
    Stage("shade_opaque", _shade_forward, ("gbuffer", *_LIGHTS), ("batch",)),
    SHADE_TRANSPARENT_FORWARD,
)
SHADOW_BITS = Stage("shadow_bits", _shadow_bits, ("shadow_masks", "shadow_slots", "layers"))
_SHADOWED = ("clusters", "assign", "cluster_light", "shadow_bits")
SHADE_SHADOWED = (
    Stage("shade_opaque", _shade, ("gbuffer", *_LIGHTS, *_SHADOWED), ("batch",)),
    Stage(
        "shade_transparent", _shade_transparent, ("gbuffer", "layers", *_LIGHTS, "shade_opaque", *_SHADOWED), ("batch",)
    ),
)


def light_volume_stages(stencil: bool) -> tuple[Stage, ...]:
    """Light volumes drawn, and their pixels shaded; what is transparent as by `forward`."""
    draw = functools.partial(_draw_volumes, stencil)
    return (
        Stage("assign", draw, ("positions", "grid", *_LIGHTS), ("batch", "pairs")),
        Stage("shade_opaque", _shade_volumes, ("gbuffer", *_LIGHTS, "assign"), ("batch",)),
        SHADE_TRANSPARENT_FORWARD,
    )
