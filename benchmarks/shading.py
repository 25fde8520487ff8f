"""Where a frame's time goes: stages, lanes and steps of the atrium's busiest view, by technique and batch.

python benchmarks/shading.py [BATCH,BATCH,...]
"""

from __future__ import annotations

import sys
import time

import jax
import numpy as np

from vtfs.configurations import configuration
from vtfs.device import device_name
from vtfs.frame import frame_program, image_on_host, planned, run_stages, stage_program
from vtfs.frame_counts import count
from vtfs.frame_inputs import FrameInputs
from vtfs.reference import forward_reference, largest_relative_difference
from vtfs.scene_setup import SceneOptions, set_up
from vtfs.techniques import REGISTRY


def median_ms(run, repeats: int = 9) -> float:
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - started)
    return float(np.median(times)) * 1e3


def main() -> None:
    batches = [int(b) for b in sys.argv[1].split(",")] if len(sys.argv) > 1 else [0, 1024, 4096, 16384, 65536, 2**24]
    setup = set_up(SceneOptions())
    inputs = FrameInputs(setup.samples(5), setup.lights)
    reference = forward_reference(inputs.samples, setup.lights)
    print(device_name())
    for technique in ("tiled_deferred", "volume_tiled_bvh"):
        for batch in batches:
            config = configuration(technique, {"batch": batch})
            counts, _ = count(config, inputs)
            env, sizes = run_stages(config, inputs, counts.sizes)
            program, arguments = (
                frame_program(technique, planned(config, sizes), inputs.has_transparent),
                inputs.environment(config),
            )
            frame_ms = median_ms(lambda program=program, arguments=arguments: program(arguments))
            worst = largest_relative_difference(
                image_on_host(env["shade_opaque"], inputs), reference, inputs.samples.valid
            )
            at = counts.at_batch(batch)
            stages = {}
            for stage in REGISTRY[technique].stages_of(planned(config, sizes), inputs.has_transparent):
                own = stage_program(stage, stage.narrowed(planned(config, sizes)))
                stages[stage.name] = median_ms(
                    lambda own=own, stage=stage, env=env: own(*(env[n] for n in stage.needs))
                )
            print(
                f"{technique} batch={batch}: frame {frame_ms:.2f} ms; "
                + ", ".join(f"{name} {ms:.2f}" for name, ms in stages.items())
                + f"; {at['lighting_computations']:,} computations, {at['shading_lanes']:,} lanes, "
                f"{at['shading_steps']:,} steps; worst difference {worst:.1e}",
                flush=True,
            )


if __name__ == "__main__":
    main()
