"""Caches and folders of the tests: never the user's."""

import os

import jax
import pytest
from hypothesis import settings

# The same examples in every run, so that a change fails for what it did; HYPOTHESIS_PROFILE=explore draws new ones.
settings.register_profile("same", derandomize=True)
settings.register_profile("explore", derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


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


@pytest.fixture(scope="module", autouse=True)
def _programs_of_one_file():
    """Compiled programs go with the file that made them: each takes memory maps, and Linux allows a process 65,530."""
    yield
    jax.clear_caches()


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """The working directory is a folder of the test's own: what a command reads and writes by its name lies there."""
    monkeypatch.chdir(tmp_path)
