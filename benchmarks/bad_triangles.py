"""Does any bad triangle shadow what float64 brute force leaves lit? Thousands of random ones, on the stress stage.

    PYTHONPATH=. python benchmarks/bad_triangles.py --rounds 5

Each round draws a light among the things on the stage and 400 triangles of one kind around it; `ptsv` and
`cluster_hierarchy` are run on all that is seen, and differ where they do by what `is_excused` says. Counts only: a busy
machine does not matter.
"""

from __future__ import annotations

import argparse

import numpy as np

from vtfs.stability.bad_triangles import KINDS, bad_triangles, tilted_triangles
from vtfs.stability.shadow_ladders import N_EDGES, N_TRIANGLES, N_VERTICES
from vtfs.stability.shadow_methods import SHADOW_METHODS, ShadowRunner, Shapes
from vtfs.stability.shadow_verdicts import judge_shadows
from vtfs.stability.stage import default_stage

N = 400
METHODS = ("ptsv", "cluster_hierarchy")


def corners(kind: str, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if kind in KINDS:
        return bad_triangles(kind, light, N, rng)
    middle = rng.uniform([-5, 0.5, -5], [5, 4, 4], (N, 3))
    exponent = rng.uniform(-14, -2)
    tilt, width = (10**exponent, 0.5) if kind == "edge-on" else (0.7, 10**exponent)
    return tilted_triangles(light, middle, tilt, width, rng)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5, help="of each kind, 400 triangles each")
    rounds = parser.parse_args().rounds
    runner = ShadowRunner(
        Shapes(N_TRIANGLES, N_VERTICES, N_EDGES), [method for method in SHADOW_METHODS if method.name in METHODS]
    )
    print(f"{'kind':30} {'triangles':>9} {'samples':>8} {'shadowed':>8}  false light, false shadow, in the bands")
    for kind in ("edge-on", "sliver", *KINDS):
        totals = {name: np.zeros(3, int) for name in METHODS}
        n_samples = n_shadowed = 0
        for seed in range(rounds):
            rng = np.random.default_rng(seed)
            stage = default_stage(seed).lit_from(rng.uniform([-4, 2, -4], [4, 6, 5]))
            found = judge_shadows(
                stage.with_triangles(corners(kind, np.array(stage.light.position_m), rng)).case(), runner
            )
            n_samples, n_shadowed = n_samples + found.lit + found.shadowed, n_shadowed + found.shadowed
            for name, v in found.verdicts.items():
                totals[name] += v.false_light, v.false_shadow, v.near_edge + v.near_plane
        errors = "; ".join(f"{name} {a}, {b}, {c}" for name, (a, b, c) in totals.items())
        print(f"{kind:30} {rounds * N:9,} {n_samples:8,} {n_shadowed:8,}  {errors}", flush=True)


if __name__ == "__main__":
    main()
