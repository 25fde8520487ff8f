"""What any file may hold at the most, and JSON that is damaged."""

import gzip

import pytest

from tests.tuning.formats.tables import written
from tuning.formats import bounded_text
from tuning.formats.csv_table import read_csv
from tuning.formats.extra_p import read_extra_p
from tuning.formats.kernel_tuner import read_kernel_tuner
from tuning.formats.t4 import read_t4
from vtfs.input_error import InputError


def test_nothing_is_unpacked_past_the_limit(folder, monkeypatch):
    monkeypatch.setattr(bounded_text, "LARGEST_BYTES", 2**20)
    bomb = written(folder, gzip.compress(b"0" * 2**26), "bomb.json.gz")
    assert bomb.stat().st_size < 2**18
    asked = []

    def counted(self, size=-1):
        asked.append(size)
        return original(self, size)

    original = gzip.GzipFile.read
    monkeypatch.setattr(gzip.GzipFile, "read", counted)
    with pytest.raises(InputError, match="more than 1 MiB"):
        read_kernel_tuner(bomb)
    assert asked == [2**20 + 1]
    plain = written(folder, b"0" * (2**20 + 1), "large.csv")
    with pytest.raises(InputError, match="more than 1 MiB"):
        read_csv(plain)


@pytest.mark.parametrize("reader", [read_kernel_tuner, read_t4, read_extra_p])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"cache": {"8": {"time"', ("cut off",)),
        ('{"a": 1} x', ("not JSON",)),
        ("[1]", ("object",)),
        ('{"a": ' + "9" * 5000 + "}", ("digits",)),
        ("[" * 100_000, ("nested",)),
        ("", ("empty",)),
    ],
)
def test_damaged_json_is_refused(folder, reader, content, words):
    with pytest.raises(InputError) as refused:
        reader(written(folder, content, "damaged.json"))
    for word in words:
        assert word in str(refused.value), refused.value
