"""Light assignment from 32 to millions of lights: every assigner, the sorts and the stages of a tree's build.

python benchmarks/light_assignment.py [--lights 32,1024,...] [--only NAME] [--full] [--warp] [--bevy PATH]

Without a peer: 1920x1080, 32-pixel tiles, self-similar slices, near 0.1 m, far 200 m, a surface in about 15,600
clusters, lights in the box of the surface with 20 of them at a median sample. `--full` times the whole update as well:
clusters, build and assignment in one program. `--warp` times NVIDIA Warp on the same lights and boxes
(`peers/warp_lights.py`).

With `--bevy PATH` (a program built from `peers/bevy_clusters`, never part of this project): its 30 x 17 x 24 grid with
every cell occupied, its lights (4 m, uniform over depth and screen), and its CPU clustering between our runs.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vtfs.bounds import Sphere
from vtfs.camera import Camera, Viewport
from vtfs.cluster_grid import ClusterGrid, cell_boxes, cluster_grid
from vtfs.clusters import Clusters, form_clusters
from vtfs.device import device_name
from vtfs.gbuffer import Positions, to_runs
from vtfs.light_assignment.brute_force import assign_brute_force
from vtfs.light_assignment.coarse_to_fine import assign_coarse_to_fine, n_tests
from vtfs.light_assignment.light_tree import assign_tree, build_light_tree, light_tree, reduce_lights
from vtfs.light_lists import LightLists
from vtfs.lights import scatter_lights
from vtfs.morton import morton_codes
from vtfs.sort_keys import SORTS

VIEWPORT = Viewport(1920, 1080)
NEAR_M, FAR_M, TILE_PX = 0.1, 200.0, 32
CELLS, CLUSTERS = 2**20, 2**17
MOST_BRUTE_FORCE_TESTS = {"cpu": 2**28}
SLOWEST_SORT = {"merge_path": {"cpu": 2**16}}

N_BOXES = 750

DENSE = (30, 17, 24)
DENSE_FIRST_M, DENSE_FAR_M, DENSE_RANGE_M, DENSE_TILE_PX = 5.0, 100.0, 4.0, 64


Times = dict[str, float]  # milliseconds by what was timed


def on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def median_ms(run: Callable[[], object], least_s: float = 0.2, repeats: int = 5) -> float:
    """Of at least `repeats` runs and `least_s` seconds."""
    jax.block_until_ready(run())
    times: list[float] = []
    while len(times) < repeats or (sum(times) < least_s and len(times) < 200):
        started = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - started)
    return float(np.median(times)) * 1e3


def on_arrays(function: Callable[..., object], *arguments: object) -> tuple[Callable[[], list[jax.Array]], Any]:
    """The program with its arguments, as one calls it who holds the arrays; and how to make its result of them.

    Packing and unpacking our records takes Python 0.1 ms a call.
    """
    leaves, tree = jax.tree.flatten(arguments)
    program = jax.jit(lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves))))
    return partial(program, *leaves), jax.tree.structure(jax.eval_shape(function, *arguments))


def surface_positions(camera: Camera) -> Positions:
    """A floor, a far wall and many small boxes before them: one smooth depth a box, with steps between."""
    rng = np.random.default_rng(0)
    x, y = camera.pixel_slopes()
    depth_m = np.broadcast_to(np.minimum(FAR_M * 0.9, 2.0 / np.maximum(-y, 1e-3))[:, None], (len(y), len(x))).copy()
    for _ in range(N_BOXES):
        width, height = rng.integers(8, 96, 2)
        left, top = rng.integers(0, len(x) - width), rng.integers(0, len(y) - height)
        part = np.s_[top : top + height, left : left + width]
        tilt = 1 + 0.3 * rng.normal() * (np.arange(width) / width - 0.5)
        depth_m[part] = np.minimum(depth_m[part], NEAR_M * 5 * (0.9 * FAR_M / NEAR_M / 5) ** rng.random() * tilt)
    depth_m = np.clip(depth_m, NEAR_M, FAR_M)
    channels = (x[None, :] * depth_m, y[:, None] * depth_m, -depth_m)
    x_m, y_m, z_m = (jnp.asarray(to_runs(channel.astype(np.float32))) for channel in channels)
    valid, place = jnp.asarray(to_runs(np.ones(depth_m.shape, bool))), jnp.arange(x_m.shape[0], dtype=jnp.int32)
    return Positions(x_m, y_m, z_m, valid, place, camera.viewport)


def lights_around(positions: Positions, n_lights: int) -> Sphere:
    """In the box of the surface's samples; the median sample is reached by 20."""
    valid = np.asarray(positions.valid)
    seen = np.stack([np.asarray(c)[valid] for c in (positions.x_m, positions.y_m, positions.z_m)], axis=1)
    lights = scatter_lights((seen.min(0), seen.max(0)), n_lights, 0, seen)
    columns = np.concatenate([lights.position_m, lights.range_m[:, None]], axis=1).astype(np.float32)
    return Sphere(*(jnp.asarray(column) for column in columns.T))


def fitting_capacity(assign: Callable[[int], LightLists]) -> int:
    """The smallest power of two with which the lists fit, and the lists of groups before them."""
    capacity = 2**17
    while bool((lists := assign(capacity)).overflowed):
        capacity *= 8
    tight = 2 ** (max(int(lists.total), 1) - 1).bit_length()
    return next(c for c in (tight, 2 * tight, 4 * tight, capacity) if c >= capacity or not assign(c).overflowed)


def assigners(capacity: int, only: str) -> dict[str, Callable[[Sphere, Clusters], LightLists]]:
    """From lights and clusters to lists, with whatever is built on the way. Chunks are 2^19 tests on a CPU."""
    words = 2**14 if on_cpu() else 2**23
    found: dict[str, Callable[[Sphere, Clusters], LightLists]] = {
        f"coarse to fine, b={b}": lambda s, c, b=b: assign_coarse_to_fine(s, c, capacity, words, b)[0] for b in (16, 32)
    }
    for b in (8, 32):
        rows = (2**19 if on_cpu() else 2**22) // b
        found[f"tree, b={b}"] = lambda s, c, b=b, rows=rows: assign_tree(light_tree(s, b), c, capacity, rows)[0]
    found["brute force"] = lambda s, c: assign_brute_force(s, c, capacity, 2**14 if on_cpu() else 2**17)[0]
    return {name: assign for name, assign in found.items() if only in name}


def time_assigners(
    lights: Sphere, clusters: Clusters, only: str, between: Callable[[], None] = lambda: None
) -> tuple[Times, int]:
    """Every assigner, checked against the first; and the capacity of the pairs."""
    n_lights, n_clusters = lights.x_m.shape[0], int(clusters.n_clusters)
    first = jax.jit(
        lambda s, c, capacity: assign_coarse_to_fine(s, c, capacity, 2**14 if on_cpu() else 2**23), static_argnums=2
    )
    capacity = fitting_capacity(lambda capacity: first(lights, clusters, capacity)[0])
    lists, counts = first(lights, clusters, capacity)
    coarse, fine = n_tests(counts)
    pairs = int(np.asarray(lists.count, np.int64).sum())
    print(
        f"{n_lights:,} lights, {n_clusters:,} clusters, {pairs:,} pairs (capacity {capacity:,}); "
        f"coarse to fine tests {coarse:,} and {fine:,}",
        flush=True,
    )
    brute_force_tests = MOST_BRUTE_FORCE_TESTS.get(jax.default_backend()) or 2**36
    found: Times = {}
    for name, assign in assigners(capacity, only).items():
        if name == "brute force" and n_lights * n_clusters > brute_force_tests:
            continue
        run, tree = on_arrays(assign, lights, clusters)
        started = time.perf_counter()
        result = jax.tree.unflatten(tree, jax.block_until_ready(run()))
        compile_s = time.perf_counter() - started
        if bool(result.overflowed):
            print(f"  {name}: a level does not fit the capacity of the pairs", flush=True)
            continue
        differing = int(np.abs(np.asarray(result.count) - np.asarray(lists.count)).sum())
        found[name] = median_ms(run)
        print(f"  {name}: {found[name]:.3f} ms, first call {compile_s:.1f} s, other pairs {differing}", flush=True)
        between()
    return found, capacity


def time_stages(lights: Sphere) -> Times:
    """What a tree's build is made of."""
    n_lights = lights.x_m.shape[0]
    box = jax.jit(reduce_lights)(lights)
    codes = jax.jit(morton_codes)(lights, *box)
    reduce_ms = median_ms(partial(jax.jit(reduce_lights), lights))
    found = {"reduce": reduce_ms, "Morton codes": median_ms(partial(jax.jit(morton_codes), lights, *box))}
    order = jax.jit(SORTS["xla"])((codes,))
    for name, sort in SORTS.items():
        if n_lights > SLOWEST_SORT.get(name, {}).get(jax.default_backend(), n_lights):
            continue
        program = jax.jit(sort)
        if not bool((program((codes,)) == order).all()):
            raise SystemExit(f"sort, {name}: not the order of XLA's sort.")
        found[f"sort, {name}"] = median_ms(partial(program, (codes,)))
    for b in (8, 32):
        program = jax.jit(lambda s, o, b=b: build_light_tree(s, o, b))
        found[f"build, b={b}"] = median_ms(partial(program, lights, order))
    return found


def view_benchmark(counts: list[int], only: str, full: bool, warp: bool) -> None:
    camera = Camera((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 60.0, NEAR_M, FAR_M, VIEWPORT)
    positions, grid = surface_positions(camera), jax.device_put(cluster_grid(camera, TILE_PX, 0, FAR_M))
    form, tree = on_arrays(lambda p, g: form_clusters(p, g, "implicit", CELLS, CLUSTERS), positions, grid)
    clusters = jax.tree.unflatten(tree, form())
    assert not bool(clusters.overflowed)
    print(f"clusters: {int(clusters.n_clusters):,} occupied, {median_ms(form):.3f} ms")
    # The clusters by themselves: blocks are of no use here, and their capacity is larger.
    n = 2 ** (int(clusters.n_clusters) - 1).bit_length()
    own = jax.tree.map(lambda a: a[:n] if a.ndim == 1 and a.shape[0] == CLUSTERS else a, clusters)
    table: dict[int, Times] = {}
    for n_lights in counts:
        lights = lights_around(positions, n_lights)
        table[n_lights], capacity = time_assigners(lights, own, only)
        table[n_lights] |= time_warp_beside(lights, own) if warp else time_stages(lights)
        if full:
            for name, assign in assigners(capacity, only).items():
                if name != "brute force":
                    update, _ = on_arrays(partial(_update, assign, n), lights, positions, grid)
                    table[n_lights][f"update, {name}"] = median_ms(update)
    print_table(table)


def time_warp_beside(lights: Sphere, clusters: Clusters) -> Times:
    from benchmarks.peers.warp_lights import time_warp

    n, box = int(clusters.n_clusters), clusters.box
    low, high = (
        np.stack([np.asarray(c)[:n] for c in corner], axis=1)
        for corner in ((box.low_x_m, box.low_y_m, box.low_z_m), (box.high_x_m, box.high_y_m, box.high_z_m))
    )
    rows = np.stack([np.asarray(c) for c in (lights.x_m, lights.y_m, lights.z_m, lights.radius_m)], axis=1)
    times, lengths = time_warp(rows, low, high)
    print(f"  Warp: {int(lengths.sum(dtype=np.int64)):,} pairs, {times}", flush=True)
    return times


def _update(assign, n: int, lights: Sphere, positions: Positions, grid: ClusterGrid):
    """Clusters, build and assignment in one program; what shading would read."""
    clusters = form_clusters(positions, grid, "implicit", CELLS, CLUSTERS)
    own = jax.tree.map(lambda a: a[:n] if a.ndim == 1 and a.shape[0] == CLUSTERS else a, clusters)
    return clusters.block_of_sample, clusters.block_cluster, assign(lights, own)


def dense_clusters() -> Clusters:
    """Every cell of the peer's grid: the first slice ends at 5 m, the others are self-similar up to 100 m."""
    columns, rows, slices = DENSE
    log_growth = math.log(DENSE_FAR_M / DENSE_FIRST_M) / (slices - 1)
    tan_y, aspect = math.tan(math.pi / 6), VIEWPORT.width_px / VIEWPORT.height_px
    first_m = DENSE_FIRST_M / math.exp(log_growth)
    grid = ClusterGrid(
        tile_px_x=jnp.int32(DENSE_TILE_PX),
        tile_px_y=jnp.int32(DENSE_TILE_PX),
        depth_slices=jnp.int32(slices),
        scheme=jnp.int32(0),
        z_near_m=jnp.float32(first_m),
        z_far_m=jnp.float32(DENSE_FAR_M),
        log_growth=jnp.float32(log_growth),
        slope_per_px=jnp.float32(2 * tan_y / VIEWPORT.height_px),
        slope_x=jnp.float32(-tan_y * aspect),
        slope_y=jnp.float32(tan_y),
        converges=jnp.float32(1),
        normal_bins=jnp.int32(0),
    )
    n = columns * rows * slices
    key = jnp.arange(n, dtype=jnp.int32)
    zeros, count = jnp.zeros(n, jnp.int32), jnp.int32(n)
    box = cell_boxes(grid, VIEWPORT, key)
    return Clusters(key, box, count, zeros, zeros, count, count, jnp.zeros((1, 32), jnp.int32), jnp.bool_(False))


def dense_lights(n_lights: int) -> Sphere:
    """Uniform over depth, and over the screen at that depth."""
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(NEAR_M, DENSE_FAR_M, n_lights)
    tan_y, aspect = math.tan(math.pi / 6), VIEWPORT.width_px / VIEWPORT.height_px
    x, y = (rng.uniform(-1, 1, n_lights) * depth_m * tangent for tangent in (tan_y * aspect, tan_y))
    columns = (x, y, -depth_m, np.full(n_lights, DENSE_RANGE_M))
    return Sphere(*(jnp.asarray(column, jnp.float32) for column in columns))


def run_bevy(program: str, lights: Sphere, iterations: int) -> dict:
    rows = np.stack([np.asarray(column) for column in (lights.x_m, lights.y_m, lights.z_m, lights.radius_m)], axis=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "lights.csv"
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header="x,y,z,range", comments="")
        size = [str(VIEWPORT.width_px), str(VIEWPORT.height_px)]
        command = [program, str(len(rows)), *size, "--lights", str(path), "--xyz", *map(str, DENSE)]
        command += ["--first", str(DENSE_FIRST_M), "--far", "constant", "--farz", str(DENSE_FAR_M)]
        command += ["--iters", str(iterations)]
        return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def dense_benchmark(counts: list[int], only: str, bevy: str) -> None:
    clusters = dense_clusters()
    table: dict[int, Times] = {}
    for n_lights in counts:
        lights = dense_lights(n_lights)
        iterations = max(5, min(100, 1_000_000 // n_lights))
        peers: list[dict] = []
        run_peer = partial(run_bevy, bevy, lights, iterations)
        table[n_lights], _ = time_assigners(lights, clusters, only, lambda: peers.append(run_peer()))  # noqa: B023
        table[n_lights][str(peers[0]["peer"])] = float(np.median([peer["ms_median"] for peer in peers]))
        print(
            f"  {peers[0]['peer']}: {peers[0]['pairs']:,} pairs, median of {len(peers)} runs between ours", flush=True
        )
    print_table(table)


def print_table(table: dict[int, Times]) -> None:
    """One row for each thing timed, one column for each number of lights; milliseconds."""
    names = list(dict.fromkeys(name for times in table.values() for name in times))
    print("\n| ms | " + " | ".join(f"{n:,} lights" for n in table) + " |\n|" + " --- |" * (len(table) + 1))
    for name in names:
        cells = [f"{times[name]:.3f}" if name in times else "" for times in table.values()]
        print(f"| {name} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lights", help="numbers of lights, separated by commas")
    parser.add_argument("--only", default="", help="assigners whose name holds this")
    parser.add_argument("--full", action="store_true", help="also clusters, build and assignment in one program")
    parser.add_argument("--warp", action="store_true", help="also NVIDIA Warp, instead of the stages of a tree")
    parser.add_argument("--bevy", help="path of the peer's program: its grid and lights instead")
    arguments = parser.parse_args()
    print(f"{device_name()}, jax {jax.__version__}")
    default = "1000,10000,100000" if arguments.bevy else "32,1024,32768,1048576"
    counts = [int(n) for n in (arguments.lights or default).split(",")]
    if arguments.bevy:
        dense_benchmark(counts, arguments.only, arguments.bevy)
    else:
        view_benchmark(counts, arguments.only, arguments.full, arguments.warp)


if __name__ == "__main__":
    main()
