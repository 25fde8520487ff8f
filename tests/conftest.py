"""Caches of the tests: never the user's."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory):
    """One cache folder a session: programs are compiled once, and nothing of an earlier session is believed."""
    before = os.environ.get("VTFS_CACHE_DIR")
    os.environ["VTFS_CACHE_DIR"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if before is None:
        del os.environ["VTFS_CACHE_DIR"]
    else:
        os.environ["VTFS_CACHE_DIR"] = before
