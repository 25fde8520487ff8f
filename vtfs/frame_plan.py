"""What is static in a frame, and the record of a stage, which depends on a part of it only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from vtfs.clusters import Bounds, Unique
from vtfs.light_culling import Cull, LeafTest
from vtfs.normal_cones import ConeKind
from vtfs.shadow_mask import ShadowPlan
from vtfs.shadow_stages import CastingStage

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
    - `cells`, `blocks`, `pairs`: rounded capacities (see `frame_sizes.Sizes`).
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
      `cluster_light` is that, or None. `shadow_masks` are those of `shadow_merge`, with what alpha casters leave where
      there are any.
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
