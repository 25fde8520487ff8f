"""The light tests that are put on the ladders, and what they missed, against float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vtfs.configurations import Configuration, configuration
from vtfs.frame import run_stages
from vtfs.frame_inputs import FrameInputs
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.lights import Lights
from vtfs.parameters import Value
from vtfs.view_samples import ViewSamples

N_LIGHTS = 128
"""On every rung of the built-in ladders, so that each method is compiled once."""

_CAP = 32
_TILE_PX, _BATCH = 8, 1024


@dataclass(frozen=True)
class LightCase:
    """One view and lights around it."""

    samples: ViewSamples
    lights: Lights


@dataclass(frozen=True)
class LightMethod:
    """One column of the result.

    - `cap`: lights that a list holds, the others are lost, as in engines with lists of fixed length; 0: all.
    - `moves_in_float32`: lights go from world to view space in float32.
    """

    name: str
    configuration: Configuration
    cap: int = 0
    moves_in_float32: bool = False


def _all_methods() -> tuple[LightMethod, ...]:
    def configured(technique: str, **params: Value) -> Configuration:
        return configuration(technique, {"tile_px": _TILE_PX, "batch": _BATCH, **params})

    culls = ("frustum", "box", "planes", "screen_rect")
    methods = [LightMethod(f"volume_tiled, cull={cull}", configured("volume_tiled", cull=cull)) for cull in culls]
    methods += [LightMethod(f"tiled_deferred, cull={cull}", configured("tiled_deferred", cull=cull)) for cull in culls]
    methods += [
        LightMethod(f"volume_tiled_bvh, leaf_test={test}", configured("volume_tiled_bvh", branching=8, leaf_test=test))
        for test in ("sphere", "box")
    ]
    tight = configured("volume_tiled", cull="box", bounds="explicit")
    methods.append(LightMethod("volume_tiled, bounds=explicit", tight))
    methods.append(LightMethod("bounds=explicit, lights moved in float32", tight, moves_in_float32=True))
    methods.append(LightMethod(f"bounds=explicit, at most {_CAP} lights a cell", tight, cap=_CAP))
    return tuple(methods)


LIGHT_METHODS: tuple[LightMethod, ...] = _all_methods()


@dataclass(frozen=True)
class LightVerdict:
    """One method on one rung.

    - `missed`: pairs of a sample and a light that reaches it, which is not on its list.
    - `listed`, `proven`: pairs of a cell and a light on its list, and those of them that reach a sample of the cell.
    """

    missed: int = 0
    listed: int = 0
    proven: int = 0
    refused: str = ""


@dataclass(frozen=True)
class LightOutcome:
    """One rung: valid samples, pairs of a sample and a light that reaches it, a verdict for each method."""

    samples: int
    reaching: int
    verdicts: dict[str, LightVerdict]


def judge_lights(case: LightCase, methods: Sequence[LightMethod] = LIGHT_METHODS) -> LightOutcome:
    """Run methods on a case."""
    reaches = _reaches(case)[case.samples.valid]
    exact, rounded = FrameInputs(case.samples, case.lights), FrameInputs(case.samples, _moved_in_float32(case))

    def verdict(method: LightMethod) -> LightVerdict:
        try:
            listed, cell = _listed(method, rounded if method.moves_in_float32 else exact)
        except InputError as error:
            return LightVerdict(refused=str(error))
        cell = cell[case.samples.valid]
        proven = np.zeros_like(listed)
        for n in range(reaches.shape[1]):
            proven[cell[reaches[:, n]], n] = True
        return LightVerdict(int((reaches & ~listed[cell]).sum()), int(listed.sum()), int((proven & listed).sum()))

    return LightOutcome(
        int(case.samples.valid.sum()), int(reaches.sum()), {method.name: verdict(method) for method in methods}
    )


def _reaches(case: LightCase) -> np.ndarray:
    """Is a light's window above 0, bool `[h, w, N]`? float64, of the float32 positions that the device has."""
    position = case.samples.position_m.astype(np.float64)
    lights = case.lights.relative_to(case.samples.camera.view_from_world)
    away = position[:, :, None, :] - lights.position_m
    ratio = np.linalg.norm(away, axis=-1) / np.maximum(lights.range_m, 1e-300)
    return (ratio < 1) & (1 - np.minimum(ratio, 1) ** 4 > 0) & (lights.range_m > 0)


def _listed(method: LightMethod, inputs: FrameInputs) -> tuple[np.ndarray, np.ndarray]:
    """Lights on the list of each cell, bool `[cells, lights]`, and the cell of each pixel, `[h, w]`."""
    env, _ = run_stages(method.configuration, inputs, until="assign")
    clusters, lists = env["clusters"], env["assign"]
    n_clusters = int(clusters.n_clusters)
    offset, count, index = (np.asarray(a) for a in (lists.offset, lists.count, lists.index))
    count = count[:n_clusters]
    kept = np.minimum(count, method.cap) if method.cap else count
    entry = np.repeat(offset[:n_clusters] - (np.cumsum(kept) - kept), kept) + np.arange(kept.sum())
    listed = np.zeros((n_clusters, inputs.n_lights), bool)
    listed[np.repeat(np.arange(n_clusters), kept), index[entry]] = True
    cell = np.asarray(clusters.block_cluster)[np.asarray(clusters.block_of_sample)]
    return listed, from_runs(cell[: env["positions"].n_visible_runs], inputs.viewport)


def _moved_in_float32(case: LightCase) -> Lights:
    """The lights where an engine sees them that keeps positions and its view matrix in float32."""
    matrix = case.samples.camera.view_from_world
    narrow = matrix.astype(np.float32)
    seen = case.lights.position_m.astype(np.float32) @ narrow[:3, :3].T + narrow[:3, 3]
    position = (seen.astype(np.float64) - matrix[:3, 3]) @ matrix[:3, :3]
    return replace(case.lights, position_m=position)
