"""Light through alpha casters, against float64; each surface once; and random bits that mean what they say."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull

from tests.strategies import SMALL, a_camera, seeds, surface_samples
from tests.vtfs.shadow_cases import CLUSTERS, N_TRIANGLES, N_VERTICES, TILES, light_of, soup
from vtfs.alpha_casters import AlphaCasters, Blending, alpha_on_device, scene_bias_m, scene_casters
from vtfs.camera import Camera, Viewport
from vtfs.gallery import build_scene
from vtfs.gbuffer import Fragments, from_runs
from vtfs.input_error import InputError
from vtfs.random_words import random_words
from vtfs.shadow_casters import Casters, ShadowLight
from vtfs.shadow_mask import ShadowPlan, casters_on_device, default_bias_m, facing_samples, shadow_frame
from vtfs.shadow_references import brute_force, classify, view_points_m
from vtfs.shadow_techniques import shadow_grid
from vtfs.transmittance_references import brute_force_transmittance
from vtfs.transmitted_light import alpha_program, in_fragments, transmitted_light, views_of
from vtfs.view_samples import ViewSamples, trace_view_samples

some = settings(max_examples=4, deadline=None)
VARIANTS: tuple[tuple[str, ShadowPlan, Blending, tuple[str, ...]], ...] = (
    ("cluster_hierarchy", CLUSTERS, "coloured", ("at the eye", "near", "inside", "far")),
    ("ptsv", TILES, "grey", ("at the eye", "near", "inside", "far")),
    ("cluster_hierarchy", CLUSTERS, "stochastic", ("directional",)),
)


def panes(camera: Camera, rng: np.random.Generator) -> Casters:
    """As `soup`, but large: most ways to a light meet several."""
    casters = soup(camera, rng)
    middle = casters.vertices_m.reshape(-1, 4, 3).mean(axis=1, keepdims=True)
    size = 10 ** rng.uniform(0.1, 0.7, (len(middle), 1, 1))
    corners = middle + rng.normal(size=(len(middle), 4, 3)) * size
    return Casters(corners.reshape(-1, 3), casters.triangles)


def made_of(casters: Casters, rng: np.random.Generator, has_images: bool = True) -> AlphaCasters:
    """A fifth of the triangles masked, the others blended, two thirds of both with one of two images or none."""
    n = casters.n_triangles
    return AlphaCasters(
        casters, np.arange(n), rng.choice([0.0, 0.3, 0.7, 1.0], n, p=[0.1, 0.5, 0.3, 0.1]), rng.uniform(0, 1.2, (n, 3)),
        np.where(rng.random(n) < 0.2, rng.uniform(0, 0.8, n), np.nan), rng.integers(-1, 2 if has_images else 0, n),
        rng.normal(size=(n, 3, 2)) * 2, tuple(rng.random(size).astype(np.float32) for size in ((8, 8), (5, 12))),
    )  # fmt: skip


def left_by(
    variant: tuple[str, ShadowPlan, Blending],
    samples: ViewSamples,
    casters: AlphaCasters,
    light: ShadowLight,
    bias_m: float,
    stream: tuple[int, int] = (0, 0),
) -> np.ndarray:
    """Without a sizing run: the capacities of these tests hold everything."""
    technique, plan, blending = variant
    # Edges are of stencils, and their number would compile each mesh anew.
    on_device = replace(casters_on_device(casters.casters), edges=jnp.zeros((1, 4), jnp.int32))
    frame = shadow_frame(samples, on_device, light, shadow_grid(samples, 8), bias_m)
    with jax.enable_x64(True):
        found = alpha_program(technique, plan, blending)(
            frame, alpha_on_device(casters), jnp.asarray(np.array(stream, np.uint32))
        )
    assert not bool(found.mask.overflowed)
    view = samples.camera.viewport
    shadowed = from_runs(np.asarray(found.mask.shadowed), view)
    if blending == "stochastic":
        return np.where(shadowed, 0.0, 1.0)
    channels = np.stack([from_runs(np.asarray(channel), view) for channel in found.transmittance], axis=-1)
    assert (channels[shadowed] == 0).all()
    return channels if blending == "coloured" else channels[..., 0]


@pytest.mark.parametrize(("technique", "plan", "blending", "lights"), VARIANTS)
@given(seed=seeds, k=st.integers(0, 3))
@some
def test_a_soup_of_all_kinds_leaves_the_light_that_float64_says(technique, plan, blending, lights, seed, k):
    rng = np.random.default_rng(seed)
    camera = a_camera(SMALL, eye_m=((1.0, 2.0, 3.0), (1e6, -3e5, 1e6))[seed % 2])
    samples, light = surface_samples(camera, seed), light_of(camera, lights[k % len(lights)], rng)
    casters = made_of(panes(camera, rng), rng, has_images=technique != "ptsv")  # without any, the program has no images
    bias_m = default_bias_m(casters.casters)
    found = left_by((technique, plan, blending), samples, casters, light, bias_m, (seed, 7))
    points, eye = view_points_m(samples, samples.valid), np.array(camera.eye_m)
    pixel = np.flatnonzero(samples.valid.ravel())
    reference = brute_force_transmittance(points, casters, light, bias_m, eye, blending, pixel, (seed, 7))
    error = np.abs(found[samples.valid] - reference.transmittance).reshape(len(points), -1).max(axis=1)
    # Float32 of the result is 6e-8; the clamp of alpha 1.5e-8; an alpha test within 1e-9 of its cutoff may go either
    # way, as coordinates of textures are a few roundings of 1e-16 apart, times 1e6 m from the origin.
    differs = (error > 1e-6) & (reference.cutoff_margin > 1e-9)
    bands = classify(points, differs, casters.casters, light, bias_m, eye)
    assert bands.errors == 0 and bands.total <= 0.01 * len(points)
    assert (found[~samples.valid] == 1).all()
    # Another order of the triangles: the same numbers to the last bit.
    shuffled = casters.kept(rng.permutation(N_TRIANGLES))
    assert (left_by((technique, plan, blending), samples, shuffled, light, bias_m, (seed, 7)) == found).all()


def test_the_soups_let_through_much_and_stop_much():
    """The test above would say little of soups that leave all light, or none."""
    left = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        camera = a_camera(SMALL)
        samples, light = surface_samples(camera, seed), light_of(camera, "inside", rng)
        casters = made_of(panes(camera, rng), rng)
        points = view_points_m(samples, samples.valid)
        left.append(brute_force_transmittance(points, casters, light, 1e-4, np.array(camera.eye_m)).transmittance)
    values = np.concatenate(left)
    assert (values == 0).mean() > 0.1 and (values == 1).mean() > 0.1 and ((values > 0) & (values < 1)).mean() > 0.2


def shells_toward(points_m: np.ndarray, light_m: np.ndarray, radii_m: tuple[float, float]) -> Casters:
    """Two closed shells around a light, with vertices exactly on the ways from the light to some points."""
    ways = points_m - light_m
    ways = np.concatenate([ways / np.linalg.norm(ways, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    hull = ConvexHull(ways).simplices
    # Of float32, as those of meshes: samples are aimed at to 6e-8, and never to the last bit of float64.
    vertices = np.concatenate([light_m + (radius * ways).astype(np.float32) for radius in radii_m])
    triangles = np.concatenate([hull, hull + len(ways)])
    # To the size that other tests compile: what is left over is without area.
    n_left = N_TRIANGLES - len(triangles)
    assert n_left >= 0
    padded = np.zeros((N_VERTICES, 3))
    padded[: len(vertices)] = vertices
    return Casters(padded, np.concatenate([triangles, np.zeros((n_left, 3), int)]))


@pytest.mark.parametrize(("technique", "plan", "blending"), [variant[:3] for variant in VARIANTS[:2]])
def test_each_closed_shell_counts_exactly_once_at_vertices_and_edges_too(technique, plan, blending):
    for seed, offset in ((0, (1.0, 2.0, 3.0)), (1, (1e5, -3e4, 1e5)), (2, (0.0, 0.0, 0.0))):
        rng = np.random.default_rng(seed)
        camera = a_camera(SMALL, eye_m=offset)
        samples = surface_samples(camera, seed)
        matrix = camera.view_from_world
        points = samples.position_m[samples.valid].astype(np.float64) @ matrix[:3, :3] + camera.eye_m
        light_m = np.round(points.mean(axis=0), 3)
        nearest_m = np.linalg.norm(points - light_m, axis=1).min()
        shells = shells_toward(points[rng.choice(len(points), 40, False)], light_m, (0.2 * nearest_m, 0.6 * nearest_m))
        alpha = np.repeat([0.25, 0.8, 0.5], [88, 88, N_TRIANGLES - 176])
        # The programs of the soups: one with images, which triangles without area have here, and one without.
        image = np.where(np.arange(N_TRIANGLES) < 176, -1, -1 if technique == "ptsv" else 0)
        casters = replace(
            made_of(shells, rng), opacity=alpha, cutoff=np.full(N_TRIANGLES, np.nan), tint=np.zeros((N_TRIANGLES, 3)),
            image=image,
        )  # fmt: skip
        left = left_by((technique, plan, blending), samples, casters, ShadowLight(tuple(light_m)), 0.0)
        # Twice or not at all would be 0.2 or 0.75 times that, or more.
        assert_allclose(left[samples.valid], 0.75 * 0.2, rtol=1e-6)


def test_random_bits_mean_the_transmittance():
    camera, rng = a_camera(SMALL), np.random.default_rng(5)
    samples, casters = surface_samples(camera, 5), made_of(panes(camera, rng), rng)
    light, bias_m, n = light_of(camera, "directional", rng), default_bias_m(casters.casters), 100
    variant = VARIANTS[2][:3]
    points, eye = view_points_m(samples, samples.valid), np.array(camera.eye_m)
    expected = brute_force_transmittance(points, casters, light, bias_m, eye).transmittance
    bits = np.array([left_by(variant, samples, casters, light, bias_m, (i, 0))[samples.valid] for i in range(n)])
    mean = bits.mean(axis=0)
    # Hoeffding for the mean of n bits a sample: one in 1e9 strays further.
    assert abs(mean.mean() - expected.mean()) < math.sqrt(math.log(2e9) / (2 * bits.size))
    mixed = (expected > 0.05) & (expected < 0.95)
    assert mixed.sum() > 100
    # Bits of a sample are independent: their means scatter as those of coins do, six deviations of chi-squared around.
    scatter = (mean - expected)[mixed] ** 2 / (expected * (1 - expected))[mixed] * n
    assert abs(scatter.mean() - 1) < 6 * math.sqrt(2 / mixed.sum())
    assert (mean[expected == 0] == 0).all() and (mean[expected == 1] == 1).all()
    # Neighbours do not flip together: the mean over the image scatters as of independent samples, too.
    images = bits[:, mixed].mean(axis=1)
    assert images.std() < 1.5 * math.sqrt((expected * (1 - expected))[mixed].mean() / mixed.sum())


def test_random_words_are_those_of_the_paper():
    def pcg4d(*words: int) -> int:
        """Listing 17 of Jarzynski and Olano 2020, in integers."""
        x, y, z, w = ((word * 1664525 + 1013904223) % 2**32 for word in words)
        for k in range(2):
            x = (x + y * w) % 2**32
            y = (y + z * x) % 2**32
            z = (z + x * y) % 2**32
            w = (w + y * z) % 2**32
            if k == 0:
                x, y, z, w = (word ^ word >> 16 for word in (x, y, z, w))
        return x

    words = np.random.default_rng(0).integers(0, 2**32, (50, 4))
    expected = [pcg4d(*map(int, row)) for row in words]
    assert random_words(*words.T.astype(np.uint32)).tolist() == expected
    assert np.asarray(random_words(*map(jnp.asarray, words.T.astype(np.uint32)))).tolist() == expected


@functools.cache
def conservatory() -> tuple:
    scene = build_scene("conservatory", 2_000)
    camera = replace(scene.cameras.camera(12), viewport=Viewport(64, 40))  # type: ignore[union-attr]
    return trace_view_samples(scene, camera), scene_casters(scene), ShadowLight((3.0, 11.0, 5.0))


def test_a_conservatory_and_its_panes_receive_the_light_that_float64_says():
    samples, casters, light = conservatory()
    layers = samples.layers.transparent
    assert casters.opaque.n_triangles and np.isnan(casters.alpha.cutoff).any() and (casters.alpha.image >= 0).any()
    assert len(layers) >= 2
    bias_m, eye = scene_bias_m(casters), np.array(samples.camera.eye_m)
    n_blended, n_in_bands, n = 0, 0, 0
    plan = ShadowPlan(8, 8)
    # Receivers are what is seen, and the panes before it: a view each.
    for number, view in enumerate(views_of(samples)[:3]):
        receives = facing_samples(view, light)
        found = transmitted_light("ptsv", plan, view, casters, light, receives=receives, stream=(0, number))
        points = view_points_m(view, receives)
        reference = brute_force_transmittance(points, casters.alpha, light, bias_m, eye)
        expected = np.where(brute_force(points, casters.opaque, light, bias_m, eye), 0, reference.transmittance)
        differs = (np.abs(found.transmittance[receives] - expected) > 1e-5) & (reference.cutoff_margin > 1e-9)
        for part in (casters.opaque, casters.alpha.casters):
            bands = classify(points, differs, part, light, bias_m, eye)
            differs[differs] = np.isin(np.flatnonzero(differs), bands.error_points)
            n_in_bands += bands.near_edge + bands.near_plane
        assert not differs.any()
        assert (found.transmittance[~receives] == 1).all() and (found.transmittance[found.shadowed] == 0).all()
        n_blended += ((expected > 0) & (expected < 1)).sum()
        n += len(points)
    assert n_blended > 0.3 * n and n_in_bands <= 1e-3 * n


def test_what_views_receive_is_put_where_their_fragments_are_shaded():
    samples, _, _ = conservatory()
    images = [view.position_m for view in views_of(samples)]
    fragments = Fragments(samples, with_hidden=False)
    positions = fragments.positions()
    assert positions.n_transparent_runs > 0
    found = in_fragments(samples, images)
    for c, component in enumerate((positions.x_m, positions.y_m, positions.z_m)):
        assert (found[..., c] == np.asarray(component)).all()
        assert (in_fragments(samples, [image[..., c] for image in images]) == np.asarray(component)).all()


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("opacity", np.full(2, np.nan), "`opacity`: of triangle 0"),
        ("tint", np.full((2, 3), -1.0), "`tint`: of triangle 0"),
        ("uv", np.full((2, 3, 2), np.inf), "`uv`: of triangle 0"),
        ("image", np.array([0, -1]), "`image`: must be from -1 to -1"),
        ("cutoff", np.zeros(3), r"`cutoff`: has shape \(3,\)"),
    ],
)
def test_bad_alpha_casters_are_refused_by_name(field, value, message):
    good = AlphaCasters(
        Casters(np.eye(3), np.array([[0, 1, 2], [0, 2, 1]])), np.arange(2), np.ones(2), np.ones((2, 3)),
        np.full(2, 0.5), np.full(2, -1), np.zeros((2, 3, 2)),
    )  # fmt: skip
    with pytest.raises(InputError, match=message):
        replace(good, **{field: value})


def test_what_light_is_transmitted_by_is_checked():
    samples, casters, light = conservatory()
    with pytest.raises(InputError, match="`blending='x'`: must be one of grey, coloured, stochastic"):
        transmitted_light("ptsv", ShadowPlan(), samples, casters, light, "x")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"`receives`: is bool of shape \(2, 2\)"):
        transmitted_light("ptsv", ShadowPlan(), samples, casters, light, receives=np.ones((2, 2), bool))
    with pytest.raises(InputError, match="make it a directional light"):
        transmitted_light("ptsv", ShadowPlan(), samples, casters, ShadowLight((0.0, 1e9, 0.0)))


def test_a_stencil_casts_no_alpha_shadows():
    samples, casters, light = conservatory()
    with pytest.raises(InputError, match="`z_fail`: casts no alpha shadows; use ptsv or cluster_hierarchy"):
        transmitted_light("z_fail", ShadowPlan(), samples, casters, light)
