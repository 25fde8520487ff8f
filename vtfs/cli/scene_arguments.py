"""The scene of a command: ten options that every command on a scene has."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from vtfs.input_error import InputError

if TYPE_CHECKING:
    from vtfs.scene_setup import SceneSetup


_PANEL = "Scene"


@dataclass(frozen=True)
class SceneArguments:
    """What was said on the command line; nothing of it is checked yet."""

    scene: Annotated[
        str | None,
        typer.Argument(
            metavar="[SCENE]",
            help="GLB, glTF, OBJ, PLY or STL file; a G-buffer .npz (or a folder of them); or a built-in scene. "
            "Default: atrium.",
        ),
    ] = None
    cameras: Annotated[
        Path | None, typer.Option(help="Camera path: cameras.json.", metavar="FILE", rich_help_panel=_PANEL)
    ] = None
    lights: Annotated[
        str | None,
        typer.Option(
            help="lights.csv, or a number of lights to scatter.",
            metavar="FILE|N",
            show_default="the scene's, else 1000",
            rich_help_panel=_PANEL,
        ),
    ] = None
    size: Annotated[
        str | None, typer.Option(help="Image size, as 1280x720.", metavar="WxH", rich_help_panel=_PANEL)
    ] = None
    seed: Annotated[int, typer.Option(min=0, help="Of everything that is random.", rich_help_panel=_PANEL)] = 0
    lights_per_sample: Annotated[
        int,
        typer.Option(
            min=1,
            help="Scattered lights get the range at which so many reach a visible sample in the median.",
            rich_help_panel=_PANEL,
        ),
    ] = 20
    density: Annotated[
        str,
        typer.Option(
            help="Where lights are scattered: `constant`: in the scene's box; `fixed`: one a cubic metre.",
            rich_help_panel=_PANEL,
        ),
    ] = "constant"
    shadow_lights: Annotated[
        int,
        typer.Option(
            min=0,
            max=32,
            help="Shadow techniques: lights that cast on each frame, those that light it most; directional lights "
            "cast besides.",
            rich_help_panel=_PANEL,
        ),
    ] = 1
    triangles: Annotated[
        int | None, typer.Option(help="Size of a built-in scene, 1,000 to 1,000,000 triangles.", rich_help_panel=_PANEL)
    ] = None

    def set_up(self) -> SceneSetup:
        """Load it.

        **Raises:** `InputError` for what is wrong in the options or in the files.
        """
        if self.density not in ("constant", "fixed"):
            raise InputError(f"--density {self.density}: must be constant or fixed.")
        viewport = _viewport(self.size)
        from vtfs.scene_setup import SceneOptions, set_up

        return set_up(
            SceneOptions(
                self.scene,
                self.cameras,
                self.lights,
                viewport,
                self.seed,
                self.lights_per_sample,
                self.density,  # type: ignore[arg-type]
                self.triangles,
                self.shadow_lights,
            )
        )


def with_scene(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose first parameter is `SceneArguments`, as one with an option for each of their fields."""
    hints = get_type_hints(SceneArguments, include_extras=True)
    own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]
    of_scene = [
        inspect.Parameter(f.name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=f.default, annotation=hints[f.name])
        for f in fields(SceneArguments)
    ]
    # SCENE leads; the command's own options come before those of the scene in the help.
    parameters = [of_scene[0], *own, *of_scene[1:]]

    @wraps(command)
    def spread(**given: Any) -> None:
        scene = SceneArguments(**{p.name: given.pop(p.name) for p in of_scene})
        command(scene, **given)

    spread.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    spread.__annotations__ = {p.name: p.annotation for p in parameters}
    return spread


def _viewport(size: str | None):
    if size is None:
        return None
    from vtfs.camera import Viewport

    try:
        width, height = (int(part) for part in size.lower().split("x"))
    except ValueError:
        raise InputError(f"--size {size}: must be WIDTHxHEIGHT in pixels, as 1280x720.") from None
    return Viewport(width, height)
