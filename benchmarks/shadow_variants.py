"""Variants of the two hierarchical shadow techniques: each value of each parameter, and each pair of values."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

from vtfs.shadow_casters import FrontFaces
from vtfs.shadow_mask import ShadowPlan

VALUES: dict[str, tuple[Any, ...]] = {
    "technique": ("cluster_hierarchy", "ptsv"),
    "tile_px": (8, 4, 16),
    "branching": (8, 32, 4),
    "bounds": ("explicit", "implicit"),
    "extra": ("vertex", "off", "silhouette"),
    "feedback": (True, False),
    "batch": ("all", "quarter"),
    "passes": ((1, 0), (2, 0), (2, 1)),
    "tree": ("compact", "full"),
    "front_faces": ("cast", "culled"),
}
"""The first is the default. `passes`: how many, and the level at which the second begins, 0: halfway. `batch`: all
triangles, or a quarter of them."""

MORE_VALUES = {"tile_px": (2, 5, 32), "branching": (2, 16, 64)}
"""Tried one at a time."""

_ONLY_CLUSTERS = {"bounds": "explicit", "tree": "compact"}
"""What ptsv does not have."""

FULL_TREE_SLICES = 32
"""Of a full tree, whose size is to be the same for all scenes."""


@dataclass(frozen=True)
class Variant:
    """A technique, its plan without capacities, and what casts.

    - `unrolled`: the program that is timed on a GPU, without loops, with the capacities of one view.
    """

    name: str
    technique: str
    plan: ShadowPlan
    front_faces: FrontFaces
    unrolled: bool = False

    @property
    def depth_slices(self) -> int:
        return FULL_TREE_SLICES if self.plan.tree == "full" else 0


def variant(choice: dict[str, Any], n_triangles: int) -> Variant:
    """A choice of values for so many triangles."""
    passes, level = choice["passes"]
    plan = ShadowPlan(
        tile_px=choice["tile_px"],
        branching=choice["branching"],
        bounds=choice["bounds"],
        extra=choice["extra"],
        feedback=choice["feedback"],
        batch=0 if choice["batch"] == "all" else n_triangles // 4,
        passes=passes,
        level=level,
        tree=choice["tree"],
    )
    name = " ".join(f"{name}={_text(value)}" for name, value in choice.items() if name != "technique")
    return Variant(f"{choice['technique']} {name}", choice["technique"], plan, choice["front_faces"])


def unrolled(n_triangles: int) -> list[Variant]:
    """The defaults as they are timed."""
    defaults = [{name: values[0] for name, values in VALUES.items()} | {"technique": t} for t in VALUES["technique"]]
    found = [variant(choice, n_triangles) for choice in defaults]
    return [replace(one, name=f"unrolled {one.name}", unrolled=True) for one in found]


def _text(value: Any) -> str:
    return "{}@{}".format(*value) if isinstance(value, tuple) else str(value)


def exists(choice: dict[str, Any]) -> bool:
    return choice["technique"] != "ptsv" or all(choice[name] == value for name, value in _ONLY_CLUSTERS.items())


def pairwise() -> list[dict[str, Any]]:
    """Choices that hold every pair of values that exists: each takes the most pairs that none before holds."""
    every = [dict(zip(VALUES, values, strict=True)) for values in itertools.product(*VALUES.values())]
    every = [choice for choice in every if exists(choice)]
    held = [frozenset(itertools.combinations(choice.items(), 2)) for choice in every]
    pairs, chosen = set().union(*held), []
    while pairs:
        best = max(range(len(every)), key=lambda k: len(held[k] & pairs))
        chosen.append(every[best])
        pairs -= held[best]
    return chosen


def one_at_a_time() -> list[dict[str, Any]]:
    """The default of both techniques, and every other value of each parameter beside it."""
    chosen = []
    for technique in VALUES["technique"]:
        default = {name: values[0] for name, values in VALUES.items()} | {"technique": technique}
        chosen.append(default)
        for name, values in VALUES.items():
            others = (*values[1:], *MORE_VALUES.get(name, ()))
            chosen += [default | {name: value} for value in others if name != "technique"]
    return [choice for choice in chosen if exists(choice)]
