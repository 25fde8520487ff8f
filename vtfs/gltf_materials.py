"""Materials of glTF files."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from vtfs.gltf_document import Document, Json, number_of, numbers_of, object_of, resource, triple
from vtfs.input_error import InputError
from vtfs.scene import Material
from vtfs.scene_folder import alpha_of, decode_image, mean_linear_colour


class Materials:
    """The materials that primitives use, each once; numbered in order of first use."""

    def __init__(self, document: Document):
        self.kept: list[Material] = []
        self._document = document
        self._numbers: dict[object, int] = {}
        self._images: dict[int, Any] = {}

    def number(self, index: int | None, colour: np.ndarray | None, has_uv: bool) -> int:
        """The scene's number of a material of the file, times a mean vertex colour."""
        tint = None if colour is None else tuple(float(c) for c in np.nan_to_num(colour).clip(0, 1))
        key = (index, tint, has_uv)
        if key not in self._numbers:
            material = Material("default") if index is None else self._material(index, has_uv)
            if tint is not None:
                r, g, b = (c * t for c, t in zip(material.base_colour, tint, strict=True))
                material = replace(material, base_colour=(r, g, b))
            self._numbers[key] = len(self.kept)
            self.kept.append(material)
        return self._numbers[key]

    def _material(self, index: int, has_uv: bool) -> Material:
        """A material of the file.

        Metals keep their base colour as a diffuse one, as nothing here mirrors an environment; roughness r becomes
        the Blinn-Phong exponent `2 / r**4 - 2` (Karis 2013), within [1, 1024].
        """
        source, where = self._document.json["materials"][index], f"materials[{index}]"
        pbr = object_of(source, "pbrMetallicRoughness", where)
        factor = numbers_of(pbr, "baseColorFactor", where, 4, (1, 1, 1, 1))
        colour, opacity = np.array(factor[:3]), factor[3]
        mode = source.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise InputError(f"{where}.alphaMode = {str(mode)[:40]}: must be OPAQUE, MASK or BLEND.")
        image = self._base_image(index) if "baseColorTexture" in pbr else None
        alpha = None
        if image is not None:
            colour = colour * mean_linear_colour(image)
            if mode != "OPAQUE" and has_uv:
                alpha = alpha_of(image)
            elif mode == "BLEND":
                opacity *= float(alpha_of(image).mean())
        metallic = number_of(pbr, "metallicFactor", where, 1.0) if "metallicRoughnessTexture" not in pbr else 0.0
        roughness = number_of(pbr, "roughnessFactor", where, 1.0) if "metallicRoughnessTexture" not in pbr else 0.5
        strength = object_of(object_of(source, "extensions", where), "KHR_materials_emissive_strength", where)
        emissive = np.array(numbers_of(source, "emissiveFactor", where, 3, (0, 0, 0)))
        emissive = emissive * number_of(strength, "emissiveStrength", where, 1.0)
        if "emissiveTexture" in source:
            emissive = emissive * mean_linear_colour(self._image(object_of(source, "emissiveTexture", where), where))
        name = source.get("name", f"material {index}")
        return Material(
            name if isinstance(name, str) else f"material {index}",
            base_colour=triple(colour),
            opacity=1.0 if mode == "OPAQUE" else opacity,
            emissive=triple(emissive),
            specular=float(0.04 + metallic * (max(float(colour.mean()), 0.04) - 0.04)),
            shininess=float(np.clip(2 / max(roughness, 0.05) ** 4 - 2, 1, 1024)),
            alpha_mode="mask" if mode == "MASK" else "blend" if mode == "BLEND" else "opaque",
            alpha_image=alpha,
            alpha_cutoff=number_of(source, "alphaCutoff", where, 0.5),
            two_sided=source.get("doubleSided") is True,
        )

    def _base_image(self, index: int) -> Any:
        where = f"materials[{index}].pbrMetallicRoughness.baseColorTexture"
        return self._image(base_texture(self._document, index), where)

    def _image(self, info: Json, where: str) -> Any:
        """The decoded image of a texture reference."""
        document = self._document
        texture = document.entry("textures", info.get("index"), f"{where}.index")
        source = texture.get("source")
        webp = object_of(object_of(texture, "extensions", where), "EXT_texture_webp", where)
        source = webp.get("source", source)
        entry = document.entry("images", source, f"{where}: texture source")
        assert isinstance(source, int)  # `entry` refuses what is not
        if source not in self._images:
            field = f"images[{source}]"
            if "uri" in entry:
                content = resource(document.folder, entry["uri"], f"{field}.uri")
            else:
                buffer, start, length = document.view_range(entry.get("bufferView"), f"{field}.bufferView")
                content = document.buffers[buffer][start : start + length]
            self._images[source] = decode_image(content, field)
        return self._images[source]


def base_texture(document: Document, material: int | None) -> Json:
    """The base colour texture reference of a material, or an empty object."""
    if material is None:
        return {}
    where = f"materials[{material}]"
    pbr = object_of(document.json["materials"][material], "pbrMetallicRoughness", where)
    info = object_of(pbr, "baseColorTexture", where)
    transform = object_of(object_of(info, "extensions", where), "KHR_texture_transform", where)
    return info | ({"texCoord": transform["texCoord"]} if "texCoord" in transform else {})


def transformed_uv(uv: np.ndarray, info: Json) -> np.ndarray:
    """Texture coordinates after KHR_texture_transform: scale, then rotation, then offset."""
    transform = object_of(object_of(info, "extensions", "texture"), "KHR_texture_transform", "texture")
    if not transform:
        return uv
    scale = np.array(numbers_of(transform, "scale", "KHR_texture_transform", 2, (1, 1)))
    offset = np.array(numbers_of(transform, "offset", "KHR_texture_transform", 2, (0, 0)))
    angle = number_of(transform, "rotation", "KHR_texture_transform", 0.0)
    c, s = math.cos(angle), math.sin(angle)
    return ((uv * scale) @ np.array([[c, -s], [s, c]]) + offset).astype(np.float32)
