"""The shadow techniques by name: their plans, made of configurations, and their programs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax

from vtfs.configurations import Configuration
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan, uncounted
from vtfs.shadow_volumes.cluster_hierarchy import cluster_hierarchy
from vtfs.shadow_volumes.ptsv import ptsv
from vtfs.shadow_volumes.z_fail import z_fail
from vtfs.shadow_volumes.z_pass import z_pass

ShadowTechnique = Callable[[ShadowFrame, ShadowPlan], ShadowMask]

SHADOW_TECHNIQUES: dict[str, ShadowTechnique] = {
    "z_pass": z_pass,
    "z_fail": z_fail,
    "ptsv": ptsv,
    "cluster_hierarchy": cluster_hierarchy,
}
"""Shadow techniques of one signature. What differs from one plan to another is in the plan."""


def shadow_plan(config: Configuration) -> ShadowPlan:
    """The static part of a configuration of a shadow technique, without capacities."""
    params = config.params
    extra = "silhouette" if config.technique == "ptsv" else "vertex"
    return ShadowPlan(
        tile_px=int(params.get("tile_px", ShadowPlan.tile_px)),
        branching=int(params.get("branching", ShadowPlan.branching)),
        bounds=params.get("bounds", "explicit"),  # type: ignore[arg-type]
        extra=extra if params.get("planes", "off") == "on" else "off",
        feedback=params.get("feedback") == "on",
        batch=int(params.get("batch", 0)),
        stencil=params.get("stencil", "unlimited"),  # type: ignore[arg-type]
        around_eye=params.get("around_eye") == "on",
        passes=int(params.get("passes", 1)),
        level=int(params.get("level", 0)),
        tree=params.get("tree", "compact"),  # type: ignore[arg-type]
    )


def alpha_plan(config: Configuration) -> ShadowPlan:
    """The same for alpha casters. No node is accepted and no sample is finished by one of them, so that batches,
    feedback and a second pass would change nothing but the order."""
    once = replace(shadow_plan(config), feedback=False, batch=0, passes=1, level=0)
    return replace(once, blending=config["blending"])  # type: ignore[arg-type]


@functools.cache
def counting_program(technique: str, plan: ShadowPlan) -> Callable[[ShadowFrame], ShadowMask]:
    """A technique as one program, from view samples to mask and counts; to be called inside `jax.enable_x64(True)`."""

    def run(frame: ShadowFrame) -> ShadowMask:
        return SHADOW_TECHNIQUES[technique](frame, plan)

    return jax.jit(run)


@functools.cache
def shadow_program(technique: str, plan: ShadowPlan) -> Callable[[ShadowFrame], tuple[Any, Any]]:
    """The program that is timed: mask and overflow alone, so that XLA deletes the counting."""

    def run(frame: ShadowFrame) -> tuple[Any, Any]:
        mask = SHADOW_TECHNIQUES[technique](uncounted(frame), plan)
        return mask.shadowed, mask.overflowed

    return jax.jit(run)


def run_program(technique: str, plan: ShadowPlan, frame: ShadowFrame) -> ShadowMask:
    """Run and count; in float64, which is set nowhere else."""
    with jax.enable_x64(True):
        return counting_program(technique, plan)(frame)
