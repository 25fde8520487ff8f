"""`vtfs tune` on a small scene, and what its run folder holds."""

import json
from pathlib import Path

from tests.command_line import SMALL, vtfs
from tuning.record import read_measurements


def tune(*arguments, scene=SMALL, out="out", space="space.toml"):
    return vtfs("tune", *scene, "--space", space, "--out", out, *arguments)


def result_of(ran, out="out"):
    assert ran.code == 0 and ran.err == "", ran
    return json.loads(Path(out, "result.json").read_text())


def lines_of(out="out"):
    return Path(out, "measurements.jsonl").read_bytes().splitlines(keepends=True)


def configurations_of(out="out"):
    return [(m.technique, tuple(m.params.items())) for m in read_measurements(Path(out, "measurements.jsonl"))]


def is_complete(result, out="out"):
    """Every key that programs rely on, every file, and a recommendation that was measured."""
    keys = "schema scene device versions seed space_size measured compiled_programs compile_s wall_s "
    keys += "default best pareto cost_models"
    assert set(keys.split()) <= set(result)
    assert {"name", "triangles", "lights", "frames"} <= set(result["scene"])
    assert {"technique", "params", "time_ms"} <= set(result["default"])
    assert {"technique", "params", "time_ms", "time_ms_interval"} <= set(result["best"])
    assert result["pareto"] and all(
        {"technique", "params", "time_ms", "error"} <= set(point) for point in result["pareto"]
    )
    model_keys = {"technique", "stage", "terms", "dropped", "coefficients", "loo_error"}
    assert all(model_keys <= set(model) for model in result["cost_models"])
    assert {"within", "crossovers", "matters", "best", "influential"} == set(result["answers"])
    assert all(isinstance(line, str) for line in result["answer_lines"])
    best = result["best"]
    low, high = best["time_ms_interval"]
    assert 0 < low <= best["time_ms"] <= high
    measured = read_measurements(Path(out, "measurements.jsonl"))
    own = [m for m in measured if (m.technique, m.params) == (best["technique"], best["params"])]
    assert len(own) == 1 and own[0].outcome == "timed"
    assert result["measured"] + result["failed"] == len(measured) == len(set(configurations_of(out)))
    for picture in result["pictures"]:
        assert Path(out, "pictures", picture["file"]).stat().st_size > 100
    assert "<html" in Path(out, "report.html").read_text()[:1000].lower()
    leftovers = [file for file in Path(out).rglob("*") if file.name.startswith(".")]
    assert leftovers == []
