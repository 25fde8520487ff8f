"""The registry: each technique as the stages that its frames run, one after the other.

A technique is a row here and a row of `parameters.TECHNIQUES`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp

from vtfs.bit_lists import WORD_BITS
from vtfs.cluster_grid import ClusterGrid
from vtfs.cluster_light import split_lists
from vtfs.clusters import Bounds, Clusters, Unique, everything, form_clusters
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
from vtfs.light_culling import Cull, LeafTest, needs_sections
from vtfs.light_lists import AssignCounts, LightLists, ViewLights
from vtfs.light_shadows import CastMask, LightShadows, ShadowSlots, shadow_bits
from vtfs.light_volumes import LightPixels, draw_light_volumes, shade_light_volumes
from vtfs.morton import morton_codes
from vtfs.normal_cones import Components, ConeKind
from vtfs.parameters import (
    SHADOW_NAMES,
    SHADOW_REFERENCES,
    Configuration,
    lists_configuration,
    passes_only_what_meets_the_box,
)
from vtfs.shading import ClusterLight, Image, blend_layers, chunk_blocks, shade
from vtfs.shadow_mask import ShadowPlan
from vtfs.shadow_programs import shadow_plan
from vtfs.shadow_stages import TRANSMIT, CastingStage, casting_stages

_TESTS_AT_ONCE = {"cpu": 2**19, "gpu": 2**22}
"""`batch = 0` means all queries at once, as far as their rows of boxes stay in the cache of a CPU (12 MB) or leave
the memory of a GPU to others (100 MB)."""

_WORDS_AT_ONCE = {"cpu": 2**14, "gpu": 2**23}
"""The same, in words of 32 tests, where lists are refined: one light is loaded for all cells of a group."""

_FEW_LIGHTS = {"cpu": 512, "gpu": 256}
"""Up to so many lights `auto` tests all pairs; see `benchmarks/light_assignment.py`."""

Assigner = Literal["published", "coarse_to_fine", "auto"]
Walked = Literal["all_pairs", "tree", "groups"]
"""How lists were made: every light against every cell, by a tree of lights, or from groups of cells to cells."""


@dataclass(frozen=True)
class Plan:
    """What is static in a frame's programs: it fixes array shapes. A stage sees only what it names.

    - `two_lists`: transparent samples have lists of their own.
    - `keeps_order`: the light tree is sorted in some frames only.
    - `approximates`: lights that vary little over a cluster are evaluated once for it.
    - `assigner`: `published` also where `auto` has no choice.
    - `cells`, `blocks`, `pairs`: rounded capacities (see `frame.Sizes`).
    - `shadow`: of shadow techniques, with capacities of its own; `alpha`: of alpha casters, where any cast.
    """

    bounds: Bounds = "implicit"
    two_lists: bool = False
    cull: Cull = "box"
    leaf_test: LeafTest = "sphere"
    unique: Unique = "page_table"
    normal_cones: ConeKind = "implicit"
    sections: bool = False
    approximates: bool = False
    keeps_order: bool = False
    branching: int = 0
    assigner: Assigner = "published"
    batch: int = 0
    cells: int = 0
    blocks: int = 0
    pairs: int = 0
    shadow: ShadowPlan | None = None
    alpha: ShadowPlan | None = None


@dataclass(frozen=True)
class Stage:
    """One step of a frame, timed apart.

    - `needs`: inputs (`positions`, `gbuffer`, `layers`, `grid`, `normals`, `lights`, `light_cutoff`, `approximate`, for
      kept orders `old_order`, `frame`, `resort_every`, of shadow techniques `shadow_tasks` and `shadow_slots`) and
      earlier stages. `listed` are the lists as assigned, `assign` those without what is evaluated once a cluster, and
      `cluster_light` is that, or None. `shadow_masks` are those of
      `shadow_merge`, with what alpha casters leave where there are any.
    - `statics`: the fields of `Plan` that its program depends on.
    - `casting`: it runs once for each light that casts and each view, in float64: what it needs and its results are
      lists.
    """

    name: str
    run: Callable[..., Any]
    needs: tuple[str, ...]
    statics: tuple[str, ...] = ()
    casting: CastingStage | None = None

    def narrowed(self, plan: Plan) -> Plan:
        """The plan with only what the stage's program depends on, so that nothing else compiles it again."""
        own = plan.alpha if self.casting and self.casting.of_alpha else plan.shadow
        if self.casting and own:
            return Plan(shadow=self.casting.narrowed(own))
        return Plan(**{name: getattr(plan, name) for name in self.statics})


Lists = Literal["clusters", "light_volumes", "none"]


@dataclass(frozen=True)
class Technique:
    """How a frame is made.

    - `lists`: what its assignment makes: lists of lights for clusters, pixels for lights, or nothing.
    - `one_slice`: cells are whole tiles, whatever the depth.
    - `two_lists`: transparent samples have lists of their own.
    - `without_prepass`: fragments that end up hidden are shaded too; `forward` has a parameter for that.
    - `reads_gbuffer`: bytes go through a G-buffer: once for each sample, or once for each light on it.
    """

    name: str
    stages: tuple[Stage, ...]
    lists: Lists = "clusters"
    one_slice: bool = False
    two_lists: bool = False
    without_prepass: bool = False
    reads_gbuffer: Literal["never", "per_sample", "per_light"] = "never"

    @property
    def casts_shadows(self) -> bool:
        return any(stage.name == "shadow_bits" for stage in self.stages)

    def plan(self, config: Configuration) -> Plan:
        """The static part of a configuration, without capacities."""
        if self.casts_shadows:
            lists = lists_configuration(config)
            return replace(REGISTRY[lists.technique].plan(lists), shadow=shadow_plan(config))
        params = config.params
        keeps_order = int(params.get("resort_every", 1)) > 1
        has_choice = passes_only_what_meets_the_box(params) and not keeps_order  # only a tree has an order to keep
        assigner = params.get("assigner", "published") if has_choice else "published"
        return Plan(
            bounds=params.get("bounds", "implicit"),  # type: ignore[arg-type]
            two_lists=self.two_lists,
            cull=params.get("cull", "box"),  # type: ignore[arg-type]
            leaf_test=params.get("leaf_test", "sphere"),  # type: ignore[arg-type]
            unique=params.get("unique", "page_table"),  # type: ignore[arg-type]
            # How much light varies depends on where samples face, so that is found out.
            normal_cones="explicit" if approximates(config) else params.get("normal_cones", "implicit"),  # type: ignore[arg-type]
            sections=needs_sections(params.get("cull", "box")),  # type: ignore[arg-type]
            approximates=approximates(config),
            keeps_order=keeps_order,
            branching=int(params.get("branching", 0)),
            assigner=assigner,  # type: ignore[arg-type]
            batch=int(params.get("batch", 0)),
        )

    def shades_hidden(self, config: Configuration) -> bool:
        """Are fragments shaded that end up hidden?"""
        return config.params.get("prepass", "off" if self.without_prepass else "on") == "off"

    def stages_of(self, plan: Plan, has_transparent: bool) -> tuple[Stage, ...]:
        """The stages of a frame; that of transparent samples only where there are any, a tree of lights only where the
        lists are made as published, and one stage that sorts them or not in place of three where their order is kept.
        """
        stages = self.stages if plan.assigner == "published" else _without_tree(self.stages)
        left_out = {"shade_transparent": not has_transparent, "approximate": not plan.approximates}
        left_out |= dict.fromkeys(("reduce", "morton"), plan.keeps_order) | {TRANSMIT: plan.alpha is None}
        stages = (_SORT_OR_KEEP if stage is _SORT and plan.keeps_order else stage for stage in stages)
        return tuple(stage for stage in stages if not left_out.get(stage.name, False))

    def walked(self, plan: Plan, n_lights: int) -> Walked:
        """How lists are made of so many lights on this device."""
        if plan.assigner == "published":
            return "tree" if _BUILD_TREE in self.stages else "all_pairs"
        return _fastest(n_lights) if plan.assigner == "auto" else "groups"


def approximates(config: Configuration) -> bool:
    """Are some lights evaluated once a cluster?"""
    return float(config.params.get("approximate", 0)) > 0


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


_MAX_TESTS_AT_ONCE = 2**24  # their boxes take 400 MB


def walk_chunk(batch: int, branching: int, pairs: int) -> int:
    """(cluster, node) pairs tested at once."""
    if batch:
        return min(batch, _MAX_TESTS_AT_ONCE // branching)
    return min(pairs, _TESTS_AT_ONCE.get(jax.default_backend(), 2**22) // branching)


def _assign_brute_force(plan: Plan, lights: ViewLights, light_cutoff, clusters: Clusters) -> Assigned:
    chunk = walk_chunk(plan.batch, 32, plan.pairs)
    return assign_brute_force(lights.spheres(light_cutoff), clusters, plan.pairs, chunk, plan.cull, lights.cones)


def _fastest(n_lights: int) -> Walked:
    return "all_pairs" if n_lights <= _FEW_LIGHTS.get(jax.default_backend(), 0) else "groups"


def _assign_otherwise(plan: Plan, lights: ViewLights, light_cutoff, clusters: Clusters) -> Assigned:
    """Not as published: no tree of lights."""
    if plan.assigner == "auto" and _fastest(lights.n_lights) == "all_pairs":
        return _assign_brute_force(plan, lights, light_cutoff, clusters)
    spheres, chunk = lights.spheres(light_cutoff), assign_chunk("groups", plan.batch, plan.branching, plan.pairs)
    branching = plan.branching or GROUP
    return assign_coarse_to_fine(spheres, clusters, plan.pairs, chunk, branching, plan.cull, lights.cones)


def assign_chunk(walked: Walked, batch: int, branching: int, pairs: int) -> int:
    """Rows tested at once: (cluster, node) pairs, or words of 32 (cluster, light) pairs."""
    if walked == "groups":
        return batch or _WORDS_AT_ONCE.get(jax.default_backend(), 2**23)
    return walk_chunk(batch, branching if walked == "tree" else WORD_BITS, pairs)


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


_MAX_VOLUME_RUNS = 2**16  # runs whose G-buffer is gathered at once: 100 MB


def volume_chunk(pairs: int, batch: int) -> int:
    """(light, run) pairs shaded at once."""
    return min(chunk_blocks(pairs, batch), _MAX_VOLUME_RUNS)


_PAIRS_AT_ONCE = {"cpu": 2**15, "gpu": 2**20}


def _approximate(
    plan: Plan,
    gbuffer: GBuffer,
    lights: ViewLights,
    light_cutoff,
    approximate,
    clusters: Clusters,
    lists: LightLists,
) -> tuple[LightLists, ClusterLight]:
    chunk = min(plan.pairs, _PAIRS_AT_ONCE.get(jax.default_backend(), 2**20))
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


def _without_tree(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    kept = tuple(stage for stage in stages if stage.name not in ("reduce", "morton", "sort", "build_tree"))
    return tuple(_ASSIGN_OTHERWISE if stage.name == "assign" else stage for stage in kept)


_CLUSTERS = Stage(
    "clusters",
    _clusters,
    ("positions", "grid", "normals"),
    ("bounds", "two_lists", "cells", "blocks", "unique", "sections", "normal_cones"),
)
_ASSIGN_BRUTE_FORCE = Stage(
    "assign", _assign_brute_force, ("lights", "light_cutoff", "clusters"), ("batch", "pairs", "cull")
)
_SORT = Stage("sort", _sort, ("morton",))
_SORT_OR_KEEP = Stage("sort", _sort_or_keep, ("lights", "light_cutoff", "old_order", "frame", "resort_every"))
_BUILD_TREE = Stage("build_tree", _build_tree, ("lights", "light_cutoff", "sort"), ("branching",))
_ASSIGN_BY_TREE = (
    Stage("reduce", _reduce, ("lights", "light_cutoff")),
    Stage("morton", _morton, ("lights", "light_cutoff", "reduce")),
    _SORT,
    _BUILD_TREE,
    Stage("assign", _assign_tree, ("build_tree", "clusters"), ("branching", "batch", "pairs", "cull", "leaf_test")),
)
_ASSIGN_OTHERWISE = Stage(
    "assign",
    _assign_otherwise,
    ("lights", "light_cutoff", "clusters"),
    ("assigner", "branching", "batch", "pairs", "cull"),
)
_LIGHTS = ("lights", "light_cutoff")
_APPROXIMATE = Stage(
    "approximate", _approximate, ("gbuffer", *_LIGHTS, "approximate", "clusters", "listed"), ("pairs",)
)
_SHADE = (
    Stage("shade_opaque", _shade, ("gbuffer", *_LIGHTS, "clusters", "assign", "cluster_light"), ("batch",)),
    Stage(
        "shade_transparent",
        _shade_transparent,
        ("gbuffer", "layers", *_LIGHTS, "shade_opaque", "clusters", "assign", "cluster_light"),
        ("batch",),
    ),
)
_SHADE_TRANSPARENT_FORWARD = Stage(
    "shade_transparent", _shade_transparent_forward, ("gbuffer", "layers", *_LIGHTS, "shade_opaque"), ("batch",)
)


def _deferred(name: str, stencil: bool) -> Technique:
    draw = functools.partial(_draw_volumes, stencil)
    stages = (
        Stage("assign", draw, ("positions", "grid", *_LIGHTS), ("batch", "pairs")),
        Stage("shade_opaque", _shade_volumes, ("gbuffer", *_LIGHTS, "assign"), ("batch",)),
        _SHADE_TRANSPARENT_FORWARD,
    )
    return Technique(name, stages, lists="light_volumes", reads_gbuffer="per_light")


_SHADOW_BITS = Stage("shadow_bits", _shadow_bits, ("shadow_masks", "shadow_slots", "layers"))
_SHADOWED = ("clusters", "assign", "cluster_light", "shadow_bits")
_SHADE_SHADOWED = (
    Stage("shade_opaque", _shade, ("gbuffer", *_LIGHTS, *_SHADOWED), ("batch",)),
    Stage(
        "shade_transparent", _shade_transparent, ("gbuffer", "layers", *_LIGHTS, "shade_opaque", *_SHADOWED), ("batch",)
    ),
)


def _casting(name: str) -> tuple[Stage, ...]:
    """The stages of casting, of references none: they bring their masks from the host."""
    if name in SHADOW_REFERENCES:
        return ()

    def run(casting: CastingStage, plan: Plan, *inputs: Any) -> Any:
        assert plan.shadow is not None
        return casting.run(plan.shadow, *inputs)

    return tuple(
        Stage(casting.name, functools.partial(run, casting), casting.needs, ("shadow",), casting)
        for casting in casting_stages(name)
    )


def _shadowed(name: str) -> Technique:
    """Light lists, the shadow of each light that casts, and shading by both."""
    stages = (_CLUSTERS, *_ASSIGN_BY_TREE, *_casting(name), _SHADOW_BITS, *_SHADE_SHADOWED)
    return Technique(name, stages, reads_gbuffer="per_sample")


_TILED = (_CLUSTERS, _ASSIGN_BRUTE_FORCE, _APPROXIMATE, *_SHADE)
_CLUSTERED = (_CLUSTERS, *_ASSIGN_BY_TREE, _APPROXIMATE, *_SHADE)

REGISTRY: dict[str, Technique] = {
    technique.name: technique
    for technique in (
        Technique(
            "forward",
            (Stage("shade_opaque", _shade_forward, ("gbuffer", *_LIGHTS), ("batch",)), _SHADE_TRANSPARENT_FORWARD),
            lists="none",
        ),
        _deferred("deferred", stencil=False),
        _deferred("deferred_stencil", stencil=True),
        Technique("tiled_forward", _TILED, one_slice=True, without_prepass=True),
        Technique("tiled_forward_prez", _TILED, one_slice=True, two_lists=True),
        Technique(
            "tiled_deferred",
            _TILED,
            one_slice=True,
            two_lists=True,
            reads_gbuffer="per_sample",
        ),
        Technique("clustered_deferred", _CLUSTERED, reads_gbuffer="per_sample"),
        Technique("clustered_forward", _CLUSTERED),
        Technique("volume_tiled", _TILED),
        Technique("volume_tiled_bvh", _CLUSTERED),
        *map(_shadowed, SHADOW_NAMES),
    )
}
