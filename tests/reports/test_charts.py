from dataclasses import replace
from typing import Any

import pytest

from reports.chart_style import chart_html, time_axis
from reports.charts import beyond_the_chart, list_lengths, speed_against_error, stage_times
from reports.model_charts import predicted_against_measured, time_along_parameters
from reports.run_folder import read_run_folder
from tests.reports.synthetic_run import complete_run, run_of_one, run_without_times

CHARTS = [speed_against_error, stage_times, predicted_against_measured, time_along_parameters, list_lengths]


@pytest.fixture
def run(tmp_path):
    return read_run_folder(complete_run().write(tmp_path))


def drawn(draw, run) -> Any:
    figure = draw(run)
    assert figure is not None
    return figure


def trace(figure, name):
    return next(trace for trace in figure.data if trace.name == name)


@pytest.mark.parametrize("draw", CHARTS, ids=lambda draw: draw.__name__)
def test_without_data_there_is_no_chart(tmp_path, draw):
    assert draw(read_run_folder(run_without_times().write(tmp_path))) is None


def test_one_measurement_is_a_chart(tmp_path):
    figure = drawn(speed_against_error, read_run_folder(run_of_one().write(tmp_path)))
    assert len(trace(figure, "volume_tiled_bvh").x) == 1


def test_every_timed_measurement_is_in_the_chart_of_speed_and_error(run):
    figure = drawn(speed_against_error, run)
    techniques = {line.technique for line in run.measurements}
    in_chart = sorted(y for name in techniques for y in trace(figure, name).y)
    assert in_chart == sorted(time for line in run.measurements if (time := run.time_ms(line)) is not None)


def test_exact_images_stand_at_the_end_marked_exact(run):
    figure = drawn(speed_against_error, run)
    exact_at = figure.layout.xaxis.tickvals[0]
    assert figure.layout.xaxis.ticktext[0] == "exact"
    places = [x for name in ("forward", "tiled_deferred", "volume_tiled_bvh") for x in trace(figure, name).x]
    n_exact = sum(line.error is not None and line.error < 1e-7 for line in run.measurements)
    assert places.count(exact_at) == n_exact > 0
    # A decade at least lies between them and the others, so that nobody takes the end for a number.
    assert min(x for x in places if x != exact_at) >= 10 * exact_at


def test_an_error_of_zero_has_a_place_on_the_logarithmic_axis(run):
    lines = tuple(replace(line, error=0.0) for line in run.measurements if line.outcome == "timed")
    figure = drawn(speed_against_error, replace(run, measurements=lines, pareto=()))
    assert set(trace(figure, "forward").x) == {figure.layout.xaxis.tickvals[0]}


def test_the_largest_error_allowed_is_drawn(run):
    assert len(drawn(speed_against_error, run).layout.shapes) == 1
    run.result["max_error"] = 1e-3
    assert [shape.x0 for shape in drawn(speed_against_error, run).layout.shapes][1] == 1e-3


def test_the_stages_of_a_technique_stand_beside_its_frame(run):
    figure = drawn(stage_times, run)
    assert list(trace(figure, "assign").y[1]) == ["stages apart"] * 2
    frame = trace(figure, "frame, fused")
    assert list(frame.y[0]) == ["tiled_deferred", "volume_tiled_bvh"]
    assert frame.x[0] == run.stages_ms["tiled_deferred"]["frame"]


def test_a_technique_far_slower_than_the_others_is_named_and_not_drawn(run):
    assert beyond_the_chart(run) == {"forward": 2110.0}
    assert not any("forward" in trace.y[0] for trace in drawn(stage_times, run).data)


def test_every_list_stands_in_a_bin_of_its_histogram(run):
    own = trace(drawn(list_lengths, run), "volume_tiled_bvh")
    assert list(own.x) == [0, 60, 120] and sum(own.y) == pytest.approx(100)
    assert "60 to 119 lights: 1,104 lists" in own.hovertext[1]


def test_predictions_of_what_was_measured_are_compared(run):
    figure = drawn(predicted_against_measured, run)
    marks = [trace for trace in figure.data if trace.mode == "markers"]
    assert sum(len(trace.x) for trace in marks) == 22
    line = trace(figure, "perfect model")
    assert list(line.x) == list(line.y)


def test_a_line_changes_one_parameter_alone(run):
    figure = drawn(time_along_parameters, run)
    assert [note.text for note in figure.layout.annotations] == [
        f"<b>{name}</b>" for name in ("tile_px", "depth_slices", "branching", "gbuffer")
    ]
    along_tile = next(t for t in figure.data if t.name == "volume_tiled_bvh" and t.xaxis == "x")
    by_hand = [
        made.predicted_ms
        for made in sorted(run.predictions, key=lambda made: made.params.get("tile_px", 0))
        if made.technique == "volume_tiled_bvh" and {**made.params, "tile_px": 0} == {**run.best.params, "tile_px": 0}
    ]
    assert list(along_tile.y) == by_hand
    assert len(by_hand) == 5


def test_what_a_file_says_is_text_and_not_markup(run):
    evil = '<a href="javascript:alert(1)">x</a></script><script>alert(2)</script>'
    lines = tuple(replace(line, technique=evil) for line in run.measurements)
    html = chart_html(drawn(speed_against_error, replace(run, measurements=lines)), "chart")
    assert "<a href" not in html
    assert html.count("<script>") == html.count("</script>") == 1
    assert "&lt;a href" in html.encode().decode("unicode_escape")


@pytest.mark.parametrize(
    ("values_ms", "ticks"),
    [
        ([5.0, 5.0], None),
        ([0.0, 9.0], None),
        ([10.0, 100.0], [10, 15, 20, 30, 40, 50, 70, 100]),
        ([10.0, 1000.0], [10, 20, 50, 100, 200, 500, 1000]),
        ([0.3, 2.0], [0.3, 0.4, 0.5, 0.7, 1, 1.5, 2]),
        ([1e-3, 1e5], [1e-3, 1e-2, 0.1, 1, 10, 100, 1e3, 1e4, 1e5]),
    ],
)
def test_an_axis_of_times_is_logarithmic_where_they_differ_much(values_ms, ticks):
    axis = time_axis(values_ms, "ms")
    assert axis.get("tickvals") == ticks
    low, high = axis["range"]
    assert low < high
