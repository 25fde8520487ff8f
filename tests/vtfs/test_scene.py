"""Scenes: what a file holds is what is read, against files written byte by byte and round trips of built-in scenes."""

import base64
import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from vtfs.camera import Viewport
from vtfs.gallery import GALLERY, build_scene
from vtfs.input_error import InputError
from vtfs.lights import Lights, cone_cosines
from vtfs.scene import Material, Scene, load_scene, save_scene
from vtfs.view_samples import trace_view_samples

SHARED = Path(__file__).parents[2].parent / "shared" / "scenes"
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], "<f4")


def glb(tree: dict, body: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(body), len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", len(body), 0x004E4942) + body


def triangle(**changes) -> tuple[dict, bytes]:
    """One triangle with indices and texture coordinates."""
    uv = np.array([(0, 0), (1, 0), (0, 1)], "<f4")
    body = CORNERS.tobytes() + uv.tobytes() + np.array([0, 1, 2], "<u2").tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"name": "only"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": 6},
        ],
        "buffers": [{"byteLength": 66}],
    }
    return tree | changes, body


def loaded(tmp_path, tree, body=None) -> Scene:
    (tmp_path / "t.glb").write_bytes(glb(tree, triangle()[1] if body is None else body))
    return load_scene(tmp_path / "t.glb")


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(stream, format="PNG")
    return stream.getvalue()


def test_nodes_place_meshes_parents_first_with_every_kind_of_transform(tmp_path):
    turn = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # a quarter turn about z
    nodes = [
        {"translation": [10, 0, 0], "rotation": turn, "scale": [2, 3, 4], "children": [1, 2]},
        {"mesh": 0},
        {"camera": 0, "children": [3]},  # what hangs below a camera counts too
        {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1], "mesh": 0},
    ]
    cameras = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1, "aspectRatio": 2}}]
    scene = loaded(tmp_path, triangle(nodes=nodes, cameras=cameras)[0])
    assert scene.n_triangles == 2
    assert_allclose(scene.vertices_m[:3], [(10, 0, 0), (10, 2, 0), (7, 0, 0)], atol=1e-12)
    assert_allclose(scene.vertices_m[3:], [(10, 0, 20), (10, -2, 20), (7, 0, 20)], atol=1e-12)
    # The mirrored copy is wound the other way, so that its normal is mirrored with it.
    a, b, c = scene.vertices_m[scene.triangles[1]]
    assert np.cross(b - a, c - a)[2] > 0
    assert scene.cameras is not None and scene.cameras.viewport == Viewport(1440, 720)
    assert scene.cameras.far_m == np.inf


def test_materials_are_read_in_full(tmp_path):
    alpha = np.zeros((4, 2, 4))
    alpha[:2, :, 3] = 255
    alpha[..., :3] = 188  # sRGB; linear 0.503
    picture = "data:image/png;base64," + base64.b64encode(png(alpha)).decode()
    material = {
        "name": "leaf",
        "pbrMetallicRoughness": {"baseColorFactor": [0.5, 1, 0.0045, 0.75], "baseColorTexture": {"index": 0}},
        "alphaMode": "MASK",
        "alphaCutoff": 0.25,
        "emissiveFactor": [0.5, 0, 0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
        "doubleSided": True,
    }
    tree, _ = triangle(materials=[material], textures=[{"source": 0}], images=[{"uri": picture}])
    scene = loaded(tmp_path, tree)
    (read,) = scene.materials
    assert read.alpha_image is not None and scene.uv is not None
    assert_allclose(read.base_colour, np.array([0.5, 1, 0.0045]) * 0.5029, rtol=1e-3)
    assert_allclose(read.alpha_image, [[1, 1], [1, 1], [0, 0], [0, 0]])
    assert (read.opacity, read.alpha_cutoff, read.two_sided, read.emissive) == (0.75, 0.25, True, (2, 0, 0))
    assert_allclose(scene.uv, [(0, 0), (1, 0), (0, 1)])


def test_blend_materials_keep_the_image_of_their_alpha_and_opaque_ones_none(tmp_path):
    picture = "data:image/png;base64," + base64.b64encode(png(np.full((2, 2, 4), 128))).decode()
    pbr = {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": {"index": 0}}
    for mode, opacity, image in (("BLEND", 0.5, np.full((2, 2), 128 / 255, np.float32)), ("OPAQUE", 1.0, None)):
        material = {"pbrMetallicRoughness": pbr, "alphaMode": mode}
        tree, _ = triangle(materials=[material], textures=[{"source": 0}], images=[{"uri": picture}])
        (read,) = loaded(tmp_path, tree).materials
        assert np.array_equal(read.alpha_image, image) and read.opacity == pytest.approx(opacity)
        assert read.alpha_mode == mode.lower()


def test_a_texture_transform_moves_the_coordinates(tmp_path):
    picture = "data:image/png;base64," + base64.b64encode(png(np.full((2, 2, 4), 128))).decode()
    moved = {"index": 0, "extensions": {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [2, 3]}}}
    tree, _ = triangle(
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": moved}, "alphaMode": "MASK"}],
        textures=[{"source": 0}],
        images=[{"uri": picture}],
    )
    assert_allclose(np.asarray(loaded(tmp_path, tree).uv), [(0.5, 0), (2.5, 0), (0.5, 3)])


def test_vertex_colours_tint_by_their_mean(tmp_path):
    tree, body = triangle()
    tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 3
    tree["accessors"].append({"bufferView": 3, "componentType": 5121, "normalized": True, "count": 3, "type": "VEC4"})
    tree["bufferViews"].append({"buffer": 0, "byteOffset": 68, "byteLength": 12})
    tree["buffers"][0]["byteLength"] = 80
    colours = bytes([255, 0, 0, 255, 255, 255, 0, 255, 255, 0, 0, 255])
    (material,) = loaded(tmp_path, tree, body + b"\0\0" + colours).materials
    assert_allclose(material.base_colour, (1, 1 / 3, 0), atol=1e-6)


def test_strips_and_interleaved_buffers(tmp_path):
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], "<f4")
    body = np.column_stack([corners, np.full((4, 1), 7, "<f4")]).tobytes()
    tree, _ = triangle(materials=[])
    tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]}]
    tree["accessors"] = [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}]
    tree["bufferViews"] = [{"buffer": 0, "byteLength": 64, "byteStride": 16}]
    tree["buffers"] = [{"byteLength": 64}]
    scene = loaded(tmp_path, tree, body)
    assert scene.n_triangles == 2
    assert_allclose(scene.bounds_m, [(0, 0, 0), (1, 1, 0)])


def test_point_and_spot_lights_are_placed_and_get_a_range(tmp_path, caplog):
    lights = [
        {"type": "point", "color": [1, 0.5, 0], "intensity": 8, "range": 3},
        {"type": "spot", "intensity": 0.01, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.2}},
        {"type": "directional", "color": [1, 0.5, 2], "intensity": 0.5},
        {"type": "point", "intensity": 1e9},
    ]
    nodes = [{"mesh": 0}] + [
        {"translation": [i, 2, 3], "extensions": {"KHR_lights_punctual": {"light": i}}} for i in range(4)
    ]
    tree, _ = triangle(
        nodes=nodes, scenes=[{"nodes": [0, 1, 2, 3, 4]}], extensions={"KHR_lights_punctual": {"lights": lights}}
    )
    scene = loaded(tmp_path, tree)
    assert scene.lights is not None and scene.lights.n_lights == 3
    assert_allclose(scene.lights.position_m, [(0, 2, 3), (1, 2, 3), (3, 2, 3)])
    assert_allclose(scene.lights.colour[0], (8, 4, 0))
    assert_allclose(scene.lights.direction[1], (0, 0, -1))
    assert_allclose(scene.lights.cos_outer, (-2, np.cos(0.2), -2))
    assert_allclose(scene.lights.range_m, (3, 1, scene.diagonal_m))
    assert "has no range" in caplog.text and "directional" in caplog.text
    assert_allclose(scene.suns.toward, [(0, 0, 1)])  # it shines along -z of its node
    assert_allclose(scene.suns.colour, [(0.5, 0.25, 1)])


def test_external_buffers_and_images_inside_the_folder_are_read(tmp_path):
    tree, body = triangle(textures=[{"source": 0}], images=[{"uri": "textures/a%20leaf.png"}])
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["buffers"][0]["uri"] = "t.bin"
    (tmp_path / "textures").mkdir()
    (tmp_path / "textures" / "a leaf.png").write_bytes(png(np.full((1, 1, 4), 255)))
    (tmp_path / "t.bin").write_bytes(body)
    (tmp_path / "t.gltf").write_text(json.dumps(tree))
    assert load_scene(tmp_path / "t.gltf").n_triangles == 1


@pytest.mark.parametrize("name", GALLERY)
@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply"])
def test_built_in_scenes_survive_their_files(tmp_path, monkeypatch, name, suffix):
    monkeypatch.setenv("VTFS_CACHE_DIR", str(tmp_path / "cache"))
    scene = build_scene(name, 3_000)
    save_scene(scene, tmp_path / f"scene{suffix}")
    again = load_scene(tmp_path / f"scene{suffix}")
    assert again.n_triangles == scene.n_triangles
    assert_allclose(again.bounds_m, scene.bounds_m, atol=1e-5)  # float32 coordinates of tens of metres
    if suffix == ".ply":
        scene = replace(
            scene, materials=tuple(replace(m, alpha_mode="opaque", alpha_image=None) for m in scene.materials)
        )
    camera = scene.cameras.resized(Viewport(96, 54)).camera(5) if scene.cameras else None
    assert camera is not None
    expected, found = trace_view_samples(scene, camera), trace_view_samples(again, camera)
    near = np.abs(found.position_m - expected.position_m).max(axis=-1) < 1e-3
    assert near.mean() > 0.995  # silhouettes and alpha edges move by float32 rounding and 8 bits of alpha
    assert np.abs(found.base_colour - expected.base_colour)[near].max() < 0.01  # PLY: 8 bits


def test_a_glb_keeps_materials_cameras_and_lights(tmp_path):
    cos_inner, cos_outer = cone_cosines(20, 50)
    lights = Lights(
        np.array([(1.0, 2, 3), (4, 5, 6)]),
        np.array([7.0, 8]),
        np.array([(30.0, 20, 10), (0.1, 0.2, 0.3)]),
        np.array([(0.0, 0, -1), (0.6, 0, 0.8)]),
        np.array([-1, cos_inner]),
        np.array([-2, cos_outer]),
    )
    scene = build_scene("grove", 2_000)
    shiny = replace(
        scene.materials[1], emissive=(3.0, 0.5, 0.0), specular=0.1, shininess=200.0, base_colour=(0.5, 0.4, 0.3)
    )
    glass = replace(scene.materials[2], alpha_mode="blend", opacity=0.25)
    scene = replace(scene, lights=lights, materials=(scene.materials[0], shiny, glass, *scene.materials[3:]))
    save_scene(scene, tmp_path / "s.glb")
    again = load_scene(tmp_path / "s.glb")
    for before, after in zip(scene.materials, again.materials, strict=True):
        for field in ("base_colour", "opacity", "emissive", "specular", "shininess", "alpha_cutoff"):
            assert_allclose(getattr(after, field), getattr(before, field), rtol=1e-6, err_msg=f"{before.name} {field}")
        assert (after.name, after.alpha_mode, after.two_sided) == (before.name, before.alpha_mode, before.two_sided)
        if before.alpha_image is not None:
            assert after.alpha_image is not None
            assert_allclose(after.alpha_image, before.alpha_image, atol=0.5 / 255)
    assert scene.cameras is not None and again.cameras is not None and again.lights is not None
    assert len(again.cameras) == 60 and again.cameras.viewport == scene.cameras.viewport
    for i in (0, 31):
        assert_allclose(again.cameras.camera(i).view_from_world, scene.cameras.camera(i).view_from_world, atol=1e-9)
    for field in ("position_m", "range_m", "colour", "direction", "cos_inner", "cos_outer"):
        assert_allclose(getattr(again.lights, field), getattr(lights, field), atol=1e-9, err_msg=field)


OBJ = """mtllib a.mtl b.mtl
v 0 0 0
v 1 0 0
v 0 1 0
vt 0 0
vt 1 0
vt 0 1
usemtl red one
f 1/1 2/2 3/3
usemtl glass
v 0 0 1
f -1/-1 -2/-2 -3/-3
v 9 9 9
usemtl nowhere
f 1 2 3 4
"""


def test_obj_materials_and_indices(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl red one\nKd 0.9 0.1 0.0045\nKe 0 2 0\nKs 0.3 0.3 0.3\nNs 77\n")
    (tmp_path / "b.mtl").write_text("newmtl glass\nKd 1 1 1\nTr 0.75\n")
    (tmp_path / "m.obj").write_text(OBJ)
    scene = load_scene(tmp_path / "m.obj")
    by_name = {material.name: material for material in scene.materials}
    assert set(by_name) == {"red one", "glass", "nowhere"}
    red, glass = by_name["red one"], by_name["glass"]
    assert (red.base_colour, red.emissive, red.shininess) == ((0.9, 0.1, 0.0045), (0, 2, 0), 77)
    assert red.specular == pytest.approx(0.3)
    assert (glass.opacity, glass.alpha_mode) == (0.25, "blend")
    of_glass = scene.triangles[np.array([m.name for m in scene.materials])[scene.material_index] == "glass"]
    # -1 is the last vertex before that line, not the last of the file.
    assert_allclose(np.sort(scene.vertices_m[of_glass[0]], axis=0), [(0, 0, 0), (0, 0, 0), (1, 1, 1)])
    assert scene.n_triangles == 4


def test_stl_in_text_and_in_binary(tmp_path):
    text = "solid s\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    text += "endloop\nendfacet\nendsolid s\n"
    (tmp_path / "t.stl").write_text(text)
    row = np.zeros(12, "<f4")
    row[3:] = CORNERS.ravel()
    (tmp_path / "b.stl").write_bytes(b"solid".ljust(80) + struct.pack("<I", 1) + row.tobytes() + b"\0\0")
    for name in ("t.stl", "b.stl"):
        scene = load_scene(tmp_path / name)
        assert_allclose(scene.vertices_m[scene.triangles[0]], CORNERS)


def test_ply_in_text_with_colours(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 1\n"
    header += "property list uchar int vertex_indices\n"
    (tmp_path / "t.ply").write_text(
        header + "end_header\n0 0 0 255 0 0\n1 0 0 255 0 0\n1 1 0 255 0 0\n0 1 0 255 0 0\n4 0 1 2 3\n"
    )
    scene = load_scene(tmp_path / "t.ply")
    assert scene.n_triangles == 2
    assert_allclose(scene.materials[scene.material_index[0]].base_colour, (1, 0, 0))


def test_the_key_is_of_content_not_of_names():
    scene = build_scene("atrium", 1_000)
    assert replace(scene, name="other").key == scene.key
    assert replace(scene, vertices_m=scene.vertices_m + 1e-9).key != scene.key
    changed = (replace(scene.materials[0], opacity=0.5), *scene.materials[1:])
    assert replace(scene, materials=changed).key != scene.key


def test_bounds_are_of_triangles_not_of_stray_vertices():
    vertices = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (99, 99, 99)])
    scene = Scene("s", vertices, np.array([(0, 1, 2)]), None, np.zeros(1), (Material("m"),))
    assert_allclose(scene.bounds_m, [(0, 0, 0), (1, 1, 0)])


def test_unknown_suffixes_are_refused_when_writing(tmp_path):
    with pytest.raises(InputError, match=r"cannot write `\.stl`"):
        save_scene(build_scene("atrium", 1_000), tmp_path / "a.stl")


@pytest.mark.shared
@pytest.mark.parametrize("scene_file", sorted(SHARED.glob("*.glb")), ids=lambda p: p.stem)
def test_real_scenes_have_the_triangles_that_are_listed(scene_file):
    rows = [line.split(",") for line in (SHARED / "scenes.csv").read_text().splitlines()]
    listed = {row[0].removesuffix(".glb"): row for row in rows}[scene_file.stem]
    scene = load_scene(scene_file)
    assert str(scene.n_triangles) in listed
