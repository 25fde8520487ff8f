"""glTF and GLB: checked before anything else sees them, then read through trimesh.

trimesh gets a GLB that we write ourselves: only triangles, every accessor checked against its buffer, every node with
its world matrix, every primitive with a name that is its number. Materials, cameras and lights are read from the JSON,
as trimesh rounds colours to 8 bits, reads one camera and no lights.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import logging
import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vtfs.camera import CameraPath, Pose, Viewport
from vtfs.input_error import InputError
from vtfs.lights import Lights, cone_cosines
from vtfs.scene import Material, Scene
from vtfs.scene_folder import alpha_of, decode_image, mean_linear_colour, read_inside

log = logging.getLogger("vtfs.gltf")

Json = dict[str, Any]

_LARGEST_TRIANGLES = 50_000_000  # instances written out: a small file can name one mesh many times
_JSON_CHUNK, _BIN_CHUNK = 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TRIANGLES, _STRIP = 4, 5
_UNDERSTOOD = {
    "KHR_lights_punctual", "KHR_materials_emissive_strength", "KHR_texture_transform", "KHR_materials_specular",
    "KHR_materials_unlit", "KHR_materials_ior", "KHR_materials_clearcoat", "KHR_materials_sheen",
    "KHR_materials_transmission", "KHR_materials_volume", "KHR_materials_iridescence", "KHR_materials_anisotropy",
}  # fmt: skip
"""Extensions that a file may require: read here, or about how a surface looks beyond what is shaded."""
_DIM_LUX = 0.01
"""A light without a range ends where it is this weak, or at the diagonal of the scene."""


@dataclass(frozen=True)
class _Primitive:
    """One part of a mesh: numbers of accessors and of its material; `n_triangles` once, not per instance."""

    mode: int
    position: int
    indices: int | None
    uv: int | None
    colour: int | None
    material: int | None
    n_triangles: int


@dataclass(frozen=True)
class _Document:
    """The JSON and the buffers of a file, with every buffer view known to lie in its buffer."""

    json: Json
    buffers: list[bytes]
    folder: Path

    def entry(self, kind: str, index: object, field: str) -> Json:
        """An entry of a top-level list."""
        entries = self.json.get(kind, [])
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise InputError(f"{field} = {str(index)[:40]}: must be the number of one of {len(entries)} {kind}.")
        return entries[index]

    def view_range(self, index: object, field: str) -> tuple[int, int, int]:
        """Buffer, first byte and length of a buffer view."""
        view = self.entry("bufferViews", index, field)
        where = f"bufferViews[{index}]"
        buffer = _whole(view, "buffer", where)
        self.entry("buffers", buffer, f"{where}.buffer")
        start, length = _whole(view, "byteOffset", where, 0), _whole(view, "byteLength", where)
        if start + length > len(self.buffers[buffer]):
            raise InputError(
                f"{where}: bytes {start} to {start + length} lie past buffers[{buffer}] of {len(self.buffers[buffer])} "
                "bytes; export the file again."
            )
        return buffer, start, length

    def accessor(self, index: object, field: str) -> Json:
        """An accessor whose elements all lie in its buffer view."""
        accessor = self.entry("accessors", index, field)
        where = f"accessors[{index}]"
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(f"{where}: is sparse or has no bufferView; export without sparse accessors or compression.")
        component, kind = accessor.get("componentType"), accessor.get("type")
        if not isinstance(component, int) or component not in _COMPONENTS:
            raise InputError(f"{where}.componentType = {str(component)[:40]}: must be one of {list(_COMPONENTS)}.")
        if not isinstance(kind, str) or kind not in _COLUMNS:
            raise InputError(f"{where}.type = {str(kind)[:40]}: must be one of {', '.join(_COLUMNS)}.")
        count, offset = _whole(accessor, "count", where), _whole(accessor, "byteOffset", where, 0)
        element = np.dtype(_COMPONENTS[component]).itemsize * _COLUMNS[kind]
        _, _, length = self.view_range(accessor["bufferView"], f"{where}.bufferView")
        stride = self._stride(accessor, element)
        if count < 1:
            raise InputError(f"{where}.count = {count}: must be at least 1.")
        if offset + (count - 1) * stride + element > length:
            raise InputError(
                f"{where}: {count} elements end at byte {offset + (count - 1) * stride + element}, past "
                f"bufferViews[{accessor['bufferView']}] of {length} bytes; export the file again."
            )
        return accessor

    def _stride(self, accessor: Json, element: int) -> int:
        where = f"bufferViews[{accessor['bufferView']}]"
        stride = _whole(self.json["bufferViews"][accessor["bufferView"]], "byteStride", where, 0)
        if 0 < stride < element or stride > 252:
            raise InputError(f"{where}.byteStride = {stride}: must be from {element} (one element) to 252.")
        return stride or element

    def array(self, index: int) -> np.ndarray:
        """The values of a checked accessor, `[count, columns]`; normalised integers as floats."""
        accessor = self.json["accessors"][index]
        buffer, start, _ = self.view_range(accessor["bufferView"], f"accessors[{index}].bufferView")
        dtype, columns = np.dtype(_COMPONENTS[accessor["componentType"]]), _COLUMNS[accessor["type"]]
        values = np.ndarray(
            (accessor["count"], columns), dtype, self.buffers[buffer], start + accessor.get("byteOffset", 0),
            (self._stride(accessor, dtype.itemsize * columns), dtype.itemsize),
        )  # fmt: skip
        if dtype.kind == "f":
            return values.astype(np.float32)
        return np.maximum(values / np.float32(np.iinfo(dtype).max), -1).astype(np.float32)


def load_gltf(path: Path) -> Scene:
    """Read a `.glb` or `.gltf`. **Raises:** `InputError` without the name of the file, which the caller adds."""
    document = _read(path)
    for name in document.json.get("extensionsRequired", []):
        if name not in _UNDERSTOOD:
            raise InputError(f"extensionsRequired: `{str(name)[:60]}` is not supported; export without it.")
    primitives = _primitives(document)
    nodes = _placed_nodes(document)
    instances = [(p, world) for node, world in nodes for p in _primitives_of(document, node, primitives)]
    flat = [part for parts in primitives for part in parts]
    n_triangles = sum(flat[p].n_triangles for p, _ in instances)
    if n_triangles == 0:
        raise InputError("the scene has no triangles; export a mesh with faces.")
    if n_triangles > _LARGEST_TRIANGLES:
        raise InputError(f"{n_triangles} triangles with all instances: at most {_LARGEST_TRIANGLES} are read; split it.")
    scene = _assemble(path.stem, document, flat, instances)
    cameras = _cameras(document, nodes)
    return replace(scene, cameras=cameras, lights=_lights(document, nodes, scene.diagonal_m))


# --- the file -------------------------------------------------------------------------------------------------------


def _read(path: Path) -> _Document:
    content = path.read_bytes()
    binary = None
    if content[:4] == b"glTF":
        text, binary = _chunks(content)
    elif path.suffix.lower() == ".glb":
        raise InputError(f"bytes 0 to 4 = {content[:4]!r}: must be b'glTF'; this is no GLB file.")
    else:
        text = content
    try:
        parsed = json.loads(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"its JSON cannot be read ({' '.join(str(error).split())[:80]}); export the file again.") from None
    if not isinstance(parsed, dict):
        raise InputError("its JSON must be an object; export the file again.")
    for kind in ("buffers", "bufferViews", "accessors", "meshes", "nodes", "scenes", "materials", "textures", "images",
                 "cameras"):  # fmt: skip
        entries = parsed.get(kind, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise InputError(f"`{kind}`: must be a list of objects; export the file again.")
    if not isinstance(parsed.get("extensionsRequired", []), list):
        raise InputError("`extensionsRequired`: must be a list; export the file again.")
    document = _Document(parsed, [], path.parent)
    for i, buffer in enumerate(parsed.get("buffers", [])):
        document.buffers.append(_buffer(document.folder, buffer, i, binary))
    return document


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB whose lengths agree with the file."""
    if len(content) < 20:
        raise InputError(f"is truncated: {len(content)} bytes, where a GLB header has 20; copy or export it again.")
    _, version, length = struct.unpack_from("<III", content)
    if version != 2:
        raise InputError(f"header `version` = {version}: must be 2; export as glTF 2.0.")
    if length > len(content):
        raise InputError(f"is truncated: header `length` = {length}, the file has {len(content)} bytes; copy it again.")
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", content, at)
        if at + 8 + size > length:
            raise InputError(f"chunk at byte {at}: {size} bytes reach past the file's {length}; copy or export it again.")
        if not found and kind != _JSON_CHUNK:
            raise InputError(f"chunk at byte {at}: the first must be JSON; export the file again.")
        found.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON_CHUNK not in found:
        raise InputError("has no JSON chunk; export the file again.")
    return found[_JSON_CHUNK], found.get(_BIN_CHUNK)


def _buffer(folder: Path, buffer: Json, i: int, binary: bytes | None) -> bytes:
    length = _whole(buffer, "byteLength", f"buffers[{i}]")
    uri = buffer.get("uri")
    if uri is not None:
        content = _resource(folder, uri, f"buffers[{i}].uri")
    elif i == 0 and binary is not None:
        content = binary
    else:
        raise InputError(f"buffers[{i}]: has neither a `uri` nor a binary chunk; export the file again.")
    if len(content) < length:
        raise InputError(f"buffers[{i}].byteLength = {length}: only {len(content)} bytes are there; copy or export it again.")
    return content[:length]


def _resource(folder: Path, uri: object, field: str) -> bytes:
    """What a URI names: base64 data, or a file inside the scene's folder."""
    if not isinstance(uri, str):
        raise InputError(f"{field} = {str(uri)[:40]}: must be text.")
    if uri.startswith("data:"):
        head, comma, body = uri.partition(",")
        if not comma or not head.endswith(";base64"):
            raise InputError(f"{field}: data must be base64; export as GLB.")
        try:
            return base64.b64decode(body, validate=True)
        except (binascii.Error, ValueError):
            raise InputError(f"{field}: its base64 data is damaged; export the file again.") from None
    from urllib.parse import unquote

    return read_inside(folder, unquote(uri), field)


# --- triangles ------------------------------------------------------------------------------------------------------


def _primitives(document: _Document) -> list[list[_Primitive]]:
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


def _primitive(document: _Document, part: Json, where: str) -> _Primitive:
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
    uv_name = f"TEXCOORD_{_base_texture(document, material).get('texCoord', 0)}"
    uv = colour = None
    if uv_name in attributes:
        uv = _of_kind(document, attributes[uv_name], f"{where}.attributes.{uv_name}", "VEC2", (5126, 5121, 5123))
        _same_count(document, uv, position, f"{where}.attributes.{uv_name}")
    if "COLOR_0" in attributes:
        name = f"{where}.attributes.COLOR_0"
        colour = _of_kind(document, attributes["COLOR_0"], name, ("VEC3", "VEC4"), (5126, 5121, 5123))
    n_triangles = n_corners // 3 if part.get("mode", _TRIANGLES) == _TRIANGLES else max(n_corners - 2, 0)
    return _Primitive(part.get("mode", _TRIANGLES), position, indices, uv, colour, material, n_triangles)


def _of_kind(
    document: _Document, index: object, field: str, kind: str | tuple[str, ...], components: tuple[int, ...]
) -> int:
    accessor = document.accessor(index, field)
    if accessor["type"] not in kind or accessor["componentType"] not in components:
        raise InputError(
            f"{field}: is {accessor['type']} of componentType {accessor['componentType']}; must be {kind} of {components}."
        )
    assert isinstance(index, int)  # `accessor` refuses what is not
    return index


def _same_count(document: _Document, index: int, position: int, field: str) -> None:
    accessors = document.json["accessors"]
    if accessors[index]["count"] != accessors[position]["count"]:
        raise InputError(f"{field}: {accessors[index]['count']} for {accessors[position]['count']} vertices; export again.")


def _placed_nodes(document: _Document) -> list[tuple[Json, np.ndarray]]:
    """Every node of the scene with its world matrix, float64 `[4, 4]`, parents first."""
    nodes = document.json.get("nodes", [])
    children = [_indices(node, "children", f"nodes[{i}]", len(nodes)) for i, node in enumerate(nodes)]
    if document.json.get("scenes"):
        scene = document.entry("scenes", document.json.get("scene", 0), "scene")
        roots = _indices(scene, "nodes", f"scenes[{document.json.get('scene', 0)}]", len(nodes))
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
        return np.array(_numbers(node, "matrix", where, 16)).reshape(4, 4).T
    x, y, z, w = _numbers(node, "rotation", where, 4, (0, 0, 0, 1))
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
    matrix[:3, :3] = rotation * np.array(_numbers(node, "scale", where, 3, (1, 1, 1)))
    matrix[:3, 3] = _numbers(node, "translation", where, 3, (0, 0, 0))
    return matrix


def _primitives_of(document: _Document, node: Json, primitives: list[list[_Primitive]]) -> range:
    """Numbers of the primitives of a node's mesh, counted over all meshes."""
    if "mesh" not in node:
        return range(0)
    document.entry("meshes", node["mesh"], "a node's mesh")
    start = sum(len(parts) for parts in primitives[: node["mesh"]])
    return range(start, start + len(primitives[node["mesh"]]))


def _assemble(name: str, document: _Document, parts: list[_Primitive], instances: list[tuple[int, np.ndarray]]) -> Scene:
    """World-space triangles of all instances, from what trimesh reads."""
    import trimesh

    used = sorted({p for p, _ in instances})
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(_plain_glb(document, parts, used)), file_type="glb", process=False, maintain_order=True
        )
    except Exception as error:  # whatever a third-party parser raises is about this file
        raise InputError(f"trimesh cannot read it ({' '.join(str(error).split())[:100]}); export the file again.") from None
    materials = _Materials(document)
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


def _geometry(document: _Document, part: _Primitive, p: int, mesh: Any, materials: _Materials):
    """Vertices, faces, texture coordinates and material number of one primitive; None where it has no triangle."""
    if mesh is None or not hasattr(mesh, "faces"):
        return None
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise InputError(f"accessors[{part.indices}]: index {faces.max()} is out of range; there are {len(vertices)} vertices.")
    n_bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if n_bad:
        raise InputError(f"accessors[{part.position}]: {n_bad} of {len(vertices)} vertices are NaN or infinite; repair the mesh.")
    uv = None
    if part.uv is not None:
        uv = _transformed(document.array(part.uv), _base_texture(document, part.material))
    colour = None if part.colour is None else document.array(part.colour)[:, :3].mean(axis=0)
    return vertices, faces, uv, materials.number(part.material, colour, uv is not None)


def _plain_glb(document: _Document, parts: list[_Primitive], used: list[int]) -> bytes:
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
        meshes.append({"name": str(p), "primitives": [part if indices is None else part | {"indices": number[indices]}]})
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
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), _JSON_CHUNK)
    return head + text + struct.pack("<II", len(body), _BIN_CHUNK) + body


# --- materials ------------------------------------------------------------------------------------------------------


class _Materials:
    """The materials that primitives use, each once; numbered in order of first use."""

    def __init__(self, document: _Document):
        self.kept: list[Material] = []
        self._document = document
        self._numbers: dict[object, int] = {}
        self._images: dict[int, Any] = {}

    def number(self, index: int | None, colour: np.ndarray | None, has_uv: bool) -> int:
        """The scene's number of a material of the file, times a mean vertex colour."""
        tint = None if colour is None else tuple(float(c) for c in np.nan_to_num(colour).clip(0, 1))
        key = (index, tint, has_uv)
        if key not in self._numbers:
            material = Material("default") if index is None else self._read(index, has_uv)
            if tint is not None:
                r, g, b = (c * t for c, t in zip(material.base_colour, tint, strict=True))
                material = replace(material, base_colour=(r, g, b))
            self._numbers[key] = len(self.kept)
            self.kept.append(material)
        return self._numbers[key]

    def _read(self, index: int, has_uv: bool) -> Material:
        """A material of the file.

        Metals keep their base colour as a diffuse one, as nothing here mirrors an environment; roughness r becomes
        the Blinn-Phong exponent `2 / r**4 - 2` (Karis 2013), within [1, 1024].
        """
        source, where = self._document.json["materials"][index], f"materials[{index}]"
        pbr = _object(source, "pbrMetallicRoughness", where)
        factor = _numbers(pbr, "baseColorFactor", where, 4, (1, 1, 1, 1))
        colour, opacity = np.array(factor[:3]), factor[3]
        mode = source.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise InputError(f"{where}.alphaMode = {str(mode)[:40]}: must be OPAQUE, MASK or BLEND.")
        image = self._base_image(index) if "baseColorTexture" in pbr else None
        alpha = None
        if image is not None:
            colour = colour * mean_linear_colour(image)
            if mode == "MASK" and has_uv:
                alpha = alpha_of(image)
            elif mode == "BLEND":
                opacity *= float(alpha_of(image).mean())
        metallic = _number(pbr, "metallicFactor", where, 1.0) if "metallicRoughnessTexture" not in pbr else 0.0
        roughness = _number(pbr, "roughnessFactor", where, 1.0) if "metallicRoughnessTexture" not in pbr else 0.5
        strength = _object(_object(source, "extensions", where), "KHR_materials_emissive_strength", where)
        emissive = np.array(_numbers(source, "emissiveFactor", where, 3, (0, 0, 0)))
        emissive = emissive * _number(strength, "emissiveStrength", where, 1.0)
        if "emissiveTexture" in source:
            emissive = emissive * mean_linear_colour(self._image(_object(source, "emissiveTexture", where), where))
        name = source.get("name", f"material {index}")
        return Material(
            name if isinstance(name, str) else f"material {index}",
            base_colour=_triple(colour),
            opacity=1.0 if mode == "OPAQUE" else opacity,
            emissive=_triple(emissive),
            specular=float(0.04 + metallic * (max(float(colour.mean()), 0.04) - 0.04)),
            shininess=float(np.clip(2 / max(roughness, 0.05) ** 4 - 2, 1, 1024)),
            alpha_mode="mask" if mode == "MASK" else "blend" if mode == "BLEND" else "opaque",
            alpha_image=alpha,
            alpha_cutoff=_number(source, "alphaCutoff", where, 0.5),
            two_sided=source.get("doubleSided") is True,
        )

    def _base_image(self, index: int) -> Any:
        where = f"materials[{index}].pbrMetallicRoughness.baseColorTexture"
        return self._image(_base_texture(self._document, index), where)

    def _image(self, info: Json, where: str) -> Any:
        """The decoded image of a texture reference."""
        document = self._document
        texture = document.entry("textures", info.get("index"), f"{where}.index")
        source = texture.get("source")
        webp = _object(_object(texture, "extensions", where), "EXT_texture_webp", where)
        source = webp.get("source", source)
        entry = document.entry("images", source, f"{where}: texture source")
        if source not in self._images:
            field = f"images[{source}]"
            if "uri" in entry:
                content = _resource(document.folder, entry["uri"], f"{field}.uri")
            else:
                buffer, start, length = document.view_range(entry.get("bufferView"), f"{field}.bufferView")
                content = document.buffers[buffer][start : start + length]
            self._images[source] = decode_image(content, field)
        return self._images[source]


def _base_texture(document: _Document, material: int | None) -> Json:
    """The base colour texture reference of a material, or an empty object."""
    if material is None:
        return {}
    where = f"materials[{material}]"
    pbr = _object(document.json["materials"][material], "pbrMetallicRoughness", where)
    info = _object(pbr, "baseColorTexture", where)
    transform = _object(_object(info, "extensions", where), "KHR_texture_transform", where)
    return info | ({"texCoord": transform["texCoord"]} if "texCoord" in transform else {})


def _transformed(uv: np.ndarray, info: Json) -> np.ndarray:
    """Texture coordinates after KHR_texture_transform: scale, then rotation, then offset."""
    transform = _object(_object(info, "extensions", "texture"), "KHR_texture_transform", "texture")
    if not transform:
        return uv
    scale = np.array(_numbers(transform, "scale", "KHR_texture_transform", 2, (1, 1)))
    offset = np.array(_numbers(transform, "offset", "KHR_texture_transform", 2, (0, 0)))
    angle = _number(transform, "rotation", "KHR_texture_transform", 0.0)
    c, s = math.cos(angle), math.sin(angle)
    return ((uv * scale) @ np.array([[c, -s], [s, c]]) + offset).astype(np.float32)


# --- cameras and lights ---------------------------------------------------------------------------------------------


def _cameras(document: _Document, nodes: list[tuple[Json, np.ndarray]]) -> CameraPath | None:
    """All perspective cameras as one path, with the lens of the first and 720 rows."""
    poses, lens = [], None
    for node, world in nodes:
        if "camera" not in node:
            continue
        entry = document.entry("cameras", node["camera"], "a node's camera")
        where = f"cameras[{node['camera']}].perspective"
        perspective = _object(entry, "perspective", where)
        if not perspective:
            log.warning("cameras[%s]: is not a perspective camera; left out", node["camera"])
            continue
        found = (
            math.degrees(_number(perspective, "yfov", where)), _number(perspective, "znear", where),
            _number(perspective, "zfar", where, math.inf), _number(perspective, "aspectRatio", where, 16 / 9),
        )  # fmt: skip
        if lens is not None and found != lens:
            log.warning("cameras[%s]: its lens differs from the first camera's, which is used", node["camera"])
        lens = lens or found
        eye, backward, up = world[:3, 3], world[:3, 2], world[:3, 1]
        length = float(np.linalg.norm(backward))
        target = eye - backward / length if length > 0 else eye  # `Camera` refuses the latter by name
        poses.append(Pose(_triple(eye), _triple(target), _triple(up)))
    if lens is None:
        return None
    fov_y_deg, near_m, far_m, aspect = lens
    if not 0.01 <= aspect <= 20:
        raise InputError(f"cameras: aspectRatio = {aspect:g}: must be from 0.01 to 20.")
    return CameraPath(Viewport(max(1, round(720 * aspect)), 720), fov_y_deg, near_m, far_m, tuple(poses))


def _lights(document: _Document, nodes: list[tuple[Json, np.ndarray]], diagonal_m: float) -> Lights | None:
    """Point and spot lights of KHR_lights_punctual; directional ones reach everywhere and are left out."""
    extension = _object(_object(document.json, "extensions", "extensions"), "KHR_lights_punctual", "extensions")
    entries = extension.get("lights", [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError("KHR_lights_punctual.lights: must be a list of objects; export the file again.")
    rows = []
    for node, world in nodes:
        reference = _object(_object(node, "extensions", "a node"), "KHR_lights_punctual", "a node")
        if not reference:
            continue
        number = reference.get("light")
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(entries):
            raise InputError(f"a node's KHR_lights_punctual.light = {str(number)[:40]}: must be one of {len(entries)} lights.")
        row = _light(entries[number], f"KHR_lights_punctual.lights[{number}]", world, diagonal_m)
        if row is not None:
            rows.append(row)
    if not rows:
        return None
    table = np.array(rows)
    return Lights(table[:, 0:3], table[:, 3], table[:, 4:7], table[:, 7:10], table[:, 10], table[:, 11])


def _light(entry: Json, where: str, world: np.ndarray, diagonal_m: float) -> tuple[float, ...] | None:
    """Position, range, colour, direction and cone of one light."""
    kind = entry.get("type")
    if kind == "directional":
        log.warning("%s: directional lights have no range and are left out", where)
        return None
    if kind not in ("point", "spot"):
        raise InputError(f"{where}.type = {str(kind)[:40]}: must be point or spot.")
    intensity = _number(entry, "intensity", where, 1.0)
    colour = np.array(_numbers(entry, "color", where, 3, (1, 1, 1))) * intensity
    if (colour < 0).any():
        raise InputError(f"{where}: color times intensity = {colour}: must be 0 or more.")
    range_m = _number(entry, "range", where, 0.0)
    if "range" in entry and not range_m > 0:
        raise InputError(f"{where}.range = {range_m:g}: must be above 0.")
    if "range" not in entry:
        range_m = min(math.sqrt(float(colour.max()) / _DIM_LUX), diagonal_m)
        log.warning("%s: has no range; %.3g m is used, where it is weaker than %g lux", where, range_m, _DIM_LUX)
    axis = -world[:3, 2]
    length = float(np.linalg.norm(axis))
    if kind == "point" or not length > 0:
        return (*world[:3, 3], range_m, *colour, 0.0, 0.0, -1.0, -1.0, -2.0)
    spot = _object(entry, "spot", where)
    inner = _number(spot, "innerConeAngle", where, 0.0)
    outer = _number(spot, "outerConeAngle", where, math.pi / 4)
    if not 0 <= inner <= outer <= math.pi or outer == 0:
        raise InputError(f"{where}.spot: cone angles {inner:g} and {outer:g} rad: must be 0 <= inner <= outer, outer > 0.")
    return (*world[:3, 3], range_m, *colour, *(axis / length), *cone_cosines(math.degrees(inner), math.degrees(outer)))


# --- values of the JSON ---------------------------------------------------------------------------------------------


def _object(record: Json, key: str, where: str) -> Json:
    value = record.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where}: `{key}` must be an object; export the file again.")
    return value


def _number(record: Json, key: str, where: str, default: float | None = None) -> float:
    value = record.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}.{key} = {str(value)[:40]}: must be a number.")
    if not (math.isfinite(value) or value == default) or abs(value) > 1e30 and value != default:
        raise InputError(f"{where}.{key} = {value:g}: must be finite.")
    return float(value)


def _whole(record: Json, key: str, where: str, default: int | None = None) -> int:
    value = record.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"{where}.{key} = {str(value)[:40]}: must be a whole number, 0 or more.")
    return value


def _numbers(record: Json, key: str, where: str, n: int, default: tuple[float, ...] = ()) -> list[float]:
    values = record.get(key, list(default))
    if not isinstance(values, list) or len(values) != n:
        raise InputError(f"{where}.{key}: must be a list of {n} numbers.")
    return [_number({key: value}, key, where) for value in values]


def _indices(record: Json, key: str, where: str, n: int) -> list[int]:
    values = record.get(key, [])
    if not isinstance(values, list):
        raise InputError(f"{where}.{key}: must be a list of node numbers.")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < n:
            raise InputError(f"{where}.{key}: {str(value)[:40]} is not the number of one of {n} nodes.")
    return values


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
