"""The campaign over shadow masks: its variants, its views, and that it sees a wrong sample."""

from __future__ import annotations

import itertools
import json
import threading

import numpy as np

from benchmarks.run_lines import RunLines
from benchmarks.shadow_exactness import Walker, key_of, table, total
from benchmarks.shadow_variants import VALUES, exists, one_at_a_time, pairwise, unrolled, variant
from benchmarks.shadow_views import LIGHTS, Subject
from vtfs.camera import Viewport
from vtfs.shadow_references import brute_force


def test_the_variants_hold_each_pair_of_values_that_exists():
    every = [dict(zip(VALUES, values, strict=True)) for values in itertools.product(*VALUES.values())]
    pairs = {pair for choice in every if exists(choice) for pair in itertools.combinations(choice.items(), 2)}
    chosen = pairwise()
    assert pairs == {pair for choice in chosen for pair in itertools.combinations(choice.items(), 2)}
    assert (("technique", "ptsv"), ("tree", "full")) not in pairs and len(chosen) < 20
    alone = one_at_a_time()
    for name, values in VALUES.items():
        assert {choice[name] for choice in alone} >= set(values)
    names = [variant(choice, 2**16).name for choice in alone]
    assert len(set(names)) == len(names)


def test_a_view_is_right_and_one_wrong_sample_is_seen():
    subject = Subject("atrium", None, Viewport(96, 54), 1_000)
    view = subject.view(0, 3, "inside")
    assert subject.view(0, 3, "inside") is view and view.light != subject.view(0, 3, "above").light
    shadowed = brute_force(view.points_m, subject.casters, view.light, view.bias_m, view.eye_m, view.own)
    one_at_once = threading.Semaphore(1)
    for one in (variant(pairwise()[0], subject.n_padded), unrolled(subject.n_padded)[1]):
        mask = Walker(one, subject.n_padded, one_at_once).mask(view)
        found = view.judged(mask, "cast")
        assert found["errors"] == found["not_classified"] == 0
        assert found["samples"] == len(shadowed) and found["shadowed"] == shadowed.sum() > 100
        assert found["differs"] <= 1e-3 * len(shadowed)
    # Turned over, all that is not in a band is an error.
    turned = view.judged(~mask & view.receives, "cast")
    assert turned["errors"] > 300 and turned["differs"] == found["samples"] - found["differs"]
    assert turned["not_classified"] == turned["differs"] - 400
    # A sample that receives nothing must be lit.
    beyond = mask.copy()
    beyond[np.unravel_index(np.flatnonzero(~view.receives.ravel())[0], mask.shape)] = True
    assert view.judged(beyond, "cast")["errors"] == 1


def test_the_light_stands_at_the_eye_and_then_behind_the_camera():
    subject = Subject("atrium", None, Viewport(32, 18), 1_000)
    for frame, is_behind in ((0, False), (1, True)):
        view = subject.view(frame, 3, LIGHTS[2])
        camera = view.samples.camera
        moved = np.array(view.light.position_m) - camera.eye_m
        assert (np.linalg.norm(moved) > 0) == is_behind
        assert moved @ (np.array(camera.target_m) - camera.eye_m) < 0 or not is_behind


def test_lines_are_kept_and_a_run_goes_on(tmp_path):
    path = tmp_path / "shadow-exactness.jsonl"
    line = {"scene": "a", "frame": 0, "light": "inside", "variant": "v", "triangles": 5, "samples": 1_000} | {
        "shadowed": 10, "by_itself": 0, "differs": 2, "own_plane": 0, "near_edge": 1, "near_plane": 1,
        "errors": 0, "not_classified": 0,
    }  # fmt: skip
    results = RunLines(path, key_of)
    results.add({"scene": "a", "frame": 0, "light": "above", "variant": "v", "failed": "out of memory"})
    results.add(line)
    with path.open("a") as file:
        file.write(json.dumps(line)[:20])  # as a run that was killed leaves it
    again = RunLines(path, key_of)
    assert ("a", 0, "inside", "v") in again.known() and ("a", 0, "above", "v") not in again.known()
    found = total(again.lines)
    assert (found["masks"], found["failed"], found["samples"], found["most_in_bands"]) == (1, 1, 1_000, 0.002)
    again.add({**line, "light": "above"})
    assert total(again.lines)["failed"] == 0
    assert table(again.lines).endswith("| a | 5 | 2 | 2 | 2,000 | 1% | 4 | 2 | 2, 0 | 0.2000% | 0 |")
