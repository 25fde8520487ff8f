"""How much of the light lists is needed: pairs that a sample proves, out of those listed. On the host, exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vtfs.clusters import Clusters
from vtfs.gbuffer import Positions
from vtfs.light_lists import POINT_COLUMNS, LightLists, ViewLights, reach_of_cutoff

_PAIRS_AT_ONCE = 2**15  # (block, light) pairs of 32 samples: 8 MB an array


@dataclass(frozen=True)
class ListedPairs:
    """(cluster, light) pairs of a frame.

    - `listed`: on the lists; `reaching`: those whose light reaches a sample of the cluster.
    """

    listed: int
    reaching: int

    @property
    def ratio(self) -> float:
        """Listed over reaching: 1 where no pair is listed in vain. Infinite where only such are."""
        return self.listed / self.reaching if self.reaching else (1.0 if not self.listed else np.inf)


def listed_pairs(
    positions: Positions, clusters: Clusters, lists: LightLists, lights: ViewLights, light_cutoff: float = 0.0
) -> ListedPairs:
    """Count pairs and those whose light reaches: a sample within the range, its window above the cut-off, and in the
    cone of a spot. Which way surfaces face does not matter. float64, of the float32 positions of the device."""
    n_blocks = int(clusters.n_blocks)
    run, cluster = np.asarray(clusters.block_run)[:n_blocks], np.asarray(clusters.block_cluster)[:n_blocks]
    block = np.asarray(clusters.block_of_sample)
    valid = np.asarray(positions.valid)
    point = np.stack([np.asarray(c, np.float64) for c in (positions.x_m, positions.y_m, positions.z_m)])
    count, offset = np.asarray(lists.count)[cluster].astype(np.int64), np.asarray(lists.offset)[cluster]
    index, row = np.asarray(lists.index), np.asarray(lights.row, np.float64)
    share = float(reach_of_cutoff(np.float32(light_cutoff)))  # type: ignore[arg-type]
    total = int(np.asarray(lists.count)[: int(clusters.n_clusters)].sum(dtype=np.int64))
    reaches = np.zeros(total, bool)
    end = np.cumsum(count)
    for first in range(0, int(end[-1]) if n_blocks else 0, _PAIRS_AT_ONCE):
        pair = np.arange(first, min(first + _PAIRS_AT_ONCE, int(end[-1])))
        b = np.searchsorted(end, pair, side="right")
        entry = offset[b] + pair - (end[b] - count[b])
        light = row[index[entry]]
        here = valid[run[b]] & (block[run[b]] == b[:, None])
        reaches[entry[(here & _reached(point[:, run[b]], light, share)).any(axis=1)]] = True
    return ListedPairs(total, int(reaches.sum()))


def _reached(point: np.ndarray, light: np.ndarray, share: float) -> np.ndarray:
    """Of samples `[3, pairs, 32]` and a light each, bool `[pairs, 32]`."""
    to_sample = point - light[:, :3].T[:, :, None]
    distance2 = (to_sample * to_sample).sum(axis=0)
    reached = distance2 < ((light[:, 7] * share) ** 2)[:, None]
    if light.shape[1] > POINT_COLUMNS:
        along = (to_sample * light[:, 8:11].T[:, :, None]).sum(axis=0)
        reached &= along > light[:, 12, None] * np.sqrt(distance2)
    return reached
