"""Frame times that were measured elsewhere: a table as `vtfs count` writes it with times in some of its rows."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tuning.formats.csv_sheet import read_sheet
from tuning.formats.csv_table import CsvLayout, arranged, feature_cells, sheet_times_ms
from tuning.formats.registry import recognised
from tuning.record import read_measurements
from vtfs.configurations import Configuration, configuration
from vtfs.input_error import InputError
from vtfs.parameters import PARAMETERS

Counts = dict[str, float]


@dataclass(frozen=True)
class ImportedTimes:
    """What a file says of some configurations of one scene.

    - `frames`: on which all timed configurations can be compared.
    - `counts`: of every configuration, one record a frame of `frames`; empty ones where the file has no counts.
    - `repeats_ms`: of the timed configurations, for each of `frames` every repeat.
    - `device`: as the file calls it.
    """

    source: str
    frames: tuple[int, ...]
    counts: dict[Configuration, tuple[Counts, ...]]
    repeats_ms: dict[Configuration, tuple[tuple[float, ...], ...]]
    device: str
    scene: str

    def limited_to(self, techniques: Collection[str]) -> ImportedTimes:
        """**Raises:** `InputError` where none of these techniques was timed."""
        timed = {c: repeats for c, repeats in self.repeats_ms.items() if c.technique in techniques}
        if not timed:
            known = ", ".join(dict.fromkeys(c.technique for c in self.repeats_ms))
            raise InputError(f"--techniques {','.join(techniques)}: none was timed in {self.source}; it has {known}.")
        counts = {c: frames for c, frames in self.counts.items() if c.technique in techniques}
        return replace(self, counts=counts, repeats_ms=timed)

    @property
    def claim(self) -> str:
        return (
            f"from frame times imported from {Path(self.source).name}, measured elsewhere ({self.device}); "
            "this program counted and modelled, and timed nothing"
        )


def read_imported(path: Path, layout: CsvLayout | None = None) -> ImportedTimes:
    """Read a CSV file as `vtfs count --out` writes it, with times in some of its rows; or a `measurements.jsonl`.

    **Raises:** `InputError` for an unknown technique or parameter, where nothing was timed, and where the timed
    configurations have no frame in common.
    """
    if recognised(path) == "measurements":
        return _from_record(path)
    return _from_csv(path, layout or CsvLayout())


def _from_csv(path: Path, layout: CsvLayout) -> ImportedTimes:
    sheet, layout = arranged(read_sheet(path), layout)
    techniques = sheet.column("technique")
    times_ms = sheet_times_ms(sheet, layout)
    numbers, labels = feature_cells(sheet, layout)
    labels.pop("technique")
    labels = {name: column for name, column in labels.items() if name not in PARAMETERS}
    named = {}
    for name, column in labels.items():
        if len(set(column)) > 1:
            values = ", ".join(sorted({str(value) for value in column})[:3])
            raise InputError(
                f"{path}: `{name}` has several values ({values}): keep the rows of one, or leave it out (--ignore)."
            )
        named[name] = str(column[0])
    counted = [name for name in numbers if name not in PARAMETERS and name not in ("frame", "technique")]
    frames_of: dict[Configuration, dict[int, Counts]] = {}
    times_of: dict[Configuration, dict[int, list[float]]] = {}
    for row, technique in enumerate(techniques):
        given = {name: sheet.columns[name][row].strip() for name in PARAMETERS if name in sheet.columns}
        try:
            config = configuration(technique.strip(), {name: value for name, value in given.items() if value})
        except InputError as error:
            raise InputError(f"{path}: line {sheet.lines[row]}: {error}") from error
        frame = int(sheet.number(row, "frame") or 0) if "frame" in sheet.columns else 0
        counts = {name: value for name in counted if isinstance(value := numbers[name][row], float)}
        frames_of.setdefault(config, {}).setdefault(frame, counts)
        if (time := times_ms[row]) is not None:
            if not time:
                raise InputError(f"{path}: line {sheet.lines[row]}: a frame took 0 ms; leave the time empty instead.")
            times_of.setdefault(config, {}).setdefault(frame, []).append(time)
    return _comparable(
        str(path),
        frames_of,
        {c: {frame: tuple(repeats) for frame, repeats in own.items()} for c, own in times_of.items()},
        named.get("device", "an unnamed device"),
        named.get("scene", path.stem),
    )


def _from_record(path: Path) -> ImportedTimes:
    frames_of: dict[Configuration, dict[int, Counts]] = {}
    times_of: dict[Configuration, dict[int, tuple[float, ...]]] = {}
    of_scene: dict[tuple[str, str], None] = {}
    for m in read_measurements(path):
        if m.outcome != "timed":
            continue
        config = configuration(m.technique, m.params)
        of_scene[m.scene_key, m.device] = None
        counts = [{name: float(value) for name, value in frame.items()} for frame in m.counts]
        frames_of.setdefault(config, {}).update(zip(m.frames, counts, strict=True))
        for frame, repeats in zip(m.frames, m.stages_ms["frame"], strict=True):
            finite = tuple(ms for ms in repeats if math.isfinite(ms))
            if finite:
                times_of.setdefault(config, {})[frame] = finite
    if len(of_scene) > 1:
        raise InputError(f"{path}: holds several scenes or devices; keep the lines of one.")
    scene, device = next(iter(of_scene), ("", ""))
    return _comparable(str(path), frames_of, times_of, device, scene)


def _comparable(
    source: str,
    frames_of: Mapping[Configuration, Mapping[int, Counts]],
    times_of: Mapping[Configuration, Mapping[int, tuple[float, ...]]],
    device: str,
    scene: str,
) -> ImportedTimes:
    """Only the frames that every timed configuration was timed on, and what was counted on all of them."""
    if not times_of:
        raise InputError(f"{source}: no row has a time; time some configurations and fill in `time_ms`.")
    common = set.intersection(*(set(own) for own in times_of.values()))
    if not common:
        raise InputError(
            f"{source}: no frame was timed in all of {len(times_of)} configurations; time one frame in all of them."
        )
    # The frame with the most work first, as everywhere.
    first = next(iter(times_of.values()))
    frames = tuple(sorted(common, key=lambda frame: (-np.median(first[frame]), frame)))
    return ImportedTimes(
        source,
        frames,
        {c: tuple(own[f] for f in frames) for c, own in frames_of.items() if common <= own.keys()},
        {c: tuple(own[f] for f in frames) for c, own in times_of.items()},
        device,
        scene,
    )
