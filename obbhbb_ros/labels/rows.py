# SPDX-License-Identifier: Apache-2.0
"""CSV files of many images, one box a row: what their formats have in common."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.text import text_lines

Row = TypeVar('Row')
ParseRow = Callable[[list[str]], Row]


def read_rows(
    path: Path, on_error: OnError, header: Callable[[list[str]], ParseRow[Row]]
) -> Iterator[tuple[int, Row]]:
    """
    Parse the rows below a header; a row is one line, quoted fields included.

    Parameters
    ----------
    path : Path
        The file.
    on_error : callable
        Gets a LabelError for each malformed row, or one where the header cannot be used; then
        the file is left out.
    header : callable
        Column names to the function that parses the fields of a row; both raise ValueError where
        they cannot be used.

    Yields
    ------
    tuple of int and row
        Line number, counted from 1, and the parsed row.
    """
    lines = ((number, line) for number, line in text_lines(path, on_error) if line.strip())
    first, head = next(lines, (None, ''))
    try:
        columns = [column.strip() for column in split_row(head)]
        parse = header(columns)
    except ValueError as error:
        on_error(LabelError(path, first, str(error)))
        return
    for number, line in lines:
        try:
            row = parse(_fields(line, len(columns)))
        except ValueError as error:
            on_error(LabelError(path, number, str(error)))
            continue
        yield number, row


def _fields(line: str, count: int) -> list[str]:
    fields = split_row(line)
    if len(fields) != count:
        raise ValueError(f'{len(fields)} fields, the header has {count}')
    return fields


def split_row(line: str) -> list[str]:
    """
    Split a line at its commas, quotes observed.

    Raises
    ------
    ValueError
        If a quote stands where none can.
    """
    if '"' not in line:
        return line.split(',')
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise ValueError(f'not a CSV row: {error}') from None


def join_row(fields: Iterable[str]) -> str:
    """
    Join fields to a line, quoted where they need it.

    Raises
    ------
    ValueError
        If a field has a line break.
    """
    row = io.StringIO()
    csv.writer(row, lineterminator='').writerow(fields)
    line = row.getvalue()
    if '\n' in line or '\r' in line:
        raise ValueError(f'a row of a table is one line, this one has a line break: {line!r}')
    return line


def first_columns(head: str) -> Sequence[str]:
    """List the columns that the beginning of a file names."""
    first = next((line for line in head.splitlines() if line.strip()), '')
    return [column.strip(' "') for column in first.split(',')]
