"""What a technique's cells look like on the image: whose sample lies where, and the lights listed there in vain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vtfs.configurations import Configuration, configuration, lists_configuration
from vtfs.frame import run_stages
from vtfs.frame_counts import lengths_of
from vtfs.frame_inputs import FrameInputs
from vtfs.gbuffer import from_runs
from vtfs.light_volumes import lights_of_samples
from vtfs.techniques import REGISTRY


@dataclass(frozen=True)
class CellMaps:
    """Of the visible solid samples, `[h, w]`; 0 where there is none.

    - `cell`: key of each sample's cell; `depth_slice`: its slice, 0 nearest.
    - `listed`: lights in its list; `reaching`: lights whose range holds the sample.
    """

    cell: np.ndarray
    depth_slice: np.ndarray
    listed: np.ndarray
    reaching: np.ndarray

    @property
    def false_positives(self) -> np.ndarray:
        """Lights listed for a sample that do not reach it."""
        return np.maximum(self.listed - self.reaching, 0)

    @property
    def listed_per_reaching(self) -> float:
        """Lighting computations done over those that are not in vain; 1 is perfect, NaN where no light reaches."""
        reaching = int(self.reaching.sum(dtype=np.int64))
        return int(self.listed.sum(dtype=np.int64)) / reaching if reaching else float("nan")

    @property
    def listed_in_words(self) -> str:
        """`listed_per_reaching`, for a caption."""
        if not self.reaching.any():
            return "no light reaches a sample"
        return f"{self.listed_per_reaching:.2f} listed for one that reaches"


def cell_maps(config: Configuration, inputs: FrameInputs) -> CellMaps | None:
    """The maps of a technique that shades by cells; None for the others."""
    if REGISTRY[config.technique].lists != "clusters":
        return None
    config = lists_configuration(config)
    env, _ = run_stages(config, inputs, until="assign")
    clusters, positions, grid = env["clusters"], env["positions"], env["grid"]
    visible = np.s_[: positions.n_visible_runs]
    valid = np.asarray(positions.valid)[visible]
    block = np.where(valid, np.asarray(clusters.block_of_sample)[visible], 0)
    key = np.asarray(clusters.key)[np.asarray(clusters.block_cluster)[block]]
    columns, rows = (int(count) for count in grid.tiles(inputs.viewport))
    lengths = lengths_of(config, env, inputs)

    def image(runs: np.ndarray) -> np.ndarray:
        return from_runs(np.where(valid, runs, 0), inputs.viewport)

    return CellMaps(
        cell=image(key),
        depth_slice=image(key // (columns * rows)),
        listed=lengths.of_visible,
        reaching=image(_reaching(inputs, float(config["light_cutoff"]))),
    )


def _reaching(inputs: FrameInputs, light_cutoff: float) -> np.ndarray:
    """Lights that reach each visible sample, `[runs, 32]`: those that the stencil lets through."""
    config = configuration("deferred_stencil", {"light_cutoff": light_cutoff})
    env: dict[str, Any] = run_stages(config, inputs, until="assign")[0]
    return lights_of_samples(env["assign"], env["positions"].n_visible_runs)
