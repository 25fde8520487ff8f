import errno
import json
import math
import resource
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tuning.measurement import Measurement
from tuning.record import append_measurement, read_measurements
from vtfs.input_error import InputError

finite = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(st.characters(codec="utf-8"), max_size=20)
params = st.dictionaries(texts, st.integers() | finite | texts, max_size=4)
counts = st.dictionaries(texts, st.integers(0, 2**63 - 1), max_size=4)
repeats = st.lists(finite, min_size=1, max_size=4).map(tuple)


@st.composite
def measurements(draw):
    n_frames = draw(st.integers(1, 3))
    outcome = draw(st.sampled_from(["timed", "overflow", "out_of_memory", "timeout", "failed"]))
    frame = st.tuples(*[repeats] * n_frames)
    stages = draw(st.dictionaries(texts, st.lists(repeats, max_size=n_frames).map(tuple), max_size=2))
    timed = outcome == "timed"
    return Measurement(
        technique=draw(texts),
        params=draw(params),
        scene_key=draw(texts),
        frames=tuple(draw(st.lists(st.integers(0, 10**6), min_size=n_frames, max_size=n_frames))),
        seed=draw(st.integers(0, 2**63)),
        outcome=outcome,
        compile_s=draw(finite),
        stages_ms={**stages, "frame": draw(frame)} if timed else stages,
        counts=draw(st.tuples(*[counts] * n_frames)) if timed else (),
        error=draw(st.none() | finite),
        error_p999=draw(st.none() | finite),
        device=draw(texts),
        versions=draw(st.dictionaries(texts, texts, max_size=2)),
        load=draw(finite),
        message=draw(texts),
    )


ONE = Measurement(
    technique="tiled_deferred",
    params={"tile_px": 32, "gbuffer": "float32", "light_cutoff": 0.0},
    scene_key="abc",
    frames=(3, 17),
    seed=0,
    outcome="timed",
    compile_s=1.5,
    stages_ms={"frame": ((4.0, 4.1, 3.9), (2.0, 2.1, 1.9)), "assign": ((0.5,), (0.25,))},
    counts=({"samples": 100, "cells_total": 7}, {"samples": 90, "cells_total": 7}),
    error=1e-7,
    error_p999=None,
    device="a CPU",
    versions={"jax": "0.10.2"},
    load=0.3,
)
FAILED = replace(ONE, outcome="out_of_memory", stages_ms={}, counts=(), error=None, message="needs 9 GB\nhas 4 GB")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(written=st.lists(measurements(), min_size=1, max_size=3))
def test_what_is_written_is_read_again(tmp_path, written):
    path = tmp_path / "measurements.jsonl"
    path.unlink(missing_ok=True)
    for measurement in written:
        append_measurement(path, measurement)
    assert read_measurements(path) == written
    assert path.read_bytes().count(b"\n") == len(written)


def test_a_kill_at_any_byte_of_a_line_loses_that_line_alone(tmp_path):
    path = tmp_path / "measurements.jsonl"
    append_measurement(path, ONE)
    n_first = path.stat().st_size
    append_measurement(path, FAILED)
    whole = path.read_bytes()
    for size in range(n_first, len(whole)):
        path.write_bytes(whole[:size])
        # Only the end of the line is missing: then nothing is lost.
        expected = [ONE, FAILED] if size == len(whole) - 1 else [ONE]
        assert read_measurements(path) == expected
        append_measurement(path, FAILED)
        assert read_measurements(path) == [*expected, FAILED]
        assert path.read_bytes().startswith(whole[:n_first])


@pytest.mark.parametrize("tail", [b"\x00" * 40, b"\xff\xfe", b"nonsense", b'{"schema": 1, "tech'])
def test_any_rubbish_without_an_end_of_line_is_a_torn_line(tmp_path, tail):
    path = tmp_path / "measurements.jsonl"
    append_measurement(path, ONE)
    path.write_bytes(path.read_bytes() + tail)
    assert read_measurements(path) == [ONE]
    append_measurement(path, FAILED)
    assert read_measurements(path) == [ONE, FAILED]


def test_the_folder_is_made_and_an_empty_file_holds_nothing(tmp_path):
    path = tmp_path / "new" / "measurements.jsonl"
    append_measurement(path, ONE)
    assert read_measurements(path) == [ONE]
    path.write_bytes(b"")
    assert read_measurements(path) == []


def test_what_is_not_finite_is_null_on_disk(tmp_path):
    path = tmp_path / "measurements.jsonl"
    broken = replace(ONE, error=math.nan, load=math.inf, stages_ms={"frame": ((1.0, math.nan), (2.0,))})
    append_measurement(path, broken)
    text = path.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    (read,) = read_measurements(path)
    assert read.error is None
    assert math.isnan(read.load)
    assert math.isnan(read.stages_ms["frame"][0][1])


def test_numpy_numbers_are_written_as_numbers(tmp_path):
    path = tmp_path / "measurements.jsonl"
    n = np.int64(2**40)
    append_measurement(path, replace(ONE, counts=({"samples": n}, {"samples": n}), error=np.float64(0.5)))  # type: ignore[arg-type]
    (read,) = read_measurements(path)
    assert read.counts[0]["samples"] == 2**40
    assert read.error == 0.5


@contextmanager
def full_disk(n_bytes: int):
    """Files cannot grow past a size: a write is cut short and the next one fails, as on a full disk.

    Only for as long as the code under test runs: the test runner's own log is a file as well.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "measurements.jsonl"
    append_measurement(path, ONE)
    before = path.read_bytes()
    refused = pytest.raises(InputError, match=r"measurements.jsonl: cannot be written .* free some space")
    with refused, full_disk(len(before) + 100):
        append_measurement(path, FAILED)
    assert path.read_bytes() == before


def test_a_failing_flush_to_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "measurements.jsonl"
    append_measurement(path, ONE)
    before = path.read_bytes()

    def no_space(_: int):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(InputError, match="No space left on device"):
        append_measurement(path, FAILED)
    assert path.read_bytes() == before


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        append_measurement(tmp_path / "file" / "measurements.jsonl", ONE)


def _line(**changes) -> str:
    fields = {
        "schema": 1,
        "technique": "forward",
        "params": {},
        "scene_key": "k",
        "frames": [0],
        "seed": 0,
        "outcome": "timed",
        "compile_s": 0.0,
        "stages_ms": {"frame": [[1.0]]},
        "counts": [{"samples": 1}],
        "error": None,
        "error_p999": None,
        "device": "d",
        "versions": {},
        "load": 0.0,
    }
    return json.dumps({**fields, **changes})


def test_what_has_a_default_may_be_missing(tmp_path):
    path = tmp_path / "measurements.jsonl"
    path.write_text(_line() + "\n\n" + _line(seed=4) + "\n")
    assert [m.seed for m in read_measurements(path)] == [0, 4]


def test_a_configuration_that_was_timed_on_the_first_frame_alone_is_read_back(tmp_path):
    path = tmp_path / "measurements.jsonl"
    lost = replace(ONE, stages_ms={"frame": ((1.0, 2.0), ())})
    append_measurement(path, lost)
    assert read_measurements(path) == [lost]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("nonsense", "not JSON"),
        ("[1]", "not a measurement"),
        ("[" * 100_000, "not JSON"),
        ("{}", "`schema` = None is unknown"),
        (_line(schema=2), "`schema` = 2 is unknown, this version reads 1"),
        (_line(colour=1), "`colour` is not a field"),
        (_line().replace('"seed": 0, ', ""), "`seed` is missing"),
        (_line(technique=3), "`technique`: 3 is not a text"),
        (_line(frames=3), "`frames`: 3 is not a list"),
        (_line(frames=[0.5]), "`frames`: 0.5 is not a whole number"),
        (_line(seed=True), "`seed`: True is not a whole number"),
        (_line(outcome="good"), "`outcome`: 'good' is not one of timed"),
        (_line(stages_ms={"frame": [["x"]]}), "`stages_ms`: 'x' is not a number"),
        (_line(stages_ms={"frame": [1.0]}), "`stages_ms`: 1.0 is not a list"),
        (_line(stages_ms=[]), "`stages_ms`: .* is not an object"),
        (_line(stages_ms={}), "`stages_ms.frame` and `counts` need an entry"),
        (_line(stages_ms={"frame": [[]]}), "`stages_ms.frame` and `counts` need an entry"),
        (
            _line(frames=[0, 1], stages_ms={"frame": [[], [1.0]]}, counts=[{"samples": 1}] * 2),
            "`stages_ms.frame` and `counts` need an entry for each of `frames`, and times for the first",
        ),
        (_line(counts=[]), "`stages_ms.frame` and `counts` need an entry"),
        (_line(counts=[{"samples": 1.5}]), "`counts`: 1.5 is not a whole number"),
        (_line(params={"tile_px": [1]}), r"`params`: \[1\] is not a number"),
        (_line(params={"tile_px": False}), "`params`: False is not a whole number"),
        (_line(load=0.5).replace("0.5", "NaN"), "NaN is not JSON"),
        (_line(load=0.5).replace("0.5", "1e999"), "`load`: inf is not a number"),
        (_line(seed=5).replace("5", "9" * 5000), "not JSON"),
    ],
)
def test_damage_before_the_end_is_refused_with_its_line(tmp_path, line, message):
    path = tmp_path / "measurements.jsonl"
    path.write_text(f"{_line()}\n{line}\n{_line()}\n")
    with pytest.raises(InputError, match=rf"measurements.jsonl: line 2: .*{message}") as caught:
        read_measurements(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_measurements(tmp_path / "measurements.jsonl")
