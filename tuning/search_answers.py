"""What the models of a search say to the questions of `questions.py`, as records of `answers.py`.

Its models are sums of counts: the slope of a time's logarithm is a term's share of the time, and needs no `jax.grad`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tuning.answers import Answers
from tuning.choose import Objective, is_timed, time_ms
from tuning.cost_model import CostModel
from tuning.features import operations
from tuning.measurement import Measurement
from tuning.questions import fastest_of
from tuning.sweep import Prediction, SearchResult
from vtfs.configurations import configuration
from vtfs.parameters import Value

_SAMPLES = 512
_MOST_INFLUENTIAL = 3


def search_answers(found: SearchResult, objective: Objective, seed: int = 0) -> Answers:
    """Records under `matters`, `best` and `influential`, for the fused frame.

    Nothing under the others: a search has one scene, and no size that grows.
    """
    models = {name: stages["frame"] for name, stages in found.models.items() if "frame" in stages}
    timed = {name: [m for m in found.measurements if m.technique == name and _is_fitted(m)] for name in models}
    return {
        "within": [],
        "crossovers": [],
        "matters": [
            _matters(models[name], min(own, key=lambda m: time_ms(m, objective)))
            for name, own in timed.items()
            if own and models[name].terms
        ],
        "best": _best(found.predictions, models, seed) if found.predictions else [],
        "influential": [one for name, own in timed.items() if len(own) > 1 for one in _influential(models[name], own)],
    }


def _is_fitted(measurement: Measurement) -> bool:
    return is_timed(measurement) and configuration(measurement.technique, measurement.params).is_exact


def _matters(model: CostModel, fastest: Measurement) -> dict[str, Any]:
    """At the technique's fastest configuration, on the frame with the most work."""
    work = operations(fastest.counts[:1], model.terms)[0]
    shares = work * np.array(model.ms_per_op) / model.predict(fastest.counts[:1])[0]
    slopes = dict(zip(model.terms, map(float, shares), strict=True))
    return {
        "labels": {"technique": model.technique},
        "at": dict(zip(model.terms, map(float, work), strict=True)),
        "slopes": dict(sorted(slopes.items(), key=lambda item: -item[1])),
    }


def _best(predictions: tuple[Prediction, ...], models: dict[str, CostModel], seed: int) -> list[dict[str, Any]]:
    """The fastest as far as is known: measured times are taken for true, predictions err as the model's left-out
    error says, each by itself."""
    expected = np.array([p.predicted_ms if p.measured_ms is None else p.measured_ms for p in predictions])
    unsure = np.array([p.measured_ms is None for p in predictions])
    spread = np.array([models[p.configuration.technique].spread for p in predictions]) * unsure
    moved = np.random.default_rng(seed).normal(size=(_SAMPLES, len(predictions)))
    sampled = expected * np.exp(spread * moved)
    best = fastest_of(expected, sampled)
    chosen = predictions[best.row].configuration
    alike = [p.configuration.params for p in predictions if p.configuration.technique == chosen.technique]
    return [
        {
            "labels": {"technique": chosen.technique},
            "params": {name: chosen.params[name] for name in _varying(alike)},
            "time_ms": best.time_ms,
            "expected_regret": best.expected_regret,
            "worst_regret": best.worst_regret,
            "of": len(predictions),
        }
    ]


def _influential(model: CostModel, measurements: list[Measurement]) -> list[dict[str, Any]]:
    """d(prediction) / d(measurement), by implicit differentiation of the least squares in logs that the fit is, each
    row with the same weight. A configuration's frames move together."""
    counts = [frame for m in measurements for frame, repeats in _frames(m) if repeats]
    owner = np.array([k for k, m in enumerate(measurements) for _, repeats in _frames(m) if repeats])
    parts = np.column_stack([np.full(len(counts), model.fixed_ms), operations(counts, model.terms) * model.ms_per_op])
    shares = parts / parts.sum(axis=1, keepdims=True)
    moved = shares @ np.linalg.pinv(shares)  # [predictions, measurements], of logarithms
    of_each = np.array([moved[:, owner == k].sum(axis=1) for k in range(len(measurements))])
    slopes = np.sqrt(np.mean(of_each**2, axis=1))
    settings = [configuration(m.technique, m.params).params for m in measurements]  # a record may leave defaults out
    varying = _varying(settings)
    return [
        {
            "labels": {"technique": model.technique},
            "row": {name: settings[k][name] for name in varying},
            "slope": float(slopes[k]),
        }
        for k in np.argsort(-slopes, kind="stable")[:_MOST_INFLUENTIAL]
    ]


def _varying(settings: Sequence[Mapping[str, Value]]) -> list[str]:
    """Names of the parameters that do not have one value everywhere."""
    return [name for name in settings[0] if any(one[name] != settings[0][name] for one in settings)]


def _frames(measurement: Measurement) -> Iterable[tuple[Mapping[str, int], Sequence[float]]]:
    return zip(measurement.counts, measurement.stages_ms["frame"], strict=False)
