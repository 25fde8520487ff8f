"""What was computed is read again, unless anything it depends on, or the file itself, has changed."""

import logging
from pathlib import Path

import numpy as np
import pytest

import vtfs.cache
from vtfs.cache import cache_dir, cached

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "names": np.array(["x", "ü"]), "none": np.zeros((0, 3), np.int32)}


class Made:
    """Counts how often it was needed."""

    def __init__(self, arrays=ARRAYS):
        self.times, self._arrays = 0, arrays

    def __call__(self):
        self.times += 1
        return self._arrays


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("VTFS_CACHE_DIR", str(tmp_path / "a cache"))
    return tmp_path / "a cache"


def test_the_environment_moves_the_cache(monkeypatch):
    monkeypatch.setenv("VTFS_CACHE_DIR", "~/moved")
    assert cache_dir() == Path.home() / "moved"
    monkeypatch.setenv("VTFS_CACHE_DIR", "")
    assert "vtfs" in cache_dir().parts and cache_dir().is_absolute()
    monkeypatch.delenv("VTFS_CACHE_DIR")
    assert "vtfs" in cache_dir().parts


def test_it_is_made_once_and_read_as_it_was(folder):
    make = Made()
    for _ in range(3):
        read = cached("kind", ("one", "two"), make)
        assert read.keys() == ARRAYS.keys()
        for name, array in ARRAYS.items():
            assert read[name].dtype == array.dtype and np.array_equal(read[name], array)
    assert make.times == 1
    assert len(list((folder / "kind").iterdir())) == 1


@pytest.mark.parametrize(
    ("kind", "parts"), [("kind", ("one",)), ("kind", ("two", "one")), ("sort", ("one", "two")), ("kind", ())]
)
def test_another_kind_or_part_is_another_thing(folder, kind, parts):
    cached("kind", ("one", "two"), Made())
    make = Made({"b": np.ones(2)})
    assert np.array_equal(cached(kind, parts, make)["b"], np.ones(2)) and make.times == 1


def test_another_version_of_the_code_computes_again(folder, monkeypatch):
    cached("kind", ("one",), Made())
    monkeypatch.setattr(vtfs.cache, "_source_key", lambda: "changed")
    make = Made()
    cached("kind", ("one",), make)
    assert make.times == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:20],
        lambda content: content[:-1],
        lambda content: content + b"x",
        lambda content: content[:100] + bytes([content[100] ^ 1]) + content[101:],
        lambda content: b"\0" * len(content),
    ],
    ids=["empty", "no checksum", "cut", "grown", "one bit", "zeros"],
)
def test_a_damaged_file_is_made_again(folder, damage, caplog):
    cached("kind", ("one",), Made())
    (file,) = (folder / "kind").iterdir()
    file.write_bytes(damage(file.read_bytes()))
    make = Made()
    with caplog.at_level(logging.WARNING, "vtfs"):
        assert np.array_equal(cached("kind", ("one",), make)["a"], ARRAYS["a"]) and make.times == 1
    assert "damaged" in caplog.text
    cached("kind", ("one",), make)
    assert make.times == 1


def test_a_cache_that_cannot_be_written_is_done_without(folder, caplog):
    folder.write_text("a file, where the folder should be")
    make = Made()
    with caplog.at_level(logging.WARNING, "vtfs"):
        for _ in range(2):
            assert np.array_equal(cached("kind", ("one",), make)["a"], ARRAYS["a"])
    assert make.times == 2 and "cannot be written" in caplog.text


def test_what_fails_while_it_is_made_leaves_nothing(folder):
    def make():
        raise ValueError("ours")

    with pytest.raises(ValueError, match="ours"):
        cached("kind", ("one",), make)
    assert not folder.exists()
