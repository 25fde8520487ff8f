"""`vtfs stability`: where shadow and culling methods fail."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vtfs.cli.options import JsonOption, VerboseOption, check_folder, set_log_level, write_json
from vtfs.cli.scene_arguments import SceneArguments, with_scene
from vtfs.cli.status import Status
from vtfs.input_error import InputError


@with_scene
def stability(
    scene: SceneArguments,
    out: Annotated[Path, typer.Option(help="Folder of the result.", metavar="DIR")] = Path("vtfs-report"),
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the rungs that are in the folder.")] = False,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Where shadow and culling methods fail: every one on ladders of stress, against float64.

    Without SCENE on the built-in ladders alone; with one on its own casters and first camera before them.
    """
    set_log_level(verbose)
    check_folder(out, resume=True)  # the measurements of a run may lie there: its report takes the result in
    if not resume and (out / "stability.json").exists():
        raise InputError(f"{out}: holds an earlier result; go on with --resume, or name another --out.")
    from vtfs.device import keep_compiled_programs
    from vtfs.stability.run import run_stability

    own = None
    if scene.scene is not None:
        from vtfs.stability.own_scene import own_scene

        own = own_scene(scene.set_up(), scene.seed)
    elif scene.cameras or scene.lights:
        raise InputError("--cameras and --lights go with a SCENE; the built-in ladders have their own.")
    keep_compiled_programs()
    with Status() as status:
        result = run_stability(out, scene.seed, own, resume, status.share)
        status.say("writing the page")
        from reports.stability_page import write_stability_page

        page = write_stability_page(out)
        if (out / "result.json").exists():  # of a run whose report now has it too
            from reports.page import write_report

            write_report(out)
    write_json(json_file, result.as_json())
    if json_file != "-":
        from reports.stability_text import stability_text

        print(stability_text(result))
        print(f"Page: {page}")
