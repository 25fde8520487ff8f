"""Scene files that are wrong: one line that says what and where, and never anything but `InputError`."""

import json
import struct
import warnings

import numpy as np
import pytest

from tests.vtfs.test_scene import OBJ, glb, png, triangle
from vtfs.gallery import build_scene
from vtfs.input_error import InputError
from vtfs.scene import Scene, load_scene, save_scene

HEAD = "ply\nformat ascii 1.0\n"


def refused(path, message):
    with pytest.raises(InputError, match=message) as caught:
        load_scene(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and "\n" not in text and len(text) < 500


def test_a_missing_file_and_an_unknown_kind(tmp_path):
    refused(tmp_path / "none.glb", "no such file")
    (tmp_path / "a.blend").write_text("")
    refused(tmp_path / "a.blend", r"unknown kind of scene file `\.blend`; use one of \.glb")


@pytest.mark.parametrize(
    ("cut", "message"),
    [
        (lambda b: b[:10], "is truncated: 10 bytes"),
        (lambda b: b[:-8], "is truncated: header `length`"),
        (lambda b: b"what" + b[4:], "must be b'glTF'"),
        (lambda b: b[:4] + struct.pack("<I", 1) + b[8:], "`version` = 1"),
        (lambda b: b[:12] + struct.pack("<I", 2**32 - 1) + b[16:], "chunk at byte 12: 4294967295 bytes reach past"),
        (lambda b: b[:16] + b"XXXX" + b[20:], "the first must be JSON"),
        (lambda b: b[:20] + b"[" + b[21:], "its JSON cannot be read"),
        (lambda b: b"", "must be b'glTF'"),
    ],
)
def test_a_glb_whose_lengths_lie(tmp_path, cut, message):
    (tmp_path / "t.glb").write_bytes(cut(glb(*triangle())))
    refused(tmp_path / "t.glb", message)


def changed(path, value):
    """The triangle's JSON with one value set, or deleted where it is None."""
    tree, _ = triangle()
    *parents, last = path
    at = tree
    for key in parents:
        at = at[key]
    if value is None:
        del at[last]
    else:
        at[last] = value
    return tree


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("accessors", 0, "count"), 4, r"accessors\[0\]: 4 elements end at byte 48, past bufferViews\[0\] of 36"),
        (("accessors", 0, "count"), 10**15, r"accessors\[0\]: 1000000000000000 elements"),
        (("accessors", 0, "count"), -1, r"accessors\[0\].count = -1"),
        (("accessors", 0, "count"), 0, r"accessors\[0\].count = 0"),
        (("accessors", 0, "byteOffset"), 4, r"accessors\[0\]: 3 elements end at byte 40"),
        (("accessors", 0, "componentType"), 5123, r"POSITION: is VEC3 of componentType 5123"),
        (("accessors", 0, "componentType"), 1, r"accessors\[0\].componentType = 1"),
        (("accessors", 0, "type"), "VEC9", r"accessors\[0\].type = VEC9"),
        (("accessors", 0, "bufferView"), 9, r"accessors\[0\].bufferView = 9: must be the number of one of 3"),
        (("accessors", 0, "bufferView"), None, r"accessors\[0\]: is sparse or has no bufferView"),
        (("accessors", 1, "count"), 2, "TEXCOORD_0: 2 for 3 vertices"),
        (("accessors", 2, "count"), 2, "2 corners are no whole number of triangles"),
        (("bufferViews", 0, "byteLength"), 100, r"bufferViews\[0\]: bytes 0 to 100 lie past buffers\[0\] of 66"),
        (("bufferViews", 0, "byteStride"), 4, r"bufferViews\[0\].byteStride = 4"),
        (("bufferViews", 0, "buffer"), 3, r"bufferViews\[0\].buffer = 3"),
        (("buffers", 0, "byteLength"), 10**12, r"buffers\[0\].byteLength = 1000000000000: only"),
        (("meshes", 0, "primitives", 0, "attributes", "POSITION"), "x", "POSITION = x: must be the number"),
        (("meshes", 0, "primitives", 0, "attributes", "POSITION"), None, "has no POSITION"),
        (("meshes", 0, "primitives", 0, "material"), 5, "material = 5"),
        (("meshes", 0, "primitives"), {}, "primitives: must be a list"),
        (("nodes", 0, "mesh"), 1, "a node's mesh = 1"),
        (("nodes", 0, "children"), [0], r"nodes\[0\]: is reached twice"),
        (("nodes", 0, "children"), [5], r"nodes\[0\].children: 5"),
        (("nodes", 0, "matrix"), [1], r"nodes\[0\].matrix: must be a list of 16"),
        (("nodes", 0, "rotation"), [0, 0, 0, 0], r"nodes\[0\].rotation"),
        (("nodes", 0, "scale"), [1e30, 1e30, 1e30], "beyond 1e15"),
        (("nodes",), [], r"children: 0|nodes: 0 is not"),
        (("scenes", 0, "nodes"), [], "has no triangles"),
        (("meshes", 0, "primitives", 0, "mode"), 1, "has no triangles"),
        (("materials", 0, "alphaMode"), "SHEER", r"materials\[0\].alphaMode = SHEER"),
        (("materials", 0, "pbrMetallicRoughness"), {"baseColorFactor": [1, 1]}, "baseColorFactor: must be a list of 4"),
        (("materials", 0, "pbrMetallicRoughness"), {"baseColorFactor": [1, 1, -1, 1]}, "material `only` `base_colour`"),
        (("materials", 0, "pbrMetallicRoughness"), {"baseColorTexture": {"index": 0}}, "one of 0 textures"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "`KHR_draco_mesh_compression` is not supported"),
        (
            ("buffers", 0, "uri"),
            "../outside.bin",
            r"buffers\[0\].uri = '../outside.bin': leads out of the scene's folder",
        ),
        (("buffers", 0, "uri"), "/etc/passwd", "leads out"),
        (("buffers", 0, "uri"), "http://example.org/a.bin", "leads out"),
        (("buffers", 0, "uri"), "file:///etc/passwd", "leads out"),
        (("buffers", 0, "uri"), "a/%2e%2e/%2e%2e/b.bin", "leads out"),
        (("buffers", 0, "uri"), "..\\b.bin", "leads out"),
        (("buffers", 0, "uri"), "link.bin", "leads out"),
        (("buffers", 0, "uri"), "none.bin", "no such file in the scene's folder"),
        (("buffers", 0, "uri"), "x" * 5000, "buffers"),
        (("buffers", 0, "uri"), "data:application/octet-stream;base64,@@", "base64 data is damaged"),
    ],
)
def test_a_gltf_field_that_is_wrong_is_named(tmp_path, path, value, message):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "outside.bin").write_bytes(triangle()[1])
    (folder / "link.bin").symlink_to(tmp_path / "outside.bin")
    (folder / "t.glb").write_bytes(glb(changed(path, value), triangle()[1]))
    refused(folder / "t.glb", message)


def test_vertices_and_indices_that_are_wrong_are_counted(tmp_path):
    tree, body = triangle()
    nan = np.frombuffer(body[:36], "<f4").copy()
    nan[[0, 4]] = np.nan, np.inf
    (tmp_path / "t.glb").write_bytes(glb(tree, nan.tobytes() + body[36:]))
    refused(tmp_path / "t.glb", r"accessors\[0\]: 2 of 3 vertices are NaN or infinite")
    (tmp_path / "t.glb").write_bytes(glb(tree, body[:60] + np.array([0, 1, 3], "<u2").tobytes()))
    refused(tmp_path / "t.glb", r"accessors\[2\]: index 3 is out of range; there are 3 vertices")


def test_a_small_file_cannot_name_more_triangles_than_fit(tmp_path):
    tree, body = triangle()
    tree["nodes"] = [{"mesh": 0}] * 8_000
    tree["scenes"] = [{"nodes": list(range(8_000))}]
    tree["meshes"][0]["primitives"] *= 8_000
    (tmp_path / "t.glb").write_bytes(glb(tree, body))
    refused(tmp_path / "t.glb", "64000000 triangles in 64000000 parts")


def test_images_are_measured_before_they_are_decoded(tmp_path):
    bomb = bytearray(png(np.zeros((1, 1, 4))))
    bomb[16:24] = struct.pack(">II", 60_000, 60_000)
    (tmp_path / "bomb.png").write_bytes(bomb)
    (tmp_path / "text.png").write_text("no image")
    for name, message in (
        ("bomb.png", r"images\[0\]: "),
        ("text.png", r"images\[0\]: is not a PNG"),
        ("../x.png", "leads out"),
    ):
        tree, body = triangle(textures=[{"source": 0}], images=[{"uri": name}])
        tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        (tmp_path / "t.glb").write_bytes(glb(tree, body))
        refused(tmp_path / "t.glb", message)


@pytest.mark.parametrize(
    ("kind", "content", "message"),
    [
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "trimesh cannot read it"),
        ("obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 of 3 vertices are NaN"),
        ("obj", "v 0 zero 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "trimesh cannot read it"),
        ("obj", "", "no triangles|trimesh cannot"),
        ("obj", "mtllib ../out.mtl\nv 0 0 0\n", r"mtllib = '../out.mtl': leads out"),
        ("obj", "mtllib /etc/passwd\nv 0 0 0\n", "leads out"),
        ("obj", "mtllib image.mtl\nv 0 0 0\n", "map_Kd = '../x.png': leads out"),
        ("obj", "mtllib bad.mtl\nv 0 0 0\n", "`kd` = '1 x 1': must be numbers"),
        ("ply", "no", "must be b'ply'"),
        ("ply", "ply\nformat ascii 1.0\n", "has no `end_header`"),
        ("ply", "ply\nformat odd 1.0\nend_header\n", "`format` = 'odd'"),
        ("ply", HEAD + "element vertex 999999999\nproperty float x\nend_header\n0\n", "element vertex 999999999"),
        ("ply", HEAD + "element vertex many\nend_header\n", "must be `element NAME COUNT`"),
        ("ply", HEAD + "element vertex 1\nproperty quad x\nend_header\n0\n", "property quad x"),
        ("ply", HEAD + "element vertex 0\nproperty float x\nend_header\n", "no triangles|trimesh cannot"),
        ("stl", "solid s\nfacet\nvertex 0 0 0\n", "`endsolid` is missing"),
        ("stl", "solid s\nendsolid s\n", "header count|no triangles"),
        ("stl", "x" * 80 + "\xff\xff\xff\x7f" + "y" * 50, "header count = 2147483647 triangles needs"),
        ("stl", "", "header count = 0"),
    ],
)  # fmt: skip
def test_other_files_that_are_wrong(tmp_path, kind, content, message):
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "image.mtl").write_text("newmtl a\nmap_Kd ../x.png\n")
    (folder / "bad.mtl").write_text("newmtl a\nKd 1 x 1\n")
    (folder / f"s.{kind}").write_bytes(content.encode("latin-1"))
    refused(folder / f"s.{kind}", message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"triangles": np.zeros((0, 3))}, "has no triangles"),
        ({"triangles": np.array([(0, 1, 9)])}, "index 9 is out of range"),
        ({"triangles": np.array([(0, 1, -1)])}, "index -1 is out of range"),
        ({"vertices_m": np.full((3, 3), np.nan)}, "3 of 3 vertices"),
        ({"vertices_m": np.eye(3) * 1e20}, "beyond 1e15"),
        ({"material_index": np.array([4])}, "material index"),
        ({"uv": np.full((3, 2), np.inf)}, "texture coordinates must be finite"),
    ],
)
def test_a_scene_checks_itself(change, message):
    good = {
        "name": "s",
        "vertices_m": np.eye(3),
        "triangles": np.array([(0, 1, 2)]),
        "uv": None,
        "material_index": np.zeros(1),
        "materials": build_scene("atrium", 1_000).materials[:1],
    }
    with pytest.raises(InputError, match=message):
        Scene(**(good | change))


def outcome(path):
    """A damaged file is read or refused; whatever else it raises fails the test."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a damaged picture may make Pillow warn
            return load_scene(path)
    except InputError as error:
        assert "\n" not in str(error)
        return None


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".obj", ".stl", ".gltf"])
@pytest.mark.parametrize("seed", range(2))
def test_damaged_files_are_read_or_refused(tmp_path, suffix, seed):
    rng = np.random.default_rng(seed)
    path = tmp_path / f"bad{suffix}"
    good = damaged_source(tmp_path, suffix)
    for _ in range(120):
        bad = bytearray(good)
        for _ in range(int(rng.integers(1, 4))):
            # Headers are short and decide most: they get half of the damage.
            at = rng.integers(len(bad)) if rng.random() < 0.5 else rng.integers(min(len(bad), 400))
            if rng.random() < 0.5:
                bad[at] ^= 1 << rng.integers(8)
            else:
                bad[at] = rng.choice(np.frombuffer(b'0129-.e/{}[],": \n\xff\0', np.uint8))
        path.write_bytes(bad[: rng.integers(len(bad))] if rng.random() < 0.3 else bad)
        outcome(path)


def damaged_source(tmp_path, suffix):
    tree, body = triangle()
    if suffix == ".glb":
        return glb(tree, body)
    if suffix == ".gltf":
        tree["buffers"][0]["uri"] = "t.bin"
        (tmp_path / "t.bin").write_bytes(body)
        return json.dumps(tree).encode()
    if suffix == ".ply":
        save_scene(build_scene("atrium", 1_000), tmp_path / "s.ply")
        return (tmp_path / "s.ply").read_bytes()
    if suffix == ".stl":
        row = np.arange(24, dtype="<f4").reshape(2, 12)
        return b"solid".ljust(80) + struct.pack("<I", 2) + b"".join(r.tobytes() + b"\0\0" for r in row)
    (tmp_path / "a.mtl").write_text("newmtl red one\nKd 0.9 0.1 0\n")
    return OBJ.encode()
