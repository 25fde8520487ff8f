"""Where computed files are kept between runs."""

from __future__ import annotations

import functools
import hashlib
import io
import logging
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from vtfs.files import write_atomically
from vtfs.input_error import InputError

log = logging.getLogger("vtfs.cache")

Arrays = dict[str, np.ndarray]


def cache_dir() -> Path:
    """The folder for caches: `VTFS_CACHE_DIR` where that is set, else the platform's user cache folder.

    It need not exist yet; whoever writes there makes it.
    """
    moved = os.environ.get("VTFS_CACHE_DIR")
    if moved:
        return Path(moved).expanduser()
    import platformdirs  # here: `vtfs --help` has no use for it

    return Path(platformdirs.user_cache_dir("vtfs"))


def cached(kind: str, parts: tuple[str, ...], make: Callable[[], Arrays]) -> Arrays:
    """What `make` returns, from the cache where it was made before.

    The key holds `parts` and this package's own source, so that a result never outlives the code that
    computed it. A damaged file is made again; a cache that cannot be written is only logged.

    **Arguments:**

    - `kind`: the folder within the cache.
    - `parts`: everything that the result depends on.
    """
    key = hashlib.sha256("\n".join((_source_key(), *parts)).encode()).hexdigest()
    path = cache_dir() / kind / f"{key}.npz"
    arrays = _read(path)
    if arrays is None:
        arrays = make()
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, **arrays)
        body = content.getvalue()
        try:
            write_atomically(path, body + hashlib.sha256(body).digest())
        except InputError as error:
            log.warning("%s", error)
    return arrays


def _read(path: Path) -> Arrays | None:
    """The arrays of an `.npz` with the SHA-256 of its bytes behind it; None where that is not so."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    body, checksum = content[:-32], content[-32:]
    if hashlib.sha256(body).digest() != checksum:
        log.warning("%s: damaged; made again", path)
        return None
    with np.load(io.BytesIO(body), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@functools.cache
def _source_key() -> str:
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for file in sorted(folder.rglob("*.py")):
        digest.update(str(file.relative_to(folder)).encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()
