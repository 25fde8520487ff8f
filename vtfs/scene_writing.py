"""Writing scenes as GLB, OBJ and PLY, through trimesh's exporters.

trimesh rounds colours to 8 bits and joins materials that look alike: it gets a placeholder for each material, and the
true colours are written over them.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from vtfs.camera import CameraPath
from vtfs.files import write_atomically
from vtfs.lights import Lights
from vtfs.scene import Material, Scene
from vtfs.scene_folder import srgb_from_linear


def save_glb(scene: Scene, path: Path) -> None:
    """GLB with materials, alpha images, cameras and KHR_lights_punctual lights; coordinates in float32."""
    from trimesh.exchange.gltf import export_glb

    def finish(tree: dict[str, Any]) -> None:
        for entry in tree.get("materials", []):
            _write_material(entry, scene.materials[int(entry["name"])])
        if scene.cameras is not None:
            _write_cameras(tree, scene.cameras)
        if scene.lights is not None:
            _write_lights(tree, scene.lights)

    content = export_glb(_trimesh_scene(scene, pbr=True), include_normals=False, tree_postprocessor=finish)
    write_atomically(path, content)


def save_obj(scene: Scene, path: Path) -> None:
    """OBJ, with its MTL and alpha images beside it; ten digits a coordinate."""
    from PIL import Image
    from trimesh.exchange.obj import export_obj

    library = []
    for i, material in enumerate(scene.materials):
        lines = [
            f"newmtl m{i}",
            f"Kd {_text(material.base_colour)}",
            f"Ke {_text(material.emissive)}",
            f"Ks {_text((material.specular,) * 3)}",
            f"Ns {material.shininess!r}",
        ]
        # An alpha image means an alpha test there: what blends keeps the mean of its own.
        is_tested = material.alpha_mode == "mask" and material.alpha_image is not None
        mean = 1.0 if material.alpha_image is None or is_tested else float(material.alpha_image.mean())
        lines.append(f"d {material.opacity * mean!r}")
        if material.alpha_image is not None and is_tested:
            name = f"{path.stem}.alpha{i}.png"
            image = io.BytesIO()
            Image.fromarray(_bytes(material.alpha_image)).save(image, format="PNG")
            write_atomically(path.with_name(name), image.getvalue())
            lines.append(f"map_d {name}")
        library.append("\n".join(lines) + "\n")
    mtl = path.with_suffix(".mtl")
    meshes = _trimesh_scene(scene, pbr=False)
    text, _ = export_obj(meshes, include_normals=False, return_texture=True, digits=10, mtl_name=mtl.name, header="")
    write_atomically(mtl, "\n".join(library).encode())
    write_atomically(path, text.encode())


def save_ply(scene: Scene, path: Path) -> None:
    """Binary PLY with the base colours on its faces, 8 bits sRGB; coordinates in float32."""
    import trimesh
    from trimesh.exchange.ply import export_ply

    colours = np.array([material.base_colour for material in scene.materials])
    rgba = np.concatenate([_bytes(srgb_from_linear(colours)), np.full((len(colours), 1), 255, np.uint8)], axis=1)
    mesh = trimesh.Trimesh(scene.vertices_m, scene.triangles, process=False, face_colors=rgba[scene.material_index])
    write_atomically(path, export_ply(mesh, vertex_normal=False))


def _trimesh_scene(scene: Scene, pbr: bool) -> Any:
    """One mesh for each material that has triangles; the material's name is its number (OBJ: after an `m`)."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial, SimpleMaterial
    from trimesh.visual.texture import TextureVisuals

    result = trimesh.Scene()
    for i in np.unique(scene.material_index):
        faces = scene.triangles[scene.material_index == i]
        used, renumbered = np.unique(faces, return_inverse=True)
        uv = None if scene.uv is None else scene.uv[used].astype(np.float64) * (1, -1) + (0, 1)
        placeholder = [int(i) >> 16 & 255, int(i) >> 8 & 255, int(i) & 255, 255]
        if pbr:
            image = scene.materials[i].alpha_image
            texture = None
            if image is not None:
                white = np.full((*image.shape, 4), 255, np.uint8)
                white[..., 3] = _bytes(image)
                texture = Image.fromarray(white)
            material: Any = PBRMaterial(name=str(i), baseColorFactor=placeholder, baseColorTexture=texture)
        else:
            material = SimpleMaterial(name=f"m{i}", diffuse=placeholder)
        mesh = trimesh.Trimesh(scene.vertices_m[used], renumbered.reshape(-1, 3), process=False)
        mesh.visual = TextureVisuals(uv=uv, material=material)
        result.add_geometry(mesh, geom_name=f"mesh {i}", node_name=f"node {i}")
    return result


def _write_material(entry: dict[str, Any], material: Material) -> None:
    pbr = entry.setdefault("pbrMetallicRoughness", {})
    pbr["baseColorFactor"] = [*(min(c, 1.0) for c in material.base_colour), min(material.opacity, 1.0)]
    # Of dielectric 0.04 and a metal's base colour, what makes this reflectance; see the reader in gltf.py.
    mean = max(float(np.mean(material.base_colour)), 0.04)
    pbr["metallicFactor"] = float(np.clip((material.specular - 0.04) / (mean - 0.04), 0, 1)) if mean > 0.04 else 0.0
    pbr["roughnessFactor"] = float((2 / (material.shininess + 2)) ** 0.25)
    entry["name"] = material.name
    entry["doubleSided"] = material.two_sided
    entry["alphaMode"] = {"opaque": "OPAQUE", "mask": "MASK", "blend": "BLEND"}[material.alpha_mode]
    if material.alpha_mode == "mask":
        entry["alphaCutoff"] = material.alpha_cutoff
    strength = max(1.0, *material.emissive)
    if any(material.emissive):
        entry["emissiveFactor"] = [c / strength for c in material.emissive]
    if strength > 1:
        entry["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}


def _write_cameras(tree: dict[str, Any], path: CameraPath) -> None:
    """One lens and one node for each frame."""
    lens = {
        "yfov": np.radians(path.fov_y_deg), "znear": path.near_m,
        "aspectRatio": path.viewport.width_px / path.viewport.height_px,
    }  # fmt: skip
    if np.isfinite(path.far_m):
        lens["zfar"] = path.far_m
    tree["cameras"] = [{"type": "perspective", "perspective": lens}]
    for i in range(len(path)):
        world = np.linalg.inv(path.camera(i).view_from_world)
        _add_node(tree, {"name": f"frame {i}", "camera": 0, "matrix": world.T.ravel().tolist()})


def _write_lights(tree: dict[str, Any], lights: Lights) -> None:
    entries = []
    for i in range(lights.n_lights):
        intensity = max(float(lights.colour[i].max()), 1e-30)
        entry: dict[str, Any] = {
            "type": "spot" if lights.is_spot[i] else "point", "color": (lights.colour[i] / intensity).tolist(),
            "intensity": intensity, "range": max(float(lights.range_m[i]), 1e-9),
        }  # fmt: skip
        if lights.is_spot[i]:
            inner, outer = np.arccos(np.clip([lights.cos_inner[i], lights.cos_outer[i]], -1, 1))
            entry["spot"] = {"innerConeAngle": float(inner), "outerConeAngle": float(outer)}
        entries.append(entry)
        world = np.eye(4)
        world[:3, :3] = _frame_along(-lights.direction[i])
        world[:3, 3] = lights.position_m[i]
        _add_node(tree, {"matrix": world.T.ravel().tolist(), "extensions": {"KHR_lights_punctual": {"light": i}}})
    tree.setdefault("extensions", {})["KHR_lights_punctual"] = {"lights": entries}
    tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", []), "KHR_lights_punctual"})


def _frame_along(z: np.ndarray) -> np.ndarray:
    """A rotation whose third column is the unit vector `z`."""
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _add_node(tree: dict[str, Any], node: dict[str, Any]) -> None:
    tree["nodes"].append(node)
    tree["scenes"][tree.get("scene", 0)]["nodes"].append(len(tree["nodes"]) - 1)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


def _text(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(value)) for value in values)
