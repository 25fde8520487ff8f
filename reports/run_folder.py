"""What a run left in its folder, read and checked before anything is drawn.

Lists may be empty and values null: a run in which nothing could be measured still has a report. What is
there must have the right type; the first thing that does not is named and refused.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tuning.measurement import Measurement
from tuning.record import read_measurements
from vtfs.input_error import InputError
from vtfs.parameters import Value

SCHEMA = 1

Interval = tuple[float, float]


@dataclass(frozen=True)
class Timed:
    """A configuration with its time, and the error of its image where that is known.

    - `interval_ms`: 95 % interval of the time.
    - `error`: RMSE over RMS of the float64 reference.
    """

    technique: str
    params: dict[str, Value]
    time_ms: float
    interval_ms: Interval | None
    error: float | None

    def is_configuration(self, technique: str, params: Mapping[str, Value]) -> bool:
        return self.technique == technique and self.params == dict(params)


@dataclass(frozen=True)
class Gain:
    """A ratio of two times; above 1 the best configuration is faster."""

    ratio: float
    interval: Interval | None

    @property
    def inside_noise(self) -> bool:
        """True where the interval does not leave 1 behind, so that nothing was gained for certain."""
        return self.interval[0] <= 1.0 if self.interval else self.ratio <= 1.0

    @property
    def is_loss(self) -> bool:
        """True where the whole interval lies below 1: no noise, the best configuration is slower."""
        return self.interval is not None and self.interval[1] < 1.0


@dataclass(frozen=True)
class Prediction:
    """What the cost model says of one configuration, and what was measured if it was."""

    technique: str
    params: dict[str, Value]
    predicted_ms: float
    interval_ms: Interval | None
    measured_ms: float | None

    @property
    def holds(self) -> bool:
        """True where the measured time lies inside the interval of the prediction."""
        if self.measured_ms is None or self.interval_ms is None:
            return False
        return self.interval_ms[0] <= self.measured_ms <= self.interval_ms[1]

    @property
    def miss(self) -> float:
        """By which factor the prediction is off, either way; 1 where it is right or nothing was measured."""
        if not self.measured_ms or self.predicted_ms <= 0:
            return 1.0
        return max(self.measured_ms / self.predicted_ms, self.predicted_ms / self.measured_ms)


@dataclass(frozen=True)
class StageModel:
    """The fitted cost of one stage: `fixed_ms + sum(ms_per_op * ops)`.

    - `dropped`: terms that the model does without, with the leave-one-out error of a model that has them.
    - errors are relative (0.06 is 6 %).
    """

    technique: str
    stage: str
    fixed_ms: float | None
    ms_per_op: dict[str, float]
    dropped: tuple[tuple[str, float | None], ...]
    loo_error: float | None
    constant_loo_error: float | None
    n_runs: int | None


@dataclass(frozen=True)
class ListHistogram:
    """How long the light lists of a technique's cells are.

    - `lists_in_bin`: bin `i` has those of `i * bin_width` to `(i + 1) * bin_width - 1` lights.
    - `dropped_at_cap`: entries lost where an engine keeps so many lights a cell.
    """

    technique: str
    bin_width: float
    lists_in_bin: tuple[float, ...]
    n_entries: float
    longest: float
    dropped_at_cap: dict[str, float]

    @property
    def n_lists(self) -> float:
        return sum(self.lists_in_bin)


@dataclass(frozen=True)
class Scene:
    """What was rendered. None, or empty, where `result.json` does not say.

    - `measured_frames`: places on the camera path, the frame with the most work first.
    """

    name: str
    key: str
    n_triangles: float | None
    n_lights: float | None
    n_frames: float | None
    viewport_px: tuple[float, ...]
    measured_frames: tuple[float, ...]


@dataclass(frozen=True)
class RunFolder:
    """`result.json` and `measurements.jsonl` of one run, as records.

    - `result`: the whole of `result.json`, for what is only quoted (device, versions, command).
    - `counts`: technique, count, value. `stages_ms`: technique, stage, median.
    """

    path: Path
    result: dict[str, Any]
    scene: Scene
    default: Timed | None
    fastest_default: Timed | None
    best: Timed | None
    gain_over_default: Gain | None
    gain_over_fastest_default: Gain | None
    pareto: tuple[Timed, ...]
    not_measured: tuple[tuple[str, str], ...]
    cost_models: tuple[StageModel, ...]
    answer_lines: tuple[str, ...]
    predictions: tuple[Prediction, ...]
    counts: dict[str, dict[str, float]]
    stages_ms: dict[str, dict[str, float]]
    list_lengths: tuple[ListHistogram, ...]
    measurements: tuple[Measurement, ...]

    @property
    def objective(self) -> str:
        return "mean" if self.result.get("objective") == "mean" else "max"

    @property
    def casts_shadows(self) -> bool:
        return self.result.get("kind") == "shadows"

    def quoted(self, *keys: str) -> Any:
        """A value of `result.json` by its path, or None where it or anything above it is absent."""
        value: Any = self.result
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    def time_ms(self, measurement: Measurement) -> float | None:
        """The time that was optimised: of the frames' medians the slowest, or their mean."""
        medians_ms = frame_medians_ms(measurement)
        if not medians_ms:
            return None
        return statistics.fmean(medians_ms) if self.objective == "mean" else max(medians_ms)


def frame_medians_ms(measurement: Measurement) -> tuple[float, ...]:
    """Median over the repeats of the fused frame, for each frame; empty where it was not timed."""
    if measurement.outcome != "timed":
        return ()
    frames = [[ms for ms in repeats if math.isfinite(ms)] for repeats in measurement.stages_ms.get("frame", ())]
    return tuple(statistics.median(repeats) for repeats in frames if repeats)


def read_run_folder(folder: Path | str) -> RunFolder:
    """Read and check the files of a run, except for its pictures.

    **Raises:** `InputError` for a missing or damaged file, with the key or the line.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder that `vtfs tune --out` wrote.")
    result = _read_result(folder / "result.json")
    gain = _record(result, "gain")
    cost_models = tuple(_stage_model(item, at) for item, at in _records(result, "cost_models"))
    return RunFolder(
        path=folder,
        result=result,
        scene=_scene(_record(result, "scene")),
        default=_timed_or_none(result, "default"),
        fastest_default=_timed_or_none(result, "fastest_default"),
        best=_timed_or_none(result, "best"),
        gain_over_default=_gain(gain, "over_default"),
        gain_over_fastest_default=_gain(gain, "over_fastest_default"),
        pareto=tuple(point for item, at in _records(result, "pareto") if (point := _timed(item, at))),
        not_measured=tuple(
            (_text(item, "technique", at), _text(item, "reason", at)) for item, at in _records(result, "not_measured")
        ),
        cost_models=cost_models,
        answer_lines=_lines(result, "answer_lines"),
        predictions=tuple(made for item, at in _records(result, "predictions") if (made := _prediction(item, at))),
        counts=_table(result, "counts"),
        stages_ms=_table(result, "stages"),
        list_lengths=tuple(_list_histogram(item, at) for item, at in _records(result, "list_lengths")),
        measurements=tuple(read_measurements(folder / "measurements.jsonl")),
    )


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: missing; `vtfs tune --out {path.parent}` writes it.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}).") from None


def _read_result(path: Path) -> dict[str, Any]:
    content = _read(path)
    try:
        result = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged ({error}); run `vtfs tune` again.") from None
    if not isinstance(result, dict):
        raise InputError(f"{path}: holds {_kind(result)}; it must be an object.")
    if result.get("schema") != SCHEMA:
        raise InputError(f"{path}: `schema` is {result.get('schema')!r}; this version of vtfs reads {SCHEMA}.")
    # What is only quoted is checked here; the rest where its record is made.
    for key in ("space_size", "compiled_programs", "compile_s", "wall_s", "max_error"):
        _number(result, key, "")
    for key in ("versions", "heat_scale"):
        _record(result, key)
    _records(result, "pictures")
    return result


def _scene(item: dict[str, Any]) -> Scene:
    return Scene(
        name=str(item.get("name") or ""),
        key=str(item.get("key") or ""),
        n_triangles=_number(item, "triangles", "scene"),
        n_lights=_number(item, "lights", "scene"),
        n_frames=_number(item, "frames", "scene"),
        viewport_px=_list_of_numbers(item, "viewport", "scene"),
        measured_frames=_list_of_numbers(item, "measured_frames", "scene"),
    )


def _timed_or_none(result: dict[str, Any], key: str) -> Timed | None:
    return _timed(_record(result, key), key)


def _timed(item: dict[str, Any], at: str) -> Timed | None:
    """None where there is no time: nothing could be measured."""
    time_ms = _number(item, "time_ms", at)
    if time_ms is None:
        return None
    return Timed(
        technique=_text(item, "technique", at),
        params=_params(item, at),
        time_ms=time_ms,
        interval_ms=_interval(item, "time_ms_interval", at),
        error=_number(item, "error", at),
    )


def _gain(item: dict[str, Any], key: str) -> Gain | None:
    ratio = _number(item, key, "gain")
    return None if ratio is None else Gain(ratio, _interval(item, f"{key}_interval", "gain"))


def _prediction(item: dict[str, Any], at: str) -> Prediction | None:
    predicted_ms = _number(item, "predicted_ms", at)
    if predicted_ms is None:
        return None
    low_ms, high_ms = _number(item, "low_ms", at), _number(item, "high_ms", at)
    return Prediction(
        technique=_text(item, "technique", at),
        params=_params(item, at),
        predicted_ms=predicted_ms,
        interval_ms=None if low_ms is None or high_ms is None else (low_ms, high_ms),
        measured_ms=_number(item, "measured_ms", at),
    )


def _stage_model(item: dict[str, Any], at: str) -> StageModel:
    coefficients = _numbers(_record(item, "coefficients", at), f"{at}.coefficients")
    n_runs = _number(item, "n", at)
    return StageModel(
        technique=_text(item, "technique", at),
        stage=_text(item, "stage", at),
        fixed_ms=coefficients.pop("fixed_ms", None),
        ms_per_op=coefficients,
        dropped=tuple(
            (_text(term, "term", where), _number(term, "loo_error", where))
            for term, where in _records(item, "dropped", at)
        ),
        loo_error=_number(item, "loo_error", at),
        constant_loo_error=_number(item, "constant_loo_error", at),
        n_runs=None if n_runs is None else int(n_runs),
    )


def _list_histogram(item: dict[str, Any], at: str) -> ListHistogram:
    return ListHistogram(
        technique=_text(item, "technique", at),
        bin_width=_number(item, "bin_width", at) or 1.0,
        lists_in_bin=_list_of_numbers(item, "lists_in_bin", at),
        n_entries=_number(item, "entries", at) or 0.0,
        longest=_number(item, "longest", at) or 0.0,
        dropped_at_cap=_numbers(_record(item, "dropped_at_cap", at), f"{at}.dropped_at_cap"),
    )


def _params(item: dict[str, Any], at: str) -> dict[str, Value]:
    params = _record(item, "params", at)
    for name, value in params.items():
        if not isinstance(value, int | float | str):
            raise InputError(f"result.json: `{at}.params.{name}` is {_kind(value)}; it must be a number or text.")
    return params


def _table(result: dict[str, Any], key: str) -> dict[str, dict[str, float]]:
    table = _record(result, key)
    return {row: _numbers(_record(table, row, key), f"{key}.{row}") for row in table}


def _numbers(item: dict[str, Any], at: str) -> dict[str, float]:
    """The numbers of an object; an object inside (`dropped_at_cap`) is spread, null is left out."""
    found = {}
    for key, value in item.items():
        if isinstance(value, dict):
            found |= {f"{key} {inner}": number for inner, number in _numbers(value, f"{at}.{key}").items()}
        elif (number := _number(item, key, at)) is not None:
            found[key] = number
    return found


def _records(item: dict[str, Any], key: str, at: str = "") -> list[tuple[dict[str, Any], str]]:
    """A list of objects, each with its path in the file."""
    value = item.get(key)
    path = f"{at}.{key}" if at else key
    if value is None:
        return []
    if not isinstance(value, list):
        raise InputError(f"result.json: `{path}` is {_kind(value)}; it must be a list.")
    for i, entry in enumerate(value):
        if not isinstance(entry, dict):
            raise InputError(f"result.json: `{path}[{i}]` is {_kind(entry)}; it must be an object.")
    return [(entry, f"{path}[{i}]") for i, entry in enumerate(value)]


def _record(item: dict[str, Any], key: str, at: str = "") -> dict[str, Any]:
    value = item.get(key)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f"result.json: `{f'{at}.{key}' if at else key}` is {_kind(value)}; it must be an object.")
    return value


def _text(item: Mapping[str, Any], key: str, at: str) -> str:
    value = item.get(key)
    if not isinstance(value, str):
        raise InputError(f"result.json: `{at}.{key}` is {_kind(value)}; it must be text.")
    return value


def _number(item: Mapping[str, Any], key: str, at: str) -> float | None:
    """None also stands for what is not finite: a time that overflowed is not a time."""
    value = item.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"result.json: `{f'{at}.{key}' if at else key}` is {_kind(value)}; it must be a number.")
    return float(value) if math.isfinite(value) else None


def _lines(result: Mapping[str, Any], key: str) -> tuple[str, ...]:
    value = result.get(key, [])
    if not isinstance(value, list) or not all(isinstance(line, str) for line in value):
        raise InputError(f"result.json: `{key}` must be a list of texts; `vtfs tune` writes it.")
    return tuple(value)


def _list_of_numbers(item: Mapping[str, Any], key: str, at: str) -> tuple[float, ...]:
    value = item.get(key)
    if value is None:
        return ()
    if not isinstance(value, list):
        raise InputError(f"result.json: `{at}.{key}` is {_kind(value)}; it must be a list of numbers.")
    found = [_number({key: entry}, key, at) for entry in value]
    return tuple(entry for entry in found if entry is not None)


def _interval(item: Mapping[str, Any], key: str, at: str) -> Interval | None:
    value = item.get(key)
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"result.json: `{at}.{key}` is {_kind(value)}; it must be [low, high].")
    low = _number({"low": value[0]}, "low", f"{at}.{key}")
    high = _number({"high": value[1]}, "high", f"{at}.{key}")
    return None if low is None or high is None else (low, high)


def _kind(value: object) -> str:
    if value is None:
        return "missing"
    names = {dict: "an object", list: "a list", str: "text", bool: "true or false", int: "a number", float: "a number"}
    return names.get(type(value), type(value).__name__)
