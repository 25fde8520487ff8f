"""A run folder as `vtfs tune` leaves it, made up: 24 measurements of three techniques, two of which failed.

The times come from a formula with noise, so that tables and charts have the shape of real ones.
"""

from __future__ import annotations

import io
import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from vtfs.image import heat_map, random_colours

Params = dict[str, Any]

SAMPLES = 908_412
FRAMES = (17, 40, 3)
DEVICE = "cpu: AMD EPYC 9654 (2 cores)"
VERSIONS = {"vtfs": "0.1.0", "jax": "0.10.2", "jaxlib": "0.10.2", "numpy": "2.4.6", "python": "3.11.9"}
WIDTH_PX, HEIGHT_PX = 320, 180

_ERROR = {"float32": 3.1e-8, "float16": 2.4e-4, "bfloat16": 2.3e-3}
_BYTES = {"float32": 1.0, "float16": 0.93, "bfloat16": 0.95}


@dataclass(frozen=True)
class Files:
    """What is written: change it, then write it."""

    result: dict[str, Any]
    measurements: list[dict[str, Any]]
    pictures: dict[str, bytes]

    def write(self, folder: Path) -> Path:
        """Write the three kinds of file into a folder that may not exist yet."""
        (folder / "pictures").mkdir(parents=True, exist_ok=True)
        (folder / "result.json").write_text(json.dumps(self.result), encoding="utf-8")
        lines = "".join(json.dumps(line) + "\n" for line in self.measurements)
        (folder / "measurements.jsonl").write_text(lines, encoding="utf-8")
        for name, data in self.pictures.items():
            (folder / "pictures" / name).write_bytes(data)
        return folder


def complete_run() -> Files:
    """A run that went well: `volume_tiled_bvh` wins clearly."""
    rng = np.random.default_rng(0)
    space = _space()
    measured = [space[i] for i in _measured_indices(space, rng)]
    lines = [_line(technique, params, rng) for technique, params in measured]
    _fail(lines[9], "out_of_memory", "RESOURCE_EXHAUSTED: Out of memory allocating 6442450944 bytes.")
    _fail(lines[20], "failed", "XlaRuntimeError: INTERNAL: the walk needs <more> than 64 levels & stopped")
    timed = [line for line in lines if line["outcome"] == "timed"]
    exact = [line for line in timed if line["error"] < 1e-7]
    best = min(exact, key=_time_ms)
    defaults = [line for line in timed if (line["technique"], line["params"]) in _defaults()]
    default = next(line for line in defaults if line["technique"] == best["technique"])
    fastest_default = min(defaults, key=_time_ms)
    by_key = {_key(line["technique"], line["params"]): line for line in timed}
    predictions = []
    for technique, params in space:
        predicted = sum(_stages_ms(technique, params).values()) * 0.94 * math.exp(rng.normal(0, 0.05))
        line = by_key.get(_key(technique, params))
        predictions.append(
            {
                "technique": technique,
                "params": params,
                "predicted_ms": predicted,
                "low_ms": predicted * 0.88,
                "high_ms": predicted * 1.13,
                "measured_ms": _time_ms(line) if line else None,
            }
        )
    result = {
        "schema": 1,
        "command": "vtfs tune --lights 1000 --size 1280x720 --seed 0",
        "scene": {
            "name": "atrium", "triangles": 250_112, "lights": 1000, "frames": 60, "key": "9f2c61" + "0" * 58,
            "viewport": [1280, 720], "measured_frames": list(FRAMES),
        },
        "device": DEVICE,
        "versions": VERSIONS,
        "seed": 0,
        "space_size": len(space),
        "measured": len(lines),
        "failed": len(lines) - len(timed),
        "compiled_programs": 33,
        "compile_s": 41.0,
        "wall_s": 120.3,
        "stop_reason": "predicted gain 1.2 % is inside the noise (3.4 %)",
        "objective": "max",
        "max_error": None,
        "default": _timed(default),
        "fastest_default": _timed(fastest_default),
        "best": {**_timed(best), "error": best["error"]},
        "gain": _gain(best, default, fastest_default),
        "pareto": [
            {key: value for key, value in {**_timed(line), "error": line["error"]}.items() if "interval" not in key}
            for line in timed
            if not any(_time_ms(o) <= _time_ms(line) and o["error"] < line["error"] for o in timed)
            and not any(_time_ms(o) < _time_ms(line) and o["error"] <= line["error"] for o in timed)
        ],
        "not_measured": [
            {
                "technique": "forward",
                "reason": "only its default: counts say 908,412,000 lighting computations, 24 times the least",
            }
        ],
        "answer_lines": ["Predicted best:", "  volume_tiled_bvh: tile_px 16 <of> 24"],
        "cost_models": _cost_models(),
        "predictions": predictions,
        "counts": {
            "forward": {"samples": SAMPLES, "lighting_computations": SAMPLES * 1000, "bytes_moved": 41_000_000},
            "tiled_deferred": {
                "samples": SAMPLES, "cells_total": 920, "clusters_occupied": 914, "light_cluster_pairs": 131_020,
                "leaf_tests": 914_000, "lighting_computations": 118_200_311, "bytes_moved": 62_100_000,
            },
            "volume_tiled_bvh": {
                "samples": SAMPLES, "cells_total": 190_440, "clusters_occupied": 3_105, "light_cluster_pairs": 148_774,
                "tree_tests": 412_008, "leaf_tests": 1_020_442, "lighting_computations": 38_114_907,
                "bytes_moved": 88_400_000, "divergence": 51_203_392,
            },
        },
        "stages": {
            technique: {**stages, "frame": 0.94 * sum(stages.values())}
            for technique, stages in (
                ("forward", _stages_ms("forward", _FORWARD_DEFAULT)),
                ("tiled_deferred", _stages_ms("tiled_deferred", _TILED_DEFAULT)),
                ("volume_tiled_bvh", _stages_ms("volume_tiled_bvh", best["params"])),
            )
        },
        "pictures": [
            {"file": "frame.png", "kind": "frame", "technique": "forward", "caption": "Frame 17, the heaviest."},
            *(
                {
                    "file": f"heat_{technique}.png", "kind": "heat_map", "technique": technique, "caption": "",
                    "max_count": int(_heat(technique).max()), "mean_count": float(_heat(technique).mean()),
                }
                for technique in ("tiled_deferred", "volume_tiled_bvh")
            ),
            *(
                {"file": f"{kind}.png", "kind": kind, "technique": "volume_tiled_bvh", "caption": f"Of {kind}."}
                for kind in ("clusters", "slices", "false_positives")
            ),
        ],
        "list_lengths": [
            {
                "technique": "tiled_deferred", "lists": 914, "entries": 131_020, "longest": 239, "bin_width": 60,
                "lists_in_bin": [210, 302, 280, 122], "dropped_at_cap": {"32": 104_000, "64": 77_000, "128": 31_000},
            },
            {
                "technique": "volume_tiled_bvh", "lists": 3_105, "entries": 148_774, "longest": 118, "bin_width": 60,
                "lists_in_bin": [2_001, 1_104], "dropped_at_cap": {"32": 51_000, "64": 9_100, "128": 0},
            },
        ],
        "claim": "for this JAX implementation on this device; nothing is rasterised: frame times start at view samples",
    }  # fmt: skip
    top, everywhere = int(_heat("tiled_deferred").max()), np.ones((HEIGHT_PX, WIDTH_PX), bool)
    pictures = {
        "frame.png": _png(_frame()),
        "heat_tiled_deferred.png": _png(heat_map(_heat("tiled_deferred"), top, everywhere)),
        "heat_volume_tiled_bvh.png": _png(heat_map(_heat("volume_tiled_bvh"), top, everywhere)),
        "clusters.png": _png(random_colours(_heat("volume_tiled_bvh") // 8, everywhere)),
        "slices.png": _png(heat_map(_heat("volume_tiled_bvh"), top, everywhere)),
        "false_positives.png": _png(heat_map(_heat("tiled_deferred") // 4, top, everywhere)),
    }
    return Files(result, lines, pictures)


def run_inside_the_noise() -> Files:
    """A run whose best is as fast as the defaults, as far as the measurements can tell."""
    files = complete_run()
    best, default = files.result["best"], files.result["default"]
    for timed in (default, files.result["fastest_default"]):
        timed |= {"technique": best["technique"], "params": _VOLUME_DEFAULT, "time_ms": best["time_ms"] * 1.02}
        timed["time_ms_interval"] = [timed["time_ms"] * 0.97, timed["time_ms"] * 1.03]
    files.result["gain"] = {
        "over_default": 1.02, "over_default_interval": [0.98, 1.06],
        "over_fastest_default": 1.02, "over_fastest_default_interval": [0.98, 1.06],
    }  # fmt: skip
    return files


def run_without_times() -> Files:
    """A run in which everything failed."""
    files = complete_run()
    for line in files.measurements:
        _fail(line, "out_of_memory", "RESOURCE_EXHAUSTED")
    files.result.update(dict.fromkeys(("default", "fastest_default", "best", "gain")))
    empty = {
        "pareto": [],
        "cost_models": [],
        "predictions": [],
        "stages": {},
        "counts": {},
        "pictures": [],
        "list_lengths": [],
    }
    files.result.update(empty)
    files.result["failed"] = len(files.measurements)
    return files


def run_of_one() -> Files:
    """A run that measured one default and stopped."""
    files = complete_run()
    files.measurements[:] = [line for line in files.measurements if line["params"] == _VOLUME_DEFAULT]
    timed = {**_timed(files.measurements[0]), "error": files.measurements[0]["error"]}
    changes = {"default": timed, "fastest_default": timed, "best": timed, "pareto": [timed], "predictions": []}
    files.result.update(changes)
    files.result["gain"] = {
        "over_default": 1.0, "over_default_interval": None, "over_fastest_default": 1.0,
        "over_fastest_default_interval": None,
    }  # fmt: skip
    return files


_FORWARD_DEFAULT: Params = {"batch": 0, "gbuffer": "float32", "light_cutoff": 0.0}
_TILED_DEFAULT: Params = {"tile_px": 32, "batch": 0, "gbuffer": "float32", "light_cutoff": 0.0}
_VOLUME_DEFAULT: Params = {
    "tile_px": 32, "depth_slices": 0, "branching": 32, "batch": 0, "bounds": "implicit", "gbuffer": "float32",
    "light_cutoff": 0.0,
}  # fmt: skip


def _defaults() -> list[tuple[str, Params]]:
    return [
        ("forward", _FORWARD_DEFAULT),
        ("tiled_deferred", _TILED_DEFAULT),
        ("volume_tiled_bvh", _VOLUME_DEFAULT),
    ]


def _space() -> list[tuple[str, Params]]:
    tiles, gbuffers, cutoffs = (8, 16, 32, 64, 128), ("float32", "float16", "bfloat16"), (0.0, 0.02)
    tiled = [
        ("tiled_deferred", _TILED_DEFAULT | {"tile_px": tile, "gbuffer": gbuffer, "light_cutoff": cutoff})
        for tile, gbuffer, cutoff in itertools.product(tiles, gbuffers, cutoffs)
    ]
    volume = [
        (
            "volume_tiled_bvh",
            _VOLUME_DEFAULT
            | {"tile_px": t, "depth_slices": s, "branching": b, "gbuffer": gbuffer, "light_cutoff": cutoff},
        )
        for t, s, b, gbuffer, cutoff in itertools.product(tiles, (0, 16, 32, 64), (8, 16, 32), gbuffers, cutoffs)
    ]
    return [("forward", _FORWARD_DEFAULT), *tiled, *volume]


def _measured_indices(space: Sequence[tuple[str, Params]], rng: np.random.Generator) -> list[int]:
    """The defaults, a random design, and the predicted best of each precision."""
    chosen = [space.index(default) for default in _defaults()]
    cheapest = sorted(range(len(space)), key=lambda i: sum(_stages_ms(*space[i]).values()))
    exact = [i for i in cheapest if space[i][1]["gbuffer"] == "float32" and space[i][1]["light_cutoff"] == 0]
    rest = [int(i) for i in rng.permutation(len(space))]
    tiled = [i for i in rest if space[i][0] == "tiled_deferred"][:6]
    for i in [*tiled, *rest[:8], *cheapest[:3], *exact[:4], *rest[8:]]:
        if i not in chosen and len(chosen) < 24:
            chosen.append(i)
    return chosen


def _stages_ms(technique: str, params: Params) -> dict[str, float]:
    """By hand, from the shape that the costs have: small tiles cost lists, large ones cost shading."""
    scale = _BYTES[params["gbuffer"]] * (0.86 if params["light_cutoff"] else 1.0)
    if technique == "forward":
        return {"shade_opaque": 2_110.0 * scale}
    tile = params["tile_px"]
    if technique == "tiled_deferred":
        lights = 17 + 1.0 * tile
        return {"clusters": 4.2, "assign": 9.0 + 20_000 / tile**2, "shade_opaque": 1.9e-6 * SAMPLES * lights * scale}
    slices = params["depth_slices"] or 96
    lights = 7 + 0.6 * tile + 330 / slices
    clusters = 300 * (32 / tile) ** 1.5 * slices**0.8
    branching = params["branching"]
    return {
        "clusters": 14.0 + 0.0006 * clusters,
        "reduce": 3.0,
        "morton": 0.6,
        "sort": 1.3,
        "build_tree": 1.1,
        "assign": 6.0 + 0.0021 * clusters * (0.8 + abs(math.log2(branching / 16)) * 0.9),
        "shade_opaque": 1.9e-6 * SAMPLES * lights * scale,
    }


def _line(technique: str, params: Params, rng: np.random.Generator) -> dict[str, Any]:
    work = (1.0, 0.72, 0.41)  # of the three frames
    stages = _stages_ms(technique, params)
    stages["frame"] = 0.94 * sum(stages.values())
    noise = rng.normal(0, 0.03)
    return {
        "schema": 1,
        "technique": technique,
        "params": params,
        "scene_key": "9f2c61" + "0" * 58,
        "frames": list(FRAMES),
        "seed": 0,
        "outcome": "timed",
        "compile_s": float(rng.uniform(0.2, 3.5)),
        "stages_ms": {
            stage: [[value * part * math.exp(noise + rng.normal(0, 0.008)) for _ in range(5)] for part in work]
            for stage, value in stages.items()
        },
        "counts": [
            {"samples": SAMPLES, "lighting_computations": int(stages["shade_opaque"] * part / 1.9e-6)} for part in work
        ],
        "error": _ERROR[params["gbuffer"]] + (8.7e-4 if params["light_cutoff"] else 0.0),
        "error_p999": 4 * _ERROR[params["gbuffer"]],
        "device": DEVICE,
        "versions": VERSIONS,
        "load": 0.12,
        "message": "",
    }


def _fail(line: dict[str, Any], outcome: str, message: str) -> None:
    line |= {"outcome": outcome, "message": message, "stages_ms": {}, "counts": [], "error": None, "error_p999": None}


def _time_ms(line: dict[str, Any]) -> float:
    return max(float(np.median(repeats)) for repeats in line["stages_ms"]["frame"])


def _timed(line: dict[str, Any]) -> dict[str, Any]:
    time_ms = _time_ms(line)
    return {
        "technique": line["technique"],
        "params": line["params"],
        "time_ms": time_ms,
        "time_ms_interval": [time_ms * 0.985, time_ms * 1.017],
    }


def _gain(best: dict[str, Any], default: dict[str, Any], fastest_default: dict[str, Any]) -> dict[str, Any]:
    over_default, over_fastest = _time_ms(default) / _time_ms(best), _time_ms(fastest_default) / _time_ms(best)
    return {
        "over_default": over_default,
        "over_default_interval": [0.97 * over_default, 1.03 * over_default],
        "over_fastest_default": over_fastest,
        "over_fastest_default_interval": [0.97 * over_fastest, 1.03 * over_fastest],
    }


def _cost_models() -> list[dict[str, Any]]:
    def model(technique, stage, coefficients, dropped, loo_error, constant_loo_error, n) -> dict[str, Any]:
        return {
            "technique": technique,
            "stage": stage,
            "terms": [name for name in coefficients if name != "fixed_ms"],
            "dropped": [{"term": term, "loo_error": error} for term, error in dropped],
            "coefficients": coefficients,
            "loo_error": loo_error,
            "n": n,
            "constant_loo_error": constant_loo_error,
        }

    listing = {"fixed_ms": 8.7, "leaf_tests": 6.4e-5}
    shading = {"fixed_ms": 2.1, "lighting_computations": 1.87e-6}
    without = [("samples", 0.061), ("light_cluster_pairs", 0.058)]
    return [
        model("tiled_deferred", "assign", listing, [("cells_total", 0.081)], 0.07, 0.9, 24),
        model("tiled_deferred", "shade_opaque", shading, without, 0.052, 0.44, 24),
        model("volume_tiled_bvh", "clusters", {"fixed_ms": 14.2}, [("clusters_occupied", 0.031)], 0.028, 0.028, 36),
        model(
            "volume_tiled_bvh", "assign", {"fixed_ms": 5.9, "tree_tests": 9.1e-6, "leaf_tests": 3.3e-6},
            [("light_cluster_pairs", 0.101)], 0.093, 0.71, 36,
        ),
        model("volume_tiled_bvh", "shade_opaque", shading, without, 0.049, 0.38, 36),
    ]  # fmt: skip


def _key(technique: str, params: Params) -> str:
    return technique + json.dumps(params, sort_keys=True)


def _heat(technique: str) -> np.ndarray:
    """Lights per pixel: constant over tiles, falling off from the middle."""
    tile = 8 if technique == "tiled_deferred" else 3
    y, x = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX]
    x, y = x // tile * tile / WIDTH_PX - 0.5, y // tile * tile / HEIGHT_PX - 0.45
    crowd = np.exp(-6 * (x * x + 1.6 * y * y)) * (1 + 0.35 * np.sin(19 * x) * np.cos(23 * y))
    return np.round(crowd * (143 if technique == "tiled_deferred" else 61))


def _frame() -> np.ndarray:
    y, x = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX]
    u, v = x / WIDTH_PX - 0.5, y / HEIGHT_PX - 0.5
    light = np.exp(-9 * (u * u + v * v)) + 0.15 * (np.sin(60 * u) > 0.7)
    shares = np.stack([light, 0.78 * light, 0.55 * light + 0.05], axis=-1)
    return (255 * np.clip(shares, 0, 1)).astype(np.uint8)


def _png(rgb: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "PNG")
    return buffer.getvalue()
