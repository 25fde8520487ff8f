"""Exact counts of one frame: what a technique does, and how this implementation cuts it up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vtfs.chunk_sizes import assign_chunk, volume_chunk
from vtfs.cluster_grid import n_cells, tile_and_slices
from vtfs.configurations import Configuration, lists_configuration, shading_batch
from vtfs.frame import KeptStages, cast_counted, is_listed, run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_plan import Walked
from vtfs.frame_sizes import NO_SIZES, Sizes
from vtfs.light_assignment.brute_force import every_pair
from vtfs.light_lists import AssignCounts
from vtfs.op_counts import (
    ListLengths,
    OpCounts,
    added,
    approximation_counts,
    assign_counts,
    batch_counts,
    cluster_counts,
    gbuffer_traffic,
    light_volume_batch_counts,
    light_volume_lengths,
    list_lengths,
    memory_counts,
    shading_counts,
    uniform_lengths,
    walk_rows,
)
from vtfs.parameters import PARAMETERS
from vtfs.shadow_counts import shadows_counts
from vtfs.technique_names import SHADOW_REFERENCES
from vtfs.techniques import REGISTRY, approximates

_BRUTE_FORCE_WORD = 32
_NO_STRUCTURES = (
    "positions", "gbuffer", "normals", "grid", "light_cutoff", "approximate", "frame", "resort_every",
)  # fmt: skip


def lengths_of(config: Configuration, env: dict[str, Any], inputs: FrameInputs) -> ListLengths:
    """The list lengths of a frame that `run_stages` ran up to its lists."""
    lists = REGISTRY[config.technique].lists
    if lists == "clusters":
        return list_lengths(env["positions"], env["clusters"], env["assign"])
    if lists == "light_volumes":
        return light_volume_lengths(env["positions"], env["assign"], inputs.n_lights)
    return uniform_lengths(env["positions"], inputs.n_lights)


def _kept_lengths(config: Configuration, env: dict[str, Any], inputs: FrameInputs, kept: KeptStages) -> ListLengths:
    """Equal lists of the same clusters have the same lengths, whichever tree they are from."""
    if REGISTRY[config.technique].lists != "clusters":
        return lengths_of(config, env, inputs)
    counts = np.asarray(env["assign"].count)
    arguments = [env["positions"], env["clusters"]]
    return kept.result(("lengths", counts.tobytes()), arguments, lambda: lengths_of(config, env, inputs))


@dataclass(frozen=True)
class FrameCounts:
    """Exact counts of one frame.

    - `technique`: what the technique as published does, whatever the `batch` and the `assigner` (but for `memory`);
      see `op_counts`.
    - `of_block`: lengths of the blocks' lists, the `n_solid_blocks` of solid samples first; `walked`,
      `walk_rows`, `light_runs`: what `at_batch` needs besides.
    """

    technique: OpCounts
    of_block: np.ndarray
    n_solid_blocks: int
    walked: Walked
    walk_rows: tuple[int, ...]
    light_runs: int
    branching: int
    sizes: Sizes

    def at_batch(self, batch: int) -> OpCounts:
        """All counts, with those of this implementation's chunks."""
        chunk = assign_chunk(self.walked, batch, self.branching, self.sizes.pairs)
        capacity = self.sizes.blocks or len(self.of_block)
        own = batch_counts(self.of_block, self.n_solid_blocks, self.walk_rows, batch, capacity, chunk)
        if self.light_runs:
            own = added(own, light_volume_batch_counts(self.light_runs, volume_chunk(self.sizes.pairs, batch)))
        return self.technique | own

    def of(self, config: Configuration) -> OpCounts:
        """All counts of one of the configurations that have these."""
        return self.at_batch(shading_batch(config))

    def as_arrays(self) -> dict[str, np.ndarray]:
        """For a cache; the inverse of `from_arrays`."""
        sizes = (self.sizes.cells, self.sizes.blocks, self.sizes.pairs, *self.sizes.shadow)
        return {
            "names": np.array(list(self.technique)),
            "counts": np.array(list(self.technique.values()), np.int64),
            "of_block": self.of_block,
            "scalars": np.array([self.n_solid_blocks, self.light_runs, self.branching, *sizes], np.int64),
            "walked": np.array(self.walked),
            "walk_rows": np.array(self.walk_rows, np.int64),
            "alpha_sizes": np.array(self.sizes.alpha, np.int64),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> FrameCounts:
        technique = {str(name): int(value) for name, value in zip(arrays["names"], arrays["counts"], strict=True)}
        walk_rows = tuple(int(rows) for rows in arrays["walk_rows"])
        n_solid_blocks, light_runs, branching, cells, blocks, pairs, *shadow = (int(v) for v in arrays["scalars"])
        sizes = Sizes(cells, blocks, pairs, tuple(shadow), tuple(int(v) for v in arrays["alpha_sizes"]))
        walked: Walked = str(arrays["walked"])  # type: ignore[assignment]
        return cls(technique, arrays["of_block"], n_solid_blocks, walked, walk_rows, light_runs, branching, sizes)


def count(
    config: Configuration, inputs: FrameInputs, sizes: Sizes | None = None, kept: KeptStages | None = None
) -> tuple[FrameCounts, ListLengths]:
    """Count what a configuration does on a frame; nothing is shaded.

    **Arguments:**

    - `kept`: of configurations counted before on the same frame.
    """
    if REGISTRY[config.technique].casts_shadows:
        return _count_shadowed(config, inputs, sizes)
    technique, kept = REGISTRY[config.technique], kept or KeptStages()
    if is_listed(config):
        last = "approximate" if approximates(config) else "assign"
        env, sizes = run_stages(config, inputs, sizes, until=last, kept=kept)
    else:
        env, sizes = inputs.environment(config), NO_SIZES
    lengths = _kept_lengths(config, env, inputs, kept)
    branching = int(config.params.get("branching", _BRUTE_FORCE_WORD))
    tile_px, _ = tile_and_slices({"tile_px": PARAMETERS["tile_px"].default} | config.params, inputs.viewport)
    fragments = inputs.fragments(technique.shades_hidden(config))
    counts = shading_counts(lengths, fragments.n_samples, fragments.n_transparent_samples, tile_px)
    counts |= {"hidden_fragments": fragments.n_samples - inputs.fragments(with_hidden=False).n_samples}
    walked, rows, light_runs = technique.walked(technique.plan(config), inputs.n_lights), (), 0
    if technique.lists == "clusters":
        listed = lengths
        if env["listed"] is not env["assign"]:
            listed = list_lengths(env["positions"], env["clusters"], env["listed"])
        counts |= cluster_counts(listed, n_cells(env["grid"], inputs.viewport), inputs.n_lights)
        counts |= approximation_counts(listed, lengths)
        counts |= assign_counts(_published_counts(config, env, inputs), inputs.n_lights, branching)
        rows = walk_rows(env["assign_counts"])
        if technique.one_slice:
            counts["lighting_computations_tile_area"] = counts["light_cluster_pairs"] * tile_px[0] * tile_px[1]
    elif technique.lists == "light_volumes":
        light_runs = int(env["assign"].total)
        n_tests = inputs.n_lights * inputs.positions(with_hidden=False).n_visible_runs
        counts |= {"lights": inputs.n_lights, "leaf_tests": n_tests, "light_runs": light_runs}
    # By identity: lists that nothing was taken off are those that were assigned.
    structures = list({id(value): value for name, value in env.items() if name not in _NO_STRUCTURES}.values())
    counts |= memory_counts(env["gbuffer"], structures, fragments.n_samples, counts.get("light_cluster_pairs", 0))
    counts |= gbuffer_traffic(technique.reads_gbuffer, counts)
    frame_counts = FrameCounts(
        counts, lengths.of_block, lengths.n_solid_blocks, walked, rows, light_runs, branching, sizes
    )
    return frame_counts, lengths


def _count_shadowed(config: Configuration, inputs: FrameInputs, sizes: Sizes | None) -> tuple[FrameCounts, ListLengths]:
    """What shading does as for its lists, with what finding the shadows takes."""
    shading, lengths = count(lists_configuration(config), inputs, sizes)
    counts = dict(shading.technique)
    suns = inputs.shadows.scene.suns.n_lights
    counts["lighting_computations"] += suns * counts["samples"]
    counts["shadow_lights"] = len(inputs.shadows.lights)
    sizes = shading.sizes
    if config.technique not in SHADOW_REFERENCES:
        cast = cast_counted(config, inputs)
        own = shadows_counts([each.counts for each in cast.opaque], [each.counts for each in cast.alpha])
        counts |= own | {"memory": counts["memory"] + own["memory"]}
        sizes = replace(sizes, shadow=cast.sizes, alpha=cast.alpha_sizes)
    return replace(shading, technique=counts, sizes=sizes), lengths


def _published_counts(config: Configuration, env: dict[str, Any], inputs: FrameInputs) -> AssignCounts:
    """What the technique's own assigner does, however the lists of `env` were made."""
    technique = REGISTRY[config.technique]
    published = replace(technique.plan(config), assigner="published")
    if technique.walked(published, inputs.n_lights) == "all_pairs":
        return every_pair(int(env["clusters"].n_clusters), inputs.n_lights)
    if technique.plan(config) == published:
        return env["assign_counts"]
    return run_stages(config.replaced(assigner="published"), inputs, until="assign")[0]["assign_counts"]
