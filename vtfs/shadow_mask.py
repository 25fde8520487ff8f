"""Shadow masks: what a light's shadow needs on the device, what comes out, and what it took."""

from __future__ import annotations

import numbers
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from vtfs.alpha_casters import Casting
from vtfs.cluster_grid import ClusterGrid
from vtfs.gbuffer import Fragments, Positions, to_runs
from vtfs.input_error import InputError
from vtfs.layers import Layers
from vtfs.shadow_casters import BIAS, Casters, FrontFaces, ShadowLight, welded
from vtfs.shadow_volumes.planes import Extra, Precision
from vtfs.shadow_volumes.sample_tiles import MAX_BLOCKS

if TYPE_CHECKING:
    from vtfs.view_samples import ViewSamples

Bounds = Literal["explicit", "implicit"]
Stencil = Literal["unlimited", "wrap", "saturate"]
Tree = Literal["compact", "full"]


class ShadowFrame(eqx.Module):
    """View samples, casters and one light on the device.

    - `receives`: samples that are tested; `grid`: of the clusters, with the tiles of the plan.
    - `edges`: lower and higher vertex, and up to two triangles: `2 t` where triangle t runs from the lower to the
      higher
      one, `2 t + 1` where the other way, -1 for none.
    - `vertex_m`: float64, world space, components apart; `view_from_world`: float64, its rotation.
    - `eye_m`, `light_m`: float64, world space; a directional light is a unit vector toward it.
    - `culls_front`: triangles that face the light cast nothing.
    - `counted`: whether the tests of a walk are counted. Traced: a walk compiles for seconds, and the program that was
      counted is the one that is timed.
    """

    positions: Positions
    receives: Bool[Array, "runs 32"]
    grid: ClusterGrid
    vertex_m: tuple[Float[Array, " vertices"], ...]
    triangles: Int[Array, "triangles 3"]
    edges: Int[Array, "edges 4"]
    rotation: Float[Array, "3 3"]
    eye_m: Float[Array, " 3"]
    light_m: Float[Array, " 3"]
    bias_m: Float[Array, ""]
    culls_front: Bool[Array, ""]
    counted: Bool[Array, ""]
    directional: bool = eqx.field(static=True)


@dataclass(frozen=True)
class ShadowPlan:
    """What is static in a shadow program: it fixes array shapes, or which tests there are.

    - `tile_px`: 1 to 256; `branching`: children of a node, any whole number from 2 on.
    - `extra`: planes for rejection besides the four of a volume.
    - `feedback`: triangles go on only into nodes that no triangle of the same or an earlier batch accepts, and with
      batches not to samples that earlier ones shadow; those that block most of the light come first. Same mask, fewer
      tests.
    - `batch`: triangles walked together, 0: all. Never changes the mask.
    - `passes`: 1 or 2; `level`: where the first of two ends, counted from the root; 0: halfway down.
    - `tree`: of cluster_hierarchy: its nodes that hold occupied clusters, in a list; or all, at the places of their
      keys.
    - `stencil`: of z-pass and z-fail: 8 bits that wrap or saturate, or no limit; `around_eye`: z-pass starts with the
      volumes
      around the eye, without which it fails where the camera stands in one.
    - `precision`: in which samples are tested against planes. float32 leaks at vertices: it is there to show that.
    - `blending`: what alpha casters do to light; `opaque`: they cast nothing.
    - `clusters`, `groups`, `leaf_groups`, `pairs`, `cells`, `nodes`: rounded capacities: of clusters and their blocks,
      of the lists of a level, of the lists of tiles or clusters, of what goes on to a second pass, of the keys of
      clusters, of the nodes of a level of a compact tree.
    - `level_groups`: capacities of each level's lists. Then levels are unrolled and nothing loops, which suits a GPU;
      without them one loop runs over levels of `groups`, in chunks, which suits a CPU.

    **Raises:** `InputError` that names the field, the value and what is allowed.
    """

    tile_px: int = 8
    branching: int = 32
    bounds: Bounds = "explicit"
    extra: Extra = "vertex"
    feedback: bool = True
    batch: int = 0
    passes: int = 1
    level: int = 0
    tree: Tree = "compact"
    stencil: Stencil = "unlimited"
    around_eye: bool = True
    precision: Precision = "float64"
    blending: Casting = "opaque"
    clusters: int = 0
    groups: int = 0
    leaf_groups: int = 0
    pairs: int = 0
    cells: int = 0
    nodes: int = 0
    level_groups: tuple[int, ...] = ()

    def __post_init__(self):
        for name, (low, high) in _WHOLE.items():
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or not low <= value <= (high or value):
                to = f"to {high}" if high else "on"
                raise InputError(f"`ShadowPlan({name}={value!r})`: must be a whole number from {low} {to}.")
        for name, choices in _CHOICES.items():
            require_choice(f"ShadowPlan({name}={getattr(self, name)!r})", getattr(self, name), choices)
        if self.level and self.passes == 1:
            raise InputError(
                f"`ShadowPlan(level={self.level})`: is where the first of two passes ends, and this plan has one; give "
                "passes=2, or level=0."
            )


_FLAG = (False, True)
_WHOLE = {
    "tile_px": (1, 256), "branching": (2, 0), "batch": (0, 0), "passes": (1, 2), "level": (0, 24),
    "clusters": (0, MAX_BLOCKS), "groups": (0, 0), "leaf_groups": (0, 0), "pairs": (0, 0), "cells": (0, 0),
    "nodes": (0, 0),
}  # fmt: skip
"""Fields of a plan that are whole numbers, with the least and the largest value; 0: no largest one."""

_CHOICES = {
    "bounds": get_args(Bounds), "extra": get_args(Extra), "feedback": _FLAG, "tree": get_args(Tree),
    "stencil": get_args(Stencil), "around_eye": _FLAG, "precision": get_args(Precision), "blending": get_args(Casting),
}  # fmt: skip


def require_choice(given: str, value: object, choices: tuple[object, ...]) -> None:
    """**Raises:** `InputError` where a value is none of its choices; `given` says what was given."""
    if value not in choices:
        raise InputError(f"`{given}`: must be one of {', '.join(map(str, choices))}.")


class ShadowCounts(eqx.Module):
    """What a walk did, 64 bits; one entry a level of nodes, the root's children first. Where nothing is counted all are
    zero but what the capacities must hold.

    - `node_tests`: (existing child, triangle) pairs tested; `accepted`, `refined`: of these; `dropped`: what would be
      refined, into children that lie in shadow; the rest is rejected.
    - `extra_plane_tests`: pairs that neither the four planes reject nor accept, which the extra planes then test.
    - `sample_tests`: (valid sample, triangle) pairs at the leaves, all samples of the tile, as the papers test;
      `sample_tests_in_cluster`: only those of the cluster itself; `dropped_samples`: pairs spared by feedback.
    - `stencil_updates`: (sample, polygon) pairs that change a stencil; -1 for algorithms without one.
    - `tests_of_triangle`: of nodes and samples (of a stencil: by polygon).
    - `groups`: groups of each level's lists, the leaves' last: what the capacities must hold; `n_pairs`: pairs that go
      on to a second pass, likewise.
    - `list_length`: triangles tested against each tile or cluster.
    - `n_items`: occupied tiles or clusters; `n_blocks`, `n_nodes`: what `clusters` and `nodes` must hold.
    - `n_casters`: triangles with a volume.
    - `bytes_held`: by the planes of all volumes, by the tree, and by the samples with the bits of their tiles.
    """

    node_tests: Int[Array, " levels"]
    accepted: Int[Array, " levels"]
    refined: Int[Array, " levels"]
    dropped: Int[Array, " levels"]
    extra_plane_tests: Int[Array, " levels"]
    sample_tests: Int[Array, ""]
    sample_tests_in_cluster: Int[Array, ""]
    dropped_samples: Int[Array, ""]
    stencil_updates: Int[Array, ""]
    tests_of_triangle: Int[Array, " triangles"]
    groups: Int[Array, " levels_and_1"]
    n_pairs: Int[Array, ""]
    list_length: Int[Array, " items"]
    n_items: Int[Array, ""]
    n_blocks: Int[Array, ""]
    n_nodes: Int[Array, ""]
    n_casters: Int[Array, ""]
    bytes_held: Int[Array, " 3"]


class ShadowMask(eqx.Module):
    """Which samples a light does not reach.

    - `shadowed`: false where nothing is tested.
    - `overflowed`: a list did not fit its capacity: the mask is thrown away, never used.
    - `tests`: triangles in the lists that each sample's tile or cluster was tested against, where tests are counted.
    """

    shadowed: Bool[Array, "runs 32"]
    overflowed: Bool[Array, ""]
    tests: Int[Array, "runs 32"]
    counts: ShadowCounts


def facing_samples(samples: ViewSamples, light: ShadowLight) -> np.ndarray:
    """Valid samples whose normal does not turn away from the light: bool `[h, w]`. The others are dark without a
    test."""
    matrix = samples.camera.view_from_world
    light_world = light.homogeneous
    light_view = matrix[:3, :3] @ light_world[:3] + light_world[3] * matrix[:3, 3]
    to_light = light_view - light_world[3] * samples.position_m.astype(np.float64)
    return samples.valid & ((to_light * samples.normal).sum(axis=-1) > 0)


def default_bias_m(casters: Casters) -> float:
    return BIAS * casters.extent_m


class CastersOnDevice(eqx.Module):
    """Triangles as the device reads them: float64, world space."""

    vertex_m: tuple[Float[Array, " vertices"], ...]
    triangles: Int[Array, "triangles 3"]
    edges: Int[Array, "edges 4"]


def edge_list(triangles: np.ndarray) -> np.ndarray:
    """Edges as `ShadowFrame.edges`, int32 `[E, 4]`. An edge of more than two triangles is there several times."""
    low_high = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    side = np.tile(2 * np.arange(len(triangles)), 3) + (low_high[:, 0] > low_high[:, 1])
    low_high.sort(axis=1)
    keep = low_high[:, 0] != low_high[:, 1]
    low_high, side = low_high[keep], side[keep]
    order = np.lexsort((side, low_high[:, 1], low_high[:, 0]))
    low_high, side = low_high[order], side[order]
    is_first = np.ones(len(order), bool)
    is_first[1:] = (low_high[1:] != low_high[:-1]).any(axis=1)
    place = np.arange(len(order)) - np.maximum.accumulate(np.where(is_first, np.arange(len(order)), 0))
    first = np.flatnonzero(place % 2 == 0)
    has_second = np.zeros(len(first), bool)
    has_second[: len(first)] = (first + 1 < len(order)) & (place[np.minimum(first + 1, len(order) - 1)] % 2 == 1)
    second = np.where(has_second, side[np.minimum(first + 1, len(order) - 1)], -1)
    return np.column_stack([low_high[first], side[first], second]).astype(np.int32)


def casters_on_device(casters: Casters) -> CastersOnDevice:
    """Upload casters, welded; none at all become one triangle without area, as XLA cannot gather from nothing."""
    vertices, triangles = casters.vertices_m, welded(casters.vertices_m, casters.triangles)
    if not len(triangles):
        vertices, triangles = np.zeros((1, 3)), np.zeros((1, 3), np.int32)
    with jax.enable_x64(True):
        return CastersOnDevice(
            tuple(jax.device_put(np.ascontiguousarray(vertices[:, c])) for c in range(3)),
            jax.device_put(triangles),
            jax.device_put(edge_list(triangles)),
        )


def shadow_frame(
    samples: ViewSamples,
    casters: CastersOnDevice,
    light: ShadowLight,
    grid: ClusterGrid,
    bias_m: float,
    receives: np.ndarray | None = None,
    front_faces: FrontFaces = "cast",
    positions: Positions | None = None,
    counted: bool = True,
) -> ShadowFrame:
    """What a shadow program starts from.

    **Arguments:**

    - `receives`: samples that are tested, bool `[h, w]`; all valid ones unless given.
    - `positions`: of the samples, if they are on the device already.

    **Raises:** `InputError` for `receives` of another shape, a bias that is no length, or unknown `front_faces`.
    """
    camera = samples.camera
    mask = samples.valid if receives is None else _receivers(receives, samples) & samples.valid
    if not isinstance(bias_m, numbers.Real) or not 0 <= bias_m < np.inf:
        raise InputError(f"`bias_m` = {bias_m!r}: must be a finite number of metres, 0 or more.")
    require_choice(f"front_faces={front_faces!r}", front_faces, get_args(FrontFaces))
    # Transparent layers are views of their own.
    alone = replace(samples, layers=Layers())
    with jax.enable_x64(True):
        put: Any = jax.device_put
        return ShadowFrame(
            positions=Fragments(alone, with_hidden=False).positions() if positions is None else positions,
            receives=put(to_runs(mask)),
            grid=grid,
            vertex_m=casters.vertex_m,
            triangles=casters.triangles,
            edges=casters.edges,
            rotation=put(np.ascontiguousarray(camera.view_from_world[:3, :3])),
            eye_m=put(np.asarray(camera.eye_m, np.float64)),
            light_m=put(light.homogeneous[:3]),
            bias_m=put(np.float64(bias_m)),
            culls_front=put(np.bool_(front_faces == "culled")),
            counted=put(np.bool_(counted)),
            directional=light.directional,
        )


def _receivers(receives: np.ndarray, samples: ViewSamples) -> np.ndarray:
    given, shape = np.asarray(receives), samples.valid.shape
    if given.dtype != bool or given.shape != shape:
        raise InputError(
            f"`receives`: is {given.dtype} of shape {given.shape}; must be bool of shape {shape}, one for each sample."
        )
    return given


def uncounted(frame: ShadowFrame) -> ShadowFrame:
    """The same frame for a program that is timed alone: what counting takes is no part of it."""
    return eqx.tree_at(lambda f: f.counted, frame, np.bool_(False))
