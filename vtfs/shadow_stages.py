"""The stages of casting one light's shadow, each of them a function by itself."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from vtfs.shadow_inputs import ShadowTask, with_receivers
from vtfs.shadow_mask import ShadowMask, ShadowPlan
from vtfs.shadow_volumes import cluster_hierarchy, ptsv, stencil

_FAILING = {"z_pass": False, "z_fail": True}


@dataclass(frozen=True)
class CastingStage:
    """One stage, in float64.

    - `needs`: `shadow_tasks` and earlier stages.
    - `depends_on`: the fields of `ShadowPlan` that its program depends on, besides capacities; the others keep it.
    """

    name: str
    run: Callable[..., Any]
    needs: tuple[str, ...]
    depends_on: tuple[str, ...]

    def narrowed(self, plan: ShadowPlan) -> ShadowPlan:
        """The plan with only what the stage depends on, so that nothing else compiles it again."""
        return ShadowPlan(**{name: getattr(plan, name) for name in self.depends_on})


_CAPACITIES = ("clusters", "groups", "leaf_groups", "pairs", "cells", "level_groups")
_WALKED = ("branching", "extra", "feedback", "batch", "passes", "level", *_CAPACITIES)


def casting_stages(technique: str) -> tuple[CastingStage, ...]:
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
