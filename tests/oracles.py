"""What is right, the slow and obvious way: NumPy and Python loops in float64, apart from all code under test."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vtfs.camera import Camera, Viewport
from vtfs.lights import Lights
from vtfs.view_samples import ViewSamples


def in_view_space(camera: Camera, position_m: np.ndarray) -> np.ndarray:
    """World to view space, `[N, 3]`."""
    matrix = camera.view_from_world
    return np.asarray(position_m, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def in_world_space(camera: Camera, position_m: np.ndarray) -> np.ndarray:
    """View to world space, `[N, 3]`."""
    matrix = camera.view_from_world
    return (np.asarray(position_m, np.float64) - matrix[:3, 3]) @ matrix[:3, :3]


def windows(samples: ViewSamples, lights: Lights) -> np.ndarray:
    """`max(0, 1 - (d/range)^4)^2` of each light at each pixel, `[h, w, N]`; 0 where the sample is invalid."""
    position_m = samples.position_m.astype(np.float64)
    window = np.zeros((*samples.valid.shape, lights.n_lights))
    for n, light_m in enumerate(in_view_space(samples.camera, lights.position_m)):
        if lights.range_m[n] > 0:
            ratio = np.linalg.norm(position_m - light_m, axis=-1) / lights.range_m[n]
            window[..., n] = np.where(samples.valid, np.maximum(0, 1 - ratio**4) ** 2, 0)
    return window


def layered_image(samples: ViewSamples, lights: Lights, light_cutoff: float = 0.0) -> np.ndarray:
    """Transparent layers blended over the solid image, one pixel after the other."""
    total = image(samples, lights, light_cutoff)
    layers = samples.layers.transparent
    colours = [image(layer.samples, lights, light_cutoff) for layer in layers]
    for y, x in np.ndindex(samples.valid.shape):
        for layer, colour in reversed(list(zip(layers, colours, strict=True))):
            if layer.samples.valid[y, x]:
                opacity = float(layer.opacity[y, x])
                total[y, x] = opacity * colour[y, x] + (1 - opacity) * total[y, x]
    return total


def image(
    samples: ViewSamples, lights: Lights, light_cutoff: float = 0.0, listed: np.ndarray | None = None
) -> np.ndarray:
    """Blinn-Phong of all lights on all samples, one light after the other: float64 `[h, w, 3]`.

    `listed`, bool `[h, w, N]`: only these lights count.
    """
    position_m, normal, base, emissive = (
        channel.astype(np.float64)
        for channel in (samples.position_m, samples.normal, samples.base_colour, samples.emissive)
    )
    specular, shininess = samples.specular.astype(np.float64), samples.shininess.astype(np.float64)
    window = windows(samples, lights) * (1.0 if listed is None else listed)
    total = emissive.copy()
    rotation = samples.camera.view_from_world[:3, :3]
    with np.errstate(invalid="ignore", divide="ignore"):
        to_eye = -position_m / np.linalg.norm(position_m, axis=-1, keepdims=True)
        if samples.camera.is_orthographic:
            to_eye = np.broadcast_to([0.0, 0.0, 1.0], position_m.shape)
        for n, light_m in enumerate(in_view_space(samples.camera, lights.position_m)):
            to_light = light_m - position_m
            distance = np.linalg.norm(to_light, axis=-1)
            to_light /= np.maximum(distance, 1e-300)[..., None]  # from no direction at all where a light is in a sample
            half = to_light + to_eye
            half /= np.linalg.norm(half, axis=-1, keepdims=True)
            n_dot_l = np.maximum(0, (normal * to_light).sum(-1))
            n_dot_h = np.maximum(0, (normal * half).sum(-1))
            cone = 1.0
            if lights.cos_outer[n] >= -1:
                cos = -(to_light * (rotation @ lights.direction[n])).sum(-1)
                width = lights.cos_inner[n] - lights.cos_outer[n]
                cone = np.clip((cos - lights.cos_outer[n]) / width, 0, 1)
            falloff = np.where(window[..., n] > light_cutoff, window[..., n], 0) / np.maximum(distance**2, 1e-4)
            gloss = specular * n_dot_h**shininess
            added = (cone * falloff * n_dot_l)[..., None] * lights.colour[n] * (base + gloss[..., None])
            total += np.where((falloff > 0)[..., None], added, 0)
    return np.where(samples.valid[..., None], total, 0)


def near_cutoff(samples: ViewSamples, lights: Lights, light_cutoff: float, slack: float) -> np.ndarray:
    """Pixels where a window is so near to the cut-off that rounding decides, bool `[h, w]`."""
    if not light_cutoff:
        return np.zeros(samples.valid.shape, bool)
    return np.any(np.abs(windows(samples, lights) - light_cutoff) < slack, axis=-1)


def run_pixels(viewport: Viewport) -> np.ndarray:
    """Row and column of each lane of each run, `[runs, 32, 2]`: runs of 8 x 4 pixels, row by row."""
    pixels = []
    for top in range(0, viewport.height_px, 4):
        for left in range(0, viewport.width_px, 8):
            pixels.append([(top + lane // 8, left + lane % 8) for lane in range(32)])
    return np.array(pixels)


def as_image(runs: np.ndarray, viewport: Viewport) -> np.ndarray:
    """`[runs, 32]` to `[h, w]`, pixel by pixel."""
    picture = np.zeros((viewport.height_px, viewport.width_px), np.asarray(runs).dtype)
    rows, columns = np.moveaxis(run_pixels(viewport), -1, 0)
    inside = (rows < viewport.height_px) & (columns < viewport.width_px)
    picture[rows[inside], columns[inside]] = np.asarray(runs)[inside]
    return picture


def n_slices(camera: Camera, tile_px: int, depth_slices: int, far_m: float) -> tuple[float, int]:
    """Growth factor and number of slices (equations 8.1, 8.2 with a ceiling)."""
    if depth_slices:
        return (far_m / camera.near_m) ** (1 / depth_slices), depth_slices
    rows = math.ceil(camera.viewport.height_px / tile_px)
    growth = 1 + 2 * math.tan(math.radians(camera.fov_y_deg / 2)) / rows
    return growth, math.ceil(math.log(far_m / camera.near_m) / math.log(growth))


def cells(samples: ViewSamples, tile_px: int, slices: np.ndarray) -> dict[tuple[int, int, int], list[tuple[int, int]]]:
    """The valid pixels of each occupied cell (slice, tile row, tile column); `slices` is `[h, w]`."""
    found: dict[tuple[int, int, int], list[tuple[int, int]]] = {}
    for y, x in np.argwhere(samples.valid):
        found.setdefault((int(slices[y, x]), y // tile_px, x // tile_px), []).append((y, x))
    return found


def spheres_in_boxes(
    centre_m: np.ndarray, radius_m: np.ndarray, low: np.ndarray, high: np.ndarray, share: float = 1
) -> np.ndarray:
    """Do spheres, with `share` of their radius, touch boxes? bool `[boxes, spheres]` from `[N, 3]` and `[B, 3]`."""
    outside = np.maximum(np.maximum(low[:, None] - centre_m, centre_m - high[:, None]), 0)
    with np.errstate(invalid="ignore"):
        return (outside.astype(np.float64) ** 2).sum(-1) <= (radius_m.astype(np.float64) * share) ** 2


@dataclass
class SlowWalk:
    """Pairs that were found, and tests of existing children and items."""

    pairs: list[tuple[int, int]]
    child_tests: int = 0
    item_tests: int = 0


def walk(
    n_items: int,
    branching: int,
    n_queries: int,
    descend: Callable[[int, list[int]], bool],
    keep: Callable[[int, int], bool],
) -> SlowWalk:
    """Query after query down a tree of consecutive items; `descend` sees all items below a child."""
    levels = [[[item] for item in range(n_items)]]
    while len(levels[-1]) > 1 or len(levels) == 1:
        below = levels[-1]
        levels.append(
            [[item for child in below[k : k + branching] for item in child] for k in range(0, len(below), branching)]
        )
    result = SlowWalk([])

    def visit(query: int, level: int, node: int) -> None:
        children = range(node * branching, min((node + 1) * branching, len(levels[level - 1])))
        for child in children:
            if level == 1:
                result.item_tests += 1
                if keep(query, child):
                    result.pairs.append((query, child))
            else:
                result.child_tests += 1
                if descend(query, levels[level - 1][child]):
                    visit(query, level - 1, child)

    for query in range(n_queries):
        visit(query, len(levels) - 1, 0)
    return result


def morton_code(x: int, y: int, z: int) -> int:
    """Bit `s` of x, y, z at `3s`, `3s + 1`, `3s + 2`."""
    code = 0
    for s in range(10):
        for axis, value in enumerate((x, y, z)):
            code |= (value >> s & 1) << (3 * s + axis)
    return code


def divergence(of_sample: np.ndarray, tile_px: int) -> int:
    """Runs of 32 samples in tile order, 32 times the longest list of each."""
    total, (height, width) = 0, of_sample.shape
    for top in range(0, height, tile_px):
        for left in range(0, width, tile_px):
            in_tile = [
                int(of_sample[y, x]) if y < height and x < width else 0
                for y in range(top, top + tile_px)
                for x in range(left, left + tile_px)
            ]
            total += sum(32 * max(in_tile[k : k + 32]) for k in range(0, len(in_tile), 32))
    return total


def shading_work(of_block: list[int], chunk: int, capacity: int) -> tuple[int, int]:
    """Lanes and steps of shading, step by step: each chunk goes on until its longest list ends; where one chunk
    holds all blocks, only its first quarter and sixteenth go on once the lists of the others have ended."""
    ordered = sorted(of_block, reverse=True)
    lanes = steps = 0
    for first in range(0, len(ordered), chunk):
        part = ordered[first : first + chunk]
        widths = [chunk] if chunk < capacity else [chunk // d for d in (16, 4, 1) if chunk // d]
        for k in range(max(part)):
            lit = sum(length > k for length in part)
            lanes += 32 * next(width for width in widths if width >= lit)
            steps += 1
    return lanes, steps


def cell_corners(
    edges: tuple[float, float, float, float], near_m: float, far_m: float, parallel: bool = False
) -> np.ndarray:
    """Corners of the cell between the slopes left, right, bottom, top and two depths: `[8, 3]`, near face first."""
    left, right, bottom, top = edges
    corners = []
    for depth_m in (near_m, far_m):
        width = 1.0 if parallel else depth_m
        corners += [(x * width, y * width, -depth_m) for y in (bottom, top) for x in (left, right)]
    return np.array(corners, np.float64)


_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


def distances_to_cell(point_m: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance of points `[N, 3]` to a convex body of six faces: 0 inside, else to the nearest face, `[N]`."""
    centre = corners.mean(axis=0)
    outside = np.zeros(len(point_m), bool)
    nearest = np.full(len(point_m), np.inf)
    for face in _FACES:
        a, b, c, d = corners[list(face)]
        normal = np.cross(b - a, d - a)
        normal *= np.sign(normal @ (a - centre))
        outside |= (point_m - a) @ normal > 0
        for triangle in ((a, b, c), (a, c, d)):
            nearest = np.minimum(nearest, _distances_to_triangle(point_m, triangle))
    return np.where(outside, nearest, 0)


def _distances_to_triangle(point_m: np.ndarray, triangle: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    a, b, c = triangle
    normal = np.cross(b - a, c - a)
    inside = np.ones(len(point_m), bool)
    nearest = np.full(len(point_m), np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.cross(q - p, point_m - p) @ normal >= 0
        share = np.clip((point_m - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(point_m - (p + share[:, None] * (q - p)), axis=1))
    on_plane = np.abs((point_m - a) @ normal) / np.linalg.norm(normal)
    return np.where(inside, on_plane, nearest)


def projected_interval(centre: float, depth_m: float, radius_m: float, near_m: float) -> tuple[float, float] | None:
    """Least and greatest `x / depth` of a disc beyond the near plane (Mara and McGuire 2013); `None` if it has no part
    there."""
    if depth_m + radius_m < near_m:
        return None
    slopes = []
    square = centre**2 + depth_m**2 - radius_m**2
    if square > 0:
        for sign in (-1, 1):
            # Where the tangents from the eye touch the disc.
            cos, sin = math.sqrt(square), sign * radius_m
            scale = math.sqrt(square) / (centre**2 + depth_m**2)
            x, d = scale * (centre * cos - depth_m * sin), scale * (centre * sin + depth_m * cos)
            if d >= near_m:
                slopes.append(x / d)
    if depth_m - radius_m < near_m:
        half = math.sqrt(max(radius_m**2 - (near_m - depth_m) ** 2, 0))
        slopes += [(centre - half) / near_m, (centre + half) / near_m]
    return min(slopes), max(slopes)


def distance_to_cone(point_m: np.ndarray, apex_m: np.ndarray, axis: np.ndarray, half_angle: float) -> float:
    """Distance of a point to a solid cone: by the angle between its axis and the point."""
    v = point_m - apex_m
    length = float(np.linalg.norm(v))
    if length == 0:
        return 0.0
    angle = math.atan2(float(np.linalg.norm(np.cross(axis, v))), float(axis @ v)) - half_angle
    if angle <= 0:
        return 0.0
    return length * math.sin(angle) if angle < math.pi / 2 else length
