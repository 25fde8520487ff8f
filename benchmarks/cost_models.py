"""How good the cost models are: published tables, a public tile-size sweep, known laws, our own measurements.

One table of question, figure and target; peers are fitted to the same rows, in environments of their own.

python -m benchmarks.cost_models [published ntiled synthetic tiles own refits] [--published DIR] [--draws 200]
    [--regressors PYTHON] [--extrap PYTHON]

`PYTHON` is an interpreter with xgboost, scikit-learn and scipy, or with extrap 4.2.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.cost_cases import ntiled, own, published, refits, synthetic
from benchmarks.cost_cases.peers import Peers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["published", "ntiled", "synthetic", "tiles", "own", "refits"])
    parser.add_argument("--published", type=Path, default=Path("../shared/published"))
    parser.add_argument("--measurements", type=Path, default=Path("benchmarks/h200_atrium/measurements.jsonl"))
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--regressors", type=Path)
    parser.add_argument("--extrap", type=Path)
    options = parser.parse_args()
    peers = Peers(options.regressors, options.extrap)
    parts = {
        "published": lambda: published.rows(options.published, peers),
        "ntiled": lambda: ntiled.rows(options.published / "ntiled_tile_sweep.csv", peers),
        "synthetic": lambda: synthetic.rows(options.draws, peers),
        "tiles": lambda: synthetic.tile_rows(options.draws, peers),
        "own": lambda: own.rows(options.measurements, peers),
        "refits": refits.rows,
    }
    for part in options.parts:
        print(f"\n== {part}")
        for question, figure, target in parts[part]():
            print(f"{question:<52} | {figure:<64} | {target}")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
