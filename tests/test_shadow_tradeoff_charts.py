"""Tables and charts of the shadow trade-off: which lines count, what is drawn, and that a failure is said."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import pytest

from benchmarks.shadow_tradeoff_charts import QUESTIONS, curves, main, rows_of, table

TIMES_MS = list(range(1, 12))  # 1 to 11: the lowest tenth is 2, the median 6


def line(branching: int, tile_px: int = 8, times_ms: list[int] | None = None, **params) -> dict:
    plan = {"tile_px": tile_px, "branching": branching, "tree": "compact", "passes": 1, "feedback": True} | params
    extra = "".join(f" {name}={value}" for name, value in params.items())
    variant = f"ptsv tile {tile_px} b {branching}{extra}"
    return {
        "key": f"hut: {variant}",
        "scene": "hut",
        "technique": "ptsv",
        "variant": variant,
        "params": plan,
        "device": "gpu: none",
        "versions": {"jax": "0"},
        "triangles": 1_200,
        "times_ms": TIMES_MS if times_ms is None else times_ms,
        "differs_from_first": 0,
        "differs_from_rays": 3,
        "counts": {
            "samples": 5_000,
            "node_tests": 2_500_000,
            "sample_tests": 400_000,
            "node_tests_0": 0,
            "node_tests_1": 500_000,
            "node_tests_2": 2_000_000,
        },
    }


@pytest.fixture
def file(tmp_path):
    lines = [
        {"key": line(32)["key"], "failed": "MemoryError: first try"},
        line(8, times_ms=[100, 100, 100]),
        line(32, times_ms=[4 * t for t in TIMES_MS]),
        line(8),  # the later line of a configuration counts
        line(8, tile_px=4),
        line(16, feedback=False),  # on no curve
        {"key": "hut: ptsv tile 8 b 2", "failed": "MemoryError: too large"},
    ]
    path = tmp_path / "gpu9" / "shadow-tradeoff-gpu.jsonl"
    path.parent.mkdir()
    path.write_text("".join(json.dumps(one) + "\n" for one in lines))
    return path


def test_a_row_says_levels_tests_and_times(file):
    text = table(rows_of(file))
    row = "| hut (1,200 triangles) | ptsv tile 8 b 8 | 2 | 2.5 | 0.4 | 6.00 | 2.00 | 11 | 0, 3 of 5,000 |"
    assert row in text.splitlines() and "100.00" not in text
    assert "b 32 | 2 | 2.5 | 0.4 | 24.00 | 8.00 |" in text


def test_only_what_never_succeeded_is_said_to_have_failed(file):
    text = table(rows_of(file))
    assert "too large" in text and "first try" not in text


def test_a_curve_holds_its_other_parameters_fixed(file):
    branching, tile_8, tile_32 = (curves(rows_of(file), question) for question in QUESTIONS)
    assert [(one.name, one.points) for one in branching] == [("hut, ptsv", [(8, 2.0), (32, 8.0)])]
    assert [one.points for one in tile_8] == [[(4, 2.0), (8, 2.0)]]
    assert tile_32 == []  # one point is no curve


def test_a_table_and_a_chart_for_each_question_with_curves_are_written(file, tmp_path):
    main([str(file), "--charts", str(tmp_path / "charts")])
    assert file.with_suffix(".md").read_text() == table(rows_of(file))
    charts = sorted((tmp_path / "charts").iterdir())
    assert [path.name for path in charts] == ["gpu9_shadow_branching.svg", "gpu9_shadow_tile_8.svg"]
    assert len(ET.parse(charts[0]).findall(".//{*}circle")) == 2
