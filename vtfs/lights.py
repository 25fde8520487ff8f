"""Lights: points and spots with a finite range, `lights.csv`, and lights scattered in a scene."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from vtfs.files import write_atomically
from vtfs.input_error import InputError

_REQUIRED = ("x", "y", "z", "range", "r", "g", "b")
_SPOT = ("dx", "dy", "dz", "inner_deg", "outer_deg")
_POINT_DIRECTION = (0.0, 0.0, -1.0)
_LARGEST_FILE_BYTES = 2**30


@dataclass(frozen=True)
class Lights:
    """Point and spot lights, all float64.

    - `position_m`, `range_m`: `[N, 3]`, `[N]`; light ends exactly at the range, which may be 0.
    - `colour`: `[N, 3]`, linear, intensity included: what arrives at distance `d` is `colour * falloff(d)`.
    - `direction`: `[N, 3]`, unit vectors from the light into its cone.
    - `cos_inner`, `cos_outer`: `[N]`; the cone's weight is `clip((cos - cos_outer) / (cos_inner - cos_outer), 0, 1)`.
      Point lights have -1 and -2, for which that is always 1.

    **Raises:** `InputError` that names the field and the light.
    """

    position_m: np.ndarray
    range_m: np.ndarray
    colour: np.ndarray
    direction: np.ndarray
    cos_inner: np.ndarray
    cos_outer: np.ndarray

    def __post_init__(self):
        n = len(self.range_m)
        for field in fields(self):
            array = np.ascontiguousarray(getattr(self, field.name), np.float64)
            columns = (3,) if field.name in ("position_m", "colour", "direction") else ()
            if array.shape != (n, *columns):
                raise InputError(f"lights `{field.name}` has shape {array.shape}: must be {(n, *columns)}.")
            bad = np.flatnonzero(~np.isfinite(array.reshape(n, math.prod(columns))).all(axis=1))
            if len(bad):
                raise InputError(f"light {bad[0]} `{field.name}` = {array[bad[0]]}: must be finite.")
            object.__setattr__(self, field.name, array)
        for name, wrong, right in (
            ("range_m", self.range_m < 0, "0 or more"),
            ("colour", (self.colour < 0).any(axis=1), "0 or more"),
            ("cos_inner", self.cos_inner <= self.cos_outer, "above cos_outer (the inner cone lies in the outer)"),
        ):
            bad = np.flatnonzero(wrong)
            if len(bad):
                raise InputError(f"light {bad[0]} `{name}` = {getattr(self, name)[bad[0]]}: must be {right}.")

    @property
    def n_lights(self) -> int:
        return len(self.range_m)

    @property
    def is_spot(self) -> np.ndarray:
        """bool `[N]`."""
        return self.cos_outer >= -1

    @cached_property
    def key(self) -> str:
        """SHA-256 of the content, in hexadecimal."""
        digest = hashlib.sha256(b"lights 1")
        for field in fields(self):
            digest.update(getattr(self, field.name).tobytes())
        return digest.hexdigest()

    def relative_to(self, view_from_world: np.ndarray) -> Lights:
        """The same lights in view space. `view_from_world` is float64 `[4, 4]` and keeps lengths."""
        rotation = view_from_world[:3, :3]
        return Lights(
            self.position_m @ rotation.T + view_from_world[:3, 3],
            self.range_m,
            self.colour,
            self.direction @ rotation.T,
            self.cos_inner,
            self.cos_outer,
        )


def point_lights(position_m: np.ndarray, range_m: np.ndarray, colour: np.ndarray) -> Lights:
    """Lights that shine everywhere: `[N, 3]`, `[N]`, `[N, 3]`."""
    n = len(range_m)
    return Lights(position_m, range_m, colour, np.tile(_POINT_DIRECTION, (n, 1)), np.full(n, -1.0), np.full(n, -2.0))


def cone_cosines(inner_deg: float, outer_deg: float) -> tuple[float, float]:
    """Cosines of a spot's half angles, `0 <= inner <= outer <= 180` degrees.

    A hard edge (inner = outer) gets a rim of 1e-6 in the cosine, as the weight divides by the difference.
    """
    cos_outer = math.cos(math.radians(outer_deg))
    return max(math.cos(math.radians(inner_deg)), cos_outer + 1e-6), cos_outer


def load_lights(path: Path | str) -> Lights:
    """Read `lights.csv`: header `x,y,z,range,r,g,b`, optionally with `dx,dy,dz,inner_deg,outer_deg` for spots.

    World space, metres. A row whose five spot columns are all empty is a point light. Angles are half
    angles, from the axis.

    **Raises:** `InputError` that names the file, the line and the column.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a lights.csv, or a number of lights.")
    if path.stat().st_size > _LARGEST_FILE_BYTES:
        raise InputError(f"{path}: has {path.stat().st_size} bytes; a lights.csv has at most {_LARGEST_FILE_BYTES}.")
    try:
        text = path.read_bytes().decode("utf-8-sig")
        return _parse(list(csv.reader(io.StringIO(text, newline=""))))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8 text; save the file as CSV in UTF-8.") from None
    except csv.Error as error:
        raise InputError(f"{path}: not CSV ({error}); the header is {','.join(_REQUIRED)}.") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def save_lights(path: Path | str, lights: Lights) -> None:
    """Write `lights.csv`; spot columns only where there are spots.

    **Raises:** `InputError` where the file cannot be written.
    """
    has_spots = bool(lights.is_spot.any())
    lines = [",".join(_REQUIRED + (_SPOT if has_spots else ()))]
    for i in range(lights.n_lights):
        row = [*lights.position_m[i], lights.range_m[i], *lights.colour[i]]
        if lights.is_spot[i]:
            angles = np.degrees(np.arccos(np.clip([lights.cos_inner[i], lights.cos_outer[i]], -1, 1)))
            row += [*lights.direction[i], *angles]
        cells = [repr(float(value)) for value in row]
        lines.append(",".join(cells + [""] * (len(_SPOT) if has_spots and not lights.is_spot[i] else 0)))
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def scatter_lights(
    bounds_m: tuple[np.ndarray, np.ndarray],
    n_lights: int,
    seed: int,
    visible_m: np.ndarray,
    lights_per_sample: int = 20,
    density: Literal["constant", "fixed"] = "constant",
) -> Lights:
    """Point lights of random hues, uniform in a box, all with one range.

    **Arguments:**

    - `bounds_m`: low and high corner of the scene, `[3]` each.
    - `visible_m`: world-space view samples, `[S, 3]`; without any, the box's own points stand for them.
    - `lights_per_sample`: the range is the median over visible samples of the distance to their nearest
      light of this rank (to the farthest light where there are fewer).
    - `density`: `constant` fills the scene's box; `fixed` fills a box of the same shape and centre whose
      volume is one cubic metre per light.

    Intensity is proportional to the range squared: with 20 lights a sample its irradiance is then about 1, whatever
    the scene's scale (the falloff's window integrates to 2.13 over a ball, a facing factor of 1/4).

    **Raises:** `InputError` for a negative number of lights.
    """
    from scipy.spatial import KDTree  # a quarter of a second to import

    if n_lights < 0:
        raise InputError(f"`lights` = {n_lights}: must be 0 or more.")
    if lights_per_sample < 1:
        raise InputError(f"`lights_per_sample` = {lights_per_sample}: must be at least 1.")
    if n_lights == 0:
        return point_lights(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
    low, high = (np.asarray(corner, np.float64) for corner in bounds_m)
    rng = np.random.default_rng(seed)
    if density == "fixed":
        # A flat box has no volume to scale: its thinnest side counts as a hundredth of its longest.
        size = np.maximum(high - low, 0.01 * max(float((high - low).max()), 1e-9))
        size *= (n_lights / np.prod(size)) ** (1 / 3)
        low, high = (low + high) / 2 - size / 2, (low + high) / 2 + size / 2
    position_m = rng.uniform(low, high, (n_lights, 3))
    samples_m = np.asarray(visible_m, np.float64).reshape(-1, 3)
    if len(samples_m) == 0:
        samples_m = rng.uniform(low, high, (256, 3))
    if len(samples_m) > 4096:  # a median needs no more
        samples_m = samples_m[rng.choice(len(samples_m), 4096, replace=False)]
    rank = min(lights_per_sample, n_lights)
    distance_m, _ = KDTree(position_m).query(samples_m, k=rank)
    range_m = float(np.median(np.reshape(distance_m, (len(samples_m), rank))[:, -1]))
    peak = 2.0 / rank * range_m**2
    return point_lights(position_m, np.full(n_lights, range_m), peak * _hues(rng.uniform(0, 1, n_lights)))


def _hues(hue: np.ndarray) -> np.ndarray:
    """Half-saturated linear colours `[N, 3]` of hues in [0, 1); their brightest component is 1."""
    ramp = np.abs((hue[:, None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1
    return 0.4 + 0.6 * np.clip(ramp, 0, 1)


def _parse(rows: list[list[str]]) -> Lights:
    header = [cell.strip() for cell in rows[0]] if rows else []
    columns = _columns(header)
    values: list[tuple[float, ...]] = []
    for line, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise InputError(f"line {line}: has {len(row)} values; the header has {len(header)} columns.")
        values.append(_light(line, {name: row[column].strip() for name, column in columns.items()}))
    table = np.array(values, np.float64).reshape(-1, 12)
    return Lights(table[:, 0:3], table[:, 3], table[:, 4:7], table[:, 7:10], table[:, 10], table[:, 11])


def _columns(header: list[str]) -> dict[str, int]:
    for name in _REQUIRED:
        if name not in header:
            raise InputError(f"line 1: column `{name}` is missing; the header is {','.join(_REQUIRED)}.")
    for name in header:
        if name not in _REQUIRED + _SPOT:
            raise InputError(f"line 1: column `{name}` is unknown; columns are {','.join(_REQUIRED + _SPOT)}.")
        if header.count(name) > 1:
            raise InputError(f"line 1: column `{name}` is there {header.count(name)} times; keep one.")
    missing = [name for name in _SPOT if name not in header]
    if missing and len(missing) < len(_SPOT):
        raise InputError(f"line 1: column `{missing[0]}` is missing; spots need {','.join(_SPOT)}.")
    return {name: header.index(name) for name in header}


def _light(line: int, cells: dict[str, str]) -> tuple[float, ...]:
    """One row: position, range, colour, direction, the cosines of the cone."""
    x, y, z, range_m, r, g, b = (_number(line, name, cells[name]) for name in _REQUIRED)
    for name, value in (("range", range_m), ("r", r), ("g", g), ("b", b)):
        if value < 0:
            raise InputError(f"line {line}: column `{name}` = {value:g}: must be 0 or more.")
    base = (x, y, z, range_m, r, g, b)
    if not any(cells.get(name) for name in _SPOT):
        return (*base, *_POINT_DIRECTION, -1.0, -2.0)
    dx, dy, dz, inner_deg, outer_deg = (_number(line, name, cells[name]) for name in _SPOT)
    length = math.hypot(dx, dy, dz)
    if not length > 0:
        raise InputError(f"line {line}: columns `dx,dy,dz` = {dx:g},{dy:g},{dz:g}: a spot needs a direction.")
    if not 0 < outer_deg <= 180:
        raise InputError(f"line {line}: column `outer_deg` = {outer_deg:g}: must be above 0 and at most 180.")
    if not 0 <= inner_deg <= outer_deg:
        raise InputError(
            f"line {line}: column `inner_deg` = {inner_deg:g}: must be from 0 to outer_deg = {outer_deg:g}."
        )
    return (*base, dx / length, dy / length, dz / length, *cone_cosines(inner_deg, outer_deg))


def _number(line: int, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"line {line}: column `{name}` = {text[:40]!r}: must be a number.") from None
    if not math.isfinite(value):
        raise InputError(f"line {line}: column `{name}` = {text[:40]!r}: must be finite.")
    return value
