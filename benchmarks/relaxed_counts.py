"""Relaxed counts against exact ones at 64 random phases of the grid, their gradient, and what it costs.

python benchmarks/relaxed_counts.py [SCENE,SCENE,...] [SAMPLES]    0 samples: only gradients and times

A scene is a built-in one or a file that `vtfs tune` takes; `CAMERAS` beside a file is `NAME.cameras.json`. The
exact mean is taken over the same samples. "phase zero" is how far the one grid that engines use is from the relaxed
count.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vtfs.camera import Viewport
from vtfs.device import device_name
from vtfs.relaxed_counts import (
    CandidatePairs,
    CountVariables,
    RelaxedFrame,
    expected_lighting_computations,
    expected_list_lengths,
    lighting_computations_at_phase,
)
from vtfs.relaxed_frame import candidate_pairs, count_variables, relaxed_frame
from vtfs.scene_setup import SceneOptions, SceneSetup, set_up

TILES, SLICES = (8, 32, 128), (16, 64, 256, None)
N_PHASES, N_GRADIENTS = 64, 100

expected = jax.jit(expected_lighting_computations)
gradient = jax.jit(jax.value_and_grad(expected_lighting_computations))
list_lengths = jax.jit(expected_list_lengths)


@jax.jit
def at_phases(variables: CountVariables, frame: RelaxedFrame, pairs: CandidatePairs, phases: jax.Array) -> jax.Array:
    return jax.lax.map(lambda phase: lighting_computations_at_phase(variables, frame, pairs, phase), phases)


def scene(name: str, viewport: Viewport) -> SceneSetup:
    cameras = Path(name).with_suffix(".cameras.json")
    return set_up(SceneOptions(scene=name, cameras=cameras if cameras.is_file() else None, viewport=viewport))


def counts(name: str, n_samples: int) -> None:
    """The table of one scene: its view in the middle of the path, at 1280x720."""
    setup = scene(name, Viewport(1280, 720))
    samples = setup.samples(setup.n_frames // 2)
    frame = relaxed_frame(samples, n_samples)
    random = np.random.default_rng(0).uniform(0, 1, (N_PHASES, 3))
    phases = jnp.asarray(np.concatenate([np.zeros((1, 3)), random]), jnp.float32)
    for tile_px in TILES:
        for depth_slices in SLICES:
            variables = count_variables(samples.camera, setup.lights, tile_px, depth_slices)
            pairs = candidate_pairs(variables, frame)
            relaxed = float(expected(variables, frame, pairs))
            zero, *exact = np.asarray(at_phases(variables, frame, pairs, phases), np.float64) * float(frame.weight)
            mean, spread = np.mean(exact), np.std(exact) / N_PHASES**0.5
            off, error, at_zero = relaxed / mean - 1, spread / mean, zero / relaxed - 1
            print(
                f"| {setup.name} | {tile_px} | {depth_slices or 'tiled'} | {relaxed:,.0f} | {mean:,.0f} "
                f"| {off:+.3%} | {error:.3%} | {at_zero:+.2%} |",
                flush=True,
            )


def gradients(setup: SceneSetup) -> None:
    """Slopes in double precision against central differences along a random direction, and how far single precision is
    from double: the norm of the difference over the norm."""
    samples = setup.samples(setup.n_frames // 2)
    frame = relaxed_frame(samples, 256)
    rng = np.random.default_rng(0)
    step = 1e-7
    for depth_slices, temperature in ((24, 0.0), (24, 0.1), (None, 0.1)):
        variables = count_variables(samples.camera, setup.lights, 32, depth_slices)
        pairs = candidate_pairs(variables, frame, temperature)
        single = gradient(variables, frame, pairs, temperature)[1]
        print(f"depth_slices={depth_slices} temperature={temperature}: variable, double against difference, single")
        with jax.enable_x64(True):
            double, still = float64(variables), float64(frame)
            slope = gradient(double, still, pairs, temperature)[1]
            for name in (field.name for field in dataclasses.fields(variables)):
                value = getattr(double, name)
                if value is None:
                    continue
                direction = rng.normal(size=value.shape) * (float(np.abs(value).max()) or 1.0)
                high, low = (
                    float(
                        expected(eqx.tree_at(lambda v, n=name: getattr(v, n), double, moved), still, pairs, temperature)
                    )
                    for moved in (value + step * direction, value - step * direction)
                )
                exact = np.asarray(getattr(slope, name))
                by_gradient = float((exact * direction).sum())
                off = by_gradient / ((high - low) / (2 * step)) - 1
                lost = np.linalg.norm(np.asarray(getattr(single, name)) - exact) / np.linalg.norm(exact)
                print(f"  {name} {off:+.1e} {lost:.1e}", flush=True)


def float64(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf, np.float64)), tree)


def timing(name: str) -> None:
    """100 gradients at 1920x1080, from 512 and from 2,048 samples, and what so few do to the count."""
    setup = scene(name, Viewport(1920, 1080))
    samples = setup.samples(setup.n_frames // 2)
    variables = count_variables(samples.camera, setup.lights, 32, 24)
    dense = relaxed_frame(samples, 65536)
    whole = float(expected(variables, dense, candidate_pairs(variables, dense)))
    for n_samples in (512, 2048, 8192):
        frame = relaxed_frame(samples, n_samples)
        started = time.perf_counter()
        pairs = candidate_pairs(variables, frame)
        found_s = time.perf_counter() - started
        lengths = np.asarray(list_lengths(variables, frame, pairs))
        value = jax.block_until_ready(gradient(variables, frame, pairs))[0]
        times = []
        for _ in range(N_GRADIENTS if n_samples <= 2048 else 10):
            started = time.perf_counter()
            jax.block_until_ready(gradient(variables, frame, pairs))
            times.append(time.perf_counter() - started)
        error, off = lengths.std() / lengths.mean() / n_samples**0.5, float(value) / whole - 1
        print(
            f"{n_samples} samples, {int(pairs.in_use.sum()):,} pairs (found in {found_s:.2f} s): gradient "
            f"{1e3 * np.median(times):.1f} ms ({len(times)} in {sum(times):.2f} s); standard error at most "
            f"{error:.2%}, {off:+.2%} from 65,536 samples",
            flush=True,
        )


def main() -> None:
    names = sys.argv[1].split(",") if len(sys.argv) > 1 else ["atrium", "street", "grove"]
    n_samples = int(sys.argv[2]) if len(sys.argv) > 2 else 4096
    print(device_name())
    print("| scene | tile | slices | relaxed | exact, mean of 64 | deviation | its standard error | phase zero |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in names if n_samples else ():
        counts(name, n_samples)
    gradients(scene(names[0], Viewport(1280, 720)))
    timing(names[0])


if __name__ == "__main__":
    main()
