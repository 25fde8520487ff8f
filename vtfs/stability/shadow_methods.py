"""The shadow methods that are put on the ladders: techniques, precisions, stencils, and what a G-buffer stores."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import equinox as eqx
import jax
import numpy as np

from vtfs.gbuffer import from_runs
from vtfs.input_error import InputError
from vtfs.shadow_capacities import fitted
from vtfs.shadow_casters import Casters, ShadowLight
from vtfs.shadow_mask import CastersOnDevice, ShadowFrame, ShadowPlan, Stencil, casters_on_device, shadow_frame
from vtfs.shadow_programs import run_program
from vtfs.shadow_references import ShadowRays, view_points_m
from vtfs.shadow_techniques import shadow_grid
from vtfs.shadow_volumes.planes import Precision
from vtfs.shadow_volumes.stencil import PolygonCounts, count_polygons, is_set
from vtfs.stability.stage import ShadowCase
from vtfs.view_samples import ViewSamples

Store = Literal["exact", "world_float32", "depth_24", "millimetre"]
"""What a method starts from: our float32 view-space positions; everything in float32 world space; positions from a
depth buffer of 24 bits; or a bias of one millimetre, whatever the scale."""

_PLAN = ShadowPlan(8, 8, clusters=2**12, groups=2**12, leaf_groups=2**14)
_ABSOLUTE_BIAS_M = 1e-3


@dataclass(frozen=True)
class ShadowMethod:
    """One column of the result. `technique` `shadow_rays` is Embree; `around_eye`, `stencil`: see `ShadowPlan`."""

    name: str
    technique: str
    precision: Precision = "float64"
    stencil: Stencil = "unlimited"
    around_eye: bool = True
    store: Store = "exact"


def _all_methods() -> Iterator[ShadowMethod]:
    precisions: tuple[Precision, ...] = ("float64", "float32")
    bits: dict[Stencil, str] = {"unlimited": "", "wrap": ", 8 bits wrapping", "saturate": ", 8 bits saturating"}
    for precision in precisions:
        end = ", float32 test" if precision == "float32" else ""
        yield ShadowMethod(f"cluster_hierarchy{end}", "cluster_hierarchy", precision)
        yield ShadowMethod(f"ptsv{end}", "ptsv", precision)
        for stencil, words in bits.items():
            yield ShadowMethod(f"z_fail{words}{end}", "z_fail", precision, stencil, False)
        for stencil, words in bits.items():
            yield ShadowMethod(f"z_pass{words}{end}", "z_pass", precision, stencil)
        for stencil, words in bits.items():
            yield ShadowMethod(f"z_pass, textbook{words}{end}", "z_pass", precision, stencil, False)
    yield ShadowMethod("shadow_rays (Embree, robust)", "shadow_rays", "float32")
    yield ShadowMethod("cluster_hierarchy, world in float32", "cluster_hierarchy", store="world_float32")
    yield ShadowMethod("cluster_hierarchy, 24-bit depth buffer", "cluster_hierarchy", store="depth_24")
    yield ShadowMethod("cluster_hierarchy, bias of 1 mm", "cluster_hierarchy", store="millimetre")


SHADOW_METHODS: tuple[ShadowMethod, ...] = tuple(_all_methods())


@dataclass(frozen=True)
class Shapes:
    """Sizes that casters are padded to, so that all rungs of a ladder share programs."""

    n_triangles: int
    n_vertices: int
    n_edges: int


class ShadowRunner:
    """Runs methods on cases, with capacities that grow where a case needs it.

    **Arguments:**

    - `shapes`: what casters are padded to; none: as they are.
    """

    def __init__(self, shapes: Shapes | None, methods: Sequence[ShadowMethod] = SHADOW_METHODS):
        self._shapes = shapes
        self._methods = tuple(methods)
        self._plans: dict[str, ShadowPlan] = {}

    def answers(self, case: ShadowCase, receives: np.ndarray) -> Iterator[tuple[ShadowMethod, np.ndarray | str]]:
        """Of each method which samples that receive light are in shadow, bool `[n]`; or why it has no answer."""
        frame = functools.cache(lambda store: self._frame(case, receives, store))
        polygons = functools.cache(lambda technique, precision: self._polygons(technique, precision, frame("exact")))

        def answer(method: ShadowMethod) -> np.ndarray:
            if method.technique == "shadow_rays":
                points, eye = view_points_m(case.samples, receives), np.array(case.samples.camera.eye_m)
                return ShadowRays(case.casters).shadowed(points, case.light, case.bias_m, eye)
            if method.technique in ("z_pass", "z_fail"):
                counted = polygons(method.technique, method.precision)
                runs = is_set(counted, method.stencil, method.around_eye)
            else:
                runs = self._mask(method.technique, method.precision, frame(method.store))
            return from_runs(np.asarray(runs), case.samples.camera.viewport)[receives]

        for method in self._methods:
            try:
                yield method, answer(method)
            except InputError as error:
                yield method, str(error)

    def _frame(self, case: ShadowCase, receives: np.ndarray, store: Store) -> ShadowFrame:
        samples, casters, light, bias_m = case.samples, case.casters, case.light, case.bias_m
        if store == "world_float32":
            samples, casters, light = _in_world_float32(samples, casters, light)
        elif store == "depth_24":
            samples = _from_depth_buffer(samples, 24)
        elif store == "millimetre":
            bias_m = _ABSOLUTE_BIAS_M
        grid = shadow_grid(samples, _PLAN.tile_px)
        return shadow_frame(samples, self._uploaded(casters), light, grid, bias_m, receives)

    def _uploaded(self, casters: Casters) -> CastersOnDevice:
        shapes = self._shapes
        if shapes is None:
            return casters_on_device(casters)
        n_vertices, n_triangles = len(casters.vertices_m), casters.n_triangles
        # Triangles of one vertex cast nothing, and edges of one vertex are not drawn.
        vertices = np.pad(casters.vertices_m, ((0, shapes.n_vertices - n_vertices), (0, 0)), mode="edge")
        triangles = np.pad(casters.triangles, ((0, shapes.n_triangles - n_triangles), (0, 0)))
        on_device = casters_on_device(Casters(vertices, triangles))
        edges = np.asarray(on_device.edges)
        padding = np.tile(np.array([0, 0, -1, -1], np.int32), (shapes.n_edges - len(edges), 1))
        return eqx.tree_at(lambda c: c.edges, on_device, jax.device_put(np.concatenate([edges, padding])))

    def _mask(self, technique: str, precision: Precision, frame: ShadowFrame) -> np.ndarray:
        plan = replace(self._plans.get(technique, _PLAN), precision=precision)
        mask = run_program(technique, plan, frame)
        if bool(mask.overflowed):
            plan = fitted(technique, plan, frame, unrolled=False)
            self._plans[technique] = plan
            mask = run_program(technique, plan, frame)
        return np.asarray(mask.shadowed)

    def _polygons(self, technique: str, precision: Precision, frame: ShadowFrame) -> PolygonCounts:
        plan = replace(self._plans.get(technique, _PLAN), precision=precision)
        counts, overflowed = _count(technique, plan, frame)
        if overflowed:
            plan = fitted(technique, plan, frame, unrolled=False)
            self._plans[technique] = plan
            counts, overflowed = _count(technique, plan, frame)
        return counts


@functools.cache
def _polygon_program(technique: str, plan: ShadowPlan):
    return jax.jit(lambda frame: count_polygons(frame, plan, by_failing=technique == "z_fail"))


def _count(technique: str, plan: ShadowPlan, frame: ShadowFrame) -> tuple[PolygonCounts, bool]:
    with jax.enable_x64(True):
        counts, overflowed = _polygon_program(technique, plan)(frame)
        return jax.tree.map(np.asarray, counts), bool(overflowed)


def _in_world_float32(
    samples: ViewSamples, casters: Casters, light: ShadowLight
) -> tuple[ViewSamples, Casters, ShadowLight]:
    """Samples, vertices and light as an engine has them that keeps the world's coordinates in float32."""
    eye = np.array(samples.camera.eye_m)
    turned = samples.camera.view_from_world[:3, :3]
    world = (samples.position_m.astype(np.float64) @ turned + eye).astype(np.float32)
    position = ((world.astype(np.float64) - eye) @ turned.T).astype(np.float32)
    position = np.where(samples.valid[..., None], position, 0)
    vertices = casters.vertices_m.astype(np.float32).astype(np.float64)
    x, y, z = (float(np.float32(c)) for c in light.position_m)
    return replace(samples, position_m=position), Casters(vertices, casters.triangles), ShadowLight((x, y, z))


def _from_depth_buffer(samples: ViewSamples, n_bits: int) -> ViewSamples:
    """Positions as read back from a depth buffer of whole numbers: `d = (1 - near/z) / (1 - near/far)`."""
    near, far = samples.camera.near_m, samples.camera.far_m
    depth_m = -samples.position_m[..., 2].astype(np.float64)
    least = near / far if math.isfinite(far) else 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        stored = np.round((1 - near / depth_m) / (1 - least) * (2**n_bits - 1)) / (2**n_bits - 1)
        again = near / np.maximum(1 - stored * (1 - least), 1e-300)
        # Where the last step of an infinite range was stored, no depth is known: the farthest that float32 holds well.
        share = np.where(samples.valid, np.clip(again / depth_m, 0, 1e6), 0)
    return replace(samples, position_m=(samples.position_m * share[..., None]).astype(np.float32))
