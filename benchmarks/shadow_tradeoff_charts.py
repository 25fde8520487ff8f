"""Tables and charts of `python -m benchmarks.shadow_tradeoff`, drawn from its committed lines alone.

    python -m benchmarks.shadow_tradeoff_charts [FILE.jsonl ...] [--charts DIR]

Of each file (by default all `*/shadow-tradeoff-*.jsonl` here) a table `FILE.md` beside it and, for each question of
`QUESTIONS` that has two points on a curve, `charts/FOLDER_shadow_QUESTION.svg`. Times in ms from call to answer: the
median of all repeats and their lowest tenth. What else runs on the machine only adds time, so that the lowest tenth is
what the charts show; where the median is far above it the run was disturbed.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.papers_charts import Line, chart

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Question:
    """A curve for each scene and technique: `x` varies, the parameters of `fixed` do not."""

    name: str
    x: str
    x_title: str
    fixed: dict[str, int]


QUESTIONS = (
    Question("branching", "branching", "children of a node, tiles of 8 pixels", {"tile_px": 8}),
    Question("tile_8", "tile_px", "tile, pixels, 8 children of a node", {"branching": 8}),
    Question("tile_32", "tile_px", "tile, pixels, 32 children of a node", {"branching": 32}),
)
PLAIN = {"tree": "compact", "passes": 1, "feedback": True}
"""Of every curve; what `shadow_tradeoff` changes besides is a row of the table alone."""


def rows_of(path: Path) -> list[dict[str, Any]]:
    """The last line of each configuration; one that failed counts only where it never succeeded."""
    lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
    failed = {line["key"]: line for line in lines if "failed" in line}
    return list((failed | {line["key"]: line for line in lines if "failed" not in line}).values())


def low_ms(row: dict[str, Any]) -> float:
    """The lowest tenth of the repeats."""
    return float(np.percentile(row["times_ms"], 10))


def table(rows: list[dict[str, Any]]) -> str:
    """All configurations, in Markdown; tests in millions."""
    done = sorted((row for row in rows if "failed" not in row), key=_place)
    devices = sorted({f"{row['device']}, jax {row['versions']['jax']}" for row in done})
    out = [
        *devices,
        "",
        "| scene | variant | levels with tests | node tests, M | sample tests, M | median, ms | lowest tenth, ms | "
        "repeats | samples unlike the first variant, unlike Embree |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in done:
        counts = row["counts"]
        levels = sum(count > 0 for name, count in counts.items() if name.startswith("node_tests_"))
        cells = [
            f"{row['scene']} ({row['triangles']:,} triangles)",
            row["variant"],
            str(levels),
            f"{counts['node_tests'] / 1e6:.1f}",
            f"{counts['sample_tests'] / 1e6:.1f}",
            f"{np.median(row['times_ms']):.2f}",
            f"{low_ms(row):.2f}",
            str(len(row["times_ms"])),
            f"{row['differs_from_first']}, {row['differs_from_rays']} of {counts['samples']:,}",
        ]
        out.append(f"| {' | '.join(cells)} |")
    out += [f"- {row['key']}: failed: {row['failed']}" for row in rows if "failed" in row]
    return "\n".join(out) + "\n"


def _place(row: dict[str, Any]) -> tuple:
    sizes = row["params"]["tile_px"], row["params"]["branching"]
    return row["triangles"], row["scene"], row["technique"], *sizes, row["variant"]


def curves(rows: list[dict[str, Any]], question: Question) -> list[Line]:
    """Those with two points and more, in the order of the rows."""
    points: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if "failed" in row or any(row["params"][k] != v for k, v in (PLAIN | question.fixed).items()):
            continue
        name = f"{row['scene']}, {row['technique'].replace('cluster_hierarchy', 'clusters')}"
        points.setdefault(name, []).append((row["params"][question.x], low_ms(row)))
    return [Line(name, sorted(where)) for name, where in points.items() if len(where) > 1]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--charts", type=Path, default=HERE / "charts")
    given = parser.parse_args(arguments)
    given.charts.mkdir(parents=True, exist_ok=True)
    for path in given.files or sorted(HERE.glob("*/shadow-tradeoff-*.jsonl")):
        rows, folder = rows_of(path), path.resolve().parent.name
        path.with_suffix(".md").write_text(table(rows), "utf-8")
        print(f"{path.with_suffix('.md')}: {len(rows)} configurations")
        for question in QUESTIONS:
            if lines := curves(rows, question):
                to = given.charts / f"{folder}_shadow_{question.name}.svg"
                title = f"Shadow masks: {folder.upper()}, view samples to mask"
                to.write_text(chart(title, question.x_title, "lowest tenth, ms", lines, log_x=True), "utf-8")
                print(f"{to}: {', '.join(line.name for line in lines)}")


if __name__ == "__main__":
    main()
