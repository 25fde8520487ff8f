"""The main job, measured: `vtfs tune` on the built-in atrium, cold and then with a warm cache.

    python benchmarks/main_job.py OUT_FOLDER

Each run is a process of its own with a cache folder of its own. Prints one JSON line a run: wall seconds, programs
compiled, peak memory, the recommendation. The `result.json` of both runs stay in OUT_FOLDER.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path


def run(out: Path, cache: Path, arguments: list[str]) -> dict[str, object]:
    """One `vtfs tune` as a new process."""
    command = [sys.executable, "-c", "from vtfs.cli import main; main()", "tune", "--out", str(out), *arguments]
    started = time.perf_counter()
    subprocess.run(command, check=True, env=os.environ | {"VTFS_CACHE_DIR": str(cache)})
    wall_s = time.perf_counter() - started
    result = json.loads((out / "result.json").read_text())
    peak_kb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return {
        "wall_s": round(wall_s, 1),
        "peak_gb": round(peak_kb / 1e6, 2),
        **{
            key: result[key]
            for key in ("compiled_programs", "compile_s", "measured", "space_size", "stop_reason", "device")
        },
        **{key: result[key] for key in ("best", "default", "fastest_default", "gain")},
    }


def main() -> None:
    folder = Path(sys.argv[1]).resolve()
    for name in ("cold", "warm"):
        print(name, json.dumps(run(folder / name, folder / "cache", sys.argv[2:])), flush=True)


if __name__ == "__main__":
    main()
