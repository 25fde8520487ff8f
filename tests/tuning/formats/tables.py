"""Tables of timings of every kind, and files that hold what a test says."""

import math

import numpy as np
from hypothesis import strategies as st

from tuning.timing_table import TimingTable

# Every character that a text file can hold; a carriage return, quotes and separators among them.
texts = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"), max_size=6)
names = st.text(st.characters(blacklist_categories=("Cs", "Cc", "Zs", "Zl", "Zp")), min_size=1, max_size=6).filter(
    lambda name: name not in ("time_ms", "compile_ms", "time", "times", "compile_time", "device", "kernel")
)
numbers = st.floats(allow_nan=False, allow_infinity=False)
times = st.floats(0, 1e300)  # their sum is finite


@st.composite
def tables(draw, blanks=True, compiled=True) -> TimingTable:
    """Whose rows differ, as those of a table that was read do; each column has at least one number."""
    n_rows = draw(st.integers(1, 4))
    own = draw(st.lists(names, unique=True, max_size=4))
    n_columns = draw(st.integers(0, len(own)))
    # One column of whole numbers tells the rows apart.
    columns = {"row": np.arange(n_rows) * 1.0}
    for name in own[:n_columns]:
        columns[name] = np.array(draw(st.lists(numbers, min_size=n_rows, max_size=n_rows)))
        if blanks and n_rows > 1 and draw(st.booleans()):
            columns[name][draw(st.integers(1, n_rows - 1))] = math.nan
    labels = {name: tuple(draw(st.lists(texts, min_size=n_rows, max_size=n_rows))) for name in own[n_columns:]}
    repeats = draw(st.lists(st.lists(times, min_size=1, max_size=3).map(tuple), min_size=n_rows, max_size=n_rows))
    compile_ms = None
    if compiled and draw(st.booleans()):
        compile_ms = tuple(draw(st.lists(st.floats(0.1, 1e6), min_size=n_rows, max_size=n_rows)))
    return TimingTable(columns, labels, tuple(repeats), compile_ms)


def are_the_same(read: TimingTable, table: TimingTable) -> None:
    assert read.repeats_ms == table.repeats_ms
    assert read.labels == table.labels
    assert read.compile_ms == table.compile_ms
    assert read.columns.keys() == table.columns.keys()
    for name, column in table.columns.items():
        np.testing.assert_array_equal(read.columns[name], column)


def written(folder, content: str | bytes, name: str = "given.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path
