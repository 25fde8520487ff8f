"""The shadow of one light on a view by a shadow technique: its grid, capacities that fit, the mask and what it took."""

from __future__ import annotations

import numbers
from dataclasses import dataclass

import numpy as np

from vtfs.camera import Camera
from vtfs.cluster_grid import ClusterGrid, cluster_grid
from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.shadow_capacities import fitted
from vtfs.shadow_casters import Casters, FrontFaces, ShadowLight, require_near
from vtfs.shadow_counts import shadow_counts
from vtfs.shadow_mask import ShadowFrame, ShadowMask, ShadowPlan, casters_on_device, default_bias_m, shadow_frame
from vtfs.shadow_programs import SHADOW_TECHNIQUES, run_program
from vtfs.shadow_volumes.sample_tiles import KEY_BITS
from vtfs.view_samples import ViewSamples


@dataclass(frozen=True)
class CastShadows:
    """A mask on the host.

    - `shadowed`: bool `[h, w]`; false where nothing was tested.
    - `tests`: int32 `[h, w]`: triangles that each sample's tile or cluster was tested against: a heat map.
    - `counts`: see `shadow_counts`; `plan`: with the capacities that held the frame.
    """

    shadowed: np.ndarray
    tests: np.ndarray
    counts: dict[str, int]
    plan: ShadowPlan


def cast_shadows(
    technique: str,
    plan: ShadowPlan,
    samples: ViewSamples,
    casters: Casters,
    light: ShadowLight,
    depth_slices: int = 0,
    front_faces: FrontFaces = "cast",
    receives: np.ndarray | None = None,
    bias_m: float | None = None,
) -> CastShadows:
    """The shadow of one light on a view: sized, run and brought to the host.

    **Arguments:** as of `shadow_frame`; `bias_m` is 1e-5 of the casters' extent unless given.

    **Raises:** `InputError` for an unknown technique, a point light further than `FARTHEST_EXTENTS`, a wrong argument,
    or where no capacity holds the frame.
    """
    if technique not in SHADOW_TECHNIQUES:
        raise InputError(f"shadow technique `{technique}`: unknown; choose from {', '.join(SHADOW_TECHNIQUES)}.")
    require_near(light, casters)
    bias = default_bias_m(casters) if bias_m is None else bias_m
    return cast_by_bias(technique, plan, samples, casters, light, depth_slices, front_faces, receives, bias)


def cast_by_bias(
    technique: str,
    plan: ShadowPlan,
    samples: ViewSamples,
    casters: Casters,
    light: ShadowLight,
    depth_slices: int,
    front_faces: FrontFaces,
    receives: np.ndarray | None,
    bias_m: float,
) -> CastShadows:
    """`cast_shadows` of casters that may be a small part of those that the light is near to."""
    grid = shadow_grid(samples, plan.tile_px, depth_slices)
    frame = shadow_frame(samples, casters_on_device(casters), light, grid, bias_m, receives, front_faces)
    plan = fitted(technique, plan, frame)
    return on_host(run_program(technique, plan, frame), plan, frame)


def on_host(mask: ShadowMask, plan: ShadowPlan, frame: ShadowFrame) -> CastShadows:
    """Bring a mask and its counts to the host.

    **Raises:** `InputError` where it overflowed: such a mask is never used.
    """
    if bool(mask.overflowed):
        raise InputError("shadows: the frame no longer fits the capacities that its sizing run found.")
    viewport = frame.positions.viewport
    return CastShadows(
        from_runs(np.asarray(mask.shadowed), viewport),
        from_runs(np.asarray(mask.tests), viewport),
        shadow_counts(mask, frame, plan),
        plan,
    )


def shadow_grid(samples: ViewSamples, tile_px: int, depth_slices: int = 0) -> ClusterGrid:
    """The grid of clusters of a view.

    **Raises:** `InputError` where it has more columns, rows or slices than keys can tell apart.
    """
    if not isinstance(depth_slices, numbers.Integral) or depth_slices < 0:
        raise InputError(f"`depth_slices` = {depth_slices!r}: must be a whole number from 0 to {2**KEY_BITS:,}.")
    depths = -samples.position_m[..., 2][samples.valid]
    return grid_of(samples.camera, float(depths.max(initial=samples.camera.near_m)), tile_px, depth_slices)


def grid_of(camera: Camera, deepest_m: float, tile_px: int, depth_slices: int) -> ClusterGrid:
    """The same, of a camera whose deepest sample is known."""
    grid = cluster_grid(camera, tile_px, depth_slices, deepest_m)
    n_slices = int(grid.depth_slices)
    longest_px = max(camera.viewport.width_px, camera.viewport.height_px)
    if -(-longest_px // tile_px) > 2**KEY_BITS:
        raise InputError(
            f"tile_px={tile_px} cuts {longest_px:,} pixels into {-(-longest_px // tile_px):,} tiles along one axis: "
            f"shadow clusters have at most {2**KEY_BITS:,}; use larger tiles."
        )
    if n_slices > 2**KEY_BITS:
        raise InputError(
            f"tile_px={tile_px} with depth_slices={depth_slices} makes {n_slices:,} slices: shadow clusters have at "
            f"most {2**KEY_BITS:,}; use larger tiles or fewer slices."
        )
    return grid
