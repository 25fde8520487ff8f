"""The registry: each technique as the stages that its frames run, one after the other.

A technique is a row here and a row of `parameters.TECHNIQUES`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any, Literal

from vtfs.configurations import Configuration, lists_configuration, passes_only_what_meets_the_box
from vtfs.frame_plan import Plan, Stage, Walked
from vtfs.light_culling import needs_sections
from vtfs.light_stages import (
    APPROXIMATE,
    ASSIGN_BRUTE_FORCE,
    ASSIGN_BY_TREE,
    ASSIGN_OTHERWISE,
    BUILD_TREE,
    CLUSTERS,
    SHADE,
    SHADE_FORWARD,
    SHADE_SHADOWED,
    SHADOW_BITS,
    SORT,
    SORT_OR_KEEP,
    fastest_for,
    light_volume_stages,
)
from vtfs.shadow_programs import shadow_plan
from vtfs.shadow_stages import TRANSMIT, CastingStage, casting_stages
from vtfs.technique_names import SHADOW_NAMES, SHADOW_REFERENCES

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
        stages = (SORT_OR_KEEP if stage is SORT and plan.keeps_order else stage for stage in stages)
        return tuple(stage for stage in stages if not left_out.get(stage.name, False))

    def walked(self, plan: Plan, n_lights: int) -> Walked:
        """How lists are made of so many lights on this device."""
        if plan.assigner == "published":
            return "tree" if BUILD_TREE in self.stages else "all_pairs"
        return fastest_for(n_lights) if plan.assigner == "auto" else "groups"


def approximates(config: Configuration) -> bool:
    """Are some lights evaluated once a cluster?"""
    return float(config.params.get("approximate", 0)) > 0


def _without_tree(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    kept = tuple(stage for stage in stages if stage.name not in ("reduce", "morton", "sort", "build_tree"))
    return tuple(ASSIGN_OTHERWISE if stage.name == "assign" else stage for stage in kept)


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
    stages = (CLUSTERS, *ASSIGN_BY_TREE, *_casting(name), SHADOW_BITS, *SHADE_SHADOWED)
    return Technique(name, stages, reads_gbuffer="per_sample")


_TILED = (CLUSTERS, ASSIGN_BRUTE_FORCE, APPROXIMATE, *SHADE)
_CLUSTERED = (CLUSTERS, *ASSIGN_BY_TREE, APPROXIMATE, *SHADE)

REGISTRY: dict[str, Technique] = {
    technique.name: technique
    for technique in (
        Technique("forward", SHADE_FORWARD, lists="none"),
        Technique("deferred", light_volume_stages(stencil=False), lists="light_volumes", reads_gbuffer="per_light"),
        Technique(
            "deferred_stencil", light_volume_stages(stencil=True), lists="light_volumes", reads_gbuffer="per_light"
        ),
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
