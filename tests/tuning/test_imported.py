"""Times of another engine in a table of counts: read, compared, modelled; nothing is measured here."""

import csv
import json
import math

import pytest

from reports.page import write_report
from tuning.imported import tune_imported
from tuning.imported_times import read_imported
from tuning.measurement import Measurement
from tuning.record import append_measurement, read_measurements
from vtfs.configurations import configuration
from vtfs.input_error import InputError

TILES = (4, 8, 12, 16, 24, 32, 48, 64)


def engine_ms(computations: float, frame: int) -> float:
    """What the engine of these tests takes: a fixed part and a price a lighting computation."""
    return 1.0 + 2e-6 * computations * (1 + 0.001 * (frame % 2))


def lighting_computations(tile_px: int, frame: int) -> int:
    """A U in the tile size, lowest at 16."""
    return 100_000 * (1 + frame) * (tile_px + 256 // tile_px)


def counts_table(path, timed=TILES, frames=(0, 3), rows=None, **changes):
    """As `vtfs count --space --out` writes it, `forward` among them, and a time where the tile is in `timed`."""
    rows = [
        {
            "technique": "tiled_deferred", "tile_px": tile, "batch": 0, "gbuffer": "float32", "light_cutoff": 0.0,
            "frame": frame, "samples": 5000, "lighting_computations": lighting_computations(tile, frame),
            "shading_lanes": 7 * tile, "memory": 10**9 // tile, "lights": 200,
            "time_ms": engine_ms(lighting_computations(tile, frame), frame) if tile in timed else "",
        }
        for frame in frames
        for tile in TILES
    ] if rows is None else rows  # fmt: skip
    rows = [{**row, **changes} for row in rows]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
    return path


def test_configurations_frames_and_counts_are_read(tmp_path):
    imported = read_imported(counts_table(tmp_path / "counts.csv", timed=(8, 32)))
    assert len(imported.counts) == len(TILES)
    assert set(imported.repeats_ms) == {configuration("tiled_deferred", {"tile_px": tile}) for tile in (8, 32)}
    assert imported.frames == (3, 0)  # the one with the most work first
    at_8 = configuration("tiled_deferred", {"tile_px": 8})
    assert imported.counts[at_8][0]["lighting_computations"] == lighting_computations(8, 3)
    assert imported.repeats_ms[at_8] == (
        (engine_ms(lighting_computations(8, 3), 3),),
        (engine_ms(lighting_computations(8, 0), 0),),
    )
    assert "tile_px" not in imported.counts[at_8][0] and imported.scene == "counts"


def test_rows_of_one_configuration_and_frame_are_repeats(tmp_path):
    row = {"technique": "forward", "frame": 0, "samples": 10, "time_ms": 3.0}
    path = counts_table(tmp_path / "c.csv", rows=[row, {**row, "time_ms": 3.5}, {**row, "time_ms": ""}])
    assert read_imported(path).repeats_ms == {configuration("forward"): ((3.0, 3.5),)}


def test_only_frames_that_all_were_timed_on_are_compared(tmp_path):
    def row(tile, frame, time):
        return {"technique": "tiled_deferred", "tile_px": tile, "frame": frame, "samples": 9, "time_ms": time}

    rows = [row(8, 0, 5.0), row(8, 1, 9.0), row(16, 0, 6.0), row(16, 1, "")]
    imported = read_imported(counts_table(tmp_path / "c.csv", rows=rows))
    assert imported.frames == (0,)
    assert imported.repeats_ms[configuration("tiled_deferred", {"tile_px": 8})] == ((5.0,),)
    rows = [row(8, 0, 5.0), row(16, 1, 6.0)]
    with pytest.raises(InputError, match="no frame was timed in all of 2"):
        read_imported(counts_table(tmp_path / "c.csv", rows=rows))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"technique": "tiled_delayed"}, ("line 2", "tiled_delayed", "tiled_deferred")),
        ({"tile_px": 1000}, ("line 2", "`tile_px`", "1000")),
        ({"branching": 8}, ("line 2", "`branching`", "does not have it")),
        ({"time_ms": 0}, ("line 2", "0 ms")),
        ({"time_ms": -1}, ("line 2", "`time_ms`", "-1")),
        ({"time_ms": "fast"}, ("line 2", "`time_ms`", "'fast'")),
        ({"time_ms": ""}, ("no row has a time", "`time_ms`")),
    ],
)
def test_a_bad_table_is_refused(tmp_path, changes, words):
    with pytest.raises(InputError) as refused:
        read_imported(counts_table(tmp_path / "counts.csv", **changes))
    for word in words:
        assert word in str(refused.value), refused.value


def test_a_table_without_techniques_is_refused(tmp_path):
    (tmp_path / "c.csv").write_text("tile_px,time_ms\n8,3\n")
    with pytest.raises(InputError, match="`technique`"):
        read_imported(tmp_path / "c.csv")


def test_times_of_two_drivers_are_not_mixed(tmp_path):
    row = {"technique": "forward", "driver": "A", "time_ms": 3.0}
    path = counts_table(tmp_path / "c.csv", rows=[row, {**row, "driver": "B"}])
    with pytest.raises(InputError, match=r"`driver` has several values \(A, B\)"):
        read_imported(path)
    one = read_imported(counts_table(tmp_path / "c.csv", rows=[{**row, "device": "Engine GPU", "scene": "hall"}]))
    assert (one.device, one.scene) == ("Engine GPU", "hall")


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    """Five of eight tile sizes were timed, not the best one."""
    folder = tmp_path_factory.mktemp("imported")
    imported = read_imported(counts_table(folder / "counts.csv", timed=(4, 8, 32, 48, 64)))
    result = tune_imported(imported, folder / "run", "max", 0, "vtfs tune", "hall")
    return folder / "run", result


def test_a_tile_size_that_was_never_timed_is_recommended_where_the_model_is_sure(tuned):
    _, result = tuned
    best = result["best"]
    assert best["params"]["tile_px"] == 16 and best["timed"] is False
    truth = engine_ms(lighting_computations(16, 3), 3)
    assert best["time_ms"] == pytest.approx(truth, rel=0.03)  # the law is exact; the model may choose a neighbour of it
    assert best["time_ms_interval"][0] <= truth <= best["time_ms_interval"][1]


def test_the_result_says_that_times_were_imported(tuned):
    _, result = tuned
    assert "imported from counts.csv" in result["claim"] and "timed nothing" in result["claim"]
    assert result["claim"].startswith("predicted and not timed yet")
    assert result["imported"]["timed"] == 5 and result["imported"]["untimed"] == 3
    assert result["compiled_programs"] == 0 and result["measured"] == 5 and result["space_size"] == 8
    assert result["scene"] == {
        "name": "hall", "triangles": None, "lights": 200, "frames": 2, "key": "counts", "measured_frames": [3, 0],
    }  # fmt: skip


def test_the_result_has_the_keys_of_a_run(tuned):
    _, result = tuned
    keys = (
        "schema scene device versions seed space_size measured compiled_programs compile_s wall_s default best pareto "
        "cost_models claim command objective gain predictions counts"
    )
    assert set(keys.split()) <= result.keys()
    model = result["cost_models"][0]
    assert {"technique", "stage", "terms", "dropped", "coefficients", "loo_error"} <= model.keys()
    # What only our own program pays for is no feature of another engine.
    assert not any("shading_lanes" in term or "memory" in term for term in model["terms"])


def test_what_the_models_answer_stands_in_the_result(tuned):
    _, result = tuned
    (matters,) = result["answers"]["matters"]
    # The engine's time is made of lighting computations and a fixed part.
    assert next(iter(matters["slopes"])) in result["cost_models"][0]["terms"][0]
    assert result["answers"]["influential"]
    assert any(line.startswith("What matters") for line in result["answer_lines"])


def test_gains_are_over_what_was_timed(tuned):
    _, result = tuned
    default_ms = engine_ms(lighting_computations(32, 3), 3)
    assert result["default"]["time_ms"] == default_ms == result["fastest_default"]["time_ms"]
    assert result["gain"]["over_default"] == pytest.approx(default_ms / result["best"]["time_ms"])
    assert "over_default_interval" not in result["gain"]  # a single time says nothing about its noise


def test_the_record_and_the_report_can_be_read(tuned):
    folder, result = tuned
    record = read_measurements(folder / "measurements.jsonl")
    assert len(record) == 5 and all(m.outcome == "timed" and "imported" in m.message for m in record)
    assert json.loads((folder / "result.json").read_text()) == result
    page = write_report(folder).read_text()
    assert "imported from counts.csv" in page


def test_the_record_of_a_run_can_be_imported(tuned, tmp_path):
    folder, _ = tuned
    imported = read_imported(folder / "measurements.jsonl")
    assert imported.frames == (3, 0) and len(imported.repeats_ms) == 5
    again = tune_imported(imported, tmp_path, "max", 0, "vtfs tune")
    assert again["best"]["timed"] and again["best"]["params"]["tile_px"] in (8, 32)


def test_the_mean_over_frames_is_another_objective(tmp_path):
    imported = read_imported(counts_table(tmp_path / "counts.csv", timed=(8, 32)))
    result = tune_imported(imported, tmp_path / "run", "mean", 0, "vtfs tune")
    at_8 = next(p for p in result["predictions"] if p["params"]["tile_px"] == 8)
    assert at_8["measured_ms"] == pytest.approx(
        (engine_ms(lighting_computations(8, 0), 0) + engine_ms(lighting_computations(8, 3), 3)) / 2
    )


def test_a_single_time_is_recommended_and_nothing_is_claimed(tmp_path):
    imported = read_imported(counts_table(tmp_path / "counts.csv", timed=(32,), frames=(0,)))
    result = tune_imported(imported, tmp_path / "run", "max", 0, "vtfs tune")
    assert result["best"]["timed"] and result["best"]["params"]["tile_px"] == 32


def test_settings_that_change_the_image_are_not_recommended(tmp_path):
    row = {"technique": "forward", "samples": 10, "gbuffer": "float32", "time_ms": 3.0}
    faster = {**row, "gbuffer": "float16", "time_ms": 2.0}
    both = read_imported(counts_table(tmp_path / "c.csv", rows=[row, faster]))
    assert tune_imported(both, tmp_path / "run", "max", 0, "vtfs tune")["best"]["params"]["gbuffer"] == "float32"
    alone = read_imported(counts_table(tmp_path / "c.csv", rows=[faster]))
    with pytest.raises(InputError, match="gbuffer float32"):
        tune_imported(alone, tmp_path / "alone", "max", 0, "vtfs tune")


def test_several_scenes_in_a_record_are_refused(tmp_path):
    for scene in ("hall", "street"):
        append_measurement(
            tmp_path / "m.jsonl",
            Measurement(
                "forward", {}, scene, (0,), 0, "timed", math.nan, {"frame": ((1.0,),)}, ({},), None, None, "G", {}, 0
            ),
        )
    with pytest.raises(InputError, match="several scenes"):
        read_imported(tmp_path / "m.jsonl")
