"""A CSV file as a header and columns of text, checked: no cell is guessed and none is dropped."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tuning.formats.bounded_text import read_text
from tuning.formats.grouping import Value, as_number
from vtfs.input_error import InputError

_DELIMITERS = (",", ";", "\t")


@dataclass(frozen=True)
class Sheet:
    """Columns of text, in the order of the file.

    - `lines`: of each row, where it ends in the file, for messages.
    """

    path: str
    columns: dict[str, tuple[str, ...]]
    lines: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.lines)

    def column(self, name: str) -> tuple[str, ...]:
        """**Raises:** `InputError` where there is none of that name."""
        if name not in self.columns:
            raise InputError(f"{self.path}: has no column `{name}`; it has {', '.join(self.columns)}.")
        return self.columns[name]

    def at(self, row: int, name: str) -> str:
        """A cell's place, for a message."""
        return f"{self.path}: line {self.lines[row]}: `{name}`"

    def values(self, name: str, as_text: bool = False) -> list[Value]:
        """A column as numbers where most of its cells are numbers (or `as_text` forbids it), else as texts.

        **Raises:** `InputError` for a text among numbers, NaN and infinity.
        """
        column = self.column(name)
        if as_text or not is_mostly_numbers(column):
            return list(column)
        return [self.number(row, name) for row in range(len(self))]

    def number(self, row: int, name: str) -> float | None:
        """The number in a cell; `None` where it is empty.

        **Raises:** `InputError` for a text, NaN and infinity.
        """
        cell = self.columns[name][row].strip()
        if not cell:
            return None
        try:
            number = float(cell)
        except ValueError:
            pointed = cell.replace(",", ".")
            right = f"write {pointed}" if _is_number(pointed) else "correct it"
            raise InputError(
                f"{self.at(row, name)} = {cell[:40]!r}: is not a number; {right}, or --ignore it."
            ) from None
        return as_number(number, self.at(row, name))


def read_sheet(path: Path | str) -> Sheet:
    """Read a CSV file; comma, semicolon or tab, whichever its header has most of.

    **Raises:** `InputError` for what is no UTF-8 text, a header with a name twice or none, and a row that is longer
    or shorter than it.
    """
    return parse_sheet(read_text(path), str(path))


def parse_sheet(text: str, path: str) -> Sheet:
    """As `read_sheet`, of text that was read."""
    first = text.lstrip("\r\n").partition("\n")[0]
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(_DELIMITERS, key=first.count), strict=True)
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        header = [name.strip() for name in next(row for row in reader if row)]
        _check_header(header, path)
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                raise InputError(
                    f"{path}: line {reader.line_num}: has {len(row)} cells and the header {len(header)}; write an "
                    "empty cell where there is no value, and quote cells that hold the separator."
                )
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(f"{path}: line {reader.line_num}: is not CSV ({error}); close quotes that open.") from error
    if not rows:
        raise InputError(f"{path}: has a header and no rows; it must hold at least one.")
    return Sheet(path, dict(zip(header, zip(*rows, strict=True), strict=True)), tuple(lines))


def is_mostly_numbers(column: Sequence[str]) -> bool:
    """More than half of the cells that hold anything are numbers; true where none does."""
    filled = [cell for cell in column if cell.strip()]
    return not filled or 2 * sum(map(_is_number, filled)) > len(filled)


def _check_header(header: list[str], path: str) -> None:
    for index, name in enumerate(header):
        if not name:
            raise InputError(f"{path}: column {index + 1} has no name; name it, or remove it (pandas: index=False).")
        if name in header[:index]:
            raise InputError(f"{path}: `{name}` is the name of two columns; rename one of them.")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
