"""The pictures of a run, put into the page itself, and the legend of the heat maps."""

from __future__ import annotations

import base64
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vtfs.input_error import InputError

# The ramp of `vtfs.image.heat_map`, for where `result.json` does not bring its own.
HEAT_COLOURS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")

_SHOWS = {
    "clusters": "The cells that samples lie in.",
    "slices": "The depth slice of each sample.",
    "false_positives": "Lights listed for a sample that do not reach it.",
    "shadows": "The shadows that were found.",
}

_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Picture:
    """One PNG as a data URI, so that the page needs no other file.

    - `unit`: what a heat map shows; `max_count`, `mean_count`: of it per pixel.
    """

    uri: str
    kind: str
    technique: str
    caption: str
    width_px: int
    height_px: int
    max_count: float | None
    mean_count: float | None
    unit: str = "lighting computations per pixel"

    @property
    def alternative(self) -> str:
        """What a reader who does not see the picture needs to know."""
        if self.kind != "heat_map":
            return f"{_SHOWS.get(self.kind, 'The rendered frame.')} {self.caption}".strip()
        numbers = [
            f"{label} {value:g}"
            for label, value in (("mean", self.mean_count), ("most", self.max_count))
            if value is not None
        ]
        counted = f": {', '.join(numbers)}" if numbers else ""
        return f"Heat map of {self.unit} with {self.technique}{counted}."


@dataclass(frozen=True)
class HeatScale:
    """The colour scale that all heat maps share.

    - `ticks`: place along the bar in percent, and the count there; `unit`: of what.
    """

    gradient: str
    ticks: tuple[tuple[float, float], ...]
    is_log: bool
    unit: str


def read_pictures(folder: Path, listed: list[dict[str, Any]]) -> tuple[Picture, ...]:
    """The pictures that `result.json` lists: the rendered frame, heat maps, then cells.

    **Raises:** `InputError` for a missing or truncated PNG, or a name that leaves the folder.
    """
    pictures = [_picture(folder, item) for item in listed]
    return tuple(sorted(pictures, key=lambda picture: (picture.kind in _SHOWS, picture.kind == "heat_map")))


def heat_scale(pictures: tuple[Picture, ...], given: dict[str, Any]) -> HeatScale | None:
    """The legend; None where no heat map says how many computations its brightest colour stands for.

    - `given`: `heat_scale` of `result.json`: `colours` (from few to many), `max_count`, `scale` (`linear` or
      `log`, the latter of 1 + count). What it leaves out is the ramp above, from 0 to the most of all maps.
    """
    counts = [picture.max_count for picture in pictures if picture.kind == "heat_map" and picture.max_count]
    top = given.get("max_count") or max(counts, default=0)
    colours = given.get("colours") or HEAT_COLOURS
    if not isinstance(top, int | float) or not isinstance(colours, list | tuple):
        raise InputError("result.json: `heat_scale` must hold `max_count`, a number, and `colours`, a list.")
    if top <= 0 or not any(picture.kind == "heat_map" for picture in pictures):
        return None
    is_log = given.get("scale") == "log"
    return HeatScale(
        gradient=f"linear-gradient(to right, {', '.join(_checked_colour(colour) for colour in colours)})",
        ticks=_log_ticks(top) if is_log else _linear_ticks(top),
        is_log=is_log,
        unit=next(picture.unit for picture in pictures if picture.kind == "heat_map"),
    )


def _picture(folder: Path, item: dict[str, Any]) -> Picture:
    name = item.get("file")
    if not isinstance(name, str) or Path(name).name != name:
        raise InputError(f"result.json: `pictures` names {name!r}; it must be a file in {folder}.")
    path = folder / name
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); run `vtfs tune` again.") from None
    # A PNG starts with its signature and the IHDR chunk, which holds its size, and ends with IEND.
    if not data.startswith(_SIGNATURE) or len(data) < 33 or b"IEND" not in data[-12:]:
        raise InputError(f"{path}: not a PNG, or cut short; run `vtfs tune` again.")
    width_px, height_px = struct.unpack(">II", data[16:24])
    return Picture(
        uri=f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}",
        kind=str(item.get("kind") or "frame"),
        technique=str(item.get("technique") or ""),
        caption=str(item.get("caption") or ""),
        width_px=width_px,
        height_px=height_px,
        max_count=_count(item.get("max_count")),
        mean_count=_count(item.get("mean_count")),
        unit=str(item.get("unit") or Picture.unit),
    )


def _count(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _checked_colour(colour: object) -> str:
    """Only `#rrggbb`: it goes into a style, where other text could mean something else."""
    if isinstance(colour, str) and len(colour) == 7 and colour[0] == "#":
        try:
            int(colour[1:], 16)
        except ValueError:
            pass
        else:
            return colour
    raise InputError(f"result.json: `heat_scale.colours` holds {colour!r}; it must be `#rrggbb`.")


def _linear_ticks(top: float) -> tuple[tuple[float, float], ...]:
    """Round counts from 0, and the top."""
    # The smallest of 1, 2, 5, 10, ... that makes at most five steps; counts are whole.
    step = next(step * 10**k for k in range(12) for step in (1, 2, 5) if 5 * step * 10**k >= top)
    counts = [float(count) for count in range(0, math.ceil(top), step) if count < 0.9 * top]
    return tuple((100 * count / top, count) for count in [*counts, float(top)])


def _log_ticks(top: float) -> tuple[tuple[float, float], ...]:
    """0, the powers of ten and the top, of a scale that is linear in log(1 + count)."""
    whole = math.log1p(top)
    counts = [0.0, *(float(10**k) for k in range(12) if 10**k < 0.7 * top), float(top)]
    return tuple((100 * math.log1p(count) / whole, count) for count in counts)
