"""What does a tree of lights cost that keeps its order while lights move? Tests by the age of the order, exact counts.

    python benchmarks/resort.py [atrium] --lights 1000

Each light moves on a line of its own at one speed, reflected by the scene's box; the camera follows its path. Ratios
are over the tree sorted in the same frame, means over frames. Counts only, so a busy machine does not matter; the times
of sorting and of the boxes are in `benchmarks/light_assignment.py`.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from dataclasses import replace

import numpy as np

from vtfs.camera import Viewport
from vtfs.configurations import configuration
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.light_lists import view_lights
from vtfs.lights import Lights
from vtfs.scene_setup import SceneOptions, SceneSetup, set_up

AGES = (1, 2, 4, 8, 16, 32)


def moved(setup: SceneSetup, direction: np.ndarray, travelled_m: float) -> Lights:
    low, high = setup.bounds_m
    at = setup.lights.position_m + direction * travelled_m - low
    size = high - low
    folded = np.abs((at + size) % (2 * size) - size)  # there and back
    return replace(setup.lights, position_m=low + folded)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="atrium")
    parser.add_argument("--lights", default="1000")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--speeds", default="0.02,0.1,0.5", help="shares of the lights' range a frame")
    parser.add_argument("--branching", type=int, default=32)
    asked = parser.parse_args()
    width, height = map(int, asked.size.split("x"))
    setup = set_up(SceneOptions(asked.scene, lights=asked.lights, viewport=Viewport(width, height)))
    direction = np.random.default_rng(0).normal(size=(setup.lights.n_lights, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    range_m = float(np.median(setup.lights.range_m))
    print(f"## {setup.name}, {setup.lights.n_lights:,} lights, range {range_m:.2f} m, branching {asked.branching}\n")
    print(
        "| speed, ranges a frame | " + " | ".join(f"age {age}" for age in AGES) + " |\n|" + " --- |" * (len(AGES) + 1)
    )
    frames = [int(f) for f in np.linspace(AGES[-1], setup.n_frames - 1, 4).round()]
    for share in map(float, asked.speeds.split(",")):
        ratios = defaultdict(list)
        for frame in frames:

            def lights_of(i: int, share: float = share) -> Lights:
                return moved(setup, direction, share * range_m * i)

            def tests(last_sorted: int | None, frame: int = frame) -> int:
                # `resort_every` of a frame more than its own number keeps what frame 0 left: ages are set by hand.
                inputs = FrameInputs(
                    setup.samples(frame),
                    lights_of(frame),
                    frame=0 if last_sorted is None else 1,
                    earlier_lights=lambda _: view_lights(
                        lights_of(last_sorted or 0), setup.cameras.camera(last_sorted or 0)
                    ),
                )
                params = {"branching": asked.branching, "resort_every": 64}
                counts = count(configuration("volume_tiled_bvh", params), inputs)[0].technique
                return counts["tree_tests"] + counts["leaf_tests"]

            sorted_now = tests(None)
            for age in AGES:
                ratios[age].append(tests(frame - age) / sorted_now)
        print(f"| {share:g} | " + " | ".join(f"{np.mean(ratios[age]):.3f}" for age in AGES) + " |", flush=True)


if __name__ == "__main__":
    main()
