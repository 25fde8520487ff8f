"""Pictures: tone mapping, heat maps, PNG files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from vtfs.files import write_atomically

# Viridis at five places (Smith, van der Walt and Firing 2015): dark is few, bright is many, also in grey.
_HEAT = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


def exposure(image: np.ndarray, valid: np.ndarray) -> float:
    """What brings the 95th percentile of an image's luminance to 1."""
    bright = float(np.percentile(image[valid] @ LUMINANCE, 95)) if valid.any() else 0.0
    return 1 / bright if bright > 0 else 1.0


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB (ITU-R BT.709)


def tone_map(image: np.ndarray, scale: float) -> np.ndarray:
    """Linear HDR `[h, w, 3]` to sRGB bytes: extended Reinhard on luminance, white at four times the
    exposed level (Reinhard et al. 2002, Eq. 4)."""
    exposed = np.nan_to_num(image.astype(np.float64), posinf=1e30).clip(0, 1e30) * scale
    luminance = exposed @ LUMINANCE
    mapped = luminance * (1 + luminance / 16) / (1 + luminance)
    linear = np.clip(exposed * (mapped / np.maximum(luminance, 1e-12))[..., None], 0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(srgb * 255).astype(np.uint8)


def heat_map(counts: np.ndarray, largest: int, valid: np.ndarray) -> np.ndarray:
    """Counts `[h, w]` as sRGB bytes, 0 dark to `largest` bright; invalid pixels black."""
    place = np.clip(np.where(valid, counts, 0) / max(largest, 1), 0, 1) * (len(_HEAT) - 1)
    low = np.minimum(place.astype(int), len(_HEAT) - 2)
    share = (place - low)[..., None]
    colour = _HEAT[low] * (1 - share) + _HEAT[low + 1] * share
    return np.round(np.where(valid[..., None], colour, 0)).astype(np.uint8)


def random_colours(labels: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """One colour a label `[h, w]`, neighbours told apart; the same label has the same colour in every picture."""
    # Multiplicative hashing (Knuth 1998, Sec. 6.4): the golden ratio of 2^32 spreads consecutive labels.
    hashed = labels.astype(np.uint32) * np.uint32(2654435761)
    channels = [(hashed >> np.uint32(shift)) & np.uint32(255) for shift in (24, 16, 8)]
    colour = 64 + np.stack(channels, axis=-1) * 0.75  # none is so dark that it looks like nothing
    return np.where(valid[..., None], colour, 0).astype(np.uint8)


def write_png(path: Path | str, pixels: np.ndarray) -> None:
    """Bytes `[h, w, 3]` as a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    write_atomically(path, buffer.getvalue())
