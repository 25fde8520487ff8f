"""The shadow techniques, and how one is run: capacities that fit, the program, the mask and what it took."""

from __future__ import annotations

import functools
import logging
import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from vtfs.cluster_grid import cluster_grid
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.parameters import Configuration
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight, require_near
from vtfs.shadow_mask import (
    ShadowFrame,
    ShadowMask,
    ShadowPlan,
    casters_on_device,
    default_bias_m,
    shadow_frame,
    uncounted,
)
from vtfs.shadow_volumes.cluster_hierarchy import cluster_hierarchy
from vtfs.shadow_volumes.full_tree import n_cells, require_room
from vtfs.shadow_volumes.levels import LANES, LEAF_LANES
from vtfs.shadow_volumes.ptsv import ptsv
from vtfs.shadow_volumes.sample_tiles import KEY_BITS, MAX_BLOCKS
from vtfs.shadow_volumes.z_fail import z_fail
from vtfs.shadow_volumes.z_pass import z_pass
from vtfs.view_samples import ViewSamples

if TYPE_CHECKING:
    from vtfs.camera import Camera
    from vtfs.cluster_grid import ClusterGrid

log = logging.getLogger("vtfs.shadows")

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
        tile_px=int(config["tile_px"]),
        branching=int(config["branching"]),
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


_FIRST = ShadowPlan(clusters=2**12, groups=2**10, leaf_groups=2**13)
_LARGEST = {"clusters": MAX_BLOCKS}
_LARGEST_OF_LISTS = 2**26
_FIRST_LISTS = {"z_pass": 2, "z_fail": 2, "ptsv": 1, "cluster_hierarchy": 1}
"""Lists of a level for each triangle, where the search for capacities begins: each step of it compiles, and on a CPU
what is too large is written all the same."""

_FIRST_SHARE = {"z_pass": 1, "z_fail": 1, "ptsv": 4, "cluster_hierarchy": 8}
"""Samples for one list of a leaf, likewise."""


def shadow_grid(samples: ViewSamples, tile_px: int, depth_slices: int = 0) -> ClusterGrid:
    """The grid of clusters of a view.

    **Raises:** `InputError` where it has more columns, rows or slices than keys can tell apart.
    """
    if not isinstance(depth_slices, numbers.Integral) or depth_slices < 0:
        raise InputError(f"`depth_slices` = {depth_slices!r}: must be a whole number from 0 to {2**KEY_BITS:,}.")
    depths = -samples.position_m[..., 2][samples.valid]
    return grid_of(samples.camera, float(depths.max(initial=samples.camera.near_m)), tile_px, depth_slices)


def grid_of(camera: Camera, deepest_m: float, tile_px: int, depth_slices: int) -> ClusterGrid:
    """The same, of a camera whose deepest sample is known."""
    grid = cluster_grid(camera, tile_px, depth_slices, deepest_m)
    n_slices = int(grid.depth_slices)
    longest_px = max(camera.viewport.width_px, camera.viewport.height_px)
    if -(-longest_px // tile_px) > 2**KEY_BITS:
        raise InputError(
            f"tile_px={tile_px} cuts {longest_px:,} pixels into {-(-longest_px // tile_px):,} tiles along one axis: "
            f"shadow clusters have at most {2**KEY_BITS:,}; use larger tiles."
        )
    if n_slices > 2**KEY_BITS:
        raise InputError(
            f"tile_px={tile_px} with depth_slices={depth_slices} makes {n_slices:,} slices: shadow clusters have at "
            f"most {2**KEY_BITS:,}; use larger tiles or fewer slices."
        )
    return grid


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


def _rounded_up(name: str, needed: int, first: int) -> int:
    """Powers of 2 from the first size on.

    **Raises:** `InputError` where no capacity holds that many.
    """
    largest = _LARGEST.get(name, _LARGEST_OF_LISTS)
    if needed > largest:
        raise InputError(f"shadows: {needed:,} {name} needed, at most {largest:,} fit; use larger tiles or a batch.")
    return max(first, 1 << (max(needed, 1) - 1).bit_length())


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
    n_first = min(n_samples // min(8, plan.tile_px), MAX_BLOCKS)
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
        clusters=plan.clusters or _rounded_up("clusters", n_first, _FIRST.clusters),
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


def _rounded_up_finely(needed: int) -> int:
    """Eighths of powers of 2: without a loop, what is not needed is computed all the same."""
    step = 1 << max(6, needed.bit_length() - 4)
    return max(1, -(-needed // step)) * step


def _more(needed: np.integer, capacity: int) -> int:
    """Four times as many where a level did not fit: those below it are cut, and need more than they say."""
    return max(int(needed), 4 * capacity) if needed > capacity else 1


@dataclass(frozen=True)
class CastShadows:
    """A mask on the host.

    - `shadowed`: bool `[h, w]`; false where nothing was tested.
    - `tests`: int32 `[h, w]`: triangles that each sample's tile or cluster was tested against: a heat map.
    - `counts`: see `shadow_counts`; `plan`: with the capacities that held the frame.
    """

    shadowed: np.ndarray
    tests: np.ndarray
    counts: dict[str, int]
    plan: ShadowPlan


def cast_shadows(
    technique: str,
    plan: ShadowPlan,
    samples: ViewSamples,
    casters: Casters,
    light: ShadowLight,
    depth_slices: int = 0,
    front_faces: FrontFaces = "cast",
    receives: np.ndarray | None = None,
    bias_m: float | None = None,
) -> CastShadows:
    """The shadow of one light on a view: sized, run and brought to the host.

    **Arguments:** as of `shadow_frame`; `bias_m` is 1e-5 of the casters' extent unless given.

    **Raises:** `InputError` for an unknown technique, a point light further than `FARTHEST_EXTENTS`, a wrong argument,
    or where no capacity holds the frame.
    """
    if technique not in SHADOW_TECHNIQUES:
        raise InputError(f"shadow technique `{technique}`: unknown; choose from {', '.join(SHADOW_TECHNIQUES)}.")
    require_near(light, casters)
    bias = default_bias_m(casters) if bias_m is None else bias_m
    return cast_by_bias(technique, plan, samples, casters, light, depth_slices, front_faces, receives, bias)


def cast_by_bias(
    technique: str,
    plan: ShadowPlan,
    samples: ViewSamples,
    casters: Casters,
    light: ShadowLight,
    depth_slices: int,
    front_faces: FrontFaces,
    receives: np.ndarray | None,
    bias_m: float,
) -> CastShadows:
    """`cast_shadows` of casters that may be a small part of those that the light is near to."""
    grid = shadow_grid(samples, plan.tile_px, depth_slices)
    frame = shadow_frame(samples, casters_on_device(casters), light, grid, bias_m, receives, front_faces)
    plan = fitted(technique, plan, frame)
    return on_host(run_program(technique, plan, frame), plan, frame)


def on_host(mask: ShadowMask, plan: ShadowPlan, frame: ShadowFrame) -> CastShadows:
    """Bring a mask and its counts to the host.

    **Raises:** `InputError` where it overflowed: such a mask is never used.
    """
    if bool(mask.overflowed):
        raise InputError("shadows: the frame no longer fits the capacities that its sizing run found.")
    viewport = frame.positions.viewport
    return CastShadows(
        from_runs(np.asarray(mask.shadowed), viewport),
        from_runs(np.asarray(mask.tests), viewport),
        shadow_counts(mask, frame, plan),
        plan,
    )


def shadow_counts(mask: ShadowMask, frame: ShadowFrame, plan: ShadowPlan) -> dict[str, int]:
    """Counts of a shadow technique.

    - `test_and_set`: (existing node or valid sample, triangle) pairs tested; at leaves all samples of the tile, as in
      the
      papers. `test_and_set_in_cluster` counts there only the samples of the cluster itself. With a stencil: one for
      each
      sample and volume polygon that passes (z_pass) or fails (z_fail) the depth test; what the tiles cost stays apart.
    - `node_tests_0` ...: of them, on each level below the root; `accepted_*`, `refined_*`, `dropped_*` likewise, the
      others are rejected: `rejected_nodes` in all. `dropped_nodes`, `dropped_samples`: pairs that feedback spares.
    - `tests_of_largest`: of the 1,024 triangles with the most tests: how unevenly the work lies.
    - `extra_plane_tests`: planes tested beyond the four of a volume.
    - `memory`: bytes of all structures at their capacities: `memory_planes` of the volumes, `memory_tree`,
      `memory_lists` of the levels that are held at once, `memory_samples` with the bits of their tiles.
    """
    counts = mask.counts
    nodes, accepted, refined, dropped, extra = (
        np.asarray(column).astype(np.int64)
        for column in (counts.node_tests, counts.accepted, counts.refined, counts.dropped, counts.extra_plane_tests)
    )
    per_level = {
        f"{name}_{level}": int(value)
        for name, column in (
            ("node_tests", nodes), ("accepted", accepted), ("refined", refined), ("dropped", dropped)
        )
        for level, value in enumerate(column)
    }  # fmt: skip
    of_triangle = np.sort(np.asarray(counts.tests_of_triangle).astype(np.int64))
    updates = int(counts.stencil_updates)
    on_nodes = int(nodes.sum())
    lengths = np.asarray(counts.list_length).astype(np.int64)
    planes, tree, on_samples = (int(n) for n in np.asarray(counts.bytes_held))
    memory = {
        "memory_planes": planes,
        "memory_tree": tree,
        "memory_lists": _bytes_of_lists(plan),
        "memory_samples": on_samples,
    }
    return {
        "samples": int(np.asarray(frame.receives).sum()),
        "casters": int(counts.n_casters),
        "items": int(counts.n_items),
        "test_and_set": updates if updates >= 0 else on_nodes + int(counts.sample_tests),
        "test_and_set_in_cluster": updates if updates >= 0 else on_nodes + int(counts.sample_tests_in_cluster),
        "node_tests": on_nodes,
        "sample_tests": int(counts.sample_tests),
        "extra_plane_tests": 3 * int(extra.sum()),
        "rejected_nodes": int(np.where(nodes > 0, nodes - accepted - refined - dropped, 0).sum()),
        "dropped_nodes": int(dropped.sum()),
        "dropped_samples": int(counts.dropped_samples),
        "tests_of_largest": int(of_triangle[-1_024:].sum()),
        "longest_list": int(lengths.max(initial=0)),
        "listed_pairs": int(lengths.sum()),
        "memory": sum(memory.values()),
        **memory,
        **per_level,
    }


_OF_ALPHA = {
    "shadow_samples": "alpha_samples",
    "casters": "alpha_casters",
    "shadow_clusters": "alpha_clusters",
    "node_tests": "alpha_node_tests",
    "sample_tests": "alpha_sample_tests",
    "listed_pairs": "alpha_listed_pairs",
    "longest_shadow_list": "longest_alpha_list",
}


_MEMORY = ("memory", "memory_planes", "memory_tree", "memory_lists", "memory_samples")


def shadows_counts(of_each: Sequence[dict[str, int]], of_alpha: Sequence[dict[str, int]] = ()) -> dict[str, int]:
    """Counts of the shadows of several lights and views: sums, but what is held or longest is that of the largest.

    Names that shading has too are told apart: `shadow_samples` receive shadow, `shadow_clusters` are what is walked.

    **Arguments:**

    - `of_alpha`: of alpha casters, on what opaque ones leave lit: their tests are part of `test_and_set` and
      `test_and_set_in_cluster`, and besides that stand apart, as `alpha_node_tests` and the like.
    """
    both = _shadows_counts(of_each)
    if of_alpha:
        alpha = _shadows_counts(of_alpha)
        for name in ("test_and_set", "test_and_set_in_cluster", *_MEMORY):
            both[name] += alpha[name]
        both |= {own: alpha[name] for name, own in _OF_ALPHA.items()}
    return both


def _shadows_counts(of_each: Sequence[dict[str, int]]) -> dict[str, int]:
    largest = {*_MEMORY, "longest_list", "casters"}
    total = {
        name: (max if name in largest else sum)(counts.get(name, 0) for counts in of_each)
        for name in dict.fromkeys(name for counts in of_each for name in counts)
    }
    names = {"samples": "shadow_samples", "items": "shadow_clusters", "longest_list": "longest_shadow_list"}
    return {names.get(name, name): value for name, value in total.items()}


def _bytes_of_lists(plan: ShadowPlan) -> int:
    """Lists of a level and of the next one, those of all levels where nothing loops; with what a level's tests found:
    for each group and child its bits, and how many were found before it. Of two passes the pairs between them."""
    groups, tested = 2 * plan.groups, plan.groups
    if plan.level_groups:
        groups, tested = sum(plan.level_groups), max(plan.level_groups)
    lists = 4 * (LANES * groups + LEAF_LANES * plan.leaf_groups)
    return lists + 12 * plan.branching * tested + 2 * 8 * plan.pairs
