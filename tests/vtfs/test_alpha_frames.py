"""Frames under alpha-masked, blended and coloured casters: images and checks against float64."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from tests.strategies import nearby_lights
from tests.vtfs.test_shadowed_frame import SUNS
from tuning.shadow_check import ShadowChecker, light_on_host, masks_on_host, one_blending
from vtfs.alpha_casters import Blending
from vtfs.camera import Camera, Viewport
from vtfs.configurations import configuration
from vtfs.directional_lights import NO_DIRECTIONAL, DirectionalLights
from vtfs.frame import cast_program, planned, render, run_stages
from vtfs.frame_counts import FrameCounts, count
from vtfs.frame_inputs import FrameInputs
from vtfs.gallery import build_scene
from vtfs.input_error import InputError
from vtfs.lights import Lights, point_lights
from vtfs.reference import ViewShadows, forward_reference, largest_relative_difference
from vtfs.scene import AlphaMode, Material, Scene
from vtfs.shadow_casters import BIAS
from vtfs.shadow_maps import shadow_maps
from vtfs.shadow_scene import shadow_scene
from vtfs.view_samples import trace_view_samples

PTSV = configuration("ptsv", {"branching": 8})
NO_LIGHT = point_lights(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))
RED, ALPHA = (1.0, 0.25, 0.0), 0.5


def floor_under_glass(alpha_mode: AlphaMode = "blend") -> FrameInputs:
    """A grey floor, seen from below a pane that all light comes through."""
    floor, pane = (
        Material("floor", (0.8, 0.8, 0.8), specular=0.0),
        Material("pane", RED, ALPHA, alpha_mode=alpha_mode),
    )
    square = np.array([[-1.0, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]])
    vertices = np.concatenate([3 * square, 50 * square + [0, 5.0, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    scene = Scene("glass", vertices, triangles, None, np.array([0, 0, 1, 1]), (floor, pane))
    camera = Camera((0.0, 3.0, 0.1), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, 0.1, 100.0, Viewport(16, 8))
    samples = trace_view_samples(scene, camera)
    light = point_lights(np.array([[0.3, 9.0, 0.2]]), np.array([60.0]), np.full((1, 3), 40.0))
    suns = DirectionalLights(np.array([[0.2, 1.0, 0.1]]), np.array([[1.0, 0.9, 0.7]]))
    return FrameInputs(samples, light, shadow_scene=shadow_scene(scene, suns, 1))


@pytest.mark.parametrize("technique", ["ptsv", "brute_force"])
@pytest.mark.parametrize(
    ("blending", "factor"),
    [("opaque", (1, 1, 1)), ("grey", (0.5, 0.5, 0.5)), ("coloured", (1, 1 - 0.5 * 0.75, 0.5))],
)
def test_a_half_transparent_pane_leaves_exactly_its_share_of_point_and_sun(technique, blending, factor):
    inputs = floor_under_glass()
    assert inputs.samples.valid.all() and not inputs.has_transparent
    lit = render(configuration(technique, {"blending": "opaque"}), inputs)
    assert (lit > 0.1).all()
    found = render(configuration(technique, {"blending": blending}), inputs)
    # Factors are right to a rounding of float32; the sum of two lights to two more.
    assert np.abs(found / (lit * np.array(factor, np.float32)) - 1).max() < 4 * 2.0**-23


@pytest.mark.parametrize("technique", ["ptsv", "brute_force"])
def test_the_map_of_shadows_holds_what_panes_stop(technique):
    for blending, stopped in (("grey", 0.5), ("coloured", 1 - (1 + 0.625 + 0.5) / 3)):
        maps = shadow_maps(configuration(technique, {"blending": blending}), floor_under_glass())
        assert maps is not None and (maps.lit == 2).all()
        assert np.abs(maps.stopped - 2 * stopped).max() < 1e-6  # float32 transmittances
        assert abs(maps.share_stopped - stopped) < 1e-6


def test_stochastic_panes_let_each_sample_have_all_of_a_light_or_none():
    inputs = floor_under_glass()
    config = configuration("ptsv", {"blending": "stochastic"})
    lit = configuration("ptsv", {"blending": "opaque"})
    maps = shadow_maps(config, inputs)
    assert maps is not None and (maps.lit == 2).all()
    # 256 coins: six deviations around half of them.
    assert abs(maps.stopped.sum() - 128) < 6 * 8 and len(np.unique(maps.stopped)) == 3
    found, full = render(config, inputs), render(lit, inputs)
    assert (found[maps.stopped == 2] == 0).all()
    whole = maps.stopped == 0
    assert np.abs(found[whole] / full[whole] - 1).max() < 4 * 2.0**-23  # another program, other fused sums
    assert np.array_equal(found, render(configuration("brute_force", {"blending": "stochastic"}), inputs))


@functools.cache
def conservatory(suns: bool = True) -> tuple[FrameInputs, Lights]:
    scene: Scene = build_scene("conservatory", 2_000)
    assert scene.cameras is not None
    samples = trace_view_samples(scene, replace(scene.cameras.camera(12), viewport=Viewport(48, 28)))
    lights = nearby_lights(samples, 21, 4)
    return FrameInputs(samples, lights, shadow_scene=shadow_scene(scene, SUNS if suns else NO_DIRECTIONAL, 2)), lights


def float64_image(inputs: FrameInputs, lights: Lights, blending: Blending) -> np.ndarray:
    shadows, own = inputs.shadows, []
    for v, view in enumerate(shadows.views):
        masks = np.array([shadows.reference(view, k, "brute_force", "cast") for k in range(len(shadows.lights))])
        left = np.array([shadows.reference_light(v, k, view.valid, blending)[0] for k in range(len(masks))])
        own.append(ViewShadows(shadows.slot, masks, shadows.scene.suns, left))
    return forward_reference(inputs.samples, lights, own)


@pytest.mark.parametrize("blending", ["grey", "coloured", "stochastic"])
def test_a_conservatory_is_lit_as_float64_says_panes_too(blending):
    inputs, lights = conservatory()
    assert inputs.has_transparent and len(inputs.shadows.views) > 2
    config = PTSV.replaced(blending=blending)
    image, expected = render(config, inputs).astype(np.float64), float64_image(inputs, lights, blending)
    off = np.abs(image - expected).max(axis=-1) > 1e-4 * np.maximum(np.abs(expected).max(axis=-1), expected.mean())
    # Pixels in which rounding decides one of many masks of 4 lights on several layers.
    assert off.sum() <= 0.01 * off.size
    opaque_only = render(PTSV.replaced(blending="opaque"), inputs)
    assert largest_relative_difference(opaque_only, expected, inputs.seen()) > 0.1


def cast(inputs: FrameInputs, config):
    sizes = run_stages(config, inputs, until="assign")[1]
    masks = cast_program(config.technique, planned(config, sizes))(inputs.shadows.tasks(config))
    return masks_on_host(masks, inputs.samples), light_on_host(masks, inputs)


def test_the_check_passes_what_is_right_and_finds_light_that_is_not():
    inputs, lights = conservatory()
    config = PTSV.replaced(blending="coloured")
    masks, left = cast(inputs, config)
    key = ("test_alpha_frames", "conservatory")

    def checked(left):
        return ShadowChecker(inputs.shadows, inputs.samples, lights, key).check(config, masks, left)

    right = checked(left)
    assert right.wrong == ""
    image = render(config, inputs)
    assert largest_relative_difference(image, right.image, inputs.seen()) < 1e-4
    # All light of one layer's last light off by a thousandth; one channel swapped with another; a light not stopped.
    n = len(inputs.shadows.lights)
    for i, change in ((2 * n - 1, lambda c: c * 0.999), (0, lambda c: c[..., ::-1]), (n, np.ones_like)):
        wrong = [change(channels) if i == j else channels for j, channels in enumerate(left)]
        assert checked(wrong).wrong.startswith("transmittance: "), i
    assert checked([np.ones_like(channels) for channels in left]).wrong


def test_counts_say_what_alpha_casters_take_and_survive_the_cache():
    inputs, _ = conservatory()
    frame_counts = count(PTSV, inputs)[0]
    counts, opaque = frame_counts.of(PTSV), count(PTSV.replaced(blending="opaque"), inputs)[0].technique
    alpha = inputs.shadows.scene.alpha
    assert alpha is not None and 0 < counts["alpha_casters"] <= alpha.casters.n_triangles
    assert not any(name.startswith("alpha_") for name in opaque)
    own = counts["alpha_node_tests"] + counts["alpha_sample_tests"]
    assert counts["test_and_set"] == opaque["test_and_set"] + own > opaque["test_and_set"]
    assert 0 < counts["alpha_samples"] < counts["shadow_samples"] == opaque["shadow_samples"]
    assert FrameCounts.from_arrays(frame_counts.as_arrays()).sizes == frame_counts.sizes
    assert frame_counts.sizes.alpha and not count(PTSV.replaced(blending="opaque"), inputs)[0].sizes.alpha


def test_a_stencil_refuses_alpha_casters_by_name_and_casts_by_opaque_ones_when_told_to():
    inputs, _ = conservatory()
    with pytest.raises(InputError, match=r"`z_fail`: a stencil cannot cast .* or blending=opaque"):
        render(configuration("z_fail"), inputs)
    scene, opaque = inputs.shadows.scene, configuration("z_fail", {"blending": "opaque"})
    assert scene.blending(opaque) == "opaque"
    one_blending([opaque, PTSV.replaced(blending="opaque")], scene)
    with pytest.raises(InputError, match="`blending` = opaque, grey: are different shadows"):
        one_blending([opaque, PTSV], scene)
    assert list(scene.cannot_cast(["ptsv", "z_fail", "z_pass"])) == ["z_fail", "z_pass"]
    with pytest.raises(InputError, match="`z_fail`: a stencil cannot"):
        one_blending([PTSV, configuration("z_fail")], scene)
    without = floor_under_glass("opaque").shadows.scene
    one_blending([configuration("z_fail"), PTSV.replaced(blending="coloured")], without)


def test_without_alpha_casters_a_frame_has_the_programs_of_opaque_ones():
    inputs = floor_under_glass("opaque")
    shadows = inputs.shadows
    assert shadows.scene.alpha is None and shadows.tasks(PTSV)[0].alpha is None
    sizes = run_stages(PTSV, inputs, until="assign")[1]
    assert sizes.alpha == ()
    assert planned(PTSV, sizes) == planned(PTSV.replaced(blending="opaque"), sizes)
    assert shadows.scene.bias_m == BIAS * shadows.scene.casters.extent_m
    assert render(configuration("z_fail"), inputs).max() == 0  # the pane is opaque
