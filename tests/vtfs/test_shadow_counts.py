"""What a walk of shadow volumes counts is what a slow loop over triangles and nodes counts."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.strategies import SMALL, a_camera, surface_samples
from tests.vtfs.shadow_cases import CLUSTERS, N_TRIANGLES, TILES, light_of, soup
from vtfs.shadow_counts import shadow_counts
from vtfs.shadow_mask import ShadowFrame, ShadowPlan, casters_on_device, default_bias_m, shadow_frame
from vtfs.shadow_programs import run_program
from vtfs.shadow_techniques import shadow_grid
from vtfs.shadow_volumes import cluster_hierarchy
from vtfs.shadow_volumes import ptsv as tiles
from vtfs.shadow_volumes.hierarchy import Hierarchy
from vtfs.shadow_volumes.planes import PAD
from vtfs.shadow_volumes.volumes import Volumes


@dataclass
class Counted:
    """Of each level below the root; `of_triangle`: tests of nodes and samples."""

    node_tests: list[int] = field(default_factory=list)
    accepted: list[int] = field(default_factory=list)
    refined: list[int] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)
    extra: list[int] = field(default_factory=list)
    sample_tests: int = 0
    of_triangle: np.ndarray = field(default_factory=lambda: np.zeros(N_TRIANGLES, int))


def counted_one_by_one(volume: Volumes, hierarchy: Hierarchy, plan: ShadowPlan) -> Counted:
    """Every triangle at every child of every node that it goes on to, in float64."""
    found, table, b = Counted(), hierarchy.table, plan.branching
    lists = {0: np.flatnonzero(volume.safe)}
    in_shadow: set[int] = set()
    planes = jax.tree.map(lambda c: np.asarray(c, np.float64), volume.nodes.at(jnp.arange(N_TRIANGLES)))
    for level, first in enumerate(table.first_row):
        only = int(table.n_below[level]) == 1
        children: dict[int, np.ndarray] = {}
        covered: set[int] = set()
        total = dict.fromkeys((column.name for column in fields(Counted)[:5]), 0)
        for node, listed in lists.items():
            boxes = np.asarray(table.row[first + node], np.float64)
            for child in np.flatnonzero(~np.isnan(boxes[0])):
                place = node * b + int(child) if table.child is None else int(table.child[first + node, child])
                if only:
                    children[place] = listed
                    continue
                box = boxes[:, child]
                ends = [fate(planes, t, box, hierarchy.is_frustum, float(volume.bias_m)) for t in listed.tolist()]
                goes_on = np.array([end == "refined" for end in ends], bool)
                total["node_tests"] += len(listed)
                total["accepted"] += ends.count("accepted")
                total["extra"] += ends.count("refined") + ends.count("rejected by extra planes")
                np.add.at(found.of_triangle, listed, 1)
                if "accepted" in ends or node in in_shadow:
                    covered.add(place)
                if place in covered and plan.feedback:
                    total["dropped"] += int(goes_on.sum())
                else:
                    total["refined"] += int(goes_on.sum())
                    children[place] = listed[goes_on]
        lists, in_shadow = children, covered
        for name, n in total.items():
            getattr(found, name).append(n)
    for item, listed in lists.items():
        n_samples = int(hierarchy.n_in_tile[item])
        found.sample_tests += len(listed) * n_samples
        np.add.at(found.of_triangle, listed, n_samples)
    return found


def fate(planes, t: int, box: np.ndarray, is_frustum: bool, bias_m: float) -> str:
    """What a node's test of one triangle says; `box` as a row of the table."""
    everywhere = len(planes.offset) > 1
    is_inside = True
    for k, plane in enumerate((*planes.side, planes.face, *planes.extra)):
        normal = np.array([c[t] for c in plane])
        offset = planes.offset[k][t] if everywhere else planes.offset[0][t] if k == 3 else 0.0
        low, high = distances(normal, offset, box, is_frustum)
        if high < 0:
            return "rejected" if k < 4 else "rejected by extra planes"
        is_inside &= k > 3 or low > (bias_m if k == 3 else 0)
        if k == 3 and is_inside:
            return "accepted"
    return "refined"


def distances(normal: np.ndarray, offset: float, box: np.ndarray, is_frustum: bool) -> tuple[float, float]:
    """Least and greatest distance of all corners from a plane, padded as the table is."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    if not is_frustum:
        all_of = (box[:3] + signs * box[3:]) @ normal
    else:
        slope = np.column_stack([box[:2] + signs[:, :2] * box[3:5], np.full(8, -1.0)])
        lean = slope @ normal + signs[:, 2] * abs(normal[2]) * PAD
        all_of = np.concatenate([box[2] * lean, box[5] * lean])
    pad = PAD * abs(offset)
    return all_of.min() - (offset + pad), all_of.max() - (offset - pad)


def a_frame() -> ShadowFrame:
    camera, rng = a_camera(SMALL), np.random.default_rng(6)
    samples, casters = surface_samples(camera, 6), soup(camera, rng, largest=1.0)
    light = light_of(camera, "inside", rng)
    return shadow_frame(samples, casters_on_device(casters), light, shadow_grid(samples, 8), default_bias_m(casters))


@pytest.mark.parametrize(
    ("technique", "plan"),
    [
        ("cluster_hierarchy", CLUSTERS),
        ("cluster_hierarchy", replace(CLUSTERS, feedback=False, bounds="implicit", branching=4)),
        ("ptsv", replace(TILES, branching=4)),
    ],
    ids=["feedback", "implicit", "ptsv"],
)
def test_a_walk_counts_what_a_loop_counts(technique, plan):
    frame = a_frame()
    stages = tiles if technique == "ptsv" else cluster_hierarchy
    mask = run_program(technique, plan, frame)
    with jax.enable_x64(True):
        volume, hierarchy = jax.jit(lambda f: (stages.shadow_planes(f, plan), stages.shadow_build(f, plan)))(frame)
    expected = counted_one_by_one(volume, hierarchy, plan)
    counts = mask.counts
    for name in ("node_tests", "accepted", "refined", "dropped"):
        assert np.asarray(getattr(counts, name)).tolist() == getattr(expected, name), name
    assert np.asarray(counts.extra_plane_tests).tolist() == expected.extra
    assert int(counts.sample_tests) == expected.sample_tests
    assert (np.asarray(counts.tests_of_triangle) == expected.of_triangle).all()
    assert min(sum(expected.accepted), sum(expected.refined)) > 0
    assert sum(expected.extra) > sum(expected.refined) + sum(expected.dropped)
    assert (sum(expected.dropped) > 0) == plan.feedback
    rejected = sum(expected.node_tests) - sum(expected.accepted) - sum(expected.refined) - sum(expected.dropped)
    assert shadow_counts(mask, frame, plan)["rejected_nodes"] == rejected
