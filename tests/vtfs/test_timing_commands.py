"""`vtfs fit`, `predict`, `convert` and `tune --measurements`, as they are typed."""

import csv
import json
from pathlib import Path

import pytest

from tests.command_line import SMALL, is_refused, vtfs

LIGHTS = (100, 200, 400, 800, 1600, 3200)


def shade_us(lights: int) -> float:
    return 500 + 3 * lights


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    """A CSV file of an engine: microseconds, two repeats, a row that was not timed, and a note."""
    path = tmp_path_factory.mktemp("engine") / "engine.csv"
    lines = ["frame,light_count,gpu,note,shade_us"]
    for turn in (0.998, 1.002):
        lines += [f"0,{lights},A GPU,{turn},{shade_us(lights) * turn}" for lights in LIGHTS]
    path.write_text("\n".join([*lines, "0,6400,A GPU,0,", ""]))
    return path


@pytest.fixture(scope="module")
def model(engine):
    path = engine.parent / "model.json"
    ran = vtfs("fit", engine, "--time", "shade_us", "--ignore", "note", "--json", path)
    assert ran.code == 0, ran
    return path, ran.out


def test_fit_prints_costs_with_intervals_and_what_was_skipped(model):
    path, out = model
    assert "6 rows, 1 model" in out and "1 row has no time" in out and "frame" in out.splitlines()[1]
    assert "gpu A GPU" in out and "(fixed)" in out and "light_count" in out and " to " in out and "%" in out
    assert str(path) in out.splitlines()[-1]


def test_predictions_are_in_the_order_of_the_rows(model, tmp_path):
    rows = tmp_path / "new.csv"
    # The one GPU that there is need not be named; a column more does no harm.
    rows.write_text("light_count,weather\n1600,x\n100,y\n400,y\n25600,y\n")
    found = vtfs("predict", model[0], rows, "--json", "-").json["predictions"]
    assert [set(entry) for entry in found] == [{"time_ms", "low", "high", "extrapolated"}] * 4
    for entry, lights in zip(found[:3], (1600, 100, 400), strict=True):
        assert entry["time_ms"] == pytest.approx(shade_us(lights) / 1e3, rel=0.02)  # the repeats differ by 0.4 %
        assert entry["low"] <= entry["time_ms"] <= entry["high"] and not entry["extrapolated"]
    assert found[3]["extrapolated"]


def test_predictions_are_written_beside_the_rows(model, engine, tmp_path):
    out = tmp_path / "predicted.csv"
    ran = vtfs("predict", model[0], engine, "--ignore", "note", "--out", out)
    assert ran.code == 0 and f"13 predictions: {out}" in ran.out
    rows = rows_of(out)
    assert [row["light_count"] for row in rows[:7]] == ["100", "200", "400", "800", "1600", "3200", "100"]
    assert float(rows[0]["low_ms"]) <= float(rows[0]["predicted_ms"]) <= float(rows[0]["high_ms"])
    assert rows[-1]["light_count"] == "6400" and rows[-1]["extrapolated"] == "1" and rows[0]["extrapolated"] == "0"


def test_predictions_can_be_read_on_a_terminal(model, engine):
    ran = vtfs("predict", model[0], engine)
    assert ran.code == 0 and "extrapolated" in ran.out and ran.out.count("\n") == 14


def test_a_label_that_looks_like_a_number_stays_one(tmp_path):
    (tmp_path / "t.csv").write_text("build,ms\n12,1\n12,1.01\n13,2\n13,2.02\n")
    (tmp_path / "map.toml").write_text('labels = ["build"]\n')
    model = tmp_path / "model.json"
    assert "2 models" in vtfs("fit", tmp_path / "t.csv", "--map", tmp_path / "map.toml", "--json", model).out
    (tmp_path / "new.csv").write_text("build\n13\n12\n")
    found = vtfs("predict", model, tmp_path / "new.csv", "--json", "-").json["predictions"]
    assert [entry["time_ms"] for entry in found] == pytest.approx([2.01, 1.005], rel=0.01)


def test_what_the_models_answer_is_printed_and_written(tmp_path):
    """`a` takes 1 ms and 0.01 a light, `b` 5 ms and 0.002: they cross at 500 lights."""
    rows = [f"{t},{n},{fixed + n * each}" for t, fixed, each in (("a", 1, 0.01), ("b", 5, 0.002)) for n in SIZES]
    (tmp_path / "t.csv").write_text("\n".join(["technique,lights,time_ms", *rows]))
    ran = vtfs("fit", tmp_path / "t.csv", "--json", tmp_path / "model.json")
    assert ran.code == 0
    written = json.loads((tmp_path / "model.json").read_text())["answers"]
    (crossing,) = written["crossovers"]
    # Exact rows: what is left is the grid of 512 sizes, a per cent apart, between which the gap is taken as a line.
    assert crossing["value"] == pytest.approx(500, rel=1e-3)
    assert f"a and b at {crossing['value']:,.4g} lights" in ran.out
    assert "What matters" in ran.out and "Rows that move predictions most" in ran.out
    # The model is read back with its answers beside it.
    (tmp_path / "new.csv").write_text("technique,lights\na,400\n")
    ran = vtfs("predict", tmp_path / "model.json", tmp_path / "new.csv", "--json", "-")
    assert json.loads(ran.out)["predictions"][0]["time_ms"] == pytest.approx(5.0, rel=1e-3)


SIZES = (50, 100, 200, 400, 800, 1600, 3200, 6400)


def test_a_published_table_is_fitted_offline(tmp_path):
    ran = vtfs("fit", "--published", "olsson_2012", "--where", "technique=tiled_brute_force")
    assert ran.code == 0 and "4 rows, 1 model" in ran.out and "lights" in ran.out


def test_a_file_goes_round_every_format(engine, tmp_path):
    """CSV to T4 to a Kernel Tuner cache to Extra-P to CSV: the table that comes out is the one that went in."""
    first = tmp_path / "first.csv"
    ran = vtfs("convert", engine, first, "--time", "shade_us", "--ignore", "note")
    assert ran.out == f"6 rows, 1 without a time left out: {first} (csv)\n"
    before = first
    for to, name in (("t4", "t4.json"), ("kernel_tuner", "kt.json"), ("extra_p", "ep.jsonl"), ("csv", "last.csv")):
        assert vtfs("convert", before, tmp_path / name, "--to", to).code == 0
        before = tmp_path / name
    assert before.read_text() == first.read_text()
    assert len(first.read_text().splitlines()) == 13 and "time_ms" in first.read_text()


def test_what_the_options_say_wrong_is_refused(model, engine, tmp_path):
    for arguments, words in (
        (("fit", engine, "--published", "olsson_2012"), ("--published", "DATA")),
        (("fit", "--published", "olsson"), ("--published olsson", "olsson_2012")),
        (("fit", engine, "--unit", "hours"), ("--unit hours",)),
        (("fit", engine, "--time", "ms"), ("`ms`", "shade_us")),
        (("fit", engine, "--ignore", "nothing"), ("`nothing`",)),
        (("fit", engine, "--where", "gpu"), ("--where gpu", "COLUMN=VALUE")),
        (("fit", engine, "--where", "gpu=B"), ("--where gpu=B", "A GPU")),
        (("fit", engine, "--format", "xml"), ("--format xml",)),
        (("fit", tmp_path / "absent.csv"), ("absent.csv", "cannot be read")),
        (("predict", engine, engine), ("engine.csv", "JSON")),
        (("predict", model[0], tmp_path / "absent.csv"), ("absent.csv",)),
        (("convert", engine, tmp_path / "x.json"), ("--to", "t4")),
        (("convert", engine, tmp_path / "x.json", "--to", "xml"), ("--to xml", "t4")),
    ):
        is_refused(vtfs(*arguments), *words)


def test_a_model_that_misses_a_column_of_the_rows_is_named(model, tmp_path):
    (tmp_path / "new.csv").write_text("lamps\n100\n")
    is_refused(vtfs("predict", model[0], tmp_path / "new.csv"), "`light_count`")


SPACE = "[parameters]\ntile_px = [8, 16, 32, 48]\n"


def test_the_worked_example_without_our_timings(tmp_path):
    """Count a space, time some of it elsewhere, fit, and be told what to use. The README shows these commands."""
    space, counts, out = tmp_path / "space.toml", tmp_path / "counts.csv", tmp_path / "report"
    space.write_text(SPACE)
    both = "tiled_deferred,volume_tiled_bvh"
    ran = vtfs("count", *SMALL, "--technique", both, "--space", space, "--frame", 0, "--out", counts)
    assert ran.code == 0, ran
    rows = rows_of(counts)
    assert [(row["technique"], row["tile_px"]) for row in rows] == [
        (technique, tile) for technique in both.split(",") for tile in ("8", "16", "32", "48")
    ]
    timed = with_times(counts, rows)

    ran = vtfs("fit", timed, "--time", "time_ms")
    assert ran.code == 0, ran
    assert "2 rows have no time" in ran.out and "memory" in ran.out.splitlines()[1]

    ran = vtfs("tune", "street", "--measurements", timed, "--out", out)
    assert ran.code == 0, ran
    assert "imported from counts.csv" in ran.out and f"Report: {out / 'report.html'}" in ran.out
    result = json.loads((out / "result.json").read_text())
    assert result["best"]["timed"] and ran.out.startswith(result["best"]["technique"])
    assert result["measured"] == 6 and result["compiled_programs"] == 0 and result["scene"]["name"] == "street"
    fastest = min(float(row["time_ms"]) for row in rows_of(timed) if row["time_ms"])
    assert result["best"]["time_ms"] == fastest

    one = tmp_path / "one"
    ran = vtfs("tune", "--measurements", timed, "--techniques", "tiled_deferred", "--out", one, "--json", "-")
    assert {p["technique"] for p in ran.json["predictions"]} == {"tiled_deferred"}
    is_refused(vtfs("tune", "--measurements", timed, "--out", one), "measurements of an earlier run")
    is_refused(vtfs("tune", "--measurements", timed, "--out", tmp_path / "x", "--budget", "40"), "--budget")
    is_refused(
        vtfs("tune", "--measurements", timed, "--out", tmp_path / "x", "--techniques", "forward"), "forward", "timed"
    )


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def with_times(path: Path, rows: list[dict[str, str]]) -> Path:
    """A time by hand for all but the largest tiles: 0.3 ms and 2 us a thousand lighting computations."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], "time_ms"])
        writer.writeheader()
        for row in rows:
            time = 0.3 + 2e-6 * int(row["lighting_computations"]) + 1e-4 * int(row["clusters_occupied"])
            writer.writerow({**row, "time_ms": "" if row["tile_px"] == "48" else time})
    return path
