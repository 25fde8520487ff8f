"""All commands as one program, and what becomes of what they raise."""

from __future__ import annotations

import sys
from typing import Annotated, Any, NoReturn

import typer

from vtfs.cli.convert import convert
from vtfs.cli.count import count
from vtfs.cli.fit import fit
from vtfs.cli.listings import doctor, scenes, techniques
from vtfs.cli.predict import predict
from vtfs.cli.render import render
from vtfs.cli.report import report
from vtfs.cli.stability import stability
from vtfs.cli.tune import tune
from vtfs.input_error import InputError

app = typer.Typer(
    name="vtfs",
    help="Which many-light technique and which parameters are right for your scene on your device: "
    "count, measure, model, search, report.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"vtfs {version('vtfs')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


for _command in (tune, count, render, stability, fit, predict, convert, report, scenes, techniques, doctor):
    app.command()(_command)

_UsageError: Any = typer.BadParameter.__mro__[1]
"""Click's, or that of typer where it brings its own copy of Click."""

_INTERRUPTED = 130


def main() -> None:
    """Run the command line. Bad input is one line on stderr and exit code 2."""
    arguments = sys.argv[1:]
    try:
        code = app(arguments or ["--help"], prog_name="vtfs", standalone_mode=False)
    except InputError as error:
        _leave(str(error), 2)
    except _UsageError as error:
        message = error.format_message().rstrip(".")
        joint = " See" if message.endswith("?") else "; see"
        _leave(f"{message}{joint} vtfs {_command_of(arguments)}--help.", 2)
    except MemoryError:
        _leave("this machine's memory is full; try a smaller --size, fewer lights or a smaller scene.", 1)
    except (KeyboardInterrupt, typer.Abort):
        code = _INTERRUPTED
    except BrokenPipeError:
        code = 1
    if code == _INTERRUPTED:
        resumes = _command_of(arguments) in ("tune ", "stability ")
        kept = "; what was measured is kept, --resume goes on from there" if resumes else ""
        _leave(f"interrupted{kept}.", _INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _leave(message: str, code: int) -> NoReturn:
    print(f"vtfs: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)


def _command_of(arguments: list[str]) -> str:
    """The command that was named, and a space; nothing where there is none."""
    names = {command.callback.__name__ for command in app.registered_commands if command.callback}
    return f"{arguments[0]} " if arguments and arguments[0] in names else ""
