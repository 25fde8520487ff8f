"""The printed tables as `TimingTable`: reprints dropped, technique names as here, and passes that were left out as a
stage of their own."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources

from tuning.formats.csv_sheet import parse_sheet
from tuning.formats.grouping import Value, grouped
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError

UNLISTED = "unlisted"
"""The stage of the passes that a table does not print: the frame less the printed stages."""


@dataclass(frozen=True)
class Publication:
    """A table of package data.

    - `tables_with_unlisted`: those whose printed stages do not add up to the frame.
    """

    title: str
    file: str
    tables_with_unlisted: tuple[str, ...] = ()


PUBLISHED: dict[str, Publication] = {
    "van_oosten_2017": Publication(
        "J. van Oosten: Volume Tiled Forward Shading, MSc thesis, Utrecht University, 2017, Tables 10.1 to 10.13",
        "van_oosten_2017_timings.csv",
        # Depth pre-pass, marking tiles and building their list; with a BVH also reducing lights and Morton codes.
        ("10.5", "10.6", "10.7", "10.8", "10.9", "10.10"),
    ),
    "olsson_2011": Publication(
        "O. Olsson, U. Assarsson: Tiled Shading, Journal of Graphics, GPU, and Game Tools 15(4), 2011, Tables 2 and 3",
        "olsson_2011_tiled_shading_timings.csv",
    ),
    "olsson_2012": Publication(
        "O. Olsson, M. Billeter, U. Assarsson: Clustered Deferred and Forward Shading, HPG 2012, Table 2",
        "olsson_2012_light_assignment_scaling.csv",
    ),
}

DEFAULT = "van_oosten_2017"

_VAN_OOSTEN_NAMES = {
    # His tiled forward has a depth pre-pass.
    "tiled_forward": "tiled_forward_prez",
    "volume_tiled_forward": "volume_tiled",
    "volume_tiled_forward_bvh": "volume_tiled_bvh",
}

_LABELS = {
    "scene": "scene",
    "technique": "technique",
    "density": "light_density_mode",
    "stage": "stage",
    "device": "gpu",
    "gbuffer_bits": "gbuffer_bits",
}
"""Ours and the file's. `none` of G-buffer bits stands for a technique without one, so they are no number."""

_Row = dict[str, str]


def read_published(name: str) -> TimingTable:
    """A publication's times: `lights` as the column, technique, scene, density, stage, device as labels.

    Of means, minima and maxima only the mean is taken, as the one time of a row; no repeats were printed. `frame` is
    the total. Where passes were not printed, the stage `unlisted` is the frame less the printed ones.

    **Raises:** `InputError` for an unknown name.
    """
    if name not in PUBLISHED:
        raise InputError(f"--published {name}: unknown; choose from {', '.join(PUBLISHED)}.")
    publication = PUBLISHED[name]
    rows = [
        row for row in _rows(publication.file) if not row["duplicate_of_table"] and row["stat"] in ("mean", "single")
    ]
    if name == "van_oosten_2017":
        rows = [{**row, "technique": _VAN_OOSTEN_NAMES.get(row["technique"], row["technique"])} for row in rows]
    rows += _unlisted(rows, publication.tables_with_unlisted)
    columns: dict[str, list[Value]] = {"lights": [float(row["num_lights"]) for row in rows]}
    for ours, theirs in _LABELS.items():
        values = [row[theirs] for row in rows]
        if any(values):
            columns[ours] = list(values)
    return grouped(columns, [(float(row["milliseconds"]),) for row in rows])


def _unlisted(rows: Iterable[_Row], tables: Sequence[str]) -> list[_Row]:
    """A row for each frame of the tables that has printed stages."""
    frames: dict[tuple[str, ...], dict[str, _Row]] = defaultdict(dict)
    for row in rows:
        if row["table"] in tables:
            key = tuple(row[field] for field in ("table", "scene", "technique", "light_density_mode", "num_lights"))
            frames[key][row["stage"]] = row
    return [
        {**stages["frame"], "stage": UNLISTED, "milliseconds": repr(_missing_ms(stages))} for stages in frames.values()
    ]


def _missing_ms(stages: dict[str, _Row]) -> float:
    printed = sum(float(row["milliseconds"]) for stage, row in stages.items() if stage != "frame")
    # To the digits of the tables: the rest is rounding of the subtraction.
    return round(float(stages["frame"]["milliseconds"]) - printed, 7)


def _rows(file: str) -> list[_Row]:
    text = resources.files("tuning.published").joinpath(file).read_text(encoding="utf-8")
    columns = parse_sheet(text, file).columns
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
