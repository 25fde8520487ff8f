"""Text of files that strangers wrote: bounded before it is held, UTF-8, plain or gzip."""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path
from typing import Any

from vtfs.input_error import InputError

LARGEST_BYTES = 128 * 2**20
"""Of a file, unpacked. A capture of five hours at 60 frames a second is as large."""


def read_text(path: Path | str) -> str:
    """The text of a file, without its byte order mark. A gzip file is unpacked, and never past the limit.

    **Raises:** `InputError` for what cannot be read, is empty, too large or not UTF-8.
    """
    path = Path(path)
    content = _read(path)
    if len(content) > LARGEST_BYTES:
        raise InputError(f"{path}: holds more than {LARGEST_BYTES // 2**20} MiB of text; split it, or leave rows out.")
    if content.startswith(b"PK\x03\x04"):
        raise InputError(f"{path}: is a zip archive (or an Excel workbook); unpack it, or save it as CSV.")
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: is UTF-16; save it as UTF-8 (in PowerShell: Out-File -Encoding utf8).")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: is not UTF-8 (byte {error.start} is 0x{content[error.start]:02x}); save it as UTF-8."
        ) from error
    if "\0" in text:
        raise InputError(f"{path}: holds a NUL character, so it is no text file; export it as CSV or JSON.")
    if not text.strip():
        raise InputError(f"{path}: is empty; it must hold a header and at least one row.")
    return text


def read_json(path: Path | str) -> dict[str, Any]:
    """The object that a JSON file holds.

    **Raises:** `InputError` as `read_text`, and for what is not a whole JSON object.
    """
    return json_object(read_text(path), str(path))


def json_object(text: str, where: str) -> dict[str, Any]:
    """**Raises:** `InputError` that starts with `where` for what is not a whole JSON object."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        is_cut = error.msg.startswith("Unterminated string") or not text[error.pos :].strip()
        cut = "; the end seems cut off" if is_cut else ""
        raise InputError(f"{where}: is not JSON ({error.msg}, {place}){cut}; write it again.") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: cannot be read as JSON ({_reason(error)}); write it again.") from error
    if not isinstance(value, dict):
        raise InputError(f"{where}: holds {type(value).__name__}; it must be a JSON object.")
    return value


def _reason(error: Exception) -> str:
    return "nested too deeply" if isinstance(error, RecursionError) else "a number of too many digits"


def _read(path: Path) -> bytes:
    """At most one byte more than is allowed."""
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_BYTES + 1)
            if not content.startswith(b"\x1f\x8b"):
                return content
            file.seek(0)
            with gzip.open(file) as unpacked:
                return unpacked.read(LARGEST_BYTES + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: is a damaged gzip file ({error}); fetch or write it again.") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give a file of timings.") from error
