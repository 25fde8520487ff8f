"""What a relaxed count starts from: some samples of a frame, the variables, and the pairs that may count."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from vtfs.bounds import Aabb, Sphere
from vtfs.camera import Camera
from vtfs.clusters import Clusters
from vtfs.input_error import InputError
from vtfs.light_assignment.light_tree import assign_tree, light_tree
from vtfs.lights import Lights
from vtfs.phase_average import Span, cell_box, tile_rays
from vtfs.relaxed_counts import CandidatePairs, CountVariables, RelaxedFrame, _screen, in_view, log_growth, on_screen
from vtfs.view_samples import ViewSamples

_BRANCHING = 8
_LARGEST_PAIRS = 2**28
_PLASTIC = 1.2207440846057596  # root of x**4 = x + 1: Roberts' sequence in three dimensions


def relaxed_frame(samples: ViewSamples, n_samples: int = 2048, n_phases: int = 1) -> RelaxedFrame:
    """Samples spread evenly over the image, each with its own points of a low-discrepancy sequence. Deterministic.

    Along a Z-order curve over the valid pixels one in so many is taken. For the count of a whole frame more
    samples are worth more than more phases of each: one is enough; several serve single samples.

    **Arguments:**

    - `n_samples`: at most so many; all where there are no more.

    **Raises:** `InputError` where the frame has no valid sample, or a number is below 1.
    """
    for name, value in (("n_samples", n_samples), ("n_phases", n_phases)):
        if value < 1:
            raise InputError(f"`relaxed_frame({name}={value})`: must be at least 1.")
    row, column = np.nonzero(samples.valid)
    n_valid = len(row)
    if not n_valid:
        raise InputError("the frame has no valid sample: there is nothing to count; choose another view.")
    n_samples = min(n_samples, n_valid)
    order = np.argsort(_spread_bits(column) | _spread_bits(row) << np.uint64(1))
    chosen = order[((np.arange(n_samples) + 0.5) * n_valid / n_samples).astype(np.int64)]
    camera = samples.camera
    rotation = camera.view_from_world[:3, :3]
    position_m = samples.position_m[row[chosen], column[chosen]].astype(np.float64) @ rotation
    point = np.arange(1, n_samples * n_phases + 1)[:, None] * _PLASTIC ** -np.arange(1.0, 4.0) + 0.5
    deepest_m = float(-samples.position_m[..., 2][samples.valid].min())
    return RelaxedFrame(
        *(_float32(position_m[:, c]) for c in range(3)),
        phase=_float32((point % 1).reshape(n_samples, n_phases, 3)),
        weight=_float32(n_valid / n_samples),
        view_from_world=_float32(rotation),
        far_m=_float32(camera.far_m if math.isfinite(camera.far_m) else max(deepest_m, camera.near_m * (1 + 1e-6))),
        viewport=camera.viewport,
    )


def count_variables(
    camera: Camera, lights: Lights, tile_px: float = 32, depth_slices: float | None = 0, far_m: float | None = None
) -> CountVariables:
    """The variables of a configuration.

    **Arguments:**

    - `depth_slices`: 0: cubic cells, as a real number of slices (see `cubic_depth_slices`); `None`: tiled shading.
    - `far_m`: the frame's, where the camera's is infinite and cells are to be cubic.

    **Raises:** `InputError` that names the value.
    """
    far_m = camera.far_m if far_m is None else far_m
    if not tile_px > 0:
        raise InputError(f"`tile_px` = {tile_px:g}: must be above 0.")
    if depth_slices is not None and not (math.isfinite(depth_slices) and depth_slices >= 0):
        raise InputError(f"`depth_slices` = {depth_slices:g}: must be 0 (cubic cells), above 0, or None (tiles).")
    if depth_slices == 0:
        if not math.isfinite(far_m):
            raise InputError("`depth_slices` = 0 with an infinite far plane: give `far_m`, as the frame has it.")
        log_g = math.log1p(2 * camera.tan_half_y * tile_px / camera.viewport.height_px)
        depth_slices = math.log(far_m / camera.near_m) / log_g
    relative_m = lights.position_m - np.asarray(camera.eye_m)
    return CountVariables(
        tile_px_x=_float32(tile_px),
        tile_px_y=_float32(tile_px),
        depth_slices=None if depth_slices is None else _float32(depth_slices),
        near_m=_float32(camera.near_m),
        light_x_m=_float32(relative_m[:, 0]),
        light_y_m=_float32(relative_m[:, 1]),
        light_z_m=_float32(relative_m[:, 2]),
        light_range_m=_float32(lights.range_m),
        eye_m=_float32(np.zeros(3)),
        turn_rad=_float32(np.zeros(3)),
        tan_half_y=_float32(camera.tan_half_y),
    )


def candidate_pairs(
    variables: CountVariables, frame: RelaxedFrame, temperature: float = 0.0, margin: float = 0.02
) -> CandidatePairs:
    """The pairs whose light meets the cell of the sample at some phase; lights without range meet none.

    They are found by the light tree, as lists of lights for boxes that hold all cells of a sample.

    **Arguments:**

    - `margin`: the pairs still are all that count after tile size, log of the growth and ranges have grown by this
      share, and lights or samples have moved by this share of a light's range.

    **Raises:** `InputError` for more than 2^28 pairs.
    """
    count, light = np.zeros(frame.n_samples, np.int64), np.zeros(0, np.int32)
    if variables.light_range_m.shape[0]:
        with jax.enable_x64(False):
            single: tuple[CountVariables, RelaxedFrame] = jax.tree.map(
                lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float32), (variables, frame)
            )
            boxes, spheres = _reaches(*single, np.float32(temperature), np.float32(margin))
            count, light = _lists(boxes, spheres)
    n_pairs = len(light)
    sample = np.repeat(np.arange(frame.n_samples, dtype=np.int32), count)
    padding = (0, _rounded_up(n_pairs) - n_pairs)
    return CandidatePairs(
        jnp.asarray(np.pad(sample, padding)),
        jnp.asarray(np.pad(light, padding)),
        jnp.asarray(np.pad(np.ones(n_pairs, bool), padding)),
    )


@jax.jit
def _reaches(variables: CountVariables, frame: RelaxedFrame, temperature, margin) -> tuple[Aabb, Sphere]:
    """A box that holds all cells of each sample, and the lights, in view space."""
    x_px, y_px, depth_m = on_screen(variables, frame)
    grown = 1 + margin
    tiles = (
        Span(position - grown * tile, position + grown * tile)
        for position, tile in ((x_px, variables.tile_px_x), (y_px, variables.tile_px_y))
    )
    if variables.depth_slices is None:
        near_m, far_m = variables.near_m / grown, frame.far_m * grown
    else:
        ratio = jnp.exp(grown * log_growth(variables, frame.far_m))
        near_m, far_m = depth_m / ratio, depth_m * ratio
    x, y, z = cell_box(tile_rays(_screen(variables, frame), *tiles), near_m, far_m)
    shape = depth_m.shape
    box = Aabb(*(jnp.broadcast_to(side, shape) for side in (x.low, y.low, -z.high, x.high, y.high, -z.low)))
    light_x, light_y, light_z = in_view(variables, frame, variables.light_x_m, variables.light_y_m, variables.light_z_m)
    range_m = variables.light_range_m
    reach_m = range_m * (1 + temperature + 2 * margin)
    return box, Sphere(jnp.where(range_m > 0, light_x, jnp.inf), light_y, -light_z, reach_m)


def _lists(boxes: Aabb, spheres: Sphere) -> tuple[np.ndarray, np.ndarray]:
    """Lights that meet each box: how many, and which, box after box."""
    capacity = 2**18
    while capacity <= _LARGEST_PAIRS:
        lists = _assigned(boxes, spheres, capacity)
        if not bool(lists.overflowed):
            count = np.asarray(lists.count)
            return count, np.asarray(lists.index)[: count.sum(dtype=np.int64)]
        capacity *= 8
    raise InputError(f"relaxed count: more than {capacity // 8:,} pairs; take fewer samples.")


@functools.partial(jax.jit, static_argnums=2)
def _assigned(boxes: Aabb, spheres: Sphere, capacity: int):
    n = boxes.low_x_m.shape[0]
    nothing = jnp.zeros(n, jnp.int32)
    no = jnp.bool_(False)
    clusters = Clusters(nothing, boxes, jnp.int32(n), nothing, nothing, jnp.int32(n), jnp.int32(n), nothing, no)
    return assign_tree(light_tree(spheres, _BRANCHING), clusters, capacity, min(capacity, 2**16))[0]


def _rounded_up(n_pairs: int) -> int:
    """One of few capacities, so that few programs are compiled; what is not in use costs no time."""
    capacity = 2**14
    while capacity < n_pairs:
        capacity *= 4
    return capacity


def _spread_bits(value: np.ndarray) -> np.ndarray:
    """The bits of 16-bit numbers, each followed by a 0."""
    value = value.astype(np.uint64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        value = (value | value << np.uint64(shift)) & np.uint64(mask)
    return value


def _float32(value) -> jax.Array:
    return jnp.asarray(np.asarray(value, np.float32))
