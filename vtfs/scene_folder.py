"""Files and images that a scene names: read only from inside its folder, and measured before they are decoded."""

from __future__ import annotations

import io
import logging
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vtfs.input_error import InputError

if TYPE_CHECKING:
    from PIL.Image import Image

log = logging.getLogger("vtfs.scene")

_LARGEST_IMAGE_PX = 2**26
_LARGEST_FILE_BYTES = 2**32


def path_inside(folder: Path, name: str, field: str) -> Path:
    """Where a file is that a scene names relative to its folder; it need not be there.

    **Raises:** `InputError` where the name leads out of the folder (absolute, `..`, a link, another scheme). `field`
    says where the name stood.
    """
    out = f"{field} = {name[:80]!r}: leads out of the scene's folder; put the file beside the scene."
    # Windows paths too: what is refused must not depend on where we run.
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", name) or name.startswith(("/", "\\")) or "\0" in name:
        raise InputError(out)
    path = folder / name.replace("\\", "/")
    try:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(out)
        path.is_file()
    except (OSError, RuntimeError):  # a name that is too long, a loop of links
        raise InputError(f"{field} = {name[:80]!r}: is no file name that can be read; rename it.") from None
    return path


def read_inside(folder: Path, name: str, field: str) -> bytes:
    """The bytes of a file that a scene names. **Raises:** as `path_inside`, and where there is no such file."""
    path = path_inside(folder, name, field)
    if not path.is_file():
        raise InputError(f"{field} = {name[:80]!r}: no such file in the scene's folder; put it there.")
    try:
        if path.stat().st_size > _LARGEST_FILE_BYTES:
            raise InputError(f"{field} = {name[:80]!r}: is larger than {_LARGEST_FILE_BYTES} bytes; split the scene.")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{field} = {name[:80]!r}: cannot be read ({error.strerror}); check the file.") from None


def decode_image(content: bytes, field: str) -> Image:
    """A PNG, JPEG or WebP image as RGBA.

    **Raises:** `InputError` where it is no such image, damaged, or larger than 64 megapixels.
    """
    import PIL.Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of large images; the limit below is ours
            image = PIL.Image.open(io.BytesIO(content), formats=("PNG", "JPEG", "WEBP"))  # reads the header only
            if image.width * image.height > _LARGEST_IMAGE_PX:
                raise InputError(
                    f"{field}: has {image.width} x {image.height} pixels; at most {_LARGEST_IMAGE_PX}: scale it."
                )
            return image.convert("RGBA")
    except InputError:
        raise
    except Exception as error:  # Pillow's decoders raise many kinds for damaged data
        reason = " ".join(str(error).split())[:80]
        raise InputError(
            f"{field}: is not a PNG, JPEG or WebP image that can be read ({reason}); export it again."
        ) from None


def mean_linear_colour(image: Image) -> np.ndarray:
    """Mean colour of an sRGB image in linear values, float64 `[3]`; alpha is not a weight."""
    histogram = np.array(image.histogram(), np.float64).reshape(4, 256)[:3]
    return histogram @ linear_from_srgb(np.arange(256) / 255) / (image.width * image.height)


def alpha_of(image: Image) -> np.ndarray:
    """The alpha channel, float32 `[h, w]` in [0, 1]."""
    return np.asarray(image.getchannel("A"), np.float32) / 255


def linear_from_srgb(value: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, for values in [0, 1]."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(value: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1; values are clipped to [0, 1]."""
    value = np.clip(value, 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)
