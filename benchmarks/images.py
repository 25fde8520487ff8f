"""Does every technique make the image of `forward`? All scenes, transparent layers included.

    python benchmarks/images.py [SCENE ...] --size 640x360 --lights 1000

"Within" is `max |a - b| / max(|b|, mean b)` over the pixels that show anything, against the float32 image of `forward`
and against the float64 reference. Without SCENE: the gallery and all of ../shared/scenes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from vtfs.camera import Viewport
from vtfs.configurations import configuration
from vtfs.device import keep_compiled_programs
from vtfs.frame import render
from vtfs.frame_inputs import FrameInputs
from vtfs.gallery import GALLERY
from vtfs.parameters import TECHNIQUES
from vtfs.reference import forward_reference, largest_relative_difference
from vtfs.scene_setup import SceneOptions, set_up
from vtfs.technique_names import SHADOW_NAMES

LIMIT = 1e-4
MANY_LIGHT = tuple(name for name in TECHNIQUES if name not in SHADOW_NAMES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--lights", default="1000")
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared" / "scenes")
    asked = parser.parse_args()
    keep_compiled_programs()
    width, height = map(int, asked.size.split("x"))
    scenes = asked.scenes or [*GALLERY, *map(str, sorted(asked.shared.glob("*.glb")))]
    header = ["scene, frame", "samples, transparent", *MANY_LIGHT, "within 1e-4 of forward", "of float64"]
    print(f"| {' | '.join(header)} |")
    print("|" + " --- |" * len(header))
    for name in scenes:
        cameras = Path(name).with_suffix(".cameras.json")
        options = SceneOptions(
            name,
            lights=asked.lights,
            cameras=cameras if cameras.is_file() else None,
            viewport=Viewport(width, height),
        )
        setup = set_up(options)
        frame = setup.n_frames // 2
        inputs = FrameInputs(setup.samples(frame), setup.lights, frame=frame)
        seen = inputs.seen()
        reference = forward_reference(inputs.samples, setup.lights)
        images = {technique: render(configuration(technique), inputs) for technique in MANY_LIGHT}
        forward = images["forward"].astype(np.float64)
        of_forward = {t: largest_relative_difference(image, forward, seen) for t, image in images.items()}
        of_float64 = {t: largest_relative_difference(image, reference, seen) for t, image in images.items()}
        fragments = inputs.fragments(with_hidden=False)
        cells = " | ".join(f"{of_forward[t]:.1e}, {of_float64[t]:.1e}" for t in MANY_LIGHT)
        print(
            f"| {setup.name}, {frame} | {fragments.n_samples:,}, {fragments.n_transparent_samples:,} | {cells} | "
            f"{'yes' if max(of_forward.values()) <= LIMIT else '**no**'} | "
            f"{'yes' if max(of_float64.values()) <= LIMIT else '**no**'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
