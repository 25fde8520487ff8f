"""Nodes of glTF files: where they stand, and the cameras and lights among them."""

from __future__ import annotations

import logging
import math

import numpy as np

from vtfs.camera import CameraPath, Pose, Viewport
from vtfs.directional_lights import DirectionalLights
from vtfs.gltf_document import Document, Json, indices_of, number_of, numbers_of, object_of, triple
from vtfs.input_error import InputError
from vtfs.lights import Lights, cone_cosines

log = logging.getLogger("vtfs.gltf")

_DIM_LUX = 0.01
"""A light without a range ends where it is this weak, or at the diagonal of the scene."""


def placed_nodes(document: Document) -> list[tuple[Json, np.ndarray]]:
    """Every node of the scene with its world matrix, float64 `[4, 4]`, parents first."""
    nodes = document.json.get("nodes", [])
    children = [indices_of(node, "children", f"nodes[{i}]", len(nodes)) for i, node in enumerate(nodes)]
    if document.json.get("scenes"):
        scene = document.entry("scenes", document.json.get("scene", 0), "scene")
        roots = indices_of(scene, "nodes", f"scenes[{document.json.get('scene', 0)}]", len(nodes))
    else:
        has_parent = {child for below in children for child in below}
        roots = [i for i in range(len(nodes)) if i not in has_parent]
    placed, waiting, met = [], [(root, np.eye(4)) for root in reversed(roots)], set()
    while waiting:
        i, parent = waiting.pop()
        if i in met:
            raise InputError(f"nodes[{i}]: is reached twice; nodes must form a tree.")
        met.add(i)
        with np.errstate(all="ignore"):
            world = parent @ _local_matrix(nodes[i], f"nodes[{i}]")
        if not np.isfinite(world).all():
            raise InputError(f"nodes[{i}]: its world matrix is not finite; check scales and matrices.")
        placed.append((nodes[i], world))
        waiting.extend((child, world) for child in reversed(children[i]))
    return placed


def _local_matrix(node: Json, where: str) -> np.ndarray:
    if "matrix" in node:
        return np.array(numbers_of(node, "matrix", where, 16)).reshape(4, 4).T
    x, y, z, w = numbers_of(node, "rotation", where, 4, (0, 0, 0, 1))
    squared = x * x + y * y + z * z + w * w
    if not squared > 0:
        raise InputError(f"{where}.rotation = {node['rotation']}: must be a unit quaternion.")
    s = 2 / squared
    rotation = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(numbers_of(node, "scale", where, 3, (1, 1, 1)))
    matrix[:3, 3] = numbers_of(node, "translation", where, 3, (0, 0, 0))
    return matrix


def cameras_of(document: Document, nodes: list[tuple[Json, np.ndarray]]) -> CameraPath | None:
    """All perspective cameras as one path, with the lens of the first and 720 rows."""
    poses, lens = [], None
    for node, world in nodes:
        if "camera" not in node:
            continue
        entry = document.entry("cameras", node["camera"], "a node's camera")
        where = f"cameras[{node['camera']}].perspective"
        perspective = object_of(entry, "perspective", where)
        if not perspective:
            log.warning("cameras[%s]: is not a perspective camera; left out", node["camera"])
            continue
        found = (
            math.degrees(number_of(perspective, "yfov", where)), number_of(perspective, "znear", where),
            number_of(perspective, "zfar", where, math.inf), number_of(perspective, "aspectRatio", where, 16 / 9),
        )  # fmt: skip
        if lens is not None and found != lens:
            log.warning("cameras[%s]: its lens differs from the first camera's, which is used", node["camera"])
        lens = lens or found
        eye, backward, up = world[:3, 3], world[:3, 2], world[:3, 1]
        length = float(np.linalg.norm(backward))
        target = eye - backward / length if length > 0 else eye  # `Camera` refuses the latter by name
        poses.append(Pose(triple(eye), triple(target), triple(up)))
    if lens is None:
        return None
    fov_y_deg, near_m, far_m, aspect = lens
    if not 0.01 <= aspect <= 20:
        raise InputError(f"cameras: aspectRatio = {aspect:g}: must be from 0.01 to 20.")
    return CameraPath(Viewport(max(1, round(720 * aspect)), 720), fov_y_deg, near_m, far_m, tuple(poses))


def lights_of(
    document: Document, nodes: list[tuple[Json, np.ndarray]], diagonal_m: float
) -> tuple[Lights | None, DirectionalLights]:
    """Lights of KHR_lights_punctual: points and spots, or None where there are none; and directional ones."""
    extension = object_of(object_of(document.json, "extensions", "extensions"), "KHR_lights_punctual", "extensions")
    entries = extension.get("lights", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError("KHR_lights_punctual.lights: must be a list of objects; export the file again.")
    rows, suns = [], []
    for node, world in nodes:
        reference = object_of(object_of(node, "extensions", "a node"), "KHR_lights_punctual", "a node")
        if not reference:
            continue
        number = reference.get("light")
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(entries):
            raise InputError(
                f"a node's KHR_lights_punctual.light = {str(number)[:40]}: must be one of {len(entries)} lights."
            )
        where = f"KHR_lights_punctual.lights[{number}]"
        if entries[number].get("type") == "directional":
            log.warning("%s: is directional; it shines, and casts, with shadow techniques only", where)
            suns.append((*world[:3, 2], *_colour(entries[number], where)))  # it shines along -z
        else:
            rows.append(_light(entries[number], where, world, diagonal_m))
    directional = DirectionalLights(*np.split(np.array(suns).reshape(-1, 6), 2, axis=1))
    if not rows:
        return None, directional
    table = np.array(rows)
    lights = Lights(table[:, 0:3], table[:, 3], table[:, 4:7], table[:, 7:10], table[:, 10], table[:, 11])
    return lights, directional


def _colour(entry: Json, where: str) -> np.ndarray:
    intensity = number_of(entry, "intensity", where, 1.0)
    colour = np.array(numbers_of(entry, "color", where, 3, (1, 1, 1))) * intensity
    if (colour < 0).any():
        raise InputError(f"{where}: color times intensity = {colour}: must be 0 or more.")
    return colour


def _light(entry: Json, where: str, world: np.ndarray, diagonal_m: float) -> tuple[float, ...]:
    """Position, range, colour, direction and cone of one light."""
    kind = entry.get("type")
    if kind not in ("point", "spot"):
        raise InputError(f"{where}.type = {str(kind)[:40]}: must be point, spot or directional.")
    colour = _colour(entry, where)
    range_m = number_of(entry, "range", where, 0.0)
    if "range" in entry and not range_m > 0:
        raise InputError(f"{where}.range = {range_m:g}: must be above 0.")
    if "range" not in entry:
        range_m = min(math.sqrt(float(colour.max()) / _DIM_LUX), diagonal_m)
        log.warning("%s: has no range; %.3g m is used, where it is weaker than %g lux", where, range_m, _DIM_LUX)
    axis = -world[:3, 2]
    length = float(np.linalg.norm(axis))
    if kind == "point" or not length > 0:
        return (*world[:3, 3], range_m, *colour, 0.0, 0.0, -1.0, -1.0, -2.0)
    spot = object_of(entry, "spot", where)
    inner = number_of(spot, "innerConeAngle", where, 0.0)
    outer = number_of(spot, "outerConeAngle", where, math.pi / 4)
    if not 0 <= inner <= outer <= math.pi or outer == 0:
        raise InputError(
            f"{where}.spot: cone angles {inner:g} and {outer:g} rad: must be 0 <= inner <= outer, outer > 0."
        )
    return (*world[:3, 3], range_m, *colour, *(axis / length), *cone_cosines(math.degrees(inner), math.degrees(outer)))
