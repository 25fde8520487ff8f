"""View samples: what tracing them costs, for built-in scenes at 1920x1080.

    python benchmarks/view_samples.py [atrium,street,grove] [250000]

For each scene, in seconds: with an empty cache, Embree's hierarchy included, the fastest of three; and with a full one.
The last column is a digest of the samples: whoever makes this faster must not change it.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import replace

from vtfs.camera import Camera, CameraPath, Viewport
from vtfs.gallery import build_scene
from vtfs.scene import Scene
from vtfs.view_samples import trace_view_samples


def trace(scene: Scene, camera: Camera) -> tuple[float, str]:
    """Seconds, and the samples' key."""
    started = time.perf_counter()
    samples = trace_view_samples(scene, camera)
    return time.perf_counter() - started, samples.key


def main() -> None:
    names = sys.argv[1] if len(sys.argv) > 1 else "atrium,street,grove"
    n_triangles = int(sys.argv[2]) if len(sys.argv) > 2 else 250_000
    print("| scene | triangles | traced | cached | samples |\n| --- | --- | --- | --- | --- |")
    for name in names.split(","):
        scene = build_scene(name, n_triangles)
        assert isinstance(scene.cameras, CameraPath)
        camera = replace(scene.cameras.camera(0), viewport=Viewport(1920, 1080))
        traced_s, cached_s, keys = [], 0.0, set()
        for _ in range(3):
            with tempfile.TemporaryDirectory() as folder:
                os.environ["VTFS_CACHE_DIR"] = folder
                seconds, key = trace(scene, camera)
                traced_s.append(seconds)
                cached_s, again = trace(scene, camera)
                keys |= {key[:12], again[:12]}
        print(f"| {name} | {scene.n_triangles:,} | {min(traced_s):.2f} s | {cached_s:.2f} s | {' '.join(keys)} |")


if __name__ == "__main__":
    main()
