"""Alpha casters: are they exact, what do they cost, and what do several samples a pixel gain?

python -m benchmarks.alpha_shadows exactness [SIZE] [SCENE]   variants against float64, gallery scenes
python -m benchmarks.alpha_shadows antialiasing [WxH]     4, 8, 16 samples, traced against extrapolated
python -m benchmarks.alpha_shadows cost [WxH] [FILE]      tests, of opaque casters alone and with alpha casters

A row of `cost` is a line of FILE (alpha-cost.jsonl unless given), written as it is known and not counted again.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from benchmarks.run_lines import RunLines
from vtfs.alpha_casters import AlphaCasters, Blending, SceneCasters, scene_bias_m, scene_casters
from vtfs.camera import Viewport
from vtfs.device import keep_compiled_programs
from vtfs.gallery import build_scene
from vtfs.sample_patterns import extrapolated_sub_samples, resolved, traced_sub_samples
from vtfs.scene import Scene
from vtfs.shadow_capacities import shadow_sizes, with_shadow_sizes
from vtfs.shadow_casters import ShadowLight
from vtfs.shadow_mask import ShadowPlan, facing_samples
from vtfs.shadow_references import brute_force, classify, view_points_m
from vtfs.tracer import Tracer
from vtfs.transmittance_references import ReferenceLight, brute_force_transmittance
from vtfs.transmitted_light import transmitted_light
from vtfs.view_samples import ViewSamples, trace_view_samples

_VARIANTS: tuple[tuple[str, ShadowPlan, Blending], ...] = (
    ("cluster_hierarchy", ShadowPlan(8, 8), "grey"),
    ("cluster_hierarchy", ShadowPlan(16, 4, bounds="implicit", extra="off"), "coloured"),
    ("ptsv", ShadowPlan(5, 16, extra="off"), "coloured"),
    ("ptsv", ShadowPlan(8, 32, extra="silhouette"), "stochastic"),
)
_BLENDINGS: tuple[Blending, ...] = ("grey", "coloured", "stochastic")


def main() -> None:
    question, size = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else ""
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {' '.join(sys.argv[1:])}\n")
    if question == "exactness":
        exactness(int(size or 128), sys.argv[3] if len(sys.argv) > 3 else "")
    else:
        width, height = map(int, (size or "320x180").split("x"))
        if question == "antialiasing":
            antialiasing(Viewport(width, height))
        else:
            cost(Viewport(width, height), Path(sys.argv[3] if len(sys.argv) > 3 else "alpha-cost.jsonl"))


def light_in(scene: Scene, at: tuple[float, float, float]) -> ShadowLight:
    low, high = scene.bounds_m
    return ShadowLight(tuple(low + (high - low) * np.array(at)))


# --- exactness ------------------------------------------------------------------------------------------------------


def exactness(size_px: int, only: str) -> None:
    """Techniques, plans and blendings against the product over all triangles; of both scenes unless one is named."""
    print("| scene | view | technique | plan | blending | samples | largest error | in bands | errors |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, n_triangles, frame, at in (
        ("conservatory", 12_000, 12, (0.45, 1.2, 0.8)),
        ("grove", 12_000, 5, (0.4, 1.1, 0.6)),
    ):
        if only not in ("", name):
            continue
        scene = build_scene(name, n_triangles)
        assert scene.cameras is not None
        samples = trace_view_samples(scene, replace(scene.cameras.camera(frame), viewport=Viewport(size_px, size_px)))
        casters, light = scene_casters(scene), light_in(scene, at)
        views = [("solid", samples), *((f"layer {k}", v.samples) for k, v in enumerate(samples.layers.transparent))]
        for (technique, plan, blending), (label, view) in itertools.product(_VARIANTS, views[:3]):
            receives = facing_samples(view, light)
            reference = _Reference(view, receives, casters, light, blending)
            found = transmitted_light(
                technique, plan, view, casters, light, blending, reference.stream, receives=receives
            )
            row = reference.compared(found.transmittance[receives])
            text = f"{plan.tile_px} px, b={plan.branching}, {plan.bounds}, extra {plan.extra}"
            print(f"| {name} {frame} | {label} | {technique} | {text} | {blending} | {row} |", flush=True)


class _Reference:
    """The light that float64 says, and how a result compares with it."""

    stream = (1, 2)

    def __init__(
        self, view: ViewSamples, receives: np.ndarray, casters: SceneCasters, light: ShadowLight, blending: Blending
    ):
        self.casters, self.light = casters, light
        self.bias_m, self.eye_m = scene_bias_m(casters), np.array(view.camera.eye_m)
        self.points_m = view_points_m(view, receives)
        pixel = np.flatnonzero(receives.ravel())
        rest = (light, self.bias_m, self.eye_m)
        self.opaque = brute_force(self.points_m, casters.opaque, *rest)
        self.alpha: ReferenceLight = brute_force_transmittance(
            self.points_m, casters.alpha, *rest, blending, pixel, self.stream
        )

    def compared(self, found: np.ndarray) -> str:
        """Samples, the largest error outside the bands, samples in the bands, and others that are off by over 1e-5."""
        n = len(self.points_m)
        expected = np.where(self.opaque if found.ndim == 1 else self.opaque[:, None], 0, self.alpha.transmittance)
        error = np.abs(found - expected).reshape(n, -1).max(axis=1)
        differs = (error > 1e-5) & (self.alpha.cutoff_margin > 1e-9)
        largest = float(error[error <= 1e-5].max(initial=0))
        total = int(differs.sum())
        for part in (self.casters.opaque, self.casters.alpha.casters):
            bands = classify(self.points_m, differs, part, self.light, self.bias_m, self.eye_m)
            differs = np.isin(np.arange(n), bands.error_points)
        return f"{n:,} | {largest:.1e} | {total - int(differs.sum())} | {int(differs.sum())}"


# --- several samples a pixel ----------------------------------------------------------------------------------------


def antialiasing(viewport: Viewport) -> None:
    """Coverage by traced and by extrapolated sub-samples; 16 traced ones are the yardstick of fewer."""
    print("| scene | samples | positions | off by over 1/32 | mean error | RMS error | RMS, one triangle |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, n_triangles, frame, at in (
        ("conservatory", 12_000, 12, (0.45, 1.2, 0.8)),
        ("grove", 12_000, 5, (0.4, 1.1, 0.6)),
    ):
        scene = build_scene(name, n_triangles)
        assert scene.cameras is not None
        camera, tracer = replace(scene.cameras.camera(frame), viewport=viewport), Tracer(scene)
        casters, light = scene_casters(scene), light_in(scene, at)
        centre = trace_view_samples(scene, camera, tracer)
        views = {n: traced_sub_samples(scene, camera, n, tracer) for n in (16, 8, 4, 1)}
        traced = {n: _coverage(of_n, casters, light) for n, of_n in views.items()}
        is_one = centre.valid & np.all([view.triangle == centre.triangle for view in views[16]], axis=0)
        for n in (1, 4, 8, 16):
            rows = [("traced, against 16", traced[n], traced[16])] if n < 16 else []
            if n > 1:
                extrapolated = _coverage(extrapolated_sub_samples(centre, n), casters, light)
                rows.append((f"extrapolated, against {n} traced", extrapolated, traced[n]))
            for label, coverage, against in rows:
                off, inside = np.abs(coverage - against)[centre.valid], np.abs(coverage - against)[is_one]
                figures = f"{(off > 1 / 32).mean():.1%} | {off.mean():.4f} | {np.sqrt((off**2).mean()):.4f}"
                print(f"| {name} | {n} | {label} | {figures} | {np.sqrt((inside**2).mean()):.4f} |", flush=True)


def _coverage(views: tuple[ViewSamples, ...], casters: SceneCasters, light: ShadowLight) -> np.ndarray:
    """How much light is left of each pixel."""
    plan = ShadowPlan(8, 8)
    found = [transmitted_light("ptsv", plan, view, casters, light) for view in views]
    return resolved([each.transmittance for each in found], views)


# --- cost -----------------------------------------------------------------------------------------------------------


_COLUMNS = ("scene", "triangles", "samples", "casters", "technique", "opaque", "alpha", "lit", "passed")


def cost(viewport: Viewport, path: Path) -> None:
    """Test-and-set operations of opaque and of alpha casters, samples that the former leave lit, and what passes both.

    Each plan starts with the capacities that held the row before, so that a row compiles two programs.
    """
    keep_compiled_programs()
    rows = RunLines(path)
    for name, frame, at in (("conservatory", 12, (0.45, 1.2, 0.8)), ("grove", 5, (0.4, 1.1, 0.6))):
        scene = build_scene(name)
        assert scene.cameras is not None
        samples = trace_view_samples(scene, replace(scene.cameras.camera(frame), viewport=viewport))
        whole, light = scene_casters(scene), light_in(scene, at)
        receives = facing_samples(samples, light)
        n_triangles = f"{whole.opaque.n_triangles:,} / {whole.alpha.casters.n_triangles:,}"
        for technique in ("ptsv", "cluster_hierarchy"):
            plan = ShadowPlan(8, 8)
            for label, casters, blending in _caster_sets(whole):
                key = f"{name} {viewport.width_px}x{viewport.height_px} {technique} {label}"
                if key in rows.known():
                    continue
                found = transmitted_light(technique, plan, samples, casters, light, blending, receives=receives)
                plan = with_shadow_sizes(
                    plan, tuple(map(max, shadow_sizes(found.opaque.plan), shadow_sizes(found.alpha.plan)))
                )
                passed = float(found.transmittance[receives].mean())
                row = (
                    name, n_triangles, int(receives.sum()), label, technique, found.opaque.counts["test_and_set"],
                    found.alpha.counts["test_and_set"], found.alpha.counts["samples"], round(passed, 4),
                )  # fmt: skip
                rows.add({"key": key, **dict(zip(_COLUMNS, row, strict=True))})
                print(rows.lines[-1], flush=True)
    print(f"| {' | '.join(_COLUMNS)} |\n|{' --- |' * len(_COLUMNS)}")
    for row in rows.lines:
        print("| " + " | ".join(f"{v:,}" if isinstance(v, int) else str(v) for v in map(row.get, _COLUMNS)) + " |")


def _caster_sets(whole: SceneCasters) -> Iterator[tuple[str, SceneCasters, Blending]]:
    none: AlphaCasters = whole.alpha.kept(np.zeros(0, int))
    yield "opaque alone", SceneCasters(whole.opaque, none), "grey"
    plain = replace(whole.alpha, image=np.full(whole.alpha.casters.n_triangles, -1))
    yield "with alpha, no images", SceneCasters(whole.opaque, plain), "grey"
    for blending in _BLENDINGS:
        yield f"with alpha, {blending}", whole, blending


if __name__ == "__main__":
    main()
