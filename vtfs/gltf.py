"""glTF and GLB: checked before anything else sees them, then read through trimesh.

trimesh gets a GLB that we write ourselves: only triangles, every accessor checked against its buffer, every node with
its world matrix, every primitive with a name that is its number. Materials, cameras and lights are read from the JSON,
as trimesh rounds colours to 8 bits, reads one camera and no lights.
"""

from __future__ import annotations

import io
import json
import logging
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vtfs.gltf_document import BIN_CHUNK, JSON_CHUNK, Document, Json, read_document
from vtfs.gltf_materials import Materials, base_texture, transformed_uv
from vtfs.gltf_nodes import cameras_of, lights_of, placed_nodes
from vtfs.input_error import InputError
from vtfs.scene import Scene

log = logging.getLogger("vtfs.gltf")
# Python prints what no handler takes, tracebacks too; what matters of it is in our errors.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

_LARGEST_TRIANGLES = 50_000_000  # instances written out: a small file can name one mesh many times
_LARGEST_PARTS = 1_000_000
_TRIANGLES, _STRIP = 4, 5
_UNDERSTOOD = {
    "KHR_lights_punctual", "KHR_materials_emissive_strength", "KHR_texture_transform", "KHR_materials_specular",
    "KHR_materials_unlit", "KHR_materials_ior", "KHR_materials_clearcoat", "KHR_materials_sheen",
    "KHR_materials_transmission", "KHR_materials_volume", "KHR_materials_iridescence", "KHR_materials_anisotropy",
}  # fmt: skip
"""Extensions that a file may require: read here, or about how a surface looks beyond what is shaded."""


@dataclass(frozen=True)
class Primitive:
    """One part of a mesh: numbers of accessors and of its material; `n_triangles` once, not per instance."""

    mode: int
    position: int
    indices: int | None
    uv: int | None
    colour: int | None
    material: int | None
    n_triangles: int


def load_gltf(path: Path) -> Scene:
    """Read a `.glb` or `.gltf`. **Raises:** `InputError` without the name of the file, which the caller adds."""
    document = read_document(path)
    for name in document.json.get("extensionsRequired", []):
        if name not in _UNDERSTOOD:
            raise InputError(f"extensionsRequired: `{str(name)[:60]}` is not supported; export without it.")
    meshes = _primitives(document)
    nodes = placed_nodes(document)
    placed = [(_mesh_of(document, node), world) for node, world in nodes if "mesh" in node]
    # Counted before it is written out: a few kilobytes can name 10**12 triangles.
    n_parts = sum(len(meshes[mesh]) for mesh, _ in placed)
    per_mesh = [sum(part.n_triangles for part in parts) for parts in meshes]
    n_triangles = sum(per_mesh[mesh] for mesh, _ in placed)
    if n_triangles > _LARGEST_TRIANGLES or n_parts > _LARGEST_PARTS:
        raise InputError(
            f"{n_triangles} triangles in {n_parts} parts with all instances: at most {_LARGEST_TRIANGLES} in "
            f"{_LARGEST_PARTS} are read; split it."
        )
    if n_triangles == 0:
        raise InputError("the scene has no triangles; export a mesh with faces.")
    first = np.cumsum([0, *(len(parts) for parts in meshes)]).tolist()  # numbers of primitives run over all meshes
    flat = [part for parts in meshes for part in parts]
    instances = [(p, world) for mesh, world in placed for p in range(first[mesh], first[mesh + 1])]
    scene = _assemble(path.stem, document, flat, instances)
    cameras = cameras_of(document, nodes)
    lights, suns = lights_of(document, nodes, scene.diagonal_m)
    return replace(scene, cameras=cameras, lights=lights, suns=suns)


def _primitives(document: Document) -> list[list[Primitive]]:
    """The triangle primitives of every mesh; lines, points and fans are left out with a warning."""
    meshes = []
    for i, mesh in enumerate(document.json.get("meshes", [])):
        parts = mesh.get("primitives")
        if not isinstance(parts, list) or not all(isinstance(part, dict) for part in parts):
            raise InputError(f"meshes[{i}].primitives: must be a list of objects; export the file again.")
        kept = []
        for j, part in enumerate(parts):
            where = f"meshes[{i}].primitives[{j}]"
            if part.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP):
                kept.append(_primitive(document, part, where))
            else:
                log.warning("%s: mode %s has no triangles that are read; left out", where, part.get("mode"))
        meshes.append(kept)
    return meshes


def _primitive(document: Document, part: Json, where: str) -> Primitive:
    attributes = part.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise InputError(f"{where}.attributes: has no POSITION; export the file again.")
    position = _of_kind(document, attributes["POSITION"], f"{where}.attributes.POSITION", "VEC3", (5126,))
    n_corners = document.json["accessors"][position]["count"]
    indices = None
    if "indices" in part:
        indices = _of_kind(document, part["indices"], f"{where}.indices", "SCALAR", (5121, 5123, 5125))
        n_corners = document.json["accessors"][indices]["count"]
    if part.get("mode", _TRIANGLES) == _TRIANGLES and n_corners % 3:
        raise InputError(f"{where}: {n_corners} corners are no whole number of triangles; export the file again.")
    material = part.get("material")
    if material is not None:
        document.entry("materials", material, f"{where}.material")
    uv_name = f"TEXCOORD_{base_texture(document, material).get('texCoord', 0)}"
    uv = colour = None
    if uv_name in attributes:
        uv = _of_kind(document, attributes[uv_name], f"{where}.attributes.{uv_name}", "VEC2", (5126, 5121, 5123))
        _same_count(document, uv, position, f"{where}.attributes.{uv_name}")
    if "COLOR_0" in attributes:
        name = f"{where}.attributes.COLOR_0"
        colour = _of_kind(document, attributes["COLOR_0"], name, ("VEC3", "VEC4"), (5126, 5121, 5123))
    n_triangles = n_corners // 3 if part.get("mode", _TRIANGLES) == _TRIANGLES else max(n_corners - 2, 0)
    return Primitive(part.get("mode", _TRIANGLES), position, indices, uv, colour, material, n_triangles)


def _of_kind(
    document: Document, index: object, field: str, kind: str | tuple[str, ...], components: tuple[int, ...]
) -> int:
    accessor = document.accessor(index, field)
    if accessor["type"] not in kind or accessor["componentType"] not in components:
        raise InputError(
            f"{field}: is {accessor['type']} of componentType {accessor['componentType']}; not {kind}, {components}."
        )
    assert isinstance(index, int)  # `accessor` refuses what is not
    return index


def _same_count(document: Document, index: int, position: int, field: str) -> None:
    accessors = document.json["accessors"]
    if accessors[index]["count"] != accessors[position]["count"]:
        raise InputError(
            f"{field}: {accessors[index]['count']} for {accessors[position]['count']} vertices; export again."
        )


def _mesh_of(document: Document, node: Json) -> int:
    document.entry("meshes", node["mesh"], "a node's mesh")
    return node["mesh"]


def _assemble(name: str, document: Document, parts: list[Primitive], instances: list[tuple[int, np.ndarray]]) -> Scene:
    """World-space triangles of all instances, from what trimesh reads."""
    import trimesh

    used = sorted({p for p, _ in instances})
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(_plain_glb(document, parts, used)), file_type="glb", process=False, maintain_order=True
        )
    except Exception as error:  # whatever a third-party parser raises is about this file
        raise InputError(
            f"trimesh cannot read it ({' '.join(str(error).split())[:100]}); export the file again."
        ) from None
    materials = Materials(document)
    vertices, triangles, uvs, index, n_vertices = [], [], [], [], 0
    ready = {p: _geometry(document, parts[p], p, loaded.geometry.get(str(p)), materials) for p in used}
    for p, world in instances:
        geometry = ready[p]
        if geometry is None:
            continue
        corners, faces, uv, material = geometry
        with np.errstate(all="ignore"):  # what is not finite is named by `Scene`
            vertices.append(corners @ world[:3, :3].T + world[:3, 3])
        is_mirrored = np.linalg.det(world[:3, :3]) < 0
        triangles.append((faces[:, ::-1] if is_mirrored else faces) + n_vertices)
        uvs.append(uv)
        index.append(np.full(len(faces), material, np.int32))
        n_vertices += len(corners)
    if not triangles:
        raise InputError("the scene has no triangles; export a mesh with faces.")
    has_uv = any(uv is not None for uv in uvs)
    filled = [np.zeros((len(v), 2), np.float32) if uv is None else uv for v, uv in zip(vertices, uvs, strict=True)]
    return Scene(
        name, np.concatenate(vertices), np.concatenate(triangles), np.concatenate(filled) if has_uv else None,
        np.concatenate(index), tuple(materials.kept),
    )  # fmt: skip


def _geometry(document: Document, part: Primitive, p: int, mesh: Any, materials: Materials):
    """Vertices, faces, texture coordinates and material number of one primitive; None where it has no triangle."""
    if mesh is None or not hasattr(mesh, "faces"):
        return None
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(
            f"accessors[{part.indices}]: index {faces.max()} is out of range; there are {len(vertices)} vertices."
        )
    n_bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if n_bad:
        raise InputError(
            f"accessors[{part.position}]: {n_bad} of {len(vertices)} vertices are NaN or infinite; repair the mesh."
        )
    uv = None
    if part.uv is not None:
        uv = transformed_uv(document.array(part.uv), base_texture(document, part.material))
    colour = None if part.colour is None else document.array(part.colour)[:, :3].mean(axis=0)
    return vertices, faces, uv, materials.number(part.material, colour, uv is not None)


def _plain_glb(document: Document, parts: list[Primitive], used: list[int]) -> bytes:
    """A GLB of positions and indices only, one mesh and one node for each used primitive."""
    wanted = sorted({a for p in used for a in (parts[p].position, parts[p].indices) if a is not None})
    number = {a: i for i, a in enumerate(wanted)}
    accessors, views, body = [], [], bytearray()
    for a in wanted:
        source = document.json["accessors"][a]
        buffer, start, length = document.view_range(source["bufferView"], f"accessors[{a}].bufferView")
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": length}
        stride = document.json["bufferViews"][source["bufferView"]].get("byteStride", 0)
        views.append(view | ({"byteStride": stride} if stride else {}))
        body += document.buffers[buffer][start : start + length]
        body += b"\0" * (-len(body) % 4)
        kept = {key: source[key] for key in ("componentType", "count", "type")}
        accessors.append(kept | {"bufferView": len(views) - 1, "byteOffset": source.get("byteOffset", 0)})
    meshes = []
    for p in used:
        part = {"attributes": {"POSITION": number[parts[p].position]}, "mode": parts[p].mode}
        indices = parts[p].indices
        meshes.append(
            {"name": str(p), "primitives": [part if indices is None else part | {"indices": number[indices]}]}
        )
    header: Json = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": list(range(len(used)))}],
        "nodes": [{"mesh": i, "name": f"node {i}"} for i in range(len(used))], "meshes": meshes,
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(body)}],
    }  # fmt: skip
    return _glb(header, bytes(body))


def _glb(header: Json, body: bytes) -> bytes:
    text = json.dumps(header, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), JSON_CHUNK)
    return head + text + struct.pack("<II", len(body), BIN_CHUNK) + body
