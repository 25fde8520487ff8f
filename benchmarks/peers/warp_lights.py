# Warp reads the annotations of its kernels: they are not deferred.
# pyright: reportMissingImports=false
"""NVIDIA Warp as a peer: a bounding-volume hierarchy over the lights' boxes, one thread a cluster, two passes.

For `benchmarks/light_assignment.py --warp`; `pip install warp-lang==1.19.0`.
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import warp as wp


@wp.func
def meets(light: wp.vec4, low: wp.vec3, high: wp.vec3):  # type: ignore[no-untyped-def]
    centre = wp.vec3(light[0], light[1], light[2])
    outside = wp.max(low, wp.min(centre, high)) - centre
    return wp.dot(outside, outside) <= light[3] * light[3]


@wp.kernel
def list_lights(
    tree: wp.uint64,
    light: wp.array(dtype=wp.vec4),
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    offset: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    fills: int,
):
    cluster = wp.tid()
    query = wp.bvh_query_aabb(tree, low[cluster], high[cluster])
    found = wp.int32(0)
    n = wp.int32(0)
    while wp.bvh_query_next(query, found):
        if meets(light[found], low[cluster], high[cluster]):
            if fills == 1:
                index[offset[cluster] + n] = found
            n += 1
    if fills == 0:
        count[cluster] = n


def time_warp(lights: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """Median milliseconds of building the hierarchy (`lbvh`, the fastest to build) and of making the lists.

    **Arguments:** lights `[n, 4]` (x, y, z, radius); corners of the clusters' boxes `[clusters, 3]`.

    **Returns:** times by name, and the lists' lengths, to check that the work is the same.
    """
    wp.config.quiet = True
    wp.init()
    device = "cuda:0" if wp.is_cuda_available() else "cpu"

    def sent(rows: np.ndarray, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(rows, np.float32), dtype=dtype, device=device)

    light, lows, highs = sent(lights, wp.vec4), sent(low, wp.vec3), sent(high, wp.vec3)
    box_low, box_high = (sent(lights[:, :3] + sign * lights[:, 3:], wp.vec3) for sign in (-1, 1))
    n = len(low)
    count, offset = (wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2))

    def build() -> wp.Bvh:
        return wp.Bvh(box_low, box_high, constructor="lbvh")

    tree = build()

    def run(index: wp.array, fills: int) -> None:
        wp.launch(list_lights, n, [tree.id, light, lows, highs, offset, count, index, fills], device=device)

    run(wp.zeros(1, dtype=wp.int32, device=device), 0)
    lengths = count.numpy()
    index = wp.zeros(int(lengths.sum()), dtype=wp.int32, device=device)

    def assign() -> None:
        run(index, 0)
        wp.utils.array_scan(count, offset, inclusive=False)
        run(index, 1)

    version = wp.__version__
    return {f"Warp {version}, build": _median_ms(build), f"Warp {version}, assign": _median_ms(assign)}, lengths


def _median_ms(run: Callable[[], object], repeats: int = 20) -> float:
    run()
    wp.synchronize()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        wp.synchronize()
        times.append(time.perf_counter() - started)
    return statistics.median(times) * 1e3
