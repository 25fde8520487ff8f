"""`vtfs count`: exact counts, without timing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vtfs.cli.options import (
    JsonOption,
    SetOption,
    VerboseOption,
    check_file,
    parsed_configuration,
    set_log_level,
    split_names,
    write_json,
)
from vtfs.cli.scene_arguments import SceneArguments, with_scene
from vtfs.cli.status import Status
from vtfs.input_error import InputError
from vtfs.parameters import TECHNIQUES
from vtfs.technique_names import TECHNIQUE_GROUPS, named_techniques


@with_scene
def count(
    scene: SceneArguments,
    technique: Annotated[
        str,
        typer.Option(
            help=f"One of {', '.join(TECHNIQUES)}; with --space several, comma-separated, or a group: "
            f"{' or '.join(TECHNIQUE_GROUPS)}."
        ),
    ] = "tiled_deferred",
    settings: SetOption = None,
    frame: Annotated[
        list[int] | None, typer.Option(help="Only this frame of the path. Repeatable.", show_default="all")
    ] = None,
    space: Annotated[
        Path | None, typer.Option(help="Count every configuration of this space (TOML).", metavar="FILE")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="With --space: the CSV file to write.", metavar="FILE")] = None,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Exact counts for every frame, or for every configuration of a space."""
    set_log_level(verbose)
    if space and settings:
        raise InputError(f"--set {settings[0]}: goes without --space, which has all values; list this one there.")
    if out and not space:
        raise InputError(
            "--out goes with --space: it is the table of a space's counts; use --json for one configuration."
        )
    if out:
        check_file("--out", out)
    if space:
        from tuning.space import load_space

        configs = load_space(space, named_techniques(split_names(technique))).configurations()
    else:
        configs = (parsed_configuration(technique, settings),)
    setup = scene.set_up()
    frames = setup.chosen_frames(frame)
    from vtfs.count_table import count_frames, counts_csv, print_counts
    from vtfs.device import keep_compiled_programs

    keep_compiled_programs()
    with Status() as status:
        rows = count_frames(
            setup, configs, frames, lambda done, total: status.share(f"counting {done} of {total}", done / total)
        )
    if space and out:
        from vtfs.files import write_atomically

        write_atomically(out, counts_csv(rows).encode())
        print(f"{len(configs)} configurations, {len(frames)} frames: {out}")
        return
    records = [
        {
            "technique": c.technique,
            "params": c.params,
            "scene": {
                "name": setup.name,
                "triangles": setup.n_triangles,
                "lights": setup.lights.n_lights,
                "key": setup.key,
            },
            "frames": [{"frame": row.frame, **row.counts} for row in rows if row.configuration == c],
        }
        for c in configs
    ]
    write_json(json_file, records if space else records[0])
    if json_file != "-":
        print_counts(rows)
