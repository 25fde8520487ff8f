"""Where computed files are kept between runs."""

from __future__ import annotations

import os
from pathlib import Path


def cache_dir() -> Path:
    """The folder for caches: `VTFS_CACHE_DIR` where that is set, else the platform's user cache folder.

    It need not exist yet; whoever writes there makes it.
    """
    moved = os.environ.get("VTFS_CACHE_DIR")
    if moved:
        return Path(moved).expanduser()
    import platformdirs  # here: `vtfs --help` has no use for it

    return Path(platformdirs.user_cache_dir("vtfs"))
