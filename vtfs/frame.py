"""Running a technique on a frame: its programs, their capacities, its image and its counts."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from vtfs.cluster_grid import configured_grid, n_cells, n_keys
from vtfs.clusters import Clusters
from vtfs.gbuffer import GBuffer, from_runs, gbuffer_on_device, positions_on_device
from vtfs.input_error import InputError
from vtfs.light_lists import view_lights
from vtfs.lights import Lights
from vtfs.op_counts import (
    ListLengths,
    OpCounts,
    assign_counts,
    batch_counts,
    cluster_counts,
    list_lengths,
    memory_counts,
    shading_counts,
    uniform_lengths,
    walk_rows,
)
from vtfs.parameters import PARAMETERS, Configuration
from vtfs.techniques import REGISTRY, Plan, Stage, walk_chunk
from vtfs.view_samples import ViewSamples

_BRUTE_FORCE_WORD = 32
_NO_STRUCTURES = ("positions", "gbuffer", "normals", "grid", "light_cutoff")


class CapacityError(InputError):
    """A frame needs more than the largest capacity: it is not run, and nothing is dropped."""


@dataclass(frozen=True)
class Sizes:
    """Capacities that fix array shapes, rounded up to few sizes so that few programs are compiled.

    Loops run as often as there is work, so a generous capacity costs memory and little time.

    - `cells`: of the grid's page table; `blocks`: of clusters and of their blocks; `pairs`: of the
      (cluster, light) pairs and of every level on the way to them.
    """

    cells: int
    blocks: int
    pairs: int

    def covering(self, other: Sizes) -> Sizes:
        return Sizes(max(self.cells, other.cells), max(self.blocks, other.blocks), max(self.pairs, other.pairs))


NO_SIZES = Sizes(0, 0, 0)
"""Of techniques without lists."""

_FIRST = Sizes(cells=2**18, blocks=2**10, pairs=2**20)
_RATIO = Sizes(cells=8, blocks=4, pairs=8)
_LARGEST = Sizes(cells=2**30, blocks=2**26, pairs=2**28)


def rounded_up(name: str, needed: int) -> int:
    """The capacity that holds `needed`: the first size times powers of 4 or 8.

    **Raises:** `CapacityError` where no capacity does.
    """
    capacity, ratio, largest = (getattr(sizes, name) for sizes in (_FIRST, _RATIO, _LARGEST))
    while capacity < needed:
        capacity *= ratio
    if needed > largest:
        raise CapacityError(f"{name}: {needed:,} needed, at most {largest:,} fit; use larger tiles or fewer lights.")
    return min(capacity, largest)


class FrameInputs:
    """One frame on the device: view samples and lights, uploaded once and used by every configuration."""

    def __init__(self, samples: ViewSamples, lights: Lights):
        self.samples = samples
        self.camera = samples.camera
        self.positions = positions_on_device(samples)
        self.lights = view_lights(lights, samples.camera)
        self.n_lights = lights.n_lights
        depths = -samples.position_m[..., 2][samples.valid]
        self.deepest_m = float(depths.max(initial=samples.camera.near_m))
        self._gbuffers: dict[str, GBuffer] = {}

    def gbuffer(self, precision: str) -> GBuffer:
        if precision not in self._gbuffers:
            self._gbuffers[precision] = gbuffer_on_device(self.samples, self.positions, precision)
        return self._gbuffers[precision]

    def environment(self, config: Configuration) -> dict[str, Any]:
        """What the stages of a configuration start from, by the names that `Stage.needs` uses."""
        params = config.params
        env: dict[str, Any] = {
            "positions": self.positions,
            "gbuffer": self.gbuffer(str(params["gbuffer"])),
            "lights": self.lights,
            "light_cutoff": np.float32(params["light_cutoff"]),
        }
        if "tile_px" in params:
            one_slice = REGISTRY[config.technique].one_slice
            env["grid"] = configured_grid(self.camera, params, self.deepest_m, one_slice)
            # Only where they are read: each precision of the G-buffer would compile the clusters again.
            needs_normals = params.get("normal_bins", 0) or params.get("normal_cones", "implicit") == "explicit"
            env["normals"] = env["gbuffer"].normal if needs_normals else None
        return env


def planned(config: Configuration, sizes: Sizes) -> Plan:
    plan = REGISTRY[config.technique].plan(config)
    return replace(plan, cells=sizes.cells, blocks=sizes.blocks, pairs=sizes.pairs)


@functools.cache
def stage_program(stage: Stage, plan: Plan) -> Callable[..., Any]:
    """One stage as a program of its own. `plan` holds only what the stage names: see `narrowed`."""
    return jax.jit(functools.partial(stage.run, plan))


def narrowed(stage: Stage, plan: Plan) -> Plan:
    """The plan with only what a stage's program depends on, so that nothing else compiles it again."""
    return Plan(**{name: getattr(plan, name) for name in stage.statics})


def keep_result(env: dict[str, Any], stage: str, result: Any) -> None:
    """Add a stage's result to what later stages may need. An assignment's counts stay apart from its lists: their
    shape depends on the tree, and would compile the shading again for every branching."""
    if stage == "assign":
        env["assign"], env["assign_counts"] = result
    else:
        env[stage] = result


@functools.cache
def frame_program(technique: str, plan: Plan) -> Callable[..., Any]:
    """All stages fused in one program: from the inputs to the image and whether anything overflowed."""
    stages = REGISTRY[technique].stages

    def run(env: dict[str, Any]):
        env = dict(env)
        for stage in stages:
            keep_result(env, stage.name, stage.run(plan, *(env[name] for name in stage.needs)))
        overflowed = [env["clusters"].overflowed] if "clusters" in env else []
        overflowed += [env["assign"].overflowed] if "assign" in env else []
        return env["shade_opaque"], jax.numpy.stack(overflowed).any() if overflowed else np.bool_(False)

    return jax.jit(run)


def run_stages(
    config: Configuration, inputs: FrameInputs, sizes: Sizes | None = None, *, until: str | None = None
) -> tuple[dict[str, Any], Sizes]:
    """Run a frame stage by stage, with larger capacities until everything fits.

    **Arguments:**

    - `sizes`: capacities to start from.
    - `until`: the last stage to run; all by default.

    **Returns:** the result of every stage (and the inputs) by name, and the capacities that fit.

    **Raises:** `CapacityError`, and `InputError` for a grid with too many cells.
    """
    env = inputs.environment(config)
    n_runs = inputs.positions.z_m.shape[0]
    grid_keys = n_keys(env["grid"], inputs.positions.viewport) if "grid" in env else 0
    fitting = Sizes(rounded_up("cells", grid_keys), rounded_up("blocks", n_runs), rounded_up("pairs", 0))
    sizes = fitting.covering(sizes) if sizes else fitting
    for stage in REGISTRY[config.technique].stages:
        while True:
            plan = narrowed(stage, planned(config, sizes))
            result = stage_program(stage, plan)(*(env[name] for name in stage.needs))
            if stage.name == "clusters" and bool(result.overflowed):
                sizes = replace(sizes, blocks=rounded_up("blocks", int(result.n_blocks)))
            elif stage.name == "assign" and bool(result[0].overflowed):
                # Where a level on the way overflowed, the total is not known.
                needed = max(int(result[0].total), sizes.pairs + 1)
                sizes = replace(sizes, pairs=rounded_up("pairs", needed))
            else:
                break
        keep_result(env, stage.name, result)
        if stage.name == until:
            break
    return env, sizes


def lengths_of(env: dict[str, Any], inputs: FrameInputs) -> ListLengths:
    """The list lengths of a frame that `run_stages` ran up to its lists."""
    if "assign" not in env:
        return uniform_lengths(env["gbuffer"], inputs.n_lights)
    clusters: Clusters = env["clusters"]
    return list_lengths(env["gbuffer"], clusters, env["assign"])


@dataclass(frozen=True)
class FrameCounts:
    """Exact counts of one frame.

    - `technique`: what the technique does, whatever the `batch`; see `op_counts`.
    - `of_block`, `walk_rows`: what `at_batch` needs.
    """

    technique: OpCounts
    of_block: np.ndarray
    walk_rows: tuple[int, ...]
    branching: int
    sizes: Sizes

    def at_batch(self, batch: int) -> OpCounts:
        """All counts, with those of this implementation's chunks."""
        chunk = walk_chunk(batch, self.branching, self.sizes.pairs)
        capacity = self.sizes.blocks or len(self.of_block)
        return self.technique | batch_counts(self.of_block, self.walk_rows, batch, capacity, chunk)

    def as_arrays(self) -> dict[str, np.ndarray]:
        """For a cache; the inverse of `from_arrays`."""
        sizes = (self.sizes.cells, self.sizes.blocks, self.sizes.pairs)
        return {
            "names": np.array(list(self.technique)),
            "counts": np.array(list(self.technique.values()), np.int64),
            "of_block": self.of_block,
            "walk_rows": np.array(self.walk_rows, np.int64),
            "branching": np.array(self.branching),
            "sizes": np.array(sizes, np.int64),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> FrameCounts:
        technique = {str(name): int(value) for name, value in zip(arrays["names"], arrays["counts"], strict=True)}
        walk_rows = tuple(int(rows) for rows in arrays["walk_rows"])
        sizes = Sizes(*(int(size) for size in arrays["sizes"]))
        return cls(technique, arrays["of_block"], walk_rows, int(arrays["branching"]), sizes)


def count(config: Configuration, inputs: FrameInputs, sizes: Sizes | None = None) -> tuple[FrameCounts, ListLengths]:
    """Count what a configuration does on a frame; nothing is shaded."""
    if is_listed(config):
        env, sizes = run_stages(config, inputs, sizes, until="assign")
    else:
        env, sizes = inputs.environment(config), NO_SIZES
    lengths = lengths_of(env, inputs)
    branching = int(config.params.get("branching", _BRUTE_FORCE_WORD))
    tile_px = int(config.params.get("tile_px", PARAMETERS["tile_px"].default))
    n_samples = inputs.samples.n_valid
    counts = shading_counts(lengths, n_samples, tile_px)
    rows: tuple[int, ...] = ()
    if is_listed(config):
        counts |= cluster_counts(lengths, n_cells(env["grid"], inputs.positions.viewport), inputs.n_lights)
        counts |= assign_counts(env["assign_counts"], inputs.n_lights, branching)
        rows = walk_rows(env["assign_counts"])
    structures = [value for name, value in env.items() if name not in _NO_STRUCTURES]
    counts |= memory_counts(env["gbuffer"], structures, n_samples, counts.get("light_cluster_pairs", 0))
    return FrameCounts(counts, lengths.of_block, rows, branching, sizes), lengths


def is_listed(config: Configuration) -> bool:
    """Does the technique make light lists?"""
    return any(stage.name == "assign" for stage in REGISTRY[config.technique].stages)


def render(config: Configuration, inputs: FrameInputs) -> np.ndarray:
    """The image of a configuration by its fused program: linear, float32 `[h, w, 3]`, 0 where invalid."""
    sizes = run_stages(config, inputs, until="assign")[1] if is_listed(config) else NO_SIZES
    image, overflowed = frame_program(config.technique, planned(config, sizes))(inputs.environment(config))
    if bool(overflowed):
        raise CapacityError(f"{config}: the frame no longer fits the capacities that its sizing run found.")
    return image_on_host(image, inputs)


def image_on_host(image: tuple[Any, ...], inputs: FrameInputs) -> np.ndarray:
    """`[h, w, 3]` from the device's runs."""
    viewport = inputs.positions.viewport
    return np.stack([from_runs(np.asarray(channel), viewport) for channel in image], axis=-1)
