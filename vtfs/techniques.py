"""The registry: each technique as the stages that its frames run, one after the other.

A technique is a row here and a row of `parameters.TECHNIQUES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from vtfs.cluster_grid import ClusterGrid
from vtfs.clusters import Bounds, Clusters, Unique, everything, form_clusters
from vtfs.gbuffer import GBuffer, Positions
from vtfs.light_assignment.brute_force import assign_brute_force
from vtfs.light_assignment.light_tree import (
    LightTree,
    assign_tree,
    build_light_tree,
    reduce_lights,
    sort_lights,
)
from vtfs.light_culling import Cull, LeafTest, needs_sections
from vtfs.light_lists import AssignCounts, LightLists, ViewLights
from vtfs.morton import morton_codes
from vtfs.normal_cones import Components, ConeKind
from vtfs.parameters import Configuration
from vtfs.shading import Image, shade

_TESTS_AT_ONCE = {"cpu": 2**19, "gpu": 2**22}
"""`batch = 0` means all queries at once, as far as their rows of boxes stay in the cache of a CPU (12 MB) or leave
the memory of a GPU to others (100 MB)."""


@dataclass(frozen=True)
class Plan:
    """What is static in a frame's programs: it fixes array shapes. A stage sees only what it names.

    - `cells`, `blocks`, `pairs`: rounded capacities (see `frame.Sizes`).
    """

    bounds: Bounds = "implicit"
    cull: Cull = "box"
    leaf_test: LeafTest = "sphere"
    unique: Unique = "page_table"
    normal_cones: ConeKind = "implicit"
    sections: bool = False
    branching: int = 0
    batch: int = 0
    cells: int = 0
    blocks: int = 0
    pairs: int = 0


@dataclass(frozen=True)
class Stage:
    """One step of a frame, timed apart.

    - `needs`: inputs (`positions`, `gbuffer`, `grid`, `normals`, `lights`, `light_cutoff`) and earlier stages.
    - `statics`: the fields of `Plan` that its program depends on.
    """

    name: str
    run: Callable[..., Any]
    needs: tuple[str, ...]
    statics: tuple[str, ...] = ()


@dataclass(frozen=True)
class Technique:
    """How a frame is made.

    - `one_slice`: cells are whole tiles, whatever the depth.
    - `bounds`: what stands for the samples of a cell where the configuration does not say.
    """

    name: str
    stages: tuple[Stage, ...]
    one_slice: bool = False
    bounds: Bounds = "implicit"

    def plan(self, config: Configuration) -> Plan:
        """The static part of a configuration, without capacities."""
        params = config.params
        return Plan(
            bounds=params.get("bounds", self.bounds),  # type: ignore[arg-type]
            cull=params.get("cull", "box"),  # type: ignore[arg-type]
            leaf_test=params.get("leaf_test", "sphere"),  # type: ignore[arg-type]
            unique=params.get("unique", "page_table"),  # type: ignore[arg-type]
            normal_cones=params.get("normal_cones", "implicit"),  # type: ignore[arg-type]
            sections=needs_sections(params.get("cull", "box")),  # type: ignore[arg-type]
            branching=int(params.get("branching", 0)),
            batch=int(params.get("batch", 0)),
        )


Assigned = tuple[LightLists, AssignCounts]


def _clusters(plan: Plan, positions: Positions, grid: ClusterGrid, normals: Components | None) -> Clusters:
    return form_clusters(
        positions, grid, plan.bounds, plan.cells, plan.blocks, plan.unique, plan.sections, normals, plan.normal_cones
    )


_MAX_TESTS_AT_ONCE = 2**24  # their boxes take 400 MB


def walk_chunk(batch: int, branching: int, pairs: int) -> int:
    """(cluster, node) pairs tested at once."""
    if batch:
        return min(batch, _MAX_TESTS_AT_ONCE // branching)
    return min(pairs, _TESTS_AT_ONCE.get(jax.default_backend(), 2**22) // branching)


def _assign_brute_force(plan: Plan, lights: ViewLights, light_cutoff, clusters: Clusters) -> Assigned:
    chunk = walk_chunk(plan.batch, 32, plan.pairs)
    return assign_brute_force(lights.spheres(light_cutoff), clusters, plan.pairs, chunk, plan.cull, lights.cones)


def _assign_tree(plan: Plan, tree: LightTree, clusters: Clusters) -> Assigned:
    chunk = walk_chunk(plan.batch, plan.branching, plan.pairs)
    return assign_tree(tree, clusters, plan.pairs, chunk, plan.cull, plan.leaf_test)


def _reduce(plan: Plan, lights: ViewLights, light_cutoff):
    return reduce_lights(lights.spheres(light_cutoff))


def _morton(plan: Plan, lights: ViewLights, light_cutoff, box):
    return morton_codes(lights.spheres(light_cutoff), *box)


def _sort(plan: Plan, codes):
    return sort_lights(codes)


def _build_tree(plan: Plan, lights: ViewLights, light_cutoff, order) -> LightTree:
    return build_light_tree(lights.spheres(light_cutoff), order, plan.branching, lights.cones)


def _shade(
    plan: Plan, gbuffer: GBuffer, lights: ViewLights, light_cutoff, clusters: Clusters, lists: LightLists
) -> Image:
    return shade(gbuffer, clusters, lists, lights.row, light_cutoff, plan.batch)


def _shade_forward(plan: Plan, gbuffer: GBuffer, lights: ViewLights, light_cutoff) -> Image:
    clusters = everything(gbuffer.positions)
    return shade(gbuffer, clusters, _all_lights(lights, clusters), lights.row, light_cutoff, plan.batch)


def _all_lights(lights: ViewLights, clusters: Clusters) -> LightLists:
    n_lights = lights.n_lights
    zeros = jnp.zeros_like(clusters.key)
    return LightLists(zeros, zeros + n_lights, jnp.arange(n_lights), jnp.int32(n_lights), jnp.bool_(False))


_CLUSTERS = Stage(
    "clusters",
    _clusters,
    ("positions", "grid", "normals"),
    ("bounds", "cells", "blocks", "unique", "sections", "normal_cones"),
)
_SHADE = Stage("shade_opaque", _shade, ("gbuffer", "lights", "light_cutoff", "clusters", "assign"), ("batch",))

REGISTRY: dict[str, Technique] = {
    technique.name: technique
    for technique in (
        Technique(
            "forward", (Stage("shade_opaque", _shade_forward, ("gbuffer", "lights", "light_cutoff"), ("batch",)),)
        ),
        Technique(
            "tiled_deferred",
            (
                _CLUSTERS,
                Stage(
                    "assign", _assign_brute_force, ("lights", "light_cutoff", "clusters"), ("batch", "pairs", "cull")
                ),
                _SHADE,
            ),
            one_slice=True,
            bounds="depth_range",
        ),
        Technique(
            "volume_tiled_bvh",
            (
                _CLUSTERS,
                Stage("reduce", _reduce, ("lights", "light_cutoff")),
                Stage("morton", _morton, ("lights", "light_cutoff", "reduce")),
                Stage("sort", _sort, ("morton",)),
                Stage("build_tree", _build_tree, ("lights", "light_cutoff", "sort"), ("branching",)),
                Stage(
                    "assign",
                    _assign_tree,
                    ("build_tree", "clusters"),
                    ("branching", "batch", "pairs", "cull", "leaf_test"),
                ),
                _SHADE,
            ),
        ),
    )
}
