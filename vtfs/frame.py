"""Running a technique on a frame: its programs, their capacities, its image and its counts."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from vtfs.cluster_grid import cluster_grid, configured_grid, n_cells, n_keys, tile_and_slices
from vtfs.gbuffer import RUN_WIDTH_PX, Fragments, GBuffer, LayerTable, Positions, from_runs
from vtfs.input_error import InputError
from vtfs.light_assignment.brute_force import every_pair
from vtfs.light_assignment.light_tree import reduce_lights, sort_lights
from vtfs.light_lists import AssignCounts, ViewLights, view_lights
from vtfs.light_shadows import CastMask
from vtfs.lights import Lights
from vtfs.morton import morton_codes
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
from vtfs.parameters import PARAMETERS, SHADOW_REFERENCES, Configuration, lists_configuration, shading_batch
from vtfs.shadow_inputs import FrameShadows, ShadowScene, ShadowTask, receiving
from vtfs.shadow_mask import ShadowMask, ShadowPlan
from vtfs.shadow_techniques import (
    CastShadows,
    fitted_to_all,
    on_host,
    shadow_plan,
    shadow_sizes,
    shadows_counts,
    with_shadow_sizes,
)
from vtfs.techniques import REGISTRY, Plan, Stage, Walked, approximates, assign_chunk, volume_chunk
from vtfs.view_samples import ViewSamples

_BRUTE_FORCE_WORD = 32
_NO_STRUCTURES = (
    "positions", "gbuffer", "normals", "grid", "light_cutoff", "approximate", "frame", "resort_every",
)  # fmt: skip

_SCALARS = ("grid", "light_cutoff", "approximate", "frame", "resort_every")


class CapacityError(InputError):
    """A frame needs more than the largest capacity: it is not run, and nothing is dropped."""


@dataclass(frozen=True)
class Sizes:
    """Capacities that fix array shapes, rounded up to few sizes so that few programs are compiled.

    Loops run as often as there is work, so a generous capacity costs memory and little time.

    - `cells`: of the grid's page table; `blocks`: of clusters and of their blocks; `pairs`: of the
      (cluster, light) pairs and of every level on the way to them.
    - `shadow`: of shadow techniques, see `shadow_sizes`.
    """

    cells: int
    blocks: int
    pairs: int
    shadow: tuple[int, ...] = ()

    def covering(self, other: Sizes) -> Sizes:
        """What holds both; of the same technique and plan."""
        shadow = self.shadow or other.shadow
        if self.shadow and other.shadow:
            shadow = tuple(map(max, self.shadow, other.shadow))
        return Sizes(max(self.cells, other.cells), max(self.blocks, other.blocks), max(self.pairs, other.pairs), shadow)


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
    """One frame on the device: view samples and lights, uploaded once and used by every configuration.

    - `frame`: its number on the path: where `resort_every` divides it, the light tree is sorted.
    - `earlier_lights`: where lights were in an earlier frame, in its view space; where they are now unless given.
    - `shadow_scene`: what casts shadows, for shadow techniques.
    """

    def __init__(
        self,
        samples: ViewSamples,
        lights: Lights,
        frame: int = 0,
        earlier_lights: Callable[[int], ViewLights] | None = None,
        shadow_scene: ShadowScene | None = None,
    ):
        self._shadow_scene = shadow_scene
        self._lights = lights
        self.samples = samples
        self.frame = frame
        self._earlier_lights = earlier_lights
        self._orders: dict[tuple[int, float], jax.Array] = {}
        self._scalars: dict[tuple[str, ...], Any] = {}
        self.camera = samples.camera
        self.viewport = samples.camera.viewport
        self.lights = view_lights(lights, samples.camera)
        self.n_lights = lights.n_lights
        depths = -samples.position_m[..., 2][samples.valid]
        self.deepest_m = float(depths.max(initial=samples.camera.near_m))
        self._fragments: dict[bool, Fragments] = {}
        self._positions: dict[bool, Positions] = {}
        self._gbuffers: dict[tuple[bool, str], GBuffer] = {}

    @cached_property
    def shadows(self) -> FrameShadows:
        """What casts on this frame.

        **Raises:** `InputError` where there is no geometry, or no light that casts.
        """
        if self._shadow_scene is None:
            raise InputError("shadow techniques need the triangles of a scene: give a scene file, not a G-buffer.")
        return FrameShadows(self._shadow_scene, self.samples, self._lights)

    @cached_property
    def layers(self) -> LayerTable:
        return self.fragments(with_hidden=False).layer_table()

    @property
    def has_transparent(self) -> bool:
        return bool(self.fragments(with_hidden=False).n_transparent_runs)

    def fragments(self, with_hidden: bool) -> Fragments:
        if with_hidden not in self._fragments:
            self._fragments[with_hidden] = Fragments(self.samples, with_hidden=with_hidden)
        return self._fragments[with_hidden]

    def positions(self, with_hidden: bool) -> Positions:
        if with_hidden not in self._positions:
            self._positions[with_hidden] = self.fragments(with_hidden).positions()
        return self._positions[with_hidden]

    def gbuffer(self, precision: str, with_hidden: bool) -> GBuffer:
        key = with_hidden, precision
        if key not in self._gbuffers:
            self._gbuffers[key] = self.fragments(with_hidden).gbuffer(self.positions(with_hidden), precision)
        return self._gbuffers[key]

    def order_of(self, frame: int, light_cutoff: float) -> jax.Array:
        """The lights in Morton order of an earlier frame: what that frame left for those after it."""
        if (frame, light_cutoff) not in self._orders:
            lights = self._earlier_lights(frame) if self._earlier_lights else self.lights
            self._orders[frame, light_cutoff] = _morton_order(lights, np.float32(light_cutoff))
        return self._orders[frame, light_cutoff]

    def seen(self) -> np.ndarray:
        """Which pixels show anything: bool `[h, w]`."""
        layers = [layer.samples.valid for layer in self.samples.layers.transparent]
        return np.logical_or.reduce([self.samples.valid, *layers])

    def environment(self, config: Configuration) -> dict[str, Any]:
        """What the stages of a configuration start from, by the names that `Stage.needs` uses."""
        params = lists_configuration(config).params
        technique = REGISTRY[config.technique]
        with_hidden = technique.shades_hidden(config)
        env: dict[str, Any] = {
            "positions": self.positions(with_hidden),
            "gbuffer": self.gbuffer(str(params["gbuffer"]), with_hidden),
            "layers": self.layers,
            "lights": self.lights,
            "light_cutoff": np.float32(params["light_cutoff"]),
            "approximate": np.float32(params.get("approximate", 0)),
            "cluster_light": None,
        }
        resort_every = int(params.get("resort_every", 1))
        if resort_every > 1:
            last_sorted = self.frame - self.frame % resort_every
            env["old_order"] = self.order_of(last_sorted, float(params["light_cutoff"]))
            env |= {"frame": np.int32(self.frame), "resort_every": np.int32(resort_every)}
        if technique.lists == "clusters":
            env["grid"] = configured_grid(self.camera, params, self.deepest_m, technique.one_slice)
            # Only where they are read: each precision of the G-buffer would compile the clusters again.
            has_cones = technique.plan(config).normal_cones == "explicit"
            needs_normals = has_cones or params.get("normal_bins", 0)
            env["normals"] = env["gbuffer"].normal if needs_normals else None
        elif technique.lists == "light_volumes":  # for its pixels
            env["grid"] = cluster_grid(self.camera, RUN_WIDTH_PX, 1, self.deepest_m)
        env |= {name: self._on_device(name, env[name]) for name in _SCALARS if name in env}
        if technique.casts_shadows:
            env["shadow_slots"] = self.shadows.slots
            if config.technique in SHADOW_REFERENCES:
                env["shadow_merge"] = self.shadows.reference_masks(config)
            else:
                env["shadow_tasks"] = self.shadows.tasks(config)
        return env

    def _on_device(self, name: str, scalars: Any) -> Any:
        """Sent once: a dozen scalars, each by itself, would take a GPU 0.3 ms in every frame. The same for the same
        values: see `KeptStages`."""
        key = (name, *map(repr, jax.tree.leaves(scalars)))
        if key not in self._scalars:
            self._scalars[key] = jax.device_put(scalars)
        return self._scalars[key]


@jax.jit
def _morton_order(lights: ViewLights, light_cutoff) -> jax.Array:
    spheres = lights.spheres(light_cutoff)
    return sort_lights(morton_codes(spheres, *reduce_lights(spheres)))


def planned(config: Configuration, sizes: Sizes) -> Plan:
    plan = REGISTRY[config.technique].plan(config)
    shadow = with_shadow_sizes(plan.shadow, sizes.shadow) if plan.shadow else None
    return replace(plan, cells=sizes.cells, blocks=sizes.blocks, pairs=sizes.pairs, shadow=shadow)


@functools.cache
def stage_program(stage: Stage, plan: Plan) -> Callable[..., Any]:
    """One stage as a program of its own. `plan` holds only what the stage names: see `Stage.narrowed`."""
    program = jax.jit(functools.partial(stage.run, plan))
    return _for_each_shadow(program) if stage.casting else program


def _for_each_shadow(program: Callable[..., Any]) -> Callable[..., list[Any]]:
    """Run for each light that casts and each view, in float64."""

    def run(*lists: list[Any]) -> list[Any]:
        with jax.enable_x64(True):
            return [program(*each) for each in zip(*lists, strict=True)]

    return run


def keep_result(env: dict[str, Any], stage: str, result: Any) -> None:
    """Add a stage's result to what later stages may need. An assignment's counts stay apart from its lists: their
    shape depends on the tree, and would compile the shading again for every branching. So do those of shadows. What is
    evaluated once a cluster leaves the lists."""
    if stage == "assign":
        env["assign"], env["assign_counts"] = result
        env["listed"] = env["assign"]
    elif stage == "approximate":
        env["assign"], env["cluster_light"] = result
    elif stage == "shadow_merge":
        env["shadow_merge"] = [CastMask(mask.shadowed, mask.overflowed) for mask in result]
    else:
        env[stage] = result


def frame_program(technique: str, plan: Plan, has_transparent: bool) -> Callable[..., Any]:
    """All stages fused: from the inputs to the image and whether anything overflowed.

    One program; of shadow techniques two, as shadows are found in float64 and shaded in float32: `cast_program`, and
    from its masks to the image.
    """
    stages = REGISTRY[technique].stages_of(plan, has_transparent)
    casting = tuple(stage for stage in stages if stage.casting)
    image = _fused(tuple(stage for stage in stages if not stage.casting), replace(plan, shadow=None))
    if not casting:
        return image
    cast = cast_program(technique, plan)

    def run(env: dict[str, Any]):
        shading = {name: value for name, value in env.items() if name != "shadow_tasks"}
        return image(shading | {casting[-1].name: cast(env["shadow_tasks"])})

    return run


def cast_program(technique: str, plan: Plan) -> Callable[[list[ShadowTask]], list[CastMask]]:
    """From view samples to the mask of one light on one view, fused, and run for each of them."""
    casting = tuple(stage for stage in REGISTRY[technique].stages if stage.casting)
    return _for_each_shadow(_fused_casting(casting, Plan(shadow=plan.shadow)))


@functools.cache
def _fused_casting(stages: tuple[Stage, ...], plan: Plan) -> Callable[[ShadowTask], CastMask]:
    def run(task: ShadowTask) -> CastMask:
        env: dict[str, Any] = {"shadow_tasks": task}
        for stage in stages:
            env[stage.name] = stage.run(plan, *(env[name] for name in stage.needs))
        mask = env[stages[-1].name]
        return CastMask(mask.shadowed, mask.overflowed)  # alone, so that XLA deletes the counting

    return jax.jit(run)


@functools.cache
def _fused(stages: tuple[Stage, ...], plan: Plan) -> Callable[..., Any]:
    # By stages, not by name: techniques that differ in what is rasterised share a program here.
    def run(env: dict[str, Any]):
        env = dict(env)
        for stage in stages:
            keep_result(env, stage.name, stage.run(plan, *(env[name] for name in stage.needs)))
        overflowed = [env[name].overflowed for name in ("clusters", "assign", "shadow_bits") if name in env]
        return env[stages[-1].name], jax.numpy.stack(overflowed).any() if overflowed else np.bool_(False)

    return jax.jit(run)


class KeptStages:
    """The last results of stages, by what they were made from: the configurations of a space share grids and trees."""

    def __init__(self, most: int = 12):
        self._most = most
        self._results: OrderedDict[tuple[Any, ...], tuple[list[Any], Any]] = OrderedDict()

    def run(self, stage: Stage, plan: Plan, arguments: list[Any]) -> Any:
        # Arguments are kept beside the result: while they live, nothing else has their identity.
        return self.result((stage, plan), arguments, lambda: stage_program(stage, plan)(*arguments))

    def result(self, what: tuple[Any, ...], arguments: list[Any], make: Callable[[], Any]) -> Any:
        key = (*what, *map(id, arguments))
        if key not in self._results:
            self._results[key] = arguments, make()
        self._results.move_to_end(key)
        while len(self._results) > self._most:
            self._results.popitem(last=False)
        return self._results[key][1]


def run_stages(
    config: Configuration,
    inputs: FrameInputs,
    sizes: Sizes | None = None,
    *,
    until: str | None = None,
    kept: KeptStages | None = None,
) -> tuple[dict[str, Any], Sizes]:
    """Run a frame stage by stage, with larger capacities until everything fits.

    **Arguments:**

    - `sizes`: capacities to start from.
    - `until`: the last stage to run; all by default.
    - `kept`: where results are looked up first.

    **Returns:** the result of every stage (and the inputs) by name, and the capacities that fit.

    **Raises:** `CapacityError`, and `InputError` for a grid with too many cells.
    """
    env = inputs.environment(config)
    technique = REGISTRY[config.technique]
    n_runs = env["positions"].z_m.shape[0]
    grid_keys = n_keys(env["grid"], inputs.viewport) if technique.lists == "clusters" else 0
    if technique.two_lists and inputs.has_transparent:
        grid_keys *= 2
    fitting = Sizes(rounded_up("cells", grid_keys), rounded_up("blocks", n_runs), rounded_up("pairs", 0))
    sizes = fitting.covering(sizes) if sizes else fitting
    if "shadow_tasks" in env and not sizes.shadow:
        sizes = replace(sizes, shadow=cast_counted(config, inputs)[1])
    kept = kept or KeptStages()
    for stage in technique.stages_of(technique.plan(config), inputs.has_transparent):
        while True:
            plan = stage.narrowed(planned(config, sizes))
            result = kept.run(stage, plan, [env[name] for name in stage.needs])
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
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> FrameCounts:
        technique = {str(name): int(value) for name, value in zip(arrays["names"], arrays["counts"], strict=True)}
        walk_rows = tuple(int(rows) for rows in arrays["walk_rows"])
        n_solid_blocks, light_runs, branching, cells, blocks, pairs, *shadow = (int(v) for v in arrays["scalars"])
        sizes = Sizes(cells, blocks, pairs, tuple(shadow))
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
    shadow: tuple[int, ...] = ()
    if config.technique not in SHADOW_REFERENCES:
        cast, shadow = cast_counted(config, inputs)
        own = shadows_counts([each.counts for each in cast])
        counts |= own | {"memory": counts["memory"] + own["memory"]}
    return replace(shading, technique=counts, sizes=replace(shading.sizes, shadow=shadow)), lengths


def cast_counted(config: Configuration, inputs: FrameInputs) -> tuple[list[CastShadows], tuple[int, ...]]:
    """Shadows of all lights on each view, with tests and counts, and the capacities that hold them."""
    tasks = inputs.shadows.tasks(config)
    stages = [stage for stage in REGISTRY[config.technique].stages if stage.casting]

    def run(plan: ShadowPlan, i: int) -> ShadowMask:
        # Stage by stage: those that a setting does not change are compiled, and run, as they are.
        env: dict[str, Any] = {"shadow_tasks": [tasks[i]]}
        for stage in stages:
            program = stage_program(stage, stage.narrowed(Plan(shadow=plan)))
            env[stage.name] = program(*(env[name] for name in stage.needs))
        return env[stages[-1].name][0]

    frames = [receiving(task) for task in tasks]
    plan, masks = fitted_to_all(config.technique, shadow_plan(config), frames, run=run)
    return [on_host(mask, plan, frame) for mask, frame in zip(masks, frames, strict=True)], shadow_sizes(plan)


def _published_counts(config: Configuration, env: dict[str, Any], inputs: FrameInputs) -> AssignCounts:
    """What the technique's own assigner does, however the lists of `env` were made."""
    technique = REGISTRY[config.technique]
    published = replace(technique.plan(config), assigner="published")
    if technique.walked(published, inputs.n_lights) == "all_pairs":
        return every_pair(int(env["clusters"].n_clusters), inputs.n_lights)
    if technique.plan(config) == published:
        return env["assign_counts"]
    return run_stages(config.replaced(assigner="published"), inputs, until="assign")[0]["assign_counts"]


def is_listed(config: Configuration) -> bool:
    """Does the technique make lists, of lights or of pixels?"""
    return REGISTRY[config.technique].lists != "none"


def render(config: Configuration, inputs: FrameInputs) -> np.ndarray:
    """The image of a configuration by its fused program: linear, float32 `[h, w, 3]`, 0 where invalid."""
    sizes = run_stages(config, inputs, until="assign")[1] if is_listed(config) else NO_SIZES
    program = frame_program(config.technique, planned(config, sizes), inputs.has_transparent)
    image, overflowed = program(inputs.environment(config))
    if bool(overflowed):
        raise CapacityError(f"{config}: the frame no longer fits the capacities that its sizing run found.")
    return image_on_host(image, inputs)


def image_on_host(image: tuple[Any, ...], inputs: FrameInputs) -> np.ndarray:
    """`[h, w, 3]` from the device's runs."""
    return np.stack([from_runs(np.asarray(channel), inputs.viewport) for channel in image], axis=-1)
