"""Counts of shadow techniques: of one light on one view, and of all of a frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan
from vtfs.shadow_volumes.levels import LANES, LEAF_LANES


def shadow_counts(mask: ShadowMask, frame: ShadowFrame, plan: ShadowPlan) -> dict[str, int]:
    """Counts of a shadow technique.

    - `test_and_set`: (existing node or valid sample, triangle) pairs tested; at leaves all samples of the tile, as in
      the papers. `test_and_set_in_cluster` counts there only the samples of the cluster itself. With a stencil: one for
      each sample and volume polygon that passes (z_pass) or fails (z_fail) the depth test; what the tiles cost stays
      apart.
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
