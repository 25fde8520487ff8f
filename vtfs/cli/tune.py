"""`vtfs tune`: the main job."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vtfs.cli.imported import recommend_imported
from vtfs.cli.options import JsonOption, VerboseOption, check_folder, set_log_level, split_names, write_json
from vtfs.cli.scene_arguments import SceneArguments, with_scene
from vtfs.cli.status import Status
from vtfs.input_error import InputError
from vtfs.technique_names import TUNED_TECHNIQUES, casts_shadows, named_techniques

if TYPE_CHECKING:
    from reports.recommendation import Recommendation
    from reports.run_folder import Timed


@with_scene
def tune(
    scene: SceneArguments,
    techniques: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated; `all` stands for the many-light ones, `shadows` for the shadow ones. Those that "
            "counting finds hopeless are not measured, nor those of a group that cannot cast a scene's shadows.",
            metavar="A,B",
            show_default=", ".join(TUNED_TECHNIQUES),
        ),
    ] = None,
    space: Annotated[Path | None, typer.Option(help="Search space as TOML.", metavar="FILE")] = None,
    budget: Annotated[
        str | None, typer.Option(help="Measurements, as 40, or seconds of measuring, as 120s.", show_default="40s")
    ] = None,
    objective: Annotated[
        str, typer.Option(help="`max`: the slowest frame decides; `mean`: the mean of the frames.")
    ] = "max",
    max_error: Annotated[
        float | None,
        typer.Option(
            help="Allow settings whose image has at most this error (RMSE over RMS).",
            show_default="exact settings only",
        ),
    ] = None,
    measurements: Annotated[
        Path | None,
        typer.Option(
            help="Recommend from times measured elsewhere, and measure nothing: the table of `vtfs count --out` with a "
            "column time_ms, or a measurements.jsonl.",
            metavar="FILE",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the report.", metavar="DIR")] = Path("vtfs-report"),
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the measurements that are in the folder.")
    ] = False,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """The main job: count, measure, model, search, report."""
    set_log_level(verbose)
    given = split_names(techniques) if techniques is not None else TUNED_TECHNIQUES
    names = named_techniques(given)
    casts_shadows(names)  # refuses what cannot be compared
    if objective not in ("max", "mean"):
        raise InputError(f"--objective {objective}: must be max or mean.")
    if max_error is not None and not max_error >= 0:
        raise InputError(f"--max-error {max_error}: must be 0 or more.")
    if measurements is not None:
        for name, given in (("--budget", budget), ("--space", space), ("--max-error", max_error), ("--resume", resume)):
            if given not in (None, False):
                raise InputError(f"{name}: goes without --measurements, which measures nothing; leave one of them out.")
        recommend_imported(measurements, scene, names if techniques else None, objective, out, json_file)
        return
    from tuning.budget import Budget
    from tuning.space import load_space
    from vtfs.device import keep_compiled_programs

    budget_parsed = Budget.parse(budget) if budget is not None else None
    own_space = load_space(space, names) if space else None
    # Cheap to check, and dear to find out after minutes of measuring.
    check_folder(out, resume)
    setup = scene.set_up()
    keep_compiled_programs()
    from reports.page import write_report
    from reports.recommendation import recommend
    from reports.run_folder import read_run_folder
    from tuning.tune import DEFAULT_BUDGET, TuneOptions, tune

    options = TuneOptions(
        out,
        names,
        tuple(name for name in names if name in given) if techniques else (),
        own_space,
        budget_parsed or DEFAULT_BUDGET,
        objective,
        max_error,
        scene.seed,
        _command(),  # type: ignore[arg-type]
    )
    with Status() as status:
        result = tune(setup, options, status.say, status.search)
        status.say("writing the report")
        page = write_report(out)
        said = recommend(read_run_folder(out))
    write_json(json_file, result)
    if json_file != "-":
        print(_recommendation(result, said))
        print(f"Report: {page}")


def _command() -> str:
    return shlex.join(["vtfs", *sys.argv[1:]])


def _recommendation(result: dict[str, Any], said: Recommendation) -> str:
    """What the report recommends, in a few lines: a default where what was found is not faster for certain."""
    gain, chosen, fastest = result["gain"], said.chosen, said.fastest
    if chosen is None or fastest is None:  # the search has refused that before
        return str(result["claim"])
    kept = said.verdict == "keep_default"
    lines = [f"{'keep the default, ' if kept else ''}{_timed_text(chosen)}"]
    if kept and fastest.is_configuration(chosen.technique, chosen.params):
        lines.append("  nothing that was measured is faster")
    else:
        lines += [f"  fastest in the search: {_timed_text(fastest)}"] if kept else []
        for role, words in (("default", "its default"), ("fastest_default", "the fastest default")):
            if f"over_{role}" in gain:
                low, high = gain[f"over_{role}_interval"]
                turns = ", measured in turns" if kept else ""
                lines.append(f"  {gain[f'over_{role}']:.2f} times as fast as {words} ({low:.2f} to {high:.2f}){turns}")
    lines.append(f"  {result['claim']}")
    lines.append(
        f"  {result['measured']} configurations measured (the space has {result['space_size']}), "
        f"{result['compiled_programs']} programs compiled, {result['wall_s']:.0f} s: {result['stop_reason']}"
    )
    return "\n".join(lines)


def _timed_text(timed: Timed) -> str:
    from reports.recommendation import setting_text

    interval = f" ({timed.interval_ms[0]:.1f} to {timed.interval_ms[1]:.1f})" if timed.interval_ms else ""
    return f"{setting_text(timed.technique, timed.params)}: {timed.time_ms:.1f} ms a frame{interval}"
