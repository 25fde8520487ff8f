"""The pictures of a run, and how long the lists of its techniques are."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tuning.choose import is_timed, time_ms
from tuning.measurement import Measurement
from tuning.sweep import SearchResult
from tuning.workload import SceneWorkload
from vtfs.image import exposure, heat_map, random_colours, tone_map, write_png
from vtfs.op_counts import CAPS
from vtfs.parameters import Configuration, configuration

_BINS = 24


@dataclass(frozen=True)
class Drawn:
    """What `result.json` lists: files in the folder, and list lengths of each technique."""

    pictures: list[dict[str, Any]]
    list_lengths: list[dict[str, Any]]


def draw(workload: SceneWorkload, found: SearchResult, folder: Path) -> Drawn:
    """Write the best configuration's image, heat maps of lighting computations on one scale, and the cells of the
    fastest technique that has any; all of the frame with the most work.

    **Returns:** also, for each technique whose cells have lists, a histogram of their lengths and what engines that cap
    them would drop.
    """
    valid = workload.valid()
    image = workload.image(_config(found.best))
    write_png(folder / "frame.png", tone_map(image, exposure(image, valid)))
    pictures: list[dict[str, Any]] = [
        {
            "file": "frame.png",
            "kind": "frame",
            "technique": found.best.technique,
            "caption": f"Frame {workload.frames[0]}, the one with the most lighting computations, "
            f"as {found.best.technique} renders it.",
        }
    ]
    fastest: dict[str, Measurement] = {}
    for m in found.measurements:
        if is_timed(m) and _config(m).is_exact:
            fastest[m.technique] = min(fastest.get(m.technique, m), m, key=lambda m: time_ms(m, "max"))
    lengths = {technique: workload.list_lengths(_config(m)) for technique, m in fastest.items()}
    listed = [own for technique, own in lengths.items() if technique != "forward"] or list(lengths.values())
    largest = max((int(own.of_sample.max(initial=0)) for own in listed), default=0)
    for technique, own in lengths.items():
        name = f"heat_{technique}.png"
        write_png(folder / name, heat_map(own.of_sample, largest, valid))
        pictures.append(
            {
                "file": name,
                "kind": "heat_map",
                "technique": technique,
                "caption": f"Lighting computations per pixel, {_config(fastest[technique])}.",
                "max_count": int(own.of_sample.max(initial=0)),
                "mean_count": float(own.of_sample[valid].mean()) if valid.any() else 0.0,
                "scale_max": largest,
            }
        )
    pictures += _cells(workload, sorted(fastest.values(), key=lambda m: time_ms(m, "max")), folder)
    of_cluster = {technique: own.of_cluster for technique, own in lengths.items() if technique != "forward"}
    return Drawn(pictures, _histograms({t: own for t, own in of_cluster.items() if len(own)}))


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
                f"Lights listed in vain, 0 (dark) to {in_vain} (bright) a pixel: {maps.listed_per_reaching:.2f} are "
                "listed for one that reaches.",
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
