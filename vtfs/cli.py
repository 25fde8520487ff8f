"""The command line: reads options, calls one function, prints. Everything heavy is imported inside."""

from __future__ import annotations

import json
import logging
import shlex
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from vtfs.input_error import InputError
from vtfs.parameters import PARAMETERS, TECHNIQUES, Configuration, configuration

app = typer.Typer(
    name="vtfs",
    help="Which many-light technique and which parameters are right for your scene on your device: "
    "count, measure, model, search, report.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

SceneArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="[SCENE]",
        help="GLB, glTF, OBJ, PLY or STL file; a G-buffer .npz (or a folder of them); or a built-in scene. "
        "Default: atrium.",
    ),
]
CamerasOption = Annotated[Path | None, typer.Option(help="Camera path: cameras.json.", metavar="FILE")]
LightsOption = Annotated[
    str | None,
    typer.Option(
        help="lights.csv, or a number of lights to scatter.", metavar="FILE|N", show_default="the scene's, else 1000"
    ),
]
SizeOption = Annotated[str | None, typer.Option(help="Image size, as 1280x720.", metavar="WxH")]
SeedOption = Annotated[int, typer.Option(min=0, help="Of everything that is random.")]
PerSampleOption = Annotated[
    int,
    typer.Option(min=1, help="Scattered lights get the range at which so many reach a visible sample in the median."),
]
DensityOption = Annotated[
    str, typer.Option(help="Where lights are scattered: `constant`: in the scene's box; `fixed`: one a cubic metre.")
]
TrianglesOption = Annotated[int | None, typer.Option(help="Size of a built-in scene, 1,000 to 1,000,000 triangles.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="A parameter, as tile_px=16. Repeatable.", metavar="NAME=VALUE")
]
TechniqueOption = Annotated[str, typer.Option(help=f"One of {', '.join(TECHNIQUES)}.")]
JsonOption = Annotated[
    str | None, typer.Option("--json", help="Write the result here as JSON; - is stdout.", metavar="FILE")
]
VerboseOption = Annotated[bool, typer.Option("-v", "--verbose", help="Say more of what is done, on stderr.")]


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
        _leave(f"{error.format_message().rstrip('.')}; see vtfs {_command_of(arguments)}--help.", 2)
    except (KeyboardInterrupt, typer.Abort):
        code = _INTERRUPTED
    except BrokenPipeError:
        code = 1
    if code == _INTERRUPTED:
        kept = "; what was measured is kept, --resume goes on from there" if _command_of(arguments) == "tune " else ""
        _leave(f"interrupted{kept}.", _INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _leave(message: str, code: int) -> NoReturn:
    print(f"vtfs: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)


def _command_of(arguments: list[str]) -> str:
    """The command that was named, and a space; nothing where there is none."""
    names = {command.callback.__name__ for command in app.registered_commands if command.callback}
    return f"{arguments[0]} " if arguments and arguments[0] in names else ""


@app.command()
def tune(
    scene: SceneArgument = None,
    cameras: CamerasOption = None,
    lights: LightsOption = None,
    size: SizeOption = None,
    techniques: Annotated[
        str | None,
        typer.Option(help="Comma-separated; default: all that counting finds worth measuring.", metavar="A,B"),
    ] = None,
    space: Annotated[Path | None, typer.Option(help="Search space as TOML.", metavar="FILE")] = None,
    budget: Annotated[
        str | None, typer.Option(help="Measurements, as 40, or seconds of measuring, as 120s.", show_default="90s")
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
    out: Annotated[Path, typer.Option(help="Folder of the report.", metavar="DIR")] = Path("vtfs-report"),
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the measurements that are in the folder.")
    ] = False,
    seed: SeedOption = 0,
    lights_per_sample: PerSampleOption = 20,
    density: DensityOption = "constant",
    triangles: TrianglesOption = None,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """The main job: count, measure, model, search, report."""
    _log(verbose)
    names = _technique_names(techniques)
    if objective not in ("max", "mean"):
        raise InputError(f"--objective {objective}: must be max or mean.")
    if max_error is not None and not max_error >= 0:
        raise InputError(f"--max-error {max_error}: must be 0 or more.")
    from tuning.space import load_space
    from tuning.sweep import Budget
    from vtfs.device import keep_compiled_programs

    budget_parsed = Budget.parse(budget) if budget is not None else None
    own_space = load_space(space, names) if space else None
    # Cheap to check, and dear to find out after minutes of measuring.
    _check_folder(out, resume)
    setup = _setup(scene, cameras, lights, size, seed, lights_per_sample, density, triangles)
    keep_compiled_programs()
    from reports.page import write_report
    from tuning.tune import DEFAULT_BUDGET, TuneOptions, tune

    options = TuneOptions(
        out,
        names,
        names if techniques else (),
        own_space,
        budget_parsed or DEFAULT_BUDGET,
        objective,
        max_error,
        seed,
        _command(),  # type: ignore[arg-type]
    )
    with _Status() as status:
        result = tune(setup, options, status.say, status.search)
        status.say("writing the report")
        page = write_report(out)
    _write_json(json_file, result)
    if json_file != "-":
        print(_recommendation(result))
        print(f"Report: {page}")


@app.command()
def count(
    scene: SceneArgument = None,
    technique: TechniqueOption = "tiled_deferred",
    settings: SetOption = None,
    frame: Annotated[
        list[int] | None, typer.Option(help="Only this frame of the path. Repeatable.", show_default="all")
    ] = None,
    space: Annotated[
        Path | None, typer.Option(help="Count every configuration of this space (TOML).", metavar="FILE")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="With --space: the CSV file to write.", metavar="FILE")] = None,
    cameras: CamerasOption = None,
    lights: LightsOption = None,
    size: SizeOption = None,
    seed: SeedOption = 0,
    lights_per_sample: PerSampleOption = 20,
    density: DensityOption = "constant",
    triangles: TrianglesOption = None,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Exact counts for every frame, or for every configuration of a space."""
    _log(verbose)
    config = _configuration(technique, settings)
    if out and not space:
        raise InputError(
            "--out goes with --space: it is the table of a space's counts; use --json for one configuration."
        )
    if out:
        _check_folder(out.parent, resume=True)
    configs = (config,)
    if space:
        from tuning.space import load_space

        configs = load_space(space, (technique,)).configurations()
    setup = _setup(scene, cameras, lights, size, seed, lights_per_sample, density, triangles)
    frames = tuple(dict.fromkeys(frame)) if frame else tuple(range(setup.n_frames))
    from vtfs.count_table import count_frames, counts_csv, print_counts
    from vtfs.device import keep_compiled_programs

    keep_compiled_programs()
    with _Status() as status:
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
    _write_json(json_file, records if space else records[0])
    if json_file != "-":
        print_counts(rows)


@app.command()
def render(
    scene: SceneArgument = None,
    technique: TechniqueOption = "tiled_deferred",
    out: Annotated[Path, typer.Option(help="Folder of the pictures.", metavar="DIR")] = Path("vtfs-render"),
    settings: SetOption = None,
    frame: Annotated[list[int] | None, typer.Option(help="A frame of the path. Repeatable.", show_default="0")] = None,
    cameras: CamerasOption = None,
    lights: LightsOption = None,
    size: SizeOption = None,
    seed: SeedOption = 0,
    lights_per_sample: PerSampleOption = 20,
    density: DensityOption = "constant",
    triangles: TrianglesOption = None,
    json_file: JsonOption = None,
    verbose: VerboseOption = False,
) -> None:
    """Image and heat map of lighting computations as PNG."""
    _log(verbose)
    config = _configuration(technique, settings)
    _check_folder(out, resume=True)
    setup = _setup(scene, cameras, lights, size, seed, lights_per_sample, density, triangles)
    from vtfs.device import keep_compiled_programs
    from vtfs.frame import FrameInputs
    from vtfs.frame import count as count_frame
    from vtfs.frame import render as render_frame
    from vtfs.image import exposure, heat_map, tone_map, write_png

    keep_compiled_programs()
    written: list[dict[str, Any]] = []
    for number in dict.fromkeys(frame or [0]):
        with _Status() as status:
            status.say(f"frame {number}")
            inputs = FrameInputs(setup.samples(number), setup.lights)
            image = render_frame(config, inputs)
            _, lengths = count_frame(config, inputs)
        valid = inputs.samples.valid
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
    _write_json(json_file, {"technique": config.technique, "params": config.params, "pictures": written})


@app.command()
def report(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a `vtfs tune` run.")]) -> None:
    """Write report.html again from the files of a run; measures nothing."""
    from reports.page import write_report

    print(write_report(folder))


@app.command()
def scenes() -> None:
    """The built-in scenes."""
    from rich.console import Console
    from rich.table import Table

    from vtfs.gallery import GALLERY

    table = Table("scene", "triangles", "what it is", box=None, pad_edge=False)
    for name, builtin in GALLERY.items():
        table.add_row(name, f"{builtin.default_triangles:,}", builtin.description)
    Console().print(table)


@app.command()
def techniques() -> None:
    """The techniques and their parameters."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table("technique", "parameters", box=None, pad_edge=False)
    for name, names in TECHNIQUES.items():
        table.add_row(name, ", ".join(names))
    console.print(table)
    table = Table("parameter", "default", "values", "meaning", box=None, pad_edge=False)
    for parameter in PARAMETERS.values():
        table.add_row(parameter.name, str(parameter.default), parameter.allowed, parameter.meaning)
    console.print()
    console.print(table)


@app.command()
def doctor() -> None:
    """What this machine can do: devices, versions, caches."""
    import jax

    from vtfs.cache import cache_dir
    from vtfs.device import device_name, versions

    print(f"device    {device_name()}")
    print(f"others    {', '.join(str(d) for d in jax.devices()[1:]) or 'none'}")
    for name, version in versions().items():
        print(f"{name:9s} {version}")
    try:
        import embreex  # noqa: F401

        print("embree    found")
    except ImportError as error:
        print(f"embree    missing ({error}): view samples cannot be traced, only read from .npz")
    folder = cache_dir()
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.exists() else 0
    print(f"cache     {folder} ({size / 1e6:.0f} MB; VTFS_CACHE_DIR moves it)")


def _setup(
    scene: str | None,
    cameras: Path | None,
    lights: str | None,
    size: str | None,
    seed: int,
    lights_per_sample: int,
    density: str,
    triangles: int | None,
):
    if density not in ("constant", "fixed"):
        raise InputError(f"--density {density}: must be constant or fixed.")
    viewport = _viewport(size)
    from vtfs.scene_setup import SceneOptions, set_up

    return set_up(SceneOptions(scene, cameras, lights, viewport, seed, lights_per_sample, density, triangles))  # type: ignore[arg-type]


def _viewport(size: str | None):
    if size is None:
        return None
    from vtfs.camera import Viewport

    try:
        width, height = (int(part) for part in size.lower().split("x"))
    except ValueError:
        raise InputError(f"--size {size}: must be WIDTHxHEIGHT in pixels, as 1280x720.") from None
    return Viewport(width, height)


def _technique_names(given: str | None) -> tuple[str, ...]:
    if given is None:
        return tuple(TECHNIQUES)
    names = tuple(dict.fromkeys(name.strip() for name in given.split(",") if name.strip()))
    for name in names or ("",):
        configuration(name)  # refuses what is unknown
    return names


def _configuration(technique: str, settings: list[str] | None) -> Configuration:
    params: dict[str, str] = {}
    for setting in settings or ():
        name, equals, value = setting.partition("=")
        if not equals or not name or not value:
            raise InputError(f"--set {setting}: must be NAME=VALUE, as tile_px=16.")
        params[name.strip()] = value.strip()
    return configuration(technique, params)


def _check_folder(folder: Path, resume: bool) -> None:
    """Can it be written, and does it not hold somebody's measurements?"""
    from vtfs.files import write_atomically

    probe = folder / ".vtfs-writable"
    try:
        write_atomically(probe, b"")
    except InputError as error:
        reason = getattr(error.__cause__, "strerror", error)
        raise InputError(f"--out {folder}: is no folder that can be written ({reason}); choose another one.") from error
    probe.unlink()
    if not resume and (folder / "measurements.jsonl").exists():
        raise InputError(
            f"{folder}: holds the measurements of an earlier run; go on with --resume, or name another --out."
        )


def _write_json(target: str | None, value: object) -> None:
    if target is None:
        return
    text = json.dumps(value, indent=1, allow_nan=False)
    if target == "-":
        print(text)
        return
    from vtfs.files import write_atomically

    write_atomically(target, text.encode())


def _log(verbose: bool) -> None:
    logging.getLogger("vtfs").setLevel(logging.INFO if verbose else logging.ERROR)
    if verbose:
        logging.basicConfig(format="%(name)s: %(message)s", stream=sys.stderr)


def _command() -> str:
    return shlex.join(["vtfs", *sys.argv[1:]])


def _recommendation(result: dict[str, Any]) -> str:
    best, gain = result["best"], result["gain"]
    changed = [f"{name}={value}" for name, value in best["params"].items() if value != PARAMETERS[name].default]
    low, high = best["time_ms_interval"]
    lines = [f"{' '.join([best['technique'], *changed])}: {best['time_ms']:.1f} ms a frame ({low:.1f} to {high:.1f})"]
    for role, words in (("default", "its default"), ("fastest_default", "the fastest default")):
        if f"over_{role}" in gain:
            low, high = gain[f"over_{role}_interval"]
            lines.append(f"  {gain[f'over_{role}']:.2f} times as fast as {words} ({low:.2f} to {high:.2f})")
    lines.append(f"  {result['claim']}")
    lines.append(
        f"  {result['measured']} configurations measured (the space has {result['space_size']}), "
        f"{result['compiled_programs']} programs compiled, {result['wall_s']:.0f} s: {result['stop_reason']}"
    )
    return "\n".join(lines)


class _Status:
    """A line on the terminal that says what is being done; silent in a pipe."""

    def __enter__(self) -> _Status:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._progress.start()
        self._task = self._progress.add_task("", total=None)
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def say(self, what: str) -> None:
        self._progress.update(self._task, description=what)

    def share(self, what: str, done: float) -> None:
        self._progress.update(self._task, description=what, total=1.0, completed=done)

    def search(self, state: Any) -> None:
        best = "" if state.best_ms is None else f", best {state.best_ms:.1f} ms"
        self.share(f"{state.n_measured} measured{best}; now {state.configuration}", min(state.spent, 1.0))
