# SPDX-License-Identifier: Apache-2.0
"""
The rows of a CSV table: most are a line, and a quoted field may have line breaks, read as LF.

A row goes on to the line that ends its quotes only if it then has as many fields as the header, so
that a stray quote damages one row and not those below it.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Sequence
from typing import NamedTuple

from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.text import MAX_LINE_BYTES
from obbhbb_ros.labels.text import Block
from obbhbb_ros.labels.text import line_blocks
from obbhbb_ros.labels.text import split_row

MAX_ROW_LINES = 1000


class _Lines(NamedTuple):
    numbers: Sequence[int]
    lines: Sequence[str]


def row_blocks(
    file: LabelFile, separator_of: Callable[[str], str] = lambda header: ','
) -> Iterator[Block]:
    """
    Read the rows that are not blank in blocks of at least one, numbered by their first line.

    `separator_of` returns what separates the fields from the first row. Errors are those of
    `line_blocks`.
    """
    joiner = _RowJoiner(separator_of)
    for block in line_blocks(file.path, file.on_error):
        yield from joiner.add(*block)
    yield from joiner.add((), (), last=True)


def table_rows(
    file: LabelFile, separator_of: Callable[[str], str] = lambda header: ','
) -> Iterator[Record[str]]:
    """Read the rows one by one, as records for `LabelFile.parse_records`; see `row_blocks`."""
    blocks = row_blocks(file, separator_of)
    return ((number, '', row) for block in blocks for number, row in zip(*block, strict=True))


class _RowJoiner:
    """Joins lines to rows; lines at the end of a block wait for the next one."""

    def __init__(self, separator_of: Callable[[str], str]) -> None:
        self._separator_of = separator_of
        self._separator = ''
        self._fields = 0
        self._waiting = _Lines([], [])

    def add(
        self, numbers: Sequence[int], lines: Sequence[str], *, last: bool = False
    ) -> Iterator[Block]:
        """Yield the rows that end in these lines, if any, as a block."""
        if self._waiting.lines:
            numbers = [*self._waiting.numbers, *numbers]
            lines = [*self._waiting.lines, *lines]
            self._waiting = _Lines([], [])
        if not (self._fields and '"' not in ''.join(lines) and all(map(str.strip, lines))):
            rows = list(self._rows(numbers, lines, last))
            numbers, lines = [number for number, _ in rows], [row for _, row in rows]
        if lines:
            yield numbers, lines

    def _rows(
        self, numbers: Sequence[int], lines: Sequence[str], last: bool
    ) -> Iterator[tuple[int, str]]:
        at = 0
        while at < len(lines):
            end = at + 1
            if _is_open(lines[at]):
                end = self._end_of_row(lines, at, last)
            if not end:
                self._waiting = _Lines(numbers[at:], lines[at:])
                return
            row = '\n'.join(lines[at:end])
            if row.strip():
                self._fields = self._fields or self._start(row)
                yield numbers[at], row
            at = end

    def _end_of_row(self, lines: Sequence[str], at: int, last: bool) -> int:
        """Return where the row that begins in an open line ends; 0 if that is not known yet."""
        stop = min(len(lines), at + MAX_ROW_LINES)
        end = next((index for index in range(at + 1, stop) if _is_open(lines[index])), None)
        if end is not None:
            return end + 1 if self._is_row('\n'.join(lines[at : end + 1])) else at + 1
        complete = last or stop < len(lines) or sum(map(len, lines[at:])) > MAX_LINE_BYTES
        return at + 1 if complete else 0

    def _is_row(self, row: str) -> bool:
        try:
            fields = split_row(row, self._separator or self._separator_of(row))
        except ValueError:
            return False
        return self._fields in (0, len(fields))

    def _start(self, header: str) -> int:
        """Keep what the first row says, and return the number of its fields."""
        self._separator = self._separator_of(header)
        try:
            return len(split_row(header, self._separator))
        except ValueError:
            return 1


def _is_open(line: str) -> bool:
    """Tell whether a quoted field begins in a line and does not end there, or the reverse."""
    return line.count('"') % 2 == 1
