"""Capacities of a shadow technique: the search for those that hold one frame or several, and a plan's as numbers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import numpy as np

from vtfs.input_error import InputError
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_programs import run_program
from vtfs.shadow_volumes.full_tree import n_cells, require_room
from vtfs.shadow_volumes.sample_tiles import MAX_BLOCKS

log = logging.getLogger("vtfs.shadows")

_FIRST = ShadowPlan(clusters=2**12, groups=2**10, leaf_groups=2**13)
_LARGEST, _LARGEST_OF = 2**26, {"clusters": MAX_BLOCKS}
_FIRST_LISTS = {"z_pass": 2, "z_fail": 2, "ptsv": 1, "cluster_hierarchy": 1}
"""Lists of a level for each triangle, where the search for capacities begins: each step of it compiles, and on a CPU
what is too large is written all the same."""

_FIRST_SHARE = {"z_pass": 1, "z_fail": 1, "ptsv": 4, "cluster_hierarchy": 8}
"""Samples for one list of a leaf, likewise."""


def shadow_sizes(plan: ShadowPlan) -> tuple[int, ...]:
    """The capacities of a plan, as numbers of which the larger one holds more; levels from the leaves up, as one tree
    may be deeper than another."""
    of_levels = plan.level_groups[::-1]
    return plan.clusters, plan.groups, plan.leaf_groups, plan.pairs, plan.cells, plan.nodes, *of_levels


def with_shadow_sizes(plan: ShadowPlan, sizes: tuple[int, ...]) -> ShadowPlan:
    """The plan with such capacities; none where they are not known yet."""
    if not sizes:
        return plan
    clusters, groups, leaf_groups, pairs, cells, nodes, *of_levels = sizes
    return replace(
        plan,
        clusters=clusters,
        groups=groups,
        leaf_groups=leaf_groups,
        pairs=pairs,
        cells=cells,
        nodes=nodes,
        level_groups=tuple(of_levels[::-1]),
    )


def fitted(technique: str, plan: ShadowPlan, frame: ShadowFrame, unrolled: bool | None = None) -> ShadowPlan:
    """The plan with capacities that hold a frame, found by running it.

    **Arguments:**

    - `unrolled`: without loops, each level with its own capacity; unless given, where the device is no CPU.
    """
    return fitted_to_all(technique, plan, [frame], unrolled)[0]


def fitted_to_all(
    technique: str,
    plan: ShadowPlan,
    frames: Sequence[ShadowFrame],
    unrolled: bool | None = None,
    run: Callable[[ShadowPlan, int], ShadowMask] | None = None,
) -> tuple[ShadowPlan, list[ShadowMask]]:
    """The plan with capacities that hold all of several frames, and their masks; see `fitted`.

    **Arguments:**

    - `run`: a plan on one of the frames; by `run_program` unless given.
    """
    run = run or (lambda plan, i: run_program(technique, plan, frames[i]))
    n_samples = int(np.prod(frames[0].receives.shape))
    n_clusters = min(n_samples // min(8, plan.tile_px), MAX_BLOCKS)
    n_triangles = frames[0].triangles.shape[0]
    viewport = frames[0].positions.viewport
    if technique == "cluster_hierarchy":
        columns, rows = -(-viewport.width_px // plan.tile_px), -(-viewport.height_px // plan.tile_px)
        n_slices = max(int(frame.grid.depth_slices) for frame in frames)
        plan = replace(plan, cells=n_cells(columns, rows, n_slices))
    if plan.tree == "full":
        require_room(plan.cells, plan.branching)
    plan = replace(
        plan,
        clusters=plan.clusters or _rounded_up("clusters", n_clusters, _FIRST.clusters),
        groups=plan.groups or _rounded_up("lists", _FIRST_LISTS[technique] * n_triangles, _FIRST.groups),
        leaf_groups=plan.leaf_groups
        or _rounded_up("leaf lists", n_samples // _FIRST_SHARE[technique], _FIRST.leaf_groups),
        pairs=plan.pairs or (_rounded_up("pairs", 4 * n_triangles, 2**10) if plan.passes == 2 else 0),
        level_groups=(),
    )
    if technique == "cluster_hierarchy" and plan.tree == "compact":
        plan = replace(plan, nodes=plan.nodes or _rounded_up("nodes", plan.clusters // min(2 * plan.branching, 32), 64))

    def most(name: str) -> int:
        return max(int(getattr(mask.counts, name)) for mask in masks)

    while True:
        masks = [run(plan, i) for i in range(len(frames))]
        needed = np.max([np.asarray(mask.counts.groups) for mask in masks], axis=0).astype(np.int64)
        if not any(bool(mask.overflowed) for mask in masks):
            break
        n_blocks, n_nodes, n_pairs = (most(name) for name in ("n_blocks", "n_nodes", "n_pairs"))
        grown = replace(plan, clusters=_rounded_up("clusters", n_blocks, plan.clusters))
        if n_blocks <= plan.clusters:  # else the nodes are meaningless
            grown = replace(grown, nodes=_rounded_up("nodes", n_nodes, plan.nodes))
        if n_blocks <= plan.clusters and n_nodes <= plan.nodes:  # else the lists are
            grown = replace(
                grown,
                groups=_rounded_up("lists", _more(needed[:-1].max(), plan.groups), plan.groups),
                leaf_groups=_rounded_up("leaf lists", _more(needed[-1], plan.leaf_groups), plan.leaf_groups),
                pairs=_rounded_up("pairs", n_pairs, plan.pairs) if plan.pairs else 0,
            )
        log.info("%s: %s does not fit, trying %s", technique, plan, grown)
        if grown == plan:
            raise InputError(f"{technique}: the frame fits no capacity; use larger tiles or a batch.")
        plan = grown
    if jax.default_backend() != "cpu" if unrolled is None else unrolled:
        plan = _unrolled(plan, needed, most("n_blocks"), most("n_nodes"))
    return plan, masks


def _unrolled(plan: ShadowPlan, needed: np.ndarray, n_blocks: int, n_nodes: int) -> ShadowPlan:
    """The plan with what each level needs, and no more clusters and nodes than there are."""
    levels = tuple(_rounded_up_finely(int(n)) for n in needed[1:-1])
    if plan.tree == "compact" and n_blocks:
        plan = replace(plan, clusters=_rounded_up_finely(n_blocks), nodes=_rounded_up_finely(n_nodes))
    if not levels:
        return plan
    return replace(plan, level_groups=levels, leaf_groups=_rounded_up_finely(int(needed[-1])), groups=0)


def _rounded_up(name: str, needed: int, first: int) -> int:
    """Powers of 2 from the first size on.

    **Raises:** `InputError` where no capacity holds that many.
    """
    largest = _LARGEST_OF.get(name, _LARGEST)
    if needed > largest:
        raise InputError(f"shadows: {needed:,} {name} needed, at most {largest:,} fit; use larger tiles or a batch.")
    return max(first, 1 << (max(needed, 1) - 1).bit_length())


def _rounded_up_finely(needed: int) -> int:
    """Eighths of powers of 2: without a loop, what is not needed is computed all the same."""
    step = 1 << max(6, needed.bit_length() - 4)
    return max(1, -(-needed // step)) * step


def _more(needed: np.integer, capacity: int) -> int:
    """Four times as many where a level did not fit: those below it are cut, and need more than they say."""
    return max(int(needed), 4 * capacity) if needed > capacity else 1
