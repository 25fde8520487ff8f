"""Built-in scenes: an atrium, a street, a grove and a conservatory, made to any triangle count from 1k to 1M.

A scene is laid out for a triangle count, which decides what stands in it, and for a level of detail, which decides how
finely it is tessellated; the level is searched so that the count comes out, and only then is anything built. Metres, y
up; the same seed gives the same scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vtfs.camera import CameraPath
from vtfs.gallery_scenes.atrium import atrium, atrium_path
from vtfs.gallery_scenes.conservatory import conservatory, conservatory_path
from vtfs.gallery_scenes.grove import grove, grove_path
from vtfs.gallery_scenes.layout import Detail, Layout
from vtfs.gallery_scenes.street import street, street_path
from vtfs.input_error import InputError
from vtfs.scene import Scene

_FEWEST, _MOST = 1_000, 1_000_000


@dataclass(frozen=True)
class Builtin:
    """A built-in scene: how it is laid out for a count, a level of detail and a seed, and where its camera goes."""

    description: str
    default_triangles: int
    layout: Callable[[int, Detail, int], Layout]
    path: Callable[[], CameraPath]


def build_scene(name: str, n_triangles: int | None = None, seed: int = 0) -> Scene:
    """A built-in scene with its camera path.

    **Arguments:**

    - `n_triangles`: 1,000 to 1,000,000; the scene has that many within 15 %. Each scene has its default.

    **Raises:** `InputError` for an unknown name or a count out of range.
    """
    if name not in GALLERY:
        raise InputError(f"scene `{name}`: unknown; built-in scenes are {', '.join(GALLERY)}.")
    builtin = GALLERY[name]
    wanted = builtin.default_triangles if n_triangles is None else n_triangles
    if not _FEWEST <= wanted <= _MOST:
        raise InputError(f"scene `{name}` `n_triangles` = {wanted}: must be from {_FEWEST} to {_MOST}.")
    layout = _with_count(builtin, wanted, seed)
    vertices, triangles, uvs, index, materials, n_vertices = [], [], [], [], [], 0
    for material, part in layout:
        corner, faces, uv = part.build()
        vertices.append(corner)
        triangles.append(faces + n_vertices)
        uvs.append(uv)
        if material not in materials:
            materials.append(material)
        index.append(np.full(len(faces), materials.index(material), np.int32))
        n_vertices += len(corner)
    return Scene(
        name, np.concatenate(vertices), np.concatenate(triangles), np.concatenate(uvs).astype(np.float32),
        np.concatenate(index), tuple(materials), builtin.path(),
    )  # fmt: skip


def _with_count(builtin: Builtin, wanted: int, seed: int) -> Layout:
    """The layout whose count comes closest, by bisection of the level of detail on a log scale."""
    low, high = 0.02, 64.0
    best = builtin.layout(wanted, Detail(low), seed)
    for _ in range(13):
        middle = (low * high) ** 0.5
        layout = builtin.layout(wanted, Detail(middle), seed)
        if abs(_count(layout) - wanted) < abs(_count(best) - wanted):
            best = layout
        low, high = (middle, high) if _count(layout) < wanted else (low, middle)
    return best


def _count(layout: Layout) -> int:
    return sum(part.n_triangles for _, part in layout)


GALLERY: dict[str, Builtin] = {
    "atrium": Builtin("two-storey courtyard with colonnades, curtains and a balcony", 60_000, atrium, atrium_path),
    "street": Builtin("street with house fronts, windows, lamps, kerbs and cars", 60_000, street, street_path),
    "grove": Builtin("trees of alpha-tested leaf cards on uneven ground", 100_000, grove, grove_path),
    "conservatory": Builtin(
        "glass hall with stained panes and alpha-tested plants", 60_000, conservatory, conservatory_path
    ),
}
"""The built-in scenes, in the order in which they are shown; the first is the default."""
