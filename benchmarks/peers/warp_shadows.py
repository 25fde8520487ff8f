# The peer lives in an environment of its own.
# pyright: reportMissingImports=false
"""Shadow rays by NVIDIA Warp on the same samples; needs warp-lang 1.19 and a GPU."""

import time
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    from benchmarks.shadow_cases import Case


@wp.kernel
def any_hit(
    mesh: wp.uint64, start: wp.array(dtype=wp.vec3), light: wp.vec3, bias: wp.float32, hit: wp.array(dtype=wp.int32)
):
    i = wp.tid()
    way = light - start[i]
    distance = wp.length(way)
    way = way / distance
    hit[i] = 0
    if wp.mesh_query_ray_anyhit(mesh, start[i] + way * bias, way, distance - bias):
        hit[i] = 1


def warp_rays(case: "Case", by_rays: np.ndarray) -> dict[str, float]:
    """Median ms of building an LBVH, of refitting it and of all rays, and the answers unlike Embree's.

    Positions are relative to the eye, as float32 asks for.
    """
    wp.config.quiet = True
    wp.init()
    device, eye = "cuda:0", np.array(case.samples.camera.eye_m)
    points = case.samples.position_m[case.receives].astype(np.float64) @ case.samples.camera.view_from_world[:3, :3]
    corner = (case.casters.vertices_m - eye)[case.casters.triangles].reshape(-1, 3).astype(np.float32)
    vertices = wp.array(corner, dtype=wp.vec3, device=device)
    indices = wp.array(np.arange(len(corner), dtype=np.int32), dtype=wp.int32, device=device)
    start = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    hit = wp.zeros(len(points), dtype=wp.int32, device=device)
    light = wp.vec3(*(float(c) for c in np.array(case.light.position_m) - eye))

    def median_ms(run, n: int) -> float:
        run()
        wp.synchronize()
        times = []
        for _ in range(n):
            started = time.perf_counter()
            run()
            wp.synchronize()
            times.append(1e3 * (time.perf_counter() - started))
        return float(np.median(times))

    def build() -> wp.Mesh:
        return wp.Mesh(vertices, indices, bvh_constructor="lbvh")

    mesh = build()
    return {
        "build_ms": median_ms(build, 5),
        "refit_ms": median_ms(mesh.refit, 10),
        "query_ms": median_ms(
            lambda: wp.launch(any_hit, len(points), [mesh.id, start, light, case.bias_m, hit], device=device), 20
        ),
        "rays": len(points),
        "differ_from_embree": int(((hit.numpy() == 1) != by_rays).sum()),
    }
