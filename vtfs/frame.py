"""Running a technique on a frame: its programs, the capacities that hold it, and its image."""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from vtfs.cluster_grid import n_keys
from vtfs.configurations import Configuration
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_plan import Plan, Stage
from vtfs.frame_sizes import NO_SIZES, CapacityError, Sizes, rounded_up
from vtfs.gbuffer import from_runs
from vtfs.light_shadows import CastMask
from vtfs.shadow_capacities import fitted_to_all, shadow_sizes, with_shadow_sizes
from vtfs.shadow_inputs import ShadowTask, alpha_receiving, receiving
from vtfs.shadow_mask import ShadowMask, ShadowPlan, uncounted
from vtfs.shadow_programs import alpha_plan, shadow_plan
from vtfs.shadow_stages import TRANSMIT
from vtfs.shadow_techniques import CastShadows, on_host
from vtfs.techniques import REGISTRY


def planned(config: Configuration, sizes: Sizes) -> Plan:
    plan = REGISTRY[config.technique].plan(config)
    shadow = with_shadow_sizes(plan.shadow, sizes.shadow) if plan.shadow else None
    alpha = with_shadow_sizes(alpha_plan(config), sizes.alpha) if sizes.alpha else None
    return replace(plan, cells=sizes.cells, blocks=sizes.blocks, pairs=sizes.pairs, shadow=shadow, alpha=alpha)


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
        env["shadow_merge"] = [_cast_mask(mask) for mask in result]
        env["shadow_masks"] = env["shadow_merge"]
    elif stage == TRANSMIT:
        env["shadow_masks"] = [mask for mask, _ in result]
    else:
        env[stage] = result


def frame_program(technique: str, plan: Plan, has_transparent: bool) -> Callable[..., Any]:
    """All stages fused: from the inputs to the image and whether anything overflowed.

    One program; of shadow techniques `cast_program` and one from its masks to the image, as shadows are found in
    float64 and shaded in float32.
    """
    stages = REGISTRY[technique].stages_of(plan, has_transparent)
    casting = tuple(stage for stage in stages if stage.casting)
    image = _fused(tuple(stage for stage in stages if not stage.casting), replace(plan, shadow=None, alpha=None))
    if not casting:
        return image
    cast = cast_program(technique, plan)

    def run(env: dict[str, Any]):
        shading = {name: value for name, value in env.items() if name != "shadow_tasks"}
        return image(shading | {"shadow_masks": cast(env["shadow_tasks"])})

    return run


def _cast_mask(mask: ShadowMask) -> CastMask:
    return CastMask(mask.shadowed, mask.overflowed)


def cast_program(technique: str, plan: Plan) -> Callable[[list[ShadowTask]], list[CastMask]]:
    """From view samples to the mask of one light on one view, run for each of them.

    Where levels loop, by the stages' own programs, which counted the configuration: a walk compiles for seconds, and
    a call more costs a CPU next to nothing. Without loops fused.
    """
    casting = tuple(stage for stage in REGISTRY[technique].stages_of(plan, False) if stage.casting)
    own = Plan(shadow=plan.shadow, alpha=plan.alpha)
    if plan.shadow is not None and plan.shadow.level_groups:
        return _for_each_shadow(_fused_casting(casting, own))
    return lambda tasks: [_cast_by_stages(casting, own, task) for task in tasks]


def _cast_by_stages(stages: tuple[Stage, ...], plan: Plan, task: ShadowTask) -> CastMask:
    opaque = [stage for stage in stages if stage.name != TRANSMIT]
    mask = _cast_mask(_run_casting(opaque, plan, task))
    return mask if len(opaque) == len(stages) else _run_transmit(stages[-1], plan, task, mask)[0]


def _run_casting(stages: Sequence[Stage], plan: Plan, task: ShadowTask) -> ShadowMask:
    """The mask of opaque casters, stage by stage: those that a setting does not change are compiled as they are."""
    env: dict[str, Any] = {"shadow_tasks": [task]}
    for stage in stages:
        env[stage.name] = stage_program(stage, stage.narrowed(plan))(*(env[name] for name in stage.needs))
    return env[stages[-1].name][0]


def _run_transmit(stage: Stage, plan: Plan, task: ShadowTask, opaque: CastMask) -> tuple[CastMask, ShadowMask]:
    return stage_program(stage, stage.narrowed(plan))([task], [opaque])[0]


@functools.cache
def _fused_casting(stages: tuple[Stage, ...], plan: Plan) -> Callable[[ShadowTask], CastMask]:
    def run(task: ShadowTask) -> CastMask:
        env: dict[str, Any] = {"shadow_tasks": replace(task, frame=uncounted(task.frame))}
        for stage in stages:
            env[stage.name] = stage.run(stage.narrowed(plan), *(env[name] for name in stage.needs))
        if stages[-1].name == TRANSMIT:
            return env[TRANSMIT][0]
        return _cast_mask(env[stages[-1].name])  # alone, so that XLA deletes the counting

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
        cast = cast_counted(config, inputs)
        sizes = replace(sizes, shadow=cast.sizes, alpha=cast.alpha_sizes)
    kept = kept or KeptStages()
    for stage in technique.stages_of(planned(config, sizes), inputs.has_transparent):
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


@dataclass(frozen=True)
class CastFrame:
    """Shadows of all lights on each view, with tests and counts, and the capacities that hold them.

    - `opaque`: by opaque casters; `alpha`: what alpha casters stop wholly of the rest, empty where none cast.
    - `transmittance`: what those leave, of each light and view `[h, w, channels]`; empty likewise.
    """

    opaque: list[CastShadows]
    sizes: tuple[int, ...]
    alpha: list[CastShadows]
    transmittance: list[np.ndarray]
    alpha_sizes: tuple[int, ...]


def cast_counted(config: Configuration, inputs: FrameInputs) -> CastFrame:
    """Cast all shadows of a frame, stage by stage, with capacities that hold them."""
    tasks = inputs.shadows.tasks(config, counted=True)
    all_stages = [stage for stage in REGISTRY[config.technique].stages if stage.casting]
    stages = [stage for stage in all_stages if stage.name != TRANSMIT]

    def run(plan: ShadowPlan, i: int) -> ShadowMask:
        return _run_casting(stages, Plan(shadow=plan), tasks[i])

    frames = [receiving(task) for task in tasks]
    plan, masks = fitted_to_all(config.technique, shadow_plan(config), frames, run=run)
    opaque = [on_host(mask, plan, frame) for mask, frame in zip(masks, frames, strict=True)]
    if tasks[0].alpha is None:
        return CastFrame(opaque, shadow_sizes(plan), [], [], ())
    transmit = all_stages[-1]
    cast = [_cast_mask(mask) for mask in masks]
    left: dict[int, CastMask] = {}

    def run_alpha(plan: ShadowPlan, i: int) -> ShadowMask:
        left[i], mask = _run_transmit(transmit, Plan(alpha=plan), tasks[i], cast[i])
        return mask

    alpha_frames = [alpha_receiving(task, mask.shadowed) for task, mask in zip(tasks, cast, strict=True)]
    own, alpha_masks = fitted_to_all(config.technique, alpha_plan(config), alpha_frames, run=run_alpha)
    alpha = [on_host(mask, own, frame) for mask, frame in zip(alpha_masks, alpha_frames, strict=True)]
    channels = [image_on_host(left[i].transmittance, inputs) for i in range(len(tasks))]
    return CastFrame(opaque, shadow_sizes(plan), alpha, channels, shadow_sizes(own))


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
    """`[h, w, channels]` from the device's runs."""
    return np.stack([from_runs(np.asarray(channel), inputs.viewport) for channel in image], axis=-1)
