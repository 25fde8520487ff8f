"""How many samples a shadow method got wrong, against float64 brute force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vtfs.shadow_mask import facing_samples
from vtfs.shadow_references import brute_force, is_excused, view_points_m
from vtfs.stability.shadow_methods import ShadowRunner
from vtfs.stability.stage import ShadowCase


@dataclass(frozen=True)
class ShadowVerdict:
    """One method on one rung, in samples.

    - `false_light`, `false_shadow`: errors. `near_edge`, `near_plane`: what `is_excused` excuses.
    - `refused`: why the method did not run, or nothing.
    """

    false_light: int = 0
    false_shadow: int = 0
    near_edge: int = 0
    near_plane: int = 0
    refused: str = ""


@dataclass(frozen=True)
class ShadowOutcome:
    """One rung: samples that the reference leaves lit, and in shadow; a verdict for each method."""

    lit: int
    shadowed: int
    verdicts: dict[str, ShadowVerdict]


def judge_shadows(case: ShadowCase, runner: ShadowRunner) -> ShadowOutcome:
    """Run all methods on a case: on the samples that face the light, of those that the case tests."""
    receives = facing_samples(case.samples, case.light) & case.tested
    points, eye = view_points_m(case.samples, receives), np.array(case.samples.camera.eye_m)
    reference = brute_force(points, case.casters, case.light, case.bias_m, eye)
    answers = {method.name: answer for method, answer in runner.answers(case, receives)}
    differs = np.zeros(len(points), bool)
    for answer in answers.values():
        if not isinstance(answer, str):
            differs |= answer != reference
    # Whoever gives the other answer, the same is to be said of it.
    near_edge, near_plane = np.zeros((2, len(points)), bool)
    near_edge[differs], near_plane[differs] = is_excused(
        points[differs],
        ~reference[differs],
        case.casters,
        case.light,
        case.bias_m,
        case.own_triangle[receives][differs],
        eye,
    )

    def verdict(answer: np.ndarray | str) -> ShadowVerdict:
        if isinstance(answer, str):
            return ShadowVerdict(refused=answer)
        wrong = (answer != reference) & ~near_edge & ~near_plane
        return ShadowVerdict(
            int((wrong & ~answer).sum()),
            int((wrong & answer).sum()),
            int(((answer != reference) & near_edge).sum()),
            int(((answer != reference) & near_plane & ~near_edge).sum()),
        )

    n_shadowed = int(reference.sum())
    return ShadowOutcome(
        len(points) - n_shadowed, n_shadowed, {name: verdict(answer) for name, answer in answers.items()}
    )
