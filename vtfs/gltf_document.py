"""The JSON and the buffers of a glTF or GLB file: every length checked against the file before it is believed."""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from vtfs.input_error import InputError
from vtfs.scene_folder import read_inside

Json = dict[str, Any]

JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(frozen=True)
class Document:
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
        buffer = whole_of(view, "buffer", where)
        self.entry("buffers", buffer, f"{where}.buffer")
        start, length = whole_of(view, "byteOffset", where, 0), whole_of(view, "byteLength", where)
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
            raise InputError(
                f"{where}: is sparse or has no bufferView; export without sparse accessors or compression."
            )
        component, kind = accessor.get("componentType"), accessor.get("type")
        if not isinstance(component, int) or component not in _COMPONENTS:
            raise InputError(f"{where}.componentType = {str(component)[:40]}: must be one of {list(_COMPONENTS)}.")
        if not isinstance(kind, str) or kind not in _COLUMNS:
            raise InputError(f"{where}.type = {str(kind)[:40]}: must be one of {', '.join(_COLUMNS)}.")
        count, offset = whole_of(accessor, "count", where), whole_of(accessor, "byteOffset", where, 0)
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
        stride = whole_of(self.json["bufferViews"][accessor["bufferView"]], "byteStride", where, 0)
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


def read_document(path: Path) -> Document:
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
        raise InputError(
            f"its JSON cannot be read ({' '.join(str(error).split())[:80]}); export the file again."
        ) from None
    if not isinstance(parsed, dict):
        raise InputError("its JSON must be an object; export the file again.")
    for kind in ("buffers", "bufferViews", "accessors", "meshes", "nodes", "scenes", "materials", "textures", "images",
                 "cameras"):  # fmt: skip
        entries = parsed.get(kind, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise InputError(f"`{kind}`: must be a list of objects; export the file again.")
    if not isinstance(parsed.get("extensionsRequired", []), list):
        raise InputError("`extensionsRequired`: must be a list; export the file again.")
    document = Document(parsed, [], path.parent)
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
            raise InputError(
                f"chunk at byte {at}: {size} bytes reach past the file's {length}; copy or export it again."
            )
        if not found and kind != JSON_CHUNK:
            raise InputError(f"chunk at byte {at}: the first must be JSON; export the file again.")
        found.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    if JSON_CHUNK not in found:
        raise InputError("has no JSON chunk; export the file again.")
    return found[JSON_CHUNK], found.get(BIN_CHUNK)


def _buffer(folder: Path, buffer: Json, i: int, binary: bytes | None) -> bytes:
    length = whole_of(buffer, "byteLength", f"buffers[{i}]")
    uri = buffer.get("uri")
    if uri is not None:
        content = resource(folder, uri, f"buffers[{i}].uri")
    elif i == 0 and binary is not None:
        content = binary
    else:
        raise InputError(f"buffers[{i}]: has neither a `uri` nor a binary chunk; export the file again.")
    if len(content) < length:
        raise InputError(
            f"buffers[{i}].byteLength = {length}: only {len(content)} bytes are there; copy or export it again."
        )
    return content[:length]


def resource(folder: Path, uri: object, field: str) -> bytes:
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
    return read_inside(folder, unquote(uri), field)


def object_of(record: Json, key: str, where: str) -> Json:
    value = record.get(key, {})
    if not isinstance(value, dict):
        raise InputError(f"{where}: `{key}` must be an object; export the file again.")
    return value


def number_of(record: Json, key: str, where: str, default: float | None = None) -> float:
    value = record.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}.{key} = {str(value)[:40]}: must be a number.")
    if not (math.isfinite(value) or value == default) or (abs(value) > 1e30 and value != default):
        raise InputError(f"{where}.{key} = {value:g}: must be finite.")
    return float(value)


def whole_of(record: Json, key: str, where: str, default: int | None = None) -> int:
    value = record.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"{where}.{key} = {str(value)[:40]}: must be a whole number, 0 or more.")
    return value


def numbers_of(record: Json, key: str, where: str, n: int, default: tuple[float, ...] = ()) -> list[float]:
    values = record.get(key, list(default))
    if not isinstance(values, list) or len(values) != n:
        raise InputError(f"{where}.{key}: must be a list of {n} numbers.")
    return [number_of({key: value}, key, where) for value in values]


def indices_of(record: Json, key: str, where: str, n: int) -> list[int]:
    values = record.get(key, [])
    if not isinstance(values, list):
        raise InputError(f"{where}.{key}: must be a list of node numbers.")
    for value in values:
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < n:
            raise InputError(f"{where}.{key}: {str(value)[:40]} is not the number of one of {n} nodes.")
    return values


def triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
