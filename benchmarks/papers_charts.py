"""Charts of the papers' experiments as SVG, drawn from the committed figures alone.

    python benchmarks/papers_charts.py

Reads the Markdown tables in `h200/` and `cpu/`, and the published table in `../shared/published` where it is there;
writes `charts/*.svg`.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from html import escape
from pathlib import Path

HERE = Path(__file__).parent
PUBLISHED = HERE.parents[1] / "shared" / "published" / "olsson_2012_light_assignment_scaling.csv"
COLOURS = ("#2e5fa3", "#c47a4a", "#3f8f6b", "#8a5fa8", "#b0413e", "#6b7680")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 720, 420, 70, 200, 48, 56


@dataclass(frozen=True)
class Line:
    """One curve; what is on a logarithmic axis is above 0."""

    name: str
    points: list[tuple[float, float]]
    is_dashed: bool = False


def table(path: Path, title: str) -> list[dict[str, str]]:
    """The rows of the first table after a heading that starts with `title`; none where the file lacks it."""
    if not path.is_file():
        return []
    lines = path.read_text("utf-8").splitlines()
    start = next((i for i, line in enumerate(lines) if line.startswith(f"### {title}")), None)
    if start is None:
        return []
    body = []
    for line in lines[start + 1 :]:
        if line.startswith("|"):
            body.append([cell.strip() for cell in line.strip("|").split("|")])
        elif body:
            break
    return [dict(zip(body[0], row, strict=True)) for row in body[2:]]


def number(cell: str) -> float:
    """NaN for what failed or was not run."""
    try:
        return float(cell.replace(",", ""))
    except ValueError:
        return math.nan


def columns(rows: list[dict[str, str]], x: str, names: dict[str, str]) -> list[Line]:
    """One line for each column of `names`, which also says how it is called."""
    lines = []
    for column, name in names.items():
        points = [(number(row[x]), number(row[column])) for row in rows]
        lines.append(Line(name, [(a, b) for a, b in points if a >= 0 and b > 0]))
    return [line for line in lines if line.points]


def chart(title: str, x_title: str, y_title: str, lines: list[Line], log_x: bool) -> str:
    """An SVG with a logarithmic y axis and the names of the lines at its right."""
    xs = [x for line in lines for x, _ in line.points]
    ys = [y for line in lines for _, y in line.points]
    y_low, y_high = math.floor(math.log10(min(ys))), math.ceil(math.log10(max(ys)))
    x_of = math.log10 if log_x else float
    x_low, x_high = x_of(min(xs)), x_of(max(xs))

    def at(x: float, y: float) -> tuple[float, float]:
        across = (x_of(x) - x_low) / ((x_high - x_low) or 1)
        up = (math.log10(y) - y_low) / ((y_high - y_low) or 1)
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" '
        'font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
        f'<text x="{LEFT}" y="24" font-size="15" font-weight="bold">{escape(title)}</text>',
    ]
    for decade in range(y_low, y_high + 1):
        _, y = at(min(xs), 10.0**decade)
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e3e6e8"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{10.0**decade:g}</text>')
    for x in sorted(set(xs)):
        place, _ = at(x, 10.0**y_low)
        parts.append(
            f'<text x="{place:.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle" font-size="10">{_short(x)}</text>'
        )
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 14}" text-anchor="middle">{escape(x_title)}</text>')
    up = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="18" y="{up}" text-anchor="middle" transform="rotate(-90 18 {up})">{escape(y_title)}</text>')
    for i, line in enumerate(lines):
        colour, dash = COLOURS[i % len(COLOURS)], ' stroke-dasharray="6 4"' if line.is_dashed else ""
        placed = [at(x, y) for x, y in sorted(line.points)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in placed)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="2"{dash}/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in placed]
        key = TOP + 18 * i
        parts.append(
            f'<line x1="{WIDTH - RIGHT + 14}" x2="{WIDTH - RIGHT + 38}" y1="{key}" y2="{key}" stroke="{colour}" '
            f'stroke-width="2"{dash}/><text x="{WIDTH - RIGHT + 44}" y="{key + 4}">{escape(line.name)}</text>'
        )
    return "\n".join([*parts, "</svg>"]) + "\n"


def _short(x: float) -> str:
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if x >= factor:
            return f"{x / factor:.3g}{letter}"
    return f"{x:g}"


def published_assignment() -> list[Line]:
    """Table 2 of 2012, a GTX 480."""
    if not PUBLISHED.is_file():
        return []
    with PUBLISHED.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = {"clustered_bvh": "2012, clustered", "tiled_brute_force": "2012, tiled"}
    return [
        Line(
            name,
            [(float(r["num_lights"]), float(r["milliseconds"])) for r in rows if r["technique"] == technique],
            is_dashed=True,
        )
        for technique, name in names.items()
    ]


def write(name: str, title: str, x_title: str, y_title: str, lines: list[Line], log_x: bool = True) -> None:
    if not lines:
        print(f"{name}: no figures")
        return
    (HERE / "charts").mkdir(exist_ok=True)
    (HERE / "charts" / f"{name}.svg").write_text(chart(title, x_title, y_title, lines, log_x), "utf-8")
    print(f"charts/{name}.svg: {', '.join(line.name for line in lines)}")


RAMP = {name: name for name in ("forward", "deferred", "deferred_stencil", "tiled_deferred", "clustered_forward")}
ASSIGNMENT = {"clustered, tree": "tree", "clustered, groups": "groups", "tiled, brute force": "tiled, brute force"}
COMPUTATIONS = {
    "tiled": "tiled",
    "clustered": "clustered",
    "explicit": "explicit bounds",
    "explicit, normals": "explicit, normals",
}


def main() -> None:
    for device in ("h200", "cpu"):
        for path in sorted((HERE / device).glob("papers_*.md")):
            scene = path.stem.removeprefix("papers_")
            where = f"{scene}, {'H200' if device == 'h200' else 'two CPU cores'}"
            rows = table(path, "Frame time in ms against the number")
            write(
                f"{device}_ramp_{scene}",
                f"Small lights (2011, Fig. 4): {where}",
                "lights",
                "frame, ms",
                columns(rows, "lights", RAMP) if rows else [],
                log_x=False,
            )
            rows = table(path, "Lighting computations, tiled and clustered")
            rows = [row for row in rows if row["geometry"] == "all"]
            known = {column: name for column, name in COMPUTATIONS.items() if rows and column in rows[0]}
            write(
                f"{device}_computations_{scene}",
                f"Lighting computations (2012, Fig. 12): {where}",
                "frame of the path",
                "lighting computations",
                columns(rows, "frame", known),
                log_x=False,
            )
            rows = table(path, "Light assignment in ms")
            lines = columns(rows, "lights", ASSIGNMENT) if rows else []
            title = f"Light assignment (2012, table 2): {where}"
            write(
                f"{device}_assignment_{scene}",
                title,
                "lights",
                "ms",
                [*lines, *published_assignment()] if lines else [],
            )
            rows = table(path, "Volume tiled shading in ms")
            for volume in ("constant", "fixed"):
                own = [row for row in rows if row["volume"] == volume]
                names = {
                    "lists, brute force": "lists, brute force",
                    "lists, tree and its build": "lists, tree",
                    "frame, tree": "frame, tree",
                }
                kind = "a constant volume" if volume == "constant" else "one light a cubic metre"
                write(
                    f"{device}_volume_{volume}_{scene}",
                    f"Volume tiled (2017), {kind}: {where}",
                    "lights",
                    "ms",
                    columns(own, "lights", names) if own else [],
                )


if __name__ == "__main__":
    main()
