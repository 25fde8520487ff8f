"""What a stage's time may depend on: few counts a stage, each with a physical reason."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tuning.measurement import Measurement
from tuning.repeat_weights import repeat_weights

STAGE_TERMS: dict[str, tuple[str, ...]] = {
    "clusters": ("samples", "cells_total", "clusters_occupied"),
    "reduce": ("lights", "lights_log_lights"),
    "morton": ("lights", "lights_log_lights"),
    "sort": ("lights", "lights_log_lights"),
    "build_tree": ("tree_nodes",),
    # Loop iterations (`*_steps`) are the cost of launching: they are what a batch size changes.
    "assign": ("clusters_occupied", "light_cluster_pairs", "tree_tests", "leaf_tests", "assign_steps"),
    # Lanes are the lighting computations that the SIMD loop really runs, those that divergence wastes included.
    "shade_opaque": ("samples", "lighting_computations", "shading_lanes", "shading_steps"),
    "shade_transparent": ("transparent_samples", "lighting_computations", "shading_lanes", "shading_steps"),
    "shadow_planes": ("casters",),
    "shadow_build": ("shadow_samples", "shadow_clusters"),
    "shadow_traverse": ("node_tests", "sample_tests", "listed_pairs", "extra_plane_tests"),
    "shadow_merge": ("shadow_samples", "shadow_clusters"),
    "shadow_transmit": (
        "alpha_casters",
        "alpha_samples",
        "alpha_clusters",
        "alpha_node_tests",
        "alpha_sample_tests",
        "alpha_listed_pairs",
    ),
    "frame": (
        "samples",
        "cells_total",
        "clusters_occupied",
        "tests",
        "light_cluster_pairs",
        "lighting_computations",
        "shading_lanes",
        "shading_steps",
        "assign_steps",
        "node_tests",
        "sample_tests",
        "listed_pairs",
        "shadow_clusters",
        "alpha_node_tests",
        "alpha_sample_tests",
    ),
}
"""Candidate terms of each stage, the first of two that say the same preferred."""


@dataclass(frozen=True)
class StageTimes:
    """One stage of one technique: a row for each frame of each measurement.

    - `terms`: the candidates that this data can tell from a constant.
    - `ops`: float64 `[rows, terms]`.
    - `times_ms`: float64 `[rows]`, medians over the repeats, all positive and finite.
    - `weights`: float64 `[rows]`, of squared relative errors: rows whose repeats scatter count less.
    - `configuration`: int `[rows]`, which measurement a row belongs to, from 0 without gaps.
    """

    terms: tuple[str, ...]
    ops: np.ndarray
    times_ms: np.ndarray
    weights: np.ndarray
    configuration: np.ndarray

    @property
    def n_configurations(self) -> int:
        return int(self.configuration.max()) + 1 if len(self.configuration) else 0


def with_derived(counts: Mapping[str, int]) -> dict[str, float]:
    """The counts of a frame, with `lights_log_lights` (base 2) and `tests` (of tree nodes and leaves)."""
    derived: dict[str, float] = dict(counts)
    if "lights" in counts:
        lights = counts["lights"]
        derived["lights_log_lights"] = lights * math.log2(lights) if lights > 1 else 0.0
    tests = [counts[name] for name in ("tree_tests", "leaf_tests") if name in counts]
    if tests:
        derived["tests"] = sum(tests)
    return derived


def main_work(counts: Mapping[str, int]) -> int:
    """What tells busy frames and hopeless techniques: nodes and samples tested against triangles where shadows are
    cast, else lighting computations."""
    if "shadow_lights" in counts:
        tests = ("node_tests", "sample_tests", "alpha_node_tests", "alpha_sample_tests")
        return sum(counts.get(name, 0) for name in tests)
    return counts.get("lighting_computations", 0)


def operations(counts: Sequence[Mapping[str, int]], terms: Sequence[str]) -> np.ndarray:
    """float64 `[len(counts), terms]`.

    **Raises:** `KeyError` where a frame lacks a term.
    """
    table = np.empty((len(counts), len(terms)))
    for row, frame in zip(table, counts, strict=True):
        known = with_derived(frame)
        row[:] = [known[term] for term in terms]
    return table


def stage_times(measurements: Iterable[Measurement], stage: str, available: frozenset[str] | None = None) -> StageTimes:
    """The data of one stage, from the measurements that timed it.

    A term is a candidate where every row has it and not all rows have the same value (then it is a constant).

    **Arguments:**

    - `measurements`: of one technique.
    - `available`: the counts known before measuring; a term made of others cannot predict. `None`: all.
    """
    frames: list[Mapping[str, float]] = []
    times_ms: list[float] = []
    repeats_ms: list[list[float]] = []
    owner: list[int] = []
    n_owners = 0
    for measurement in measurements:
        if measurement.outcome != "timed":
            continue
        rows_before = len(times_ms)
        # A stage may have been timed on fewer frames than were counted.
        for counts, repeats in zip(measurement.counts, measurement.stages_ms.get(stage, ()), strict=False):
            finite = [ms for ms in repeats if math.isfinite(ms)]
            if finite and (median := float(np.median(finite))) > 0:
                known = counts if available is None else {k: v for k, v in counts.items() if k in available}
                frames.append(with_derived(known))
                times_ms.append(median)
                repeats_ms.append([ms for ms in finite if ms > 0])
                owner.append(n_owners)
        n_owners += len(times_ms) > rows_before

    columns = {
        term: np.array([frame[term] for frame in frames], float)
        for term in STAGE_TERMS.get(stage, ())
        if frames and all(term in frame for frame in frames)
    }
    columns = {term: column for term, column in columns.items() if np.ptp(column) > 0}
    ops = np.stack(list(columns.values()), axis=1) if columns else np.empty((len(frames), 0))
    weights = repeat_weights(repeats_ms) if repeats_ms else np.empty(0)
    return StageTimes(tuple(columns), ops, np.array(times_ms), weights, np.array(owner, int))
