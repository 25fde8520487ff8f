"""The stages of casting one light's shadow, each of them a function by itself."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax.numpy as jnp

from vtfs.light_shadows import CastMask
from vtfs.shadow_inputs import ShadowTask, alpha_frame, with_receivers
from vtfs.shadow_mask import ShadowMask, ShadowPlan
from vtfs.shadow_volumes import cluster_hierarchy, ptsv, stencil
from vtfs.shadow_volumes.transmittance import transmit

_FAILING = {"z_pass": False, "z_fail": True}


@dataclass(frozen=True)
class CastingStage:
    """One stage, in float64.

    - `needs`: `shadow_tasks` and earlier stages.
    - `depends_on`: the fields of `ShadowPlan` that its program depends on, besides capacities; the others keep it.
    - `of_alpha`: it runs only where alpha casters cast, by the plan and the capacities of those.
    """

    name: str
    run: Callable[..., Any]
    needs: tuple[str, ...]
    depends_on: tuple[str, ...]
    of_alpha: bool = False

    def narrowed(self, plan: ShadowPlan) -> ShadowPlan:
        """The plan with only what the stage depends on, so that nothing else compiles it again."""
        return ShadowPlan(**{name: getattr(plan, name) for name in self.depends_on})


_CAPACITIES = ("clusters", "groups", "leaf_groups", "pairs", "cells", "level_groups")
_WALKED = ("branching", "extra", "feedback", "batch", "passes", "level", *_CAPACITIES)


TRANSMIT = "shadow_transmit"


def casting_stages(technique: str) -> tuple[CastingStage, ...]:
    """The stages of opaque casters, and of techniques that have it the one of alpha casters."""
    if technique in _FAILING:
        return _opaque_stages(technique)
    of_plan = ("tile_px", "bounds", "tree", "blending", *_WALKED)
    needs = ("shadow_tasks", "shadow_merge")
    alpha = CastingStage(TRANSMIT, functools.partial(_transmit, technique), needs, of_plan, of_alpha=True)
    return (*_opaque_stages(technique), alpha)


def _opaque_stages(technique: str) -> tuple[CastingStage, ...]:
    """Planes of all volumes, the tree over what receives shadow, the walk down it, and the mask."""
    by_failing = _FAILING.get(technique)
    module: ModuleType = (
        stencil if by_failing is not None else {"ptsv": ptsv, "cluster_hierarchy": cluster_hierarchy}[technique]
    )
    variant = {} if by_failing is None else {"by_failing": by_failing}
    named = ("tile_px", "branching", "bounds", "tree", "clusters", "cells")
    return (
        CastingStage("shadow_planes", functools.partial(_planes, module, variant), ("shadow_tasks",), ("extra",)),
        CastingStage("shadow_build", functools.partial(_build, module), ("shadow_tasks",), named),
        CastingStage(
            "shadow_traverse", functools.partial(_traverse, module, variant), ("shadow_planes", "shadow_build"), _WALKED
        ),
        CastingStage(
            "shadow_merge",
            functools.partial(_merge, module, variant),
            ("shadow_planes", "shadow_build", "shadow_traverse"),
            ("stencil", "around_eye"),
        ),
    )


def _planes(module: ModuleType, variant: dict[str, bool], plan: ShadowPlan, task: ShadowTask) -> Any:
    return module.shadow_planes(task.frame, plan, **variant)


def _build(module: ModuleType, plan: ShadowPlan, task: ShadowTask) -> Any:
    return module.shadow_build(with_receivers(task), plan)


def _traverse(module: ModuleType, variant: dict[str, bool], plan: ShadowPlan, planes: Any, hierarchy: Any) -> Any:
    return module.shadow_traverse(planes, hierarchy, plan, **variant)


def _merge(
    module: ModuleType, variant: dict[str, bool], plan: ShadowPlan, planes: Any, hierarchy: Any, walk: Any
) -> ShadowMask:
    of_stencil = (plan,) if variant else ()
    return module.shadow_merge(planes, hierarchy, walk, *of_stencil, **variant)


def _transmit(
    technique: str, plan: ShadowPlan, task: ShadowTask, opaque: ShadowMask | CastMask
) -> tuple[CastMask, ShadowMask]:
    """What alpha casters leave on the samples that opaque ones leave lit, and what it took."""
    assert task.alpha is not None and plan.blending != "opaque"
    found = transmit(
        technique, alpha_frame(task, opaque.shadowed), task.alpha.surfaces, task.alpha.stream, plan, plan.blending
    )
    left = found.transmittance or (jnp.where(found.mask.shadowed, 0, 1).astype(jnp.float32),)
    return CastMask(opaque.shadowed, opaque.overflowed | found.mask.overflowed, left), found.mask
