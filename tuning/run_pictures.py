"""The pictures of a run, and how long the lists of its techniques are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tuning.choose import is_timed, time_ms
from tuning.measurement import Measurement
from tuning.sweep import SearchResult
from tuning.workload import SceneWorkload
from vtfs.configurations import Configuration, configuration
from vtfs.image import exposure, heat_map, random_colours, tone_map, write_png
from vtfs.op_counts import CAPS
from vtfs.shadow_maps import ShadowMaps
from vtfs.technique_names import SHADOW_NAMES

_BINS = 24


@dataclass(frozen=True)
class Drawn:
    """What `result.json` lists: files in the folder, and list lengths of each technique.

    - `heat_scale`: of the heat maps.
    """

    pictures: list[dict[str, Any]]
    list_lengths: list[dict[str, Any]]
    heat_scale: Literal["linear", "log"]

    def as_json(self) -> dict[str, Any]:
        return {
            "pictures": self.pictures,
            "list_lengths": self.list_lengths,
            "heat_scale": {"scale": self.heat_scale},
        }


def draw(workload: SceneWorkload, found: SearchResult, folder: Path) -> Drawn:
    """Write the best configuration's image, heat maps of the work on one scale, and the cells of the fastest technique
    that has any, or the shadows; all of the frame with the most work.

    **Returns:** also, for each technique whose cells have lists, a histogram of their lengths and what engines that cap
    them would drop.
    """
    best = _config(found.best)
    casts = best.technique in SHADOW_NAMES
    image = workload.image(best)
    write_png(folder / "frame.png", tone_map(image, exposure(image, workload.valid())))
    pictures: list[dict[str, Any]] = [
        {
            "file": "frame.png",
            "kind": "frame",
            "technique": best.technique,
            "caption": f"Frame {workload.frames[0]}, the one with the most "
            f"{'tests' if casts else 'lighting computations'}, as {best.technique} renders it.",
        }
    ]
    fastest: dict[str, Measurement] = {}
    for m in sorted(filter(is_timed, found.measurements), key=lambda m: time_ms(m, "max")):
        if _config(m).is_exact:
            fastest.setdefault(m.technique, m)
    if casts:
        maps = {technique: workload.shadow_maps(_config(m)) for technique, m in fastest.items()}
        pictures.append(_shadows(best, workload.shadow_maps(best), folder))
        tests = {technique: own.tests for technique, own in maps.items()}
        unit = "triangles (of stencils: volume polygons) tested against a pixel's tile or cluster"
        return Drawn(pictures + _heat_maps(workload, fastest, tests, unit, "log", folder), [], "log")
    lengths = {technique: workload.list_lengths(_config(m)) for technique, m in fastest.items()}
    computations = {technique: own.of_sample for technique, own in lengths.items()}
    pictures += _heat_maps(workload, fastest, computations, "lighting computations per pixel", "linear", folder)
    pictures += _cells(workload, list(fastest.values()), folder)
    of_cluster = {technique: own.of_cluster for technique, own in lengths.items() if technique != "forward"}
    return Drawn(pictures, _histograms({t: own for t, own in of_cluster.items() if len(own)}), "linear")


def _heat_maps(
    workload: SceneWorkload,
    fastest: dict[str, Measurement],
    work: dict[str, np.ndarray],
    unit: str,
    scale: Literal["linear", "log"],
    folder: Path,
) -> list[dict[str, Any]]:
    """One picture a technique, all on one scale; `log` where tiles differ by powers of ten."""
    valid = workload.valid()
    scaled = [own for technique, own in work.items() if technique != "forward"] or list(work.values())
    largest = max((int(own.max(initial=0)) for own in scaled), default=0)
    pictures = []
    for technique, own in work.items():
        name = f"heat_{technique}.png"
        shown, top = (own, largest) if scale == "linear" else (_log(own), int(_log(np.array(largest))))
        write_png(folder / name, heat_map(shown, top, valid))
        pictures.append(
            {
                "file": name,
                "kind": "heat_map",
                "technique": technique,
                "caption": f"{unit[0].upper()}{unit[1:]}, {_config(fastest[technique])}.",
                "unit": unit,
                "max_count": int(own.max(initial=0)),
                "mean_count": float(own[valid].mean()) if valid.any() else 0.0,
                "scale_max": largest,
            }
        )
    return pictures


def _log(counts: np.ndarray) -> np.ndarray:
    """Thousandths of log(1 + count), whole."""
    return np.round(1000 * np.log1p(counts)).astype(np.int64)


def _shadows(best: Configuration, maps: ShadowMaps, folder: Path) -> dict[str, Any]:
    """What share of the lights that cast and would light it each pixel is lit by."""
    lit = maps.lit > 0
    share = 1 - maps.stopped / np.maximum(maps.lit, 1)
    write_png(folder / "shadows.png", heat_map(np.round(1000 * share).astype(np.int64), 1000, lit))
    return {
        "file": "shadows.png",
        "kind": "shadows",
        "technique": best.technique,
        "caption": "Dark in the shadow of all lights that cast and would light the pixel, bright in that of none: "
        f"{maps.share_stopped:.1%} in shadow.",
    }


def _cells(workload: SceneWorkload, fastest_first: list[Measurement], folder: Path) -> list[dict[str, Any]]:
    """Cells in random colours, depth slices, and lights listed in vain, of the first that has cells."""
    for m in fastest_first:
        config = _config(m)
        maps = workload.cell_maps(config)
        if maps is None:
            continue
        solid = workload.solid()
        deepest, in_vain = int(maps.depth_slice.max(initial=0)), int(maps.false_positives.max(initial=0))
        drawn = {
            "clusters": (random_colours(maps.cell, solid), f"Clusters in random colours, {config}."),
            "slices": (heat_map(maps.depth_slice, deepest, solid), f"Depth slices, 0 (dark) to {deepest} (bright)."),
            "false_positives": (
                heat_map(maps.false_positives, in_vain, solid),
                f"Lights listed in vain, 0 (dark) to {in_vain} (bright) a pixel: {maps.listed_in_words}.",
            ),
        }
        if not deepest:
            del drawn["slices"]  # one slice: nothing to see
        for kind, (pixels, _) in drawn.items():
            write_png(folder / f"{kind}_{m.technique}.png", pixels)
        return [
            {"file": f"{kind}_{m.technique}.png", "kind": kind, "technique": m.technique, "caption": caption}
            for kind, (_, caption) in drawn.items()
        ]
    return []


def _histograms(of_cluster: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Bins of one width for all techniques: bin `i` counts lists of `i * width` to `(i + 1) * width - 1` lights."""
    longest = max((int(own.max(initial=0)) for own in of_cluster.values()), default=0)
    width = longest // _BINS + 1
    return [
        {
            "technique": technique,
            "lists": len(own),
            "entries": int(own.sum()),
            "longest": int(own.max(initial=0)),
            "bin_width": width,
            "lists_in_bin": np.bincount(own // width, minlength=longest // width + 1).tolist(),
            "dropped_at_cap": {str(cap): int(np.maximum(own - cap, 0).sum()) for cap in CAPS},
        }
        for technique, own in of_cluster.items()
    ]


def _config(m: Measurement) -> Configuration:
    return configuration(m.technique, m.params)
