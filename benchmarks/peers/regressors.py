# The peers live in an environment of their own.
# pyright: reportMissingImports=false
"""XGBoost, Gaussian processes and a non-negative line on cases from stdin; needs xgboost, scikit-learn, scipy.

Run by `benchmarks/cost_models.py`, in an environment of its own.
"""

import json
import sys
import warnings

import numpy as np
from scipy.optimize import nnls
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, DotProduct, Matern, WhiteKernel
from xgboost import XGBRegressor


def line(train, times, test):
    """Relative non-negative least squares on a constant and every column."""
    design = np.column_stack([np.ones(len(train)), train]) / times[:, None]
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1
    costs = nnls(design / scale, np.ones(len(times)))[0] / scale
    return np.column_stack([np.ones(len(test)), test]) @ costs


def xgboost(train, times, test):
    """Log times; 200 shallow trees, as the rows are few."""
    model = XGBRegressor(n_estimators=200, max_depth=3, learning_rate=0.1, n_jobs=1, random_state=0)
    return np.exp(model.fit(train, np.log(times)).predict(test))


def _process(kernel, train, times, test):
    inputs = np.log1p(np.vstack([train, test]))
    mean, spread = inputs[: len(train)].mean(axis=0), inputs[: len(train)].std(axis=0)
    inputs = (inputs - mean) / np.where(spread > 0, spread, 1)
    model = GaussianProcessRegressor(kernel, normalize_y=True, n_restarts_optimizer=2, random_state=0)
    return np.exp(model.fit(inputs[: len(train)], np.log(times)).predict(inputs[len(train) :]))


def gp_matern(train, times, test):
    return _process(ConstantKernel() * Matern(np.ones(train.shape[1]), nu=2.5) + WhiteKernel(), train, times, test)


def gp_linear_matern(train, times, test):
    kernel = ConstantKernel() * DotProduct() + ConstantKernel() * Matern(np.ones(train.shape[1]), nu=2.5)
    return _process(kernel + WhiteKernel(), train, times, test)


def main():
    warnings.simplefilter("ignore")
    cases = json.load(sys.stdin)
    peers = {
        "NNLS line": line,
        "XGBoost": xgboost,
        "GP Matern": gp_matern,
        "GP linear + Matern": gp_linear_matern,
    }
    found = {name: [] for name in peers}
    for case in cases:
        train, times, test = (np.array(case[key], float) for key in ("train", "times_ms", "test"))
        for name, peer in peers.items():
            found[name].append(peer(train, times, test).tolist())
    json.dump(found, sys.stdout)


main()
