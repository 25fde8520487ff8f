"""A workload without a device: counts by formulas, times by a law; and the spaces that are searched with it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from tuning.measurement import Measurement, Outcome
from tuning.space import Space, default_space
from vtfs.configurations import Configuration, configuration

FRAMES = (40, 11, 3)
_WORK = (1.6, 1.0, 0.5)  # of the three frames


@cache
def synthetic_counts(technique: str, tile: int, slices: int, branching: int, batch: int) -> tuple[dict[str, int], ...]:
    """Counts of about the right size for 1,000 lights at 1280x720: smaller cells have fewer lights each."""
    frames = []
    for work in _WORK:
        samples = int(800_000 * (0.8 + 0.1 * work))
        tiles = math.ceil(1280 / tile) * math.ceil(720 / tile)
        if technique == "forward":
            tiles, slices, per_cell = 1, 1, 1000.0
        elif technique == "tiled_deferred":
            slices, per_cell = 1, 30 * work * (1 + 20 * tile / 1280)
        else:
            slices = slices or max(4, int(7.6 / math.log1p(1.2 * tile / 720)))
            per_cell = 10 * work * (1 + 8 * (tile / 1280 + 1 / slices)) ** 1.5
        occupied = tiles * min(slices, 1 + 0.06 * slices)
        computations = samples * per_cell
        chunks = math.ceil(samples / batch) if batch else 1
        tests = occupied * (2 * per_cell + branching * math.log(1000) / math.log(branching))
        counts = {
            "samples": samples,
            "lights": 1000,
            "cells_total": tiles * slices,
            "clusters_occupied": occupied,
            "light_cluster_pairs": occupied * per_cell,
            "lighting_computations": computations,
            "shading_lanes": computations * (1 + 0.3 * (32 / tile) ** 0.5),
            "shading_steps": chunks * per_cell * 2,
        }
        if technique == "volume_tiled_bvh":
            counts |= {"tree_tests": tests, "leaf_tests": occupied * per_cell, "assign_steps": chunks * 8}
        frames.append({name: int(count) for name, count in counts.items()})
    return tuple(frames)


SHADING_BOUND = {"shading_lanes": 4e-6, "samples": 1e-5, "shading_steps": 0.01}
ASSIGNMENT_BOUND = {"tree_tests": 2e-5, "clusters_occupied": 5e-4, "lighting_computations": 1e-6}
LAUNCH_BOUND = {"shading_steps": 0.2, "assign_steps": 0.5, "shading_lanes": 2e-6, "cells_total": 1e-5}


@dataclass
class Synthetic:
    """A workload whose times follow a law that the search does not know."""

    law: dict[str, float]
    noise: float = 0.02
    seed: int = 0
    fails: Callable[[Configuration], bool] = lambda _: False
    hidden: Callable[[Configuration], float] = lambda _: 1.0  # a factor on the time that no count shows
    scene_key: str = "synthetic"
    device: str = "no device"
    frames: tuple[int, ...] = FRAMES
    measured: list[Configuration] = field(default_factory=list)
    best_seen: list[float | None] = field(default_factory=list)
    counted: set[Configuration] = field(default_factory=set)
    dies_at: int | None = None

    def counts(self, configuration: Configuration, /) -> tuple[dict[str, int], ...]:
        self.counted.add(configuration)
        params = {"tile_px": 32, "depth_slices": 0, "branching": 32, **configuration.params}
        keys = ("tile_px", "depth_slices", "branching", "batch")
        return synthetic_counts(configuration.technique, *(int(params[name]) for name in keys))

    def true_ms(self, configuration: Configuration) -> list[float]:
        """Noiseless time of each frame."""
        faster = 0.8 if configuration["gbuffer"] != "float32" else 1.0
        faster *= 1 - 3 * float(configuration["light_cutoff"])
        faster *= 1 - 1.5 * float(configuration.params.get("approximate", 0))
        costs = [5 + sum(self.law[n] * c for n, c in f.items() if n in self.law) for f in self.counts(configuration)]
        return [ms * faster * self.hidden(configuration) for ms in costs]

    def measure(self, configuration: Configuration, best_ms: float | None, /) -> Measurement:
        if len(self.measured) == self.dies_at:
            raise KeyboardInterrupt
        self.measured.append(configuration)
        self.best_seen.append(best_ms)
        # The same every time: what a search does then depends on what it knows alone.
        rng = np.random.default_rng([self.seed, *str(configuration).encode()])
        repeats = [ms * np.exp(self.noise * rng.normal(size=5)) for ms in self.true_ms(configuration)]
        failed = self.fails(configuration)
        outcome: Outcome = "out_of_memory" if failed else "timed"
        approximate = 0.01 * (configuration["gbuffer"] != "float32") + float(configuration["light_cutoff"])
        approximate += float(configuration.params.get("approximate", 0))
        return Measurement(
            technique=configuration.technique,
            params=configuration.params,
            scene_key=self.scene_key,
            frames=self.frames,
            seed=0,
            outcome=outcome,
            compile_s=0.5,
            stages_ms={} if failed else {"frame": tuple(tuple(map(float, r)) for r in repeats)},
            counts=() if failed else self.counts(configuration),
            error=None if failed else 1e-7 + approximate,
            error_p999=None,
            device=self.device,
            versions={},
            load=0.0,
            message="9 GB needed" if failed else "",
        )

    def least_ms(self, space: Space) -> float:
        return min(max(self.true_ms(c)) for c in space.configurations())


WHOLE = default_space(["forward", "tiled_deferred", "volume_tiled_bvh"], n_samples=1280 * 720)
LARGE = Space(
    WHOLE.techniques,
    {
        "forward": {"batch": (0, 4096, 16384, 65536, 262144)},
        "tiled_deferred": {"tile_px": (8, 16, 32, 64, 128), "batch": (0, 4096, 16384, 65536, 262144)},
        "volume_tiled_bvh": {
            "tile_px": (8, 16, 32, 64, 128),
            "depth_slices": (0, 4, 8, 16, 32, 64, 128),
            "branching": (4, 8, 16, 32),
            "batch": (0, 4096, 16384, 65536, 262144),
        },
    },
)
SMALL = Space(
    ("tiled_deferred", "volume_tiled_bvh"),
    {
        "tiled_deferred": {"tile_px": (8, 16, 32, 64)},
        "volume_tiled_bvh": {"tile_px": (16, 32, 64), "depth_slices": (0, 16, 32)},
    },
)


def erratic(configuration: Configuration) -> float:
    """A factor from 0.6 to 1.7 on the time, without any pattern: a model is never sure."""
    rng = np.random.default_rng([*str(configuration.exact()).encode()])
    return float(np.exp(rng.uniform(-0.5, 0.5)))


def of(measurement: Measurement) -> Configuration:
    return configuration(measurement.technique, measurement.params)
