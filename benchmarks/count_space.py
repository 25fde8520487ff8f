"""Counts of 200 configurations on one 1080p frame with 10,000 lights: how long, and how many programs.

python benchmarks/count_space.py [SCENE]
"""

from __future__ import annotations

import argparse
import time

from tuning.compiles import watch_compiles
from tuning.space import Space
from vtfs.camera import Viewport
from vtfs.count_table import count_frames
from vtfs.device import device_name, keep_compiled_programs
from vtfs.scene_setup import SceneOptions, set_up

TILES_PX, SLICES, BRANCHINGS = (8, 16, 32, 64), (0, 16, 24, 32, 64, 128), (4, 8, 16, 32)


def two_hundred() -> Space:
    tiles = {"tile_px": TILES_PX}
    by_tree = tiles | {"depth_slices": SLICES, "branching": BRANCHINGS}
    values = {
        "volume_tiled_bvh": by_tree,
        "clustered_forward": by_tree,
        "tiled_deferred": tiles,
        "tiled_forward_prez": tiles,
    }
    return Space(tuple(values), values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="atrium")
    arguments = parser.parse_args()
    keep_compiled_programs()
    setup = set_up(SceneOptions(arguments.scene, viewport=Viewport(1920, 1080), lights="10000"))
    setup.samples(0)
    configs = two_hundred().configurations()
    compiled = watch_compiles()
    started, cpu_started = time.perf_counter(), time.process_time()
    rows = count_frames(setup, configs, (0,), lambda done, total: None)
    wall_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu_started
    pairs = [row.counts["light_cluster_pairs"] for row in rows]
    print(
        f"{device_name()}: {len(rows)} configurations in {wall_s:.1f} s ({cpu_s:.1f} s of CPU time), "
        f"{compiled.programs} programs compiled in {compiled.seconds:.1f} s; {min(pairs):,} to {max(pairs):,} pairs"
    )


if __name__ == "__main__":
    main()
