# SPDX-License-Identifier: Apache-2.0
"""Text label files: lines and numbers in, lines out."""

from __future__ import annotations

import codecs
import csv
import math
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from pathlib import Path

from obbhbb_ros.files import write_pieces
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import OnError
from obbhbb_ros.labels.label_file import Record


def text_lines(path: Path, on_error: OnError) -> Iterator[tuple[int, str]]:
    """
    Read the lines of a UTF-8 file, with or without BOM, ended by LF, CRLF or CR.

    Yields line numbers, counted from 1, and lines without their ends. A line that is not UTF-8 is
    left out, and `on_error` gets a LabelError for it.
    """
    data = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    for number, raw in enumerate(data.splitlines(), start=1):
        try:
            line = raw.decode()
        except UnicodeDecodeError as error:
            bad = f'byte 0x{raw[error.start]:02x} at position {error.start + 1}'
            on_error(LabelError(path, number, f'not UTF-8 text: {bad}'))
        else:
            yield number, line


def read_boxes(file: LabelFile, parse: Callable[[str], Box | None]) -> list[Box]:
    """
    Parse a file with one record per line; blank lines are ignored.

    `parse` gets a line and returns a Box, or None if the line holds no box. It raises ValueError if
    the line is malformed.
    """
    boxes = (box for _, _, box in file.parse_records(filled_lines(file), parse))
    return [box for box in boxes if box is not None]


def filled_lines(file: LabelFile) -> Iterator[Record[str]]:
    """Read the lines that are not blank, as records for `LabelFile.parse_records`."""
    lines = text_lines(file.path, file.on_error)
    return ((number, '', line) for number, line in lines if line.strip())


def split_row(line: str, separator: str = ',') -> list[str]:
    """Split a line of a table into fields; raise ValueError if its quotes do not match."""
    if '"' not in line:
        return line.split(separator)
    # The line is in memory already: its fields may be longer than the csv module likes.
    limit = csv.field_size_limit()
    csv.field_size_limit(max(limit, len(line)))
    try:
        return next(csv.reader([line], strict=True, delimiter=separator))
    except csv.Error as error:
        raise ValueError(f'not a CSV row: {error}') from None
    finally:
        csv.field_size_limit(limit)


def parse_numbers(fields: Iterable[str]) -> list[float]:
    """Turn fields into finite numbers, see `parse_number`."""
    return [parse_number(field) for field in fields]


def parse_number(field: str) -> float:
    """Turn a field into a number; raise ValueError if it is not one, NaN or infinite."""
    # float() also accepts Python's 1_000, which no label format has.
    try:
        value = float('' if '_' in field else field)
    except ValueError:
        raise ValueError(f'{field!r} is not a number') from None
    if not math.isfinite(value):
        raise ValueError(f'{field!r} is not a finite number')
    return value


def parse_score(field: str) -> float:
    """Turn the field of a score into a finite number, see `parse_number`; 1.0 if it is empty."""
    return parse_number(field) if field else 1.0


def is_number(field: str) -> bool:
    """Return whether a field is a finite number."""
    try:
        parse_number(field)
    except ValueError:
        return False
    return True


def is_index(field: str) -> bool:
    """Return whether a field is a whole number from 0, as class indices are."""
    return field.isascii() and field.isdigit()


def is_normalised(values: Iterable[float]) -> bool:
    """
    Return whether coordinates can be fractions of an image.

    Boxes at the border may extend beyond the image, but not by a whole image.
    """
    return all(-1.0 <= value <= 2.0 for value in values)


def join_numbers(values: Iterable[float]) -> str:
    """Join Python floats with spaces, each as the shortest text that reads back unchanged."""
    return ' '.join(map(repr, values))


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """
    Write lines as UTF-8 with LF ends, and make missing folders.

    Raises OSError if that fails; an existing file then stays as it was.
    """
    write_pieces(path, (f'{line}\n' for line in lines))
