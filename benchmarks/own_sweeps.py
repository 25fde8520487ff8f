"""Measure four built-in scenes for the cost models' leave-one-scene-out benchmark: `vtfs tune` on each.

    python benchmarks/own_sweeps.py OUT_FOLDER [ARGUMENTS OF `vtfs tune`]

Keeps the frame times of each as `OUT_FOLDER/SCENE.jsonl`, which `python -m benchmarks.cost_models own
--measurements OUT_FOLDER` reads. The search chooses what is measured: at most 16 of 24 configurations a scene.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from vtfs.files import write_atomically

SCENES = ("atrium", "street", "conservatory", "grove")
SPACE = """
[parameters]
tile_px = [8, 16, 32, 64]
depth_slices = [0, 16]
branching = [8, 32]
"""
_ARGUMENTS = ("--triangles", "20000", "--size", "640x360", "--lights", "500", "--budget", "16")
_TECHNIQUES = "tiled_deferred,volume_tiled_bvh"


def main() -> None:
    folder = Path(sys.argv[1]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        space = Path(scratch) / "space.toml"
        space.write_text(SPACE)
        for scene in SCENES:
            out = Path(scratch) / scene
            # Later options win.
            command = [sys.executable, "-c", "from vtfs.cli import main; main()", "tune", scene, *_ARGUMENTS]
            command += ["--techniques", _TECHNIQUES, "--space", str(space), "--out", str(out), *sys.argv[2:]]
            subprocess.run(command, check=True)
            write_atomically(folder / f"{scene}.jsonl", _frames_only((out / "measurements.jsonl").read_text()).encode())


def _frames_only(record: str) -> str:
    """Without the repeats of single stages, thousands of them, which nothing here reads."""
    lines = [json.loads(line) for line in record.splitlines()]
    for line in lines:
        line["stages_ms"] = {stage: ms for stage, ms in line["stages_ms"].items() if stage == "frame"}
    return "".join(f"{json.dumps(line)}\n" for line in lines)


if __name__ == "__main__":
    main()
