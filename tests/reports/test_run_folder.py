import math
from dataclasses import replace

import pytest

from reports.run_folder import Gain, Prediction, frame_medians_ms, read_run_folder
from tests.reports.synthetic_run import complete_run, run_without_times
from vtfs.input_error import InputError


@pytest.fixture
def folder(tmp_path):
    return complete_run().write(tmp_path)


def test_everything_is_read(folder):
    run = read_run_folder(folder)
    assert len(run.measurements) == 24
    assert {line.outcome for line in run.measurements} == {"timed", "out_of_memory", "failed"}
    assert run.best is not None
    assert run.best.technique == "volume_tiled_bvh"
    assert run.best.interval_ms is not None
    assert run.stages_ms["forward"]["shade_opaque"] == 2110.0
    assert run.cost_models[0].ms_per_op == {"leaf_tests": 6.4e-5}
    assert run.cost_models[0].fixed_ms == 8.7
    assert run.cost_models[0].dropped == (("cells_total", 0.081),)
    assert (run.scene.name, run.scene.n_lights, run.scene.viewport_px) == ("atrium", 1000, (1280, 720))
    assert run.quoted("versions", "jax") == "0.10.2"
    assert run.quoted("versions", "nothing", "below") is None


def test_the_time_is_that_of_the_objective(folder):
    run = read_run_folder(folder)
    line = run.measurements[0]
    by_hand = [sorted(repeats)[2] for repeats in line.stages_ms["frame"]]  # the median of five
    assert list(frame_medians_ms(line)) == by_hand
    assert run.time_ms(line) == max(by_hand)
    run.result["objective"] = "mean"
    assert run.time_ms(line) == pytest.approx(sum(by_hand) / 3)


def test_a_failure_has_no_time(folder):
    run = read_run_folder(folder)
    failed = [line for line in run.measurements if line.outcome != "timed"]
    assert [run.time_ms(line) for line in failed] == [None, None]


def test_a_run_without_times_is_read(tmp_path):
    run = read_run_folder(run_without_times().write(tmp_path))
    assert run.best is None
    assert run.gain_over_default is None


def test_a_result_that_holds_only_its_schema_is_read(folder):
    (folder / "result.json").write_text('{"schema": 1}')
    (folder / "measurements.jsonl").write_text("")
    run = read_run_folder(folder)
    assert (run.best, run.pareto, run.measurements) == (None, (), ())


def test_a_repeat_that_was_lost_is_left_out_of_the_median(folder):
    line = read_run_folder(folder).measurements[0]
    stages_ms = {"frame": ((math.nan, 3.0, 5.0), (math.nan,))}
    assert frame_medians_ms(replace(line, stages_ms=stages_ms)) == (4.0,)


def test_a_torn_last_line_is_left_out(folder):
    path = folder / "measurements.jsonl"
    path.write_bytes(path.read_bytes() + b'{"technique": "forw')
    assert len(read_run_folder(folder).measurements) == 24


def test_a_damaged_line_in_the_middle_is_named(folder):
    path = folder / "measurements.jsonl"
    lines = path.read_text().splitlines()
    lines[4] = lines[4][:30]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=r"measurements\.jsonl: line 5: not JSON"):
        read_run_folder(folder)


@pytest.mark.parametrize("name", ["result.json", "measurements.jsonl"])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(InputError, match=rf"{name}: (missing|cannot be read)"):
        read_run_folder(folder)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder"):
        read_run_folder(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"schema": 1,', "damaged"),
        ("\udcff", "damaged"),
        ("[1]", "holds a list"),
        ('{"schema": 2}', "`schema` is 2; this version of vtfs reads 1"),
        (
            '{"schema": 1, "list_lengths": [{"technique": 3}]}',
            r"`list_lengths\[0\]\.technique` is a number; it must be text",
        ),
        ('{"schema": 1, "best": 3}', "`best` is a number; it must be an object"),
        ('{"schema": 1, "best": {"time_ms": 3}}', r"`best\.technique` is missing"),
        ('{"schema": 1, "best": {"technique": "forward", "time_ms": "3"}}', r"`best\.time_ms` is text"),
        (
            '{"schema": 1, "best": {"technique": "forward", "time_ms": 3, "time_ms_interval": [1]}}',
            r"`best\.time_ms_interval` is a list; it must be \[low, high\]",
        ),
        (
            '{"schema": 1, "best": {"technique": "forward", "time_ms": 3, "params": {"batch": [1]}}}',
            r"`best\.params\.batch` is a list; it must be a number or text",
        ),
        ("[" * 200_000, "damaged"),
        ('{"schema": 1, "pareto": [1]}', r"`pareto\[0\]` is a number"),
        ('{"schema": 1, "cost_models": {}}', "`cost_models` is an object; it must be a list"),
        ('{"schema": 1, "answer_lines": [1]}', "`answer_lines` must be a list of texts"),
        ('{"schema": 1, "counts": {"forward": 1}}', r"`counts\.forward` is a number"),
        ('{"schema": 1, "counts": {"forward": {"samples": "many"}}}', r"`counts\.forward\.samples` is text"),
        ('{"schema": 1, "gain": {"over_default": true}}', r"`gain\.over_default` is true or false"),
        ('{"schema": 1, "scene": "atrium"}', "`scene` is text"),
        ('{"schema": 1, "scene": {"lights": "many"}}', r"`scene\.lights` is text"),
        ('{"schema": 1, "scene": {"viewport": 1280}}', r"`scene\.viewport` is a number"),
        ('{"schema": 1, "wall_s": "long"}', "`wall_s` is text"),
    ],
)
def test_a_damaged_result_is_refused_in_one_line(folder, text, message):
    (folder / "result.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=message) as caught:
        read_run_folder(folder)
    assert "\n" not in str(caught.value)


def test_what_is_not_finite_is_not_a_time(folder):
    (folder / "result.json").write_text('{"schema": 1, "best": {"technique": "forward", "time_ms": NaN}}')
    assert read_run_folder(folder).best is None


def test_counts_by_cap_are_spread(folder):
    (folder / "result.json").write_text(
        '{"schema": 1, "counts": {"forward": {"dropped_at_cap": {"32": 7, "64": null}}}}'
    )
    assert read_run_folder(folder).counts == {"forward": {"dropped_at_cap 32": 7.0}}


@pytest.mark.parametrize(
    ("gain", "inside"),
    [
        (Gain(1.3, (1.2, 1.4)), False),
        (Gain(1.3, (1.0, 1.6)), True),
        (Gain(1.02, (0.98, 1.06)), True),
        (Gain(1.0, None), True),
        (Gain(1.1, None), False),
    ],
)
def test_a_gain_counts_where_its_interval_lies_above_one(gain, inside):
    assert gain.inside_noise is inside


@pytest.mark.parametrize(
    ("measured_ms", "holds", "miss"), [(10.0, True, 1.0), (20.0, False, 2.0), (5.0, False, 2.0), (None, False, 1.0)]
)
def test_how_far_a_prediction_is_off(measured_ms, holds, miss):
    made = Prediction("forward", {}, 10.0, (9.0, 11.0), measured_ms)
    assert (made.holds, made.miss) == (holds, miss)
