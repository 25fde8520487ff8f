"""`vtfs tune --measurements`: a recommendation from times that were measured elsewhere."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

from vtfs.cli.options import check_folder, write_json
from vtfs.cli.scene_arguments import SceneArguments
from vtfs.cli.status import Status
from vtfs.parameters import PARAMETERS


def recommend_imported(
    file: Path,
    scene: SceneArguments,
    techniques: tuple[str, ...] | None,
    objective: str,
    out: Path,
    json_file: str | None,
) -> None:
    """Model the file's times, write the report and print what is recommended.

    **Arguments:**

    - `techniques`: only these; `None`: all that are in the file.
    """
    from tuning.imported import tune_imported
    from tuning.imported_times import read_imported

    check_folder(out, resume=False)
    imported = read_imported(file)
    if techniques is not None:
        imported = imported.limited_to(techniques)
    from reports.page import write_report
    from vtfs.device import keep_compiled_programs

    keep_compiled_programs()
    command = shlex.join(["vtfs", *sys.argv[1:]])
    name = Path(scene.scene).stem if scene.scene else None
    with Status() as status:
        status.say("fitting")
        result = tune_imported(imported, out, objective, scene.seed, command, name)  # type: ignore[arg-type]
        status.say("writing the report")
        page = write_report(out)
    write_json(json_file, result)
    if json_file != "-":
        print(_recommendation(result))
        print(f"Report: {page}")


def _recommendation(result: dict[str, Any]) -> str:
    best, imported = result["best"], result["imported"]
    source = "timed" if best["timed"] else "predicted, not timed yet"
    lines = [f"{_configuration(best)}: {best['time_ms']:.3g} ms a frame{_interval(best)}, {source}"]
    for role, words in (("default", "its default"), ("fastest_default", "the fastest default")):
        if f"over_{role}" in result["gain"]:
            lines.append(f"  {result['gain'][f'over_{role}']:.2f} times as fast as {words}")
    lines.append(f"  {result['claim']}")
    lines.append(f"  {imported['timed']} configurations timed, {imported['untimed']} predicted or left out")
    if result["next"]:
        lines.append("  worth timing next:")
        lines += [f"    {_configuration(e)}: {e['time_ms']:.3g} ms predicted{_interval(e)}" for e in result["next"]]
    return "\n".join(lines)


def _configuration(entry: dict[str, Any]) -> str:
    changed = [f"{name}={value}" for name, value in entry["params"].items() if value != PARAMETERS[name].default]
    return " ".join([entry["technique"], *changed])


def _interval(entry: dict[str, Any]) -> str:
    interval = entry["time_ms_interval"]
    if interval is None or None in interval:
        return ""
    return f" ({interval[0]:.3g} to {interval[1]:.3g})"
