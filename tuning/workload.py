"""One scene on one device, as the search sees it: counts, and times that were checked first."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from tuning.choose import Objective, median_interval
from tuning.compiles import Compiles
from tuning.measurement import Measurement, Outcome
from tuning.shadow_check import MaskCheck, ShadowChecker, light_on_host, masks_on_host
from tuning.timing import interleaved_ms, repeats_ms, timed_ms
from vtfs.cache import cached
from vtfs.cell_maps import CellMaps, cell_maps
from vtfs.configurations import Configuration, changes_shadows, configuration, counted_configuration
from vtfs.device import device_name, versions
from vtfs.frame import cast_program, frame_program, image_on_host, is_listed, planned, run_stages, stage_program
from vtfs.frame_counts import FrameCounts, count
from vtfs.frame_inputs import FrameInputs
from vtfs.frame_sizes import NO_SIZES, CapacityError, Sizes
from vtfs.input_error import InputError
from vtfs.light_shadows import CastMask
from vtfs.lights import Lights
from vtfs.op_counts import ListLengths, OpCounts
from vtfs.reference import forward_reference, image_error
from vtfs.shadow_maps import ShadowMaps, shadow_maps
from vtfs.shadow_scene import ShadowScene
from vtfs.techniques import REGISTRY
from vtfs.view_samples import ViewSamples

log = logging.getLogger("vtfs.workload")

EXACT_ERROR = 1e-4
"""Error above which a configuration that should be exact has failed. float32 gives some 1e-5 near a light, where
the rounding of its position (1e-7 of its distance to the eye) counts against its distance to the sample."""

LOST = 1.03
"""A configuration this many times as slow as the best so far in all repeats has lost: its time needs no more."""

HOPELESS = 1.6
"""Where one run took this many times as long as the best so far, no other is made: a busy machine explains less."""

TIMEOUT_S = 30.0
"""A frame that takes longer is recorded as `timeout`, not repeated."""

_DUEL_CAP_S = 4.0


@dataclass(frozen=True)
class ScenePath:
    """What is measured: the chosen frames of a scene's camera path.

    - `frames`: their numbers, the one with the most work first; `samples`: of each.
    """

    key: str
    frames: tuple[int, ...]
    samples: tuple[ViewSamples, ...]
    lights: Lights
    seed: int
    shadow_scene: ShadowScene | None = None


class SceneWorkload:
    """Counts and measures configurations on a few frames. Implements `search_run.Workload`."""

    def __init__(self, path: ScenePath, compiles: Compiles, objective: Objective = "max"):
        self._path = path
        self._compiles = compiles
        self._objective = objective
        self._inputs = [
            FrameInputs(samples, path.lights, frame, shadow_scene=path.shadow_scene)
            for samples, frame in zip(path.samples, path.frames, strict=True)
        ]
        self._reference: np.ndarray | None = None
        self._checker: ShadowChecker | None = None
        self._counted: dict[tuple[Configuration, int], FrameCounts] = {}
        self.device = device_name()
        self.frames = path.frames
        self.scene_key = path.key

    def counts(self, config: Configuration, /) -> tuple[OpCounts, ...]:
        """Counts on the frame with the most work: what decides, and a third of the cost of counting all."""
        try:
            return (self.counts_of_frame(config, 0),)
        except (InputError, MemoryError, jax.errors.JaxRuntimeError) as error:
            log.info("%s cannot be counted: %s", config, error)
            return ()

    def counts_of_frame(self, config: Configuration, i: int) -> OpCounts:
        canonical = counted_configuration(config)
        if (canonical, i) not in self._counted:
            self._counted[canonical, i] = cached_counts(
                canonical, self.scene_key, self.frames[i], lambda: self._inputs[i]
            )
        return self._counted[canonical, i].of(config)

    def measure(self, config: Configuration, best_ms: float | None, /) -> Measurement:
        """Check a configuration against the float64 reference, then time its frame and its stages."""
        before = self._compiles.copy()
        outcome, message = "failed", ""
        taken = _Taken()
        try:
            outcome, message = self._take(config, best_ms, taken)
        except CapacityError as error:
            outcome, message = "overflow", str(error)
        except InputError as error:
            message = str(error)
        except MemoryError as error:
            outcome, message = "out_of_memory", str(error) or "the host's memory is full"
        except jax.errors.JaxRuntimeError as error:
            outcome = "out_of_memory" if "RESOURCE_EXHAUSTED" in str(error) else "failed"
            message = (str(error).splitlines() or ["the device gave no reason"])[0][:300]
        if outcome != "timed":
            log.warning("%s: %s (%s)", config, outcome, message)
        return Measurement(
            technique=config.technique,
            params=config.params,
            scene_key=self.scene_key,
            frames=self.frames,
            seed=self._path.seed,
            outcome=outcome,
            compile_s=self._compiles.seconds - before.seconds,
            stages_ms=taken.stages_ms,
            counts=taken.counts,
            error=taken.error,
            error_p999=taken.error_p999,
            device=self.device,
            versions=versions(),
            load=os.getloadavg()[0],
            message=message,
        )

    def duel_ms(self, configs: Sequence[Configuration], frame: int, rounds: int = 15) -> list[tuple[float, ...]]:
        """Times of configurations that were measured before, on one frame, in turns."""
        return interleaved_ms([self._frame_run(config, frame) for config in configs], rounds, _DUEL_CAP_S)

    def image(self, config: Configuration) -> np.ndarray:
        """The linear image of the frame with the most work."""
        return image_on_host(self._run_frame(config, 0)[0], self._inputs[0])

    def valid(self) -> np.ndarray:
        """Which pixels of that frame have a sample."""
        return self._inputs[0].seen()

    def solid(self) -> np.ndarray:
        """Which of them have a solid one."""
        return self._inputs[0].samples.valid

    def list_lengths(self, config: Configuration) -> ListLengths:
        """Lights listed for each pixel and each cell of that frame."""
        return count(config, self._inputs[0])[1]

    def cell_maps(self, config: Configuration) -> CellMaps | None:
        """The cells of that frame; None where the technique has none."""
        return cell_maps(config, self._inputs[0])

    def shadow_maps(self, config: Configuration) -> ShadowMaps:
        """Shadows and tests on that frame."""
        maps = shadow_maps(config, self._inputs[0])
        assert maps is not None  # of a shadow technique
        return maps

    @property
    def n_shadow_lights(self) -> int:
        """Lights that cast on that frame."""
        return len(self._inputs[0].shadows.lights)

    def reference(self) -> np.ndarray:
        """The float64 image of the frame with the most work, without shadows."""
        if self._reference is None:
            samples, lights = self._path.samples[0], self._path.lights
            parts = (self.scene_key, f"frame {self.frames[0]}")
            found = cached("references", parts, lambda: {"image": forward_reference(samples, lights)})
            self._reference = found["image"]
        return self._reference

    def _take(self, config: Configuration, best_ms: float | None, taken: _Taken) -> tuple[Outcome, str]:
        sizes = self._sizes_of(config)
        taken.counts = tuple(self.counts_of_frame(config, i) for i in range(len(self._inputs)))
        started = time.perf_counter()
        # Shadows before, as the frame and its stages may share their programs.
        masks = self._cast(config) if REGISTRY[config.technique].casts_shadows else []
        # The frame and its stages are programs of their own: two cores compile them at once. After the default they
        # are compiled, and the stages are run where the configuration has not lost.
        new = is_listed(config) and config == configuration(config.technique)
        with ThreadPoolExecutor(2) as pool:
            frame = pool.submit(lambda: jax.block_until_ready(self._run_frame(config, 0)))
            stages = pool.submit(run_stages, config, self._inputs[0], sizes) if new else None
            image, overflowed = frame.result()
            env = stages.result()[0] if stages else {}
        if bool(overflowed):
            return "overflow", "a frame no longer fits the capacities that its sizing run found"
        valid = self._inputs[0].seen()
        if REGISTRY[config.technique].casts_shadows:
            checked = self._check_masks(config, masks)
            reference = checked.image
            if checked.wrong and not changes_shadows(config):
                return "failed", checked.wrong
        else:
            reference = self.reference()
        with np.errstate(invalid="ignore", over="ignore"):  # of an image that overflowed the error is infinite
            taken.error, taken.error_p999 = image_error(image_on_host(image, self._inputs[0]), reference, valid)
        if config.is_exact and not taken.error <= EXACT_ERROR:
            return "failed", f"error {taken.error:.2g} against the float64 reference; float32 explains {EXACT_ERROR:g}"
        # The first run's time may be the compiler's: only a second one is held against the configuration.
        slow = time.perf_counter() - started > TIMEOUT_S
        if slow and (seconds := timed_ms(self._frame_run(config, 0)) / 1e3) > TIMEOUT_S:
            return "timeout", f"one frame took {seconds:.0f} s, more than {TIMEOUT_S:.0f} s"

        # With `mean` every frame counts; with `max` only the slowest one, and there is a time to beat.
        only_slowest = self._objective == "max"
        beat_ms = best_ms if best_ms is not None and only_slowest else math.inf
        frames: list[tuple[float, ...]] = []
        slowest_low = 0.0
        for i in range(len(self._inputs)):
            if frames and median_interval(frames[0])[0] > LOST * beat_ms:
                frames.append(())  # it lost on the first frame: the others cannot make it faster
                continue

            def decided(interval_ms: tuple[float, float], slowest_low: float = slowest_low) -> bool:
                return only_slowest and (interval_ms[0] > LOST * beat_ms or interval_ms[1] < slowest_low)

            run = self._frame_run(config, i)
            if frames:
                run()  # a frame with transparent samples, where the first has none, is a program of its own
            frames.append(repeats_ms(run, decided, hopeless_ms=HOPELESS * beat_ms))
            slowest_low = max(slowest_low, min(frames[-1]))
        # Models of stages are fitted to exact settings.
        if all(frames) and is_listed(config) and config.is_exact:
            env = env or run_stages(config, self._inputs[0], sizes)[0]
        taken.stages_ms = self._stages_ms(config, sizes, env) | {"frame": tuple(frames)}
        return "timed", ""

    def _cast(self, config: Configuration) -> list[CastMask]:
        plan = planned(config, self._sizes_of(config))
        return cast_program(config.technique, plan)(self._inputs[0].shadows.tasks(config))

    def _check_masks(self, config: Configuration, masks: list[CastMask]) -> MaskCheck:
        samples, shadows = self._path.samples[0], self._inputs[0].shadows
        if self._checker is None:
            key = (self.scene_key, f"frame {self.frames[0]}")
            self._checker = ShadowChecker(shadows, samples, self._path.lights, key)
        return self._checker.check(config, masks_on_host(masks, samples), light_on_host(masks, self._inputs[0]))

    def _stages_ms(
        self, config: Configuration, sizes: Sizes, env: dict[str, Any]
    ) -> dict[str, tuple[tuple[float, ...], ...]]:
        """The stages apart, on the frame with the most work; what `env` holds has been run before.

        None where `env` is empty: of what has lost, and where the frame is one stage.
        """
        technique = REGISTRY[config.technique]
        stages = technique.stages_of(planned(config, sizes), self._inputs[0].has_transparent) if env else ()
        times: dict[str, tuple[tuple[float, ...], ...]] = {}
        unmeasured = ((),) * (len(self._inputs) - 1)
        for stage in stages:
            program = stage_program(stage, stage.narrowed(planned(config, sizes)))
            arguments = [env[name] for name in stage.needs]

            def run(program: Callable = program, arguments: list = arguments) -> None:
                jax.block_until_ready(program(*arguments))

            times[stage.name] = (repeats_ms(run, lambda _: True), *unmeasured)
        return times

    def _sizes_of(self, config: Configuration) -> Sizes:
        """Capacities that hold all frames: they are measured with the same programs."""
        if not is_listed(config):
            return NO_SIZES
        for i in range(len(self._inputs)):
            self.counts_of_frame(config, i)
        canonical = counted_configuration(config)
        sizes = NO_SIZES
        for i in range(len(self._inputs)):
            sizes = sizes.covering(self._counted[canonical, i].sizes)
        return sizes

    def _run_frame(self, config: Configuration, i: int):
        program = frame_program(
            config.technique, planned(config, self._sizes_of(config)), self._inputs[i].has_transparent
        )
        return program(self._inputs[i].environment(config))

    def _frame_run(self, config: Configuration, i: int) -> Callable[[], object]:
        program = frame_program(
            config.technique, planned(config, self._sizes_of(config)), self._inputs[i].has_transparent
        )
        env = self._inputs[i].environment(config)

        def run() -> None:
            # Whether it overflowed is read as well: a renderer would have to.
            image, overflowed = program(env)
            jax.block_until_ready(image)
            bool(overflowed)

        return run


@dataclass
class _Taken:
    """What a measurement has so far: kept where a later step fails."""

    stages_ms: dict[str, tuple[tuple[float, ...], ...]]
    counts: tuple[OpCounts, ...]
    error: float | None
    error_p999: float | None

    def __init__(self):
        self.stages_ms, self.counts, self.error, self.error_p999 = {}, (), None, None


def cached_counts(config: Configuration, scene_key: str, frame: int, inputs: Callable[[], FrameInputs]) -> FrameCounts:
    """Counts of a frame, on disk between runs: counting a space costs as much as measuring a part of it.

    They depend on the device only by rounding at the edges of lights and cells, but are kept apart for each.
    """
    parts = (scene_key, f"frame {frame}", str(config.items), config.technique, device_name())
    return FrameCounts.from_arrays(cached("counts", parts, lambda: count(config, inputs())[0].as_arrays()))


def busiest_frames(work: dict[int, int]) -> tuple[int, ...]:
    """The frames with the most, the median and the least work, in that order and each once.

    **Arguments:**

    - `work`: lighting computations of each counted frame.
    """
    ordered = sorted(work, key=lambda frame: (-work[frame], frame))
    chosen = (ordered[0], ordered[(len(ordered) - 1) // 2], ordered[-1])
    return tuple(dict.fromkeys(chosen))
