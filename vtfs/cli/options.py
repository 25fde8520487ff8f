"""Options that several commands share, and what is done with them."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from vtfs.configurations import Configuration, configuration
from vtfs.input_error import InputError
from vtfs.parameters import TECHNIQUES

SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="A parameter, as tile_px=16. Repeatable.", metavar="NAME=VALUE")
]
TechniqueOption = Annotated[str, typer.Option(help=f"One of {', '.join(TECHNIQUES)}.")]


def _checked_json(target: str | None) -> str | None:
    if target is not None and target != "-":
        check_file("--json", Path(target))
    return target


JsonOption = Annotated[
    str | None,
    typer.Option("--json", help="Write the result here as JSON; - is stdout.", metavar="FILE", callback=_checked_json),
]
VerboseOption = Annotated[bool, typer.Option("-v", "--verbose", help="Say more of what is done, on stderr.")]


def parsed_configuration(technique: str, settings: list[str] | None) -> Configuration:
    params: dict[str, str] = {}
    for setting in settings or ():
        name, equals, value = setting.partition("=")
        if not equals or not name or not value:
            raise InputError(f"--set {setting}: must be NAME=VALUE, as tile_px=16.")
        params[name.strip()] = value.strip()
    return configuration(technique, params)


def split_names(given: str) -> tuple[str, ...]:
    """A comma-separated list."""
    return tuple(name.strip() for name in given.split(",") if name.strip())


def check_file(option: str, file: Path) -> None:
    """Can it be written? Asked before the work is done, not after it."""
    if file.is_dir():
        raise InputError(f"{option} {file}: is a folder; give the file to write.")
    _probe(file.parent, f"{option} {file}: its folder cannot be written")


def check_folder(folder: Path, resume: bool) -> None:
    """Can it be written, and does it not hold somebody's measurements?"""
    _probe(folder, f"--out {folder}: is no folder that can be written")
    if not resume and (folder / "measurements.jsonl").exists():
        raise InputError(
            f"{folder}: holds the measurements of an earlier run; go on with --resume, or name another --out."
        )


def _probe(folder: Path, otherwise: str) -> None:
    from vtfs.files import write_atomically

    probe = folder / ".vtfs-writable"
    try:
        write_atomically(probe, b"")
    except InputError as error:
        reason = getattr(error.__cause__, "strerror", error)
        raise InputError(f"{otherwise} ({reason}); choose another one.") from error
    probe.unlink()


def write_json(target: str | None, value: object) -> None:
    if target is None:
        return
    text = json.dumps(value, indent=1, allow_nan=False)
    if target == "-":
        print(text)
        return
    from vtfs.files import write_atomically

    write_atomically(target, text.encode())


def set_log_level(verbose: bool) -> None:
    logging.getLogger("vtfs").setLevel(logging.INFO if verbose else logging.ERROR)
    if verbose:
        logging.basicConfig(format="%(name)s: %(message)s", stream=sys.stderr)
