"""What transmittance is right: every alpha caster against every point, in float64, by meeting its plane with a ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vtfs.alpha_casters import AlphaCasters, Blending
from vtfs.random_words import random_words
from vtfs.shadow_casters import ShadowLight
from vtfs.shadow_references import moved_points, volume_planes
from vtfs.tracer import bilinear

_PAIRS_AT_ONCE = 2**22


@dataclass(frozen=True)
class ReferenceLight:
    """What alpha casters leave of a light at some points.

    - `transmittance`: float64 `[n]`, or `[n, 3]` where blending is coloured.
    - `cutoff_margin`: how far the alpha of the nearest decision lies from its cutoff, `[n]`; infinite without one.
      Below some roundings either answer is right.
    """

    transmittance: np.ndarray
    cutoff_margin: np.ndarray


def brute_force_transmittance(
    points_m: np.ndarray,
    casters: AlphaCasters,
    light: ShadowLight,
    bias_m: float,
    origin_m: np.ndarray,
    blending: Blending = "grey",
    pixel: np.ndarray | None = None,
    stream: tuple[int, int] = (0, 0),
) -> ReferenceLight:
    """The light that alpha casters leave, as a product over all triangles; points on an edge are behind both.

    **Arguments:** as of `brute_force`, and

    - `pixel`: of each point, row by row, `[n]`; `stream`: see `transmitted_light`. For stochastic blending alone.
    """
    n = len(points_m)
    left = np.ones((n, 3) if blending == "coloured" else n)
    margin = np.full(n, np.inf)
    if not casters.casters.n_triangles or not n:
        return ReferenceLight(left, margin)
    homogeneous = light.homogeneous - np.append(origin_m, 0) * light.homogeneous[3]
    moved, _ = moved_points(points_m, homogeneous, bias_m)
    planes, behind = volume_planes(casters.casters, origin_m, homogeneous)
    about = moved if light.directional else moved - homogeneous[:3]
    step = max(1, _PAIRS_AT_ONCE // casters.casters.n_triangles)
    for first in range(0, n, step):
        some = about[first : first + step]
        held = some @ planes[3].T > behind[3]
        for normal, offset in zip(planes[:3], behind[:3], strict=True):
            held &= some @ normal.T >= offset
        point, triangle = np.nonzero(held)
        alpha = np.minimum(_alpha_met(moved[first + point], triangle, casters, homogeneous, origin_m), 1.0)
        masked = np.isfinite(casters.cutoff[triangle])
        stops = alpha >= np.where(masked, casters.cutoff[triangle], np.inf)
        distance = np.where(masked, np.abs(alpha - casters.cutoff[triangle]), np.inf)
        if blending == "stochastic":
            assert pixel is not None
            seed, view = np.array(stream, np.uint32)[:, None]  # arrays wrap in silence, numbers do not
            word = random_words(pixel[first + point].astype(np.uint32), casters.number[triangle], seed, view)
            random = word / 2.0**32
            stops |= ~masked & (random < alpha)
            distance = np.where(masked, distance, np.abs(random - alpha))
        blended = np.where(masked | (blending == "stochastic"), 0.0, alpha)
        shares = blended[:, None] * (1 - np.minimum(casters.tint[triangle], 1)) if blending == "coloured" else blended
        factor = np.where(stops if shares.ndim == 1 else stops[:, None], 0.0, 1 - shares)
        np.multiply.at(left, first + point, factor)
        np.minimum.at(margin, first + point, distance)
    return ReferenceLight(left, margin)


def _alpha_met(
    moved_m: np.ndarray, triangle: np.ndarray, casters: AlphaCasters, light: np.ndarray, origin_m: np.ndarray
) -> np.ndarray:
    """Opacity times alpha image where rays from points to the light meet the planes of triangles, `[pairs]`."""
    alpha = casters.opacity[triangle].copy()
    textured = np.flatnonzero(casters.image[triangle] >= 0)
    t = triangle[textured]
    a, b, c = (casters.casters.vertices_m[casters.casters.triangles[t, k]] - origin_m for k in range(3))
    normal = np.cross(b - a, c - a)
    start = moved_m[textured]
    way = light[:3] - light[3] * start
    at = start + (((a - start) * normal).sum(1) / (way * normal).sum(1))[:, None] * way
    # Areas of the three parts of the triangle around the place, over its own.
    area = (normal * normal).sum(axis=1)
    weight = [(np.cross(q - p, at - p) * normal).sum(axis=1) / area for p, q in ((b, c), (c, a), (a, b))]
    uv = np.sum([w[:, None] * casters.uv[t, k] for k, w in enumerate(weight)], axis=0)
    for i, image in enumerate(casters.images):
        here = casters.image[t] == i
        alpha[textured[here]] *= bilinear(image, uv[here, 0], uv[here, 1])
    return alpha
