# The peers live in an environment of their own.
# pyright: reportMissingImports=false
"""Extra-P on cases of one column from stdin; needs extrap 4.2.

Run by `benchmarks/cost_models.py`, in an environment of its own. Cases of several columns come back as NaN: its
modelers of several parameters want rows along lines parallel to the axes, which these tables do not have.
"""

import contextlib
import json
import logging
import sys
import warnings

import numpy as np
from extrap.entities.callpath import Callpath
from extrap.entities.coordinate import Coordinate
from extrap.entities.experiment import Experiment
from extrap.entities.measurement import Measurement
from extrap.entities.metric import Metric
from extrap.entities.parameter import Parameter
from extrap.modelers.model_generator import ModelGenerator
from extrap.modelers.single_parameter.basic import SingleParameterModeler
from extrap.modelers.single_parameter.segmented import SegmentedModeler


def negative_exponents():
    modeler = SingleParameterModeler()
    modeler.allow_negative_exponents = True
    return modeler


def predict(make, train, times, test):
    if len(train[0]) != 1:
        return [float("nan")] * len(test)
    experiment = Experiment()
    experiment.add_parameter(Parameter("x"))
    callpath, metric = Callpath("frame"), Metric("time")
    experiment.add_callpath(callpath)
    experiment.add_metric(metric)
    for (x,), time in sorted(zip(train, times, strict=True)):
        coordinate = Coordinate(x)
        experiment.add_coordinate(coordinate)
        experiment.add_measurement(Measurement(coordinate, callpath, metric, time))
    ModelGenerator(experiment, make(), name="model").model_all()
    model = experiment.modelers[0].models[callpath, metric]
    found = np.array([np.ravel(model.hypothesis.function.evaluate(x))[0] for (x,) in test], float)
    return np.where(np.isfinite(found), found, np.nan).tolist()


def main():
    warnings.simplefilter("ignore")
    logging.disable(logging.CRITICAL)
    cases = json.load(sys.stdin)
    peers = {
        "Extra-P": SingleParameterModeler,
        "Extra-P, negative exponents": negative_exponents,
        "Extra-P, segmented": SegmentedModeler,
    }
    found = {}
    with contextlib.redirect_stdout(sys.stderr):
        for name, make in peers.items():
            found[name] = []
            for case in cases:
                try:
                    found[name].append(predict(make, case["train"], case["times_ms"], case["test"]))
                except Exception as error:  # whatever it refuses is a case without a prediction
                    print(f"{name}: {error!r}", file=sys.stderr)
                    found[name].append([float("nan")] * len(case["test"]))
    json.dump(found, sys.stdout)


main()
