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
    """Image and heat map of lighting computations as PNG."""
    set_log_level(verbose)
    config = parsed_configuration(technique, settings)
    check_folder(out, resume=True)
    setup = scene.set_up()
    from vtfs.device import keep_compiled_programs
    from vtfs.frame import FrameInputs
    from vtfs.frame import count as count_frame
    from vtfs.frame import render as render_frame
    from vtfs.image import exposure, heat_map, tone_map, write_png

    keep_compiled_programs()
    written: list[dict[str, Any]] = []
    for number in dict.fromkeys(frame or [0]):
        with Status() as status:
            status.say(f"frame {number}")
            inputs = FrameInputs(setup.samples(number), setup.lights)
            image = render_frame(config, inputs)
            _, lengths = count_frame(config, inputs)
        valid = inputs.seen()
        largest = int(lengths.of_sample.max(initial=0))
        paths = [out / f"{kind}_{technique}_{number:04d}.png" for kind in ("image", "heat")]
        write_png(paths[0], tone_map(image, exposure(image, valid)))
        write_png(paths[1], heat_map(lengths.of_sample, largest, valid))
        mean = float(lengths.of_sample[valid].mean()) if valid.any() else 0.0
        written.append(
            {"frame": number, "image": str(paths[0]), "heat_map": str(paths[1]), "largest": largest, "mean": mean}
        )
        if json_file != "-":
            print(
                f"{paths[0]}\n{paths[1]}  (lighting computations per pixel: {mean:.1f} in the mean, at most {largest})"
            )
    write_json(json_file, {"technique": config.technique, "params": config.params, "pictures": written})
