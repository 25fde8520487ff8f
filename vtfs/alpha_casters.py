"""Casters that stop only some of the light: alpha-masked, blended and coloured triangles, and what stops where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from vtfs.input_error import InputError
from vtfs.shadow_casters import BIAS, Casters, opaque_casters

if TYPE_CHECKING:
    from vtfs.scene import Scene

Blending = Literal["grey", "coloured", "stochastic"]
"""What blended surfaces do to light. `grey`: each stops the share alpha of every colour (Sintorn et al. 2011, Sec. 5).
`coloured`: what its alpha covers lets its base colour through, so that a colour c of the light is stopped by the share
`alpha * (1 - c)` (the transmission coefficient of McGuire and Enderton 2011). `stochastic`: it stops all of the light
of a sample with probability alpha, else none."""

Casting = Literal["opaque", "grey", "coloured", "stochastic"]
"""What casts: opaque triangles alone, or all, and then what blended ones do to light."""

LARGEST_ALPHA = 1 - 2.0**-26
"""Alphas are clamped here, as the logarithm of 1 - 1 is infinite: what stops all light still passes 1.5e-8 of it."""


@dataclass(frozen=True)
class AlphaCasters:
    """Triangles of alpha-masked and blended materials, in the order of `casters.triangles`.

    - `number`: uint32 `[T]`, of each triangle, whatever the order: what random numbers are made from.
    - `opacity`: float64 `[T]`, times the alpha image where there is one, and `tint`: `[T, 3]`, linear base colour.
    - `cutoff`: float64 `[T]`: a masked triangle stops all light where its alpha is at least this; NaN where it blends.
    - `image`: int32 `[T]`, which of `images` (float32 `[h, w]`, row 0 at v = 0), -1 for none; `uv`: float64
      `[T, 3, 2]`, of corners A, B and C.

    **Raises:** `InputError` where an array has another length, or a number is not finite or out of its range.
    """

    casters: Casters
    number: np.ndarray
    opacity: np.ndarray
    tint: np.ndarray
    cutoff: np.ndarray
    image: np.ndarray
    uv: np.ndarray
    images: tuple[np.ndarray, ...] = ()

    def __post_init__(self):
        n = self.casters.n_triangles
        for name, dtype, shape in (
            ("number", np.uint32, (n,)), ("opacity", np.float64, (n,)), ("tint", np.float64, (n, 3)),
            ("cutoff", np.float64, (n,)), ("image", np.int32, (n,)), ("uv", np.float64, (n, 3, 2)),
        ):  # fmt: skip
            values = np.ascontiguousarray(getattr(self, name), dtype)
            if values.shape != shape:
                raise InputError(f"alpha casters `{name}`: has shape {values.shape}; must be {shape}.")
            object.__setattr__(self, name, values)
        for name, wrong in (
            ("opacity", ~np.isfinite(self.opacity) | (self.opacity < 0)),
            ("tint", (~np.isfinite(self.tint) | (self.tint < 0)).any(axis=1)),
            ("uv", ~np.isfinite(self.uv).all(axis=(1, 2))),
        ):
            if wrong.any():
                at = int(np.argmax(wrong))
                raise InputError(
                    f"alpha casters `{name}`: of triangle {at} is {getattr(self, name)[at]}; must be finite."
                )
        if n and (self.image.min() < -1 or self.image.max() >= len(self.images)):
            raise InputError(f"alpha casters `image`: must be from -1 to {len(self.images) - 1}.")

    def kept(self, which: np.ndarray) -> AlphaCasters:
        """Some of the triangles: indices, or a mask."""
        return replace(
            self,
            casters=Casters(self.casters.vertices_m, self.casters.triangles[which]),
            **{name: getattr(self, name)[which] for name in ("number", "opacity", "tint", "cutoff", "image", "uv")},
        )


@dataclass(frozen=True)
class SceneCasters:
    """All that casts shadows in a scene, on the same vertices; either part may have no triangle."""

    opaque: Casters
    alpha: AlphaCasters

    @property
    def together(self) -> Casters:
        """All triangles, whatever they let through."""
        both = np.concatenate([self.opaque.triangles, self.alpha.casters.triangles])
        return Casters(self.opaque.vertices_m, both)


def scene_casters(scene: Scene) -> SceneCasters:
    """The triangles of all of a scene's materials."""
    materials = scene.materials
    of_scene = np.flatnonzero(np.array([m.alpha_mode != "opaque" for m in materials])[scene.material_index])
    index = scene.material_index[of_scene]
    images = [m.alpha_image for m in materials if m.alpha_image is not None]
    has_image = np.array([m.alpha_image is not None and scene.uv is not None for m in materials])
    image = np.where(has_image, np.cumsum(has_image) - 1, -1)
    uv = np.zeros((len(of_scene), 3, 2)) if scene.uv is None else scene.uv[scene.triangles[of_scene]]
    alpha = AlphaCasters(
        Casters(scene.vertices_m, scene.triangles[of_scene]),
        of_scene,
        np.array([m.opacity for m in materials])[index],
        np.array([m.base_colour for m in materials])[index],
        np.array([m.alpha_cutoff if m.alpha_mode == "mask" else np.nan for m in materials])[index],
        image[index],
        uv,
        tuple(images),
    )
    return SceneCasters(opaque_casters(scene), alpha)


def scene_bias_m(casters: SceneCasters) -> float:
    """The share of the extent of all casters by which samples move toward the light."""
    return BIAS * casters.together.extent_m


class AlphaSurfaces(eqx.Module):
    """Alpha casters as the device reads them, one entry a triangle and a last one that stops nothing.

    - `value`: rows of opacity, cutoff (NaN: it blends) and the shares 1 - tint of red, green and blue, float64.
    - `uv`: rows of u of A, B and C, then v of them; `size`: rows of the image's first texel, its width and height;
      width 0 without an image. `texels`: of all images; empty where no triangle has one.
    """

    value: Float[Array, "5 n"]
    uv: Float[Array, "6 n"]
    size: Int[Array, "3 n"]
    number: UInt32[Array, " n"]
    texels: Float[Array, " texels"]


def alpha_on_device(casters: AlphaCasters) -> AlphaSurfaces:
    """Upload what alpha casters are made of; in float64, so that an alpha test is as exact as the test of a side."""
    sizes = np.array([image.shape for image in casters.images], np.int32).reshape(-1, 2)
    first = np.cumsum([0, *(height * width for height, width in sizes)])[: len(sizes)]
    of_image = np.concatenate([np.column_stack([first, sizes[:, 1], sizes[:, 0]]), np.zeros((1, 3))]).astype(np.int32)
    has_image = casters.image >= 0
    texels = [image.astype(np.float32).ravel() for image in casters.images] if has_image.any() else []
    value = np.column_stack([casters.opacity, casters.cutoff, 1 - np.minimum(casters.tint, 1)])
    n_padding = (
        2 if casters.casters.n_triangles == 0 else 1
    )  # no casters become one without area, see `casters_on_device`

    def padded(rows: np.ndarray, absent: float) -> np.ndarray:
        return np.ascontiguousarray(np.concatenate([rows, np.full((n_padding, *rows.shape[1:]), absent, rows.dtype)]).T)

    with jax.enable_x64(True):
        put = jax.device_put
        return AlphaSurfaces(
            put(padded(value, 0.0)),
            put(padded(casters.uv.transpose(0, 2, 1).reshape(-1, 6), 0.0)),
            put(padded(of_image[casters.image], 0)),
            put(padded(casters.number, 0)),
            put(np.concatenate(texels) if texels else np.zeros(0, np.float32)),
        )
