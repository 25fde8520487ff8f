"""OBJ, PLY and STL: headers checked against the file, then read through trimesh; MTL materials.

trimesh never opens a file here: it gets bytes; MTL files and their images are read by us, inside the scene's folder.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vtfs.input_error import InputError
from vtfs.scene import Material, Scene
from vtfs.scene_folder import alpha_of, decode_image, linear_from_srgb, mean_linear_colour, path_inside, read_inside

log = logging.getLogger("vtfs.mesh_files")
# Python prints what no handler takes, tracebacks too; what matters of it is in our errors.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

_PLY_BYTES = {
    "char": 1, "int8": 1, "uchar": 1, "uint8": 1, "short": 2, "int16": 2, "ushort": 2, "uint16": 2, "int": 4,
    "int32": 4, "uint": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip
_LARGEST_HEADER_BYTES = 2**20
_MOST_COLOURS = 512


def load_mesh_file(path: Path) -> Scene:
    """Read an OBJ, PLY or STL. **Raises:** `InputError` without the name of the file, which the caller adds."""
    content = path.read_bytes()
    return {".obj": _load_obj, ".ply": _load_ply, ".stl": _load_stl}[path.suffix.lower()](content, path)


# --- OBJ ------------------------------------------------------------------------------------------------------------


def _load_obj(content: bytes, path: Path) -> Scene:
    """Materials of all MTL files that are there; what has none, or is not found, is grey 0.8."""
    text = content.decode("utf-8", errors="replace").replace("\r\n", "\n").replace("\\\n", " ")
    known: dict[str, Material] = {}
    for names in re.findall(r"(?m)^[ \t]*mtllib[ \t]+(.+)$", text):
        for name in [names.strip()] if path_inside(path.parent, names.strip(), "mtllib").is_file() else names.split():
            if path_inside(path.parent, name, "mtllib").is_file():
                known |= _materials(read_inside(path.parent, name, "mtllib"), path.parent, name)
            else:
                log.warning("%s: mtllib %s is not there; its materials are grey", path, name)
    # trimesh finds a material's name only through an MTL: it gets one of ours, with numbers for names.
    names = sorted({name.strip() for name in re.findall(r"(?m)^[ \t]*usemtl[ \t]+(.*)$", text)})
    number = {name: i for i, name in enumerate(names)}
    text = re.sub(r"(?m)^[ \t]*mtllib.*$", "", text)
    text = re.sub(r"(?m)^[ \t]*usemtl[ \t]+(.*)$", lambda m: f"usemtl m{number[m[1].strip()]}", text)
    text = "mtllib numbers.mtl\n" + _absolute_indices(text)
    library = "".join(f"newmtl m{i}\nKd 1 1 1\n" for i in range(len(names))).encode() or b"newmtl none\nKd 1 1 1\n"
    loaded = _through_trimesh(text.encode(), "obj", {"numbers.mtl": library})
    materials = (*(known.get(name, Material(name)) for name in names), Material("default"))

    def material_of(mesh: Any) -> np.ndarray:
        name = getattr(getattr(mesh.visual, "material", None), "name", None) or ""
        index = int(name[1:]) if re.fullmatch(r"m\d+", name) else len(names)
        return np.full(len(mesh.faces), index, np.int32)

    return _scene_of(path.stem, loaded, materials, material_of)


def _absolute_indices(text: str) -> str:
    """Negative indices as positive ones: they count back from the line they stand in, trimesh from the end."""
    if not re.search(r"(?m)^[ \t]*f[ \t].*-\d", text):
        return text
    counts = {"v": 0, "vt": 0, "vn": 0}
    lines = []
    for line in text.split("\n"):
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        if words and words[0] == "f":
            corners = []
            for corner in words[1:]:
                parts = zip(corner.split("/"), counts.values(), strict=False)
                corners.append("/".join(str(n + 1 + int(p)) if re.fullmatch(r"-\d+", p) else p for p, n in parts))
            line = " ".join(["f", *corners])
        lines.append(line)
    return "\n".join(lines)


def _materials(content: bytes, folder: Path, file_name: str) -> dict[str, Material]:
    """The materials of an MTL file: Kd, d or Tr, Ke, Ks, Ns, map_Kd (its mean), map_d (an alpha test at 1/2).

    Colours are taken as linear, as the format does not say.
    """
    found: dict[str, dict[str, list[str]]] = {}
    current: dict[str, list[str]] = {}
    for line in content.decode("utf-8", errors="replace").splitlines():
        words = line.split("#")[0].split()
        if len(words) < 2:
            continue
        if words[0] == "newmtl":
            current = found.setdefault(" ".join(words[1:]), {})
        else:
            current[words[0].lower()] = words[1:]
    return {name: _material(name, values, folder, f"{file_name}: material `{name}`") for name, values in found.items()}


def _material(name: str, values: dict[str, list[str]], folder: Path, where: str) -> Material:
    colour = np.array(_floats(values, "kd", where, (0.8, 0.8, 0.8)))
    opacity = _floats(values, "d", where, (1.0,))[-1]  # `d -halo 0.5` too
    if "tr" in values and "d" not in values:
        opacity = 1 - _floats(values, "tr", where, (0.0,))[0]
    if "map_kd" in values:
        mean = mean_linear_colour(_image(values["map_kd"], folder, f"{where} map_Kd"))
        colour = mean * colour if colour.any() else mean  # some exporters write black beside a texture
    alpha = None
    if "map_d" in values:
        image = _image(values["map_d"], folder, f"{where} map_d")
        opaque = alpha_of(image)
        alpha = opaque if opaque.min() < 1 else np.asarray(image.convert("L"), np.float32) / 255
    r, g, b = (float(c) for c in colour)
    er, eg, eb = _floats(values, "ke", where, (0.0, 0.0, 0.0))
    return Material(
        name, (r, g, b), opacity, (er, eg, eb),
        specular=float(np.mean(_floats(values, "ks", where, (0.04, 0.04, 0.04)))),
        shininess=max(1.0, _floats(values, "ns", where, (32.0,))[0]),
        alpha_mode="mask" if alpha is not None else "blend" if opacity < 1 else "opaque",
        alpha_image=alpha, two_sided=alpha is not None,
    )  # fmt: skip


def _floats(values: dict[str, list[str]], key: str, where: str, default: tuple[float, ...]) -> tuple[float, ...]:
    words = [word for word in values.get(key, []) if not word.startswith("-halo")]
    if not words:
        return default
    if len(words) == 1 and len(default) == 3:
        words = words * 3
    try:
        numbers = tuple(float(word) for word in words[: len(default)])
    except ValueError:
        raise InputError(f"{where}: `{key}` = {' '.join(words)[:40]!r}: must be numbers.") from None
    if len(numbers) != len(default) or not np.isfinite(numbers).all() or min(numbers) < 0:
        raise InputError(
            f"{where}: `{key}` = {' '.join(words)[:40]!r}: must be {len(default)} finite numbers, 0 or more."
        )
    return numbers


def _image(words: list[str], folder: Path, field: str) -> Any:
    # Options such as `-s 1 1 1` stand before the name; without any, a name may hold spaces.
    name = words[-1] if words[0].startswith("-") else " ".join(words)
    return decode_image(read_inside(folder, name, field), field)


# --- PLY ------------------------------------------------------------------------------------------------------------


def _load_ply(content: bytes, path: Path) -> Scene:
    """Colours of faces, or of vertices, become one material for each of at most 512 colours (sRGB)."""
    _check_ply(content)
    loaded = _through_trimesh(content, "ply", {})
    colours: dict[tuple[int, int, int], int] = {}

    def material_of(mesh: Any) -> np.ndarray:
        if getattr(mesh.visual, "kind", None) not in ("face", "vertex"):
            return np.full(len(mesh.faces), colours.setdefault((-1, -1, -1), len(colours)), np.int32)
        rgb = np.asarray(mesh.visual.face_colors)[:, :3].astype(np.int64)
        if len(np.unique(rgb, axis=0)) > _MOST_COLOURS:
            rgb = rgb // 32 * 32 + 16  # eight levels of each
        unique, index = np.unique(rgb, axis=0, return_inverse=True)
        number = [colours.setdefault((int(r), int(g), int(b)), len(colours)) for r, g, b in unique]
        return np.array(number, np.int32)[index.reshape(-1)]

    def materials() -> tuple[Material, ...]:
        return tuple(
            Material("default") if c[0] < 0 else Material(f"colour {i}", _linear(c)) for i, c in enumerate(colours)
        )

    return _scene_of(path.stem, loaded, materials, material_of)


def _linear(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    r, g, b = (float(c) for c in linear_from_srgb(np.array(colour) / 255))
    return r, g, b


def _check_ply(content: bytes) -> None:
    """Every element that the header promises fits into what follows it."""
    if content[:3].lower() != b"ply":
        raise InputError(f"bytes 0 to 3 = {content[:3]!r}: must be b'ply'; this is no PLY file.")
    end = re.search(rb"end_header[^\n]*\n", content[:_LARGEST_HEADER_BYTES])
    if end is None:
        raise InputError("is truncated: its header has no `end_header`; copy or export it again.")
    lines = [line.split() for line in content[: end.start()].decode("ascii", errors="replace").splitlines()]
    kind = next((words[1] for words in lines if len(words) > 1 and words[0] == "format"), "")
    if kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise InputError(f"header `format` = {kind[:40]!r}: must be ascii, binary_little_endian or binary_big_endian.")
    elements: list[tuple[str, int, int]] = []  # name, count, least bytes of a row
    for words in lines:
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 12:
                raise InputError(f"header `{' '.join(words)[:60]}`: must be `element NAME COUNT`.")
            elements.append((words[1], int(words[2]), 0))
        elif words[:1] == ["property"]:
            sizes = [_PLY_BYTES.get(word) for word in (words[2:4] if words[1:2] == ["list"] else words[1:2])]
            if not elements or not sizes or None in sizes or len(words) != (5 if words[1] == "list" else 3):
                raise InputError(f"header `{' '.join(words)[:60]}`: is no property of an element that PLY knows.")
            name, count, size = elements[-1]
            elements[-1] = (name, count, size + (sizes[0] or 0))  # of a list, its length is always there
    left = len(content) - end.end()
    for name, count, size in elements:
        least = count * (size if kind != "ascii" else 2)
        if least > left:
            raise InputError(
                f"header `element {name} {count}`: needs {least} bytes, {left} are left; copy or export it again."
            )
        left -= least


# --- STL ------------------------------------------------------------------------------------------------------------


def _load_stl(content: bytes, path: Path) -> Scene:
    """One material, grey 0.8. The format has no unit: metres are assumed."""
    promised = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    if len(content) != 84 + 50 * promised:
        is_text = content[:512].lstrip().lower().startswith(b"solid") and b"vertex" in content
        if not is_text:
            raise InputError(
                f"header count = {max(promised, 0)} triangles needs {84 + 50 * max(promised, 0)} bytes, the file has "
                f"{len(content)}; copy or export it again."
            )
        if content.lower().count(b"endsolid") == 0:
            raise InputError("is truncated: `endsolid` is missing; copy or export it again.")
    loaded = _through_trimesh(content, "stl", {})
    return _scene_of(path.stem, loaded, (Material("default"),), lambda mesh: np.zeros(len(mesh.faces), np.int32))


# --- trimesh --------------------------------------------------------------------------------------------------------


def _through_trimesh(content: bytes, kind: str, files: dict[str, bytes]) -> Any:
    """What trimesh reads from bytes; the only other files it can get are `files`."""
    import trimesh
    from trimesh.resolvers import Resolver

    class OnlyThese(Resolver):
        def __init__(self) -> None:
            pass

        def get(self, key: str) -> bytes:
            if key not in files:
                raise FileNotFoundError(key)
            return files[key]

        def keys(self) -> list[str]:
            return list(files)

        def write(self, name: str, data: object) -> None:
            raise PermissionError(name)

        def namespaced(self, namespace: str) -> OnlyThese:
            return self

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # NumPy only deprecates cutting a row of numbers short at the first word that is none.
            warnings.filterwarnings("error", message="string or file could not be read")
            options: dict[str, Any] = {"skip_materials": True} if kind == "ply" else {}
            return trimesh.load_scene(
                io.BytesIO(content), file_type=kind, resolver=OnlyThese(), process=False, **options
            )
    except Exception as error:  # whatever a third-party parser raises is about this file
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"trimesh cannot read it ({reason}); check the file or export it again.") from None


def _scene_of(
    name: str, loaded: Any, materials: tuple[Material, ...] | Callable[[], tuple[Material, ...]],
    material_of: Callable[[Any], np.ndarray],
) -> Scene:  # fmt: skip
    """All triangles of a trimesh scene. `materials` may be a function, called when all meshes have been seen."""
    vertices, triangles, uvs, index, n_vertices = [], [], [], [], 0
    for mesh in loaded.geometry.values():
        faces = np.asarray(getattr(mesh, "faces", ()))
        if faces.size == 0:
            continue
        corners = np.asarray(mesh.vertices, np.float64)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise InputError(f"faces have {faces.shape[1:]} corners; triangulate the mesh.")
        if faces.min() < 0 or faces.max() >= len(corners):
            raise InputError(f"face index {faces.max()} is out of range; there are {len(corners)} vertices.")
        uv = getattr(mesh.visual, "uv", None)
        uvs.append(None if uv is None or np.shape(uv) != (len(corners), 2) else np.asarray(uv) * (1, -1) + (0, 1))
        vertices.append(corners)
        triangles.append(faces.astype(np.int64) + n_vertices)
        index.append(material_of(mesh))
        n_vertices += len(corners)
    if not triangles:
        raise InputError("the scene has no triangles; export a mesh with faces.")
    all_uv = None
    if any(uv is not None for uv in uvs):
        filled = [np.zeros((len(v), 2)) if uv is None else uv for v, uv in zip(vertices, uvs, strict=True)]
        all_uv = np.concatenate(filled)
    known = materials if isinstance(materials, tuple) else materials()
    used, material_index = np.unique(np.concatenate(index), return_inverse=True)
    kept = tuple(known[m] for m in used)
    return Scene(name, np.concatenate(vertices), np.concatenate(triangles), all_uv, material_index.reshape(-1), kept)
