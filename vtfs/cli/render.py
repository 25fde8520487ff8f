"""`vtfs render`: pictures of a technique at work."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vtfs.cli.options import (
    JsonOption,
    SetOption,
    TechniqueOption,
    VerboseOption,
    check_folder,
    parsed_configuration,
    set_log_level,
    write_json,
)
from vtfs.cli.scene_arguments import SceneArguments, with_scene
from vtfs.cli.status import Status
from vtfs.technique_names import SHADOW_REFERENCES


@with_scene
def render(
    scene: SceneArguments,
    technique: TechniqueOption = "tiled_deferred",
    out: Annotated[Path, typer.Option(help="Folder of the pictures.", metavar="DIR")] = Path("vtfs-render"),
    settings: SetOption = None,
    frame: Annotated[list[int] | None, typer.Option(help="A frame of the path. Repeatable.", show_default="0")] = None,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Image, heat map of lighting computations, and the technique's cells as PNG.

    Of techniques with cells also: clusters in random colours, depth slices, and lights listed in vain. Of shadow
    techniques also: the shadows, and the triangles or volume polygons that each pixel is tested against.
    """
    set_log_level(verbose)
    config = parsed_configuration(technique, settings)
    check_folder(out, resume=True)
    setup = scene.set_up()
    frames = setup.chosen_frames(frame or [0])
    from vtfs.cell_maps import cell_maps
    from vtfs.device import keep_compiled_programs
    from vtfs.frame import render as render_frame
    from vtfs.frame_counts import count as count_frame
    from vtfs.image import exposure, heat_map, random_colours, tone_map, write_png
    from vtfs.shadow_maps import shadow_maps

    keep_compiled_programs()
    written: list[dict[str, Any]] = []
    for number in frames:
        with Status() as status:
            status.say(f"frame {number}")
            inputs = setup.inputs(number)
            image = render_frame(config, inputs)
            _, lengths = count_frame(config, inputs)
            maps = cell_maps(config, inputs)
            shadows = shadow_maps(config, inputs)
        seen, solid = inputs.seen(), inputs.samples.valid
        largest = int(lengths.of_sample.max(initial=0))
        mean = float(lengths.of_sample[seen].mean()) if seen.any() else 0.0
        pictures = {
            "image": (tone_map(image, exposure(image, seen)), ""),
            "heat_map": (
                heat_map(lengths.of_sample, largest, seen),
                f"lighting computations per pixel: {mean:.1f} in the mean, at most {largest}",
            ),
        }
        if maps is not None:
            in_vain, deepest = int(maps.false_positives.max(initial=0)), int(maps.depth_slice.max(initial=0))
            pictures |= {
                "clusters": (random_colours(maps.cell, solid), "clusters in random colours"),
                "slices": (heat_map(maps.depth_slice, deepest, solid), f"depth slices, 0 to {deepest}"),
                "false_positives": (
                    heat_map(maps.false_positives, in_vain, solid),
                    f"lights listed in vain: at most {in_vain}; {maps.listed_in_words}",
                ),
            }
        if shadows is not None:
            pictures["shadow_mask"] = (
                heat_map(shadows.stopped, len(inputs.shadows.lights), solid),
                f"lights that shadows keep from each pixel: {shadows.share_stopped:.1%} of what they would light",
            )
            if config.technique not in SHADOW_REFERENCES:
                # Also where nothing is tested: a picture of an earlier run would stay.
                most = int(shadows.tests.max(initial=0))
                in_the_mean = float(shadows.tests[solid].mean()) if solid.any() else 0.0
                pictures["shadow_tests"] = (
                    heat_map(shadows.tests, most, solid),
                    f"{shadows.tested} that each pixel's tile or cluster is tested against: {in_the_mean:.1f} in the "
                    f"mean, at most {most}",
                )
        paths = {kind: out / f"{_FILE_NAMES.get(kind, kind)}_{technique}_{number:04d}.png" for kind in pictures}
        for kind, (pixels, caption) in pictures.items():
            write_png(paths[kind], pixels)
            if json_file != "-":
                print(f"{paths[kind]}{caption and f'  ({caption})'}")
        files = {kind: str(path) for kind, path in paths.items()}
        written.append({"frame": number, **files, "largest": largest, "mean": mean})
    write_json(json_file, {"technique": config.technique, "params": config.params, "pictures": written})


_FILE_NAMES = {"heat_map": "heat"}
