# SPDX-License-Identifier: Apache-2.0
"""Text label files: lines and numbers in, lines out."""

from __future__ import annotations

import codecs
import csv
import math
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from obbhbb_ros.files import write_pieces
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels.label_file import FileError
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import OnError
from obbhbb_ros.labels.label_file import Record

# Lines are parsed this much at a time: a core's cache holds what comes of it.
BLOCK_BYTES = 1 << 18
MAX_LINE_BYTES = 1 << 26

Block: TypeAlias = tuple[Sequence[int], Sequence[str]]
"""Line numbers, counted from 1, and the lines without their ends."""


# How files begin that are no plain text.
PACKINGS = (
    (b'\x1f\x8b', 'gzip-compressed: unpack it'),
    (b'PK\x03\x04', 'a ZIP archive: unpack it'),
    (codecs.BOM_UTF16_LE, 'UTF-16 text: save it as UTF-8'),
    (codecs.BOM_UTF16_BE, 'UTF-16 text: save it as UTF-8'),
)
SHOWN = 60
# Boxes at the border of an image may extend beyond it, but not by a whole image.
LEAST_FRACTION = -1.0
MOST_FRACTION = 2.0


def packing(data: bytes) -> str:
    """Say what to do with a file that is no plain text, by its beginning; '' for plain text."""
    return next((what for mark, what in PACKINGS if data.startswith(mark)), '')


def describe_text(head: str) -> str:
    """Say what the beginning of a text that no format fits looks like."""
    line = next((line.strip() for line in head.splitlines() if line.strip()), '')
    if ',' not in line:
        for mark, name in ((';', 'semicolons'), ('\t', 'tabs')):
            if mark in line:
                return f'separated by {name}: separate the columns by commas'
    return f'the first line is {line[:SHOWN]!r}'


def line_blocks(path: Path, on_error: OnError) -> Iterator[Block]:
    """
    Read the lines of a UTF-8 file, with or without BOM, ended by LF, CRLF or CR, block by block.

    A line that is not UTF-8 is left out, and `on_error` gets a LabelError for it. Raises FileError
    if the file is compressed or UTF-16, or has a line of more than `MAX_LINE_BYTES`.
    """
    first = 1
    with path.open('rb') as stream:
        if problem := packing(stream.peek()[:4]):
            raise FileError(path, None, problem)
        while data := stream.read(BLOCK_BYTES) + stream.readline(MAX_LINE_BYTES):
            if len(data) >= BLOCK_BYTES + MAX_LINE_BYTES:
                raise FileError(path, None, f'a line of more than {MAX_LINE_BYTES} bytes')
            lines = (data if first > 1 else data.removeprefix(codecs.BOM_UTF8)).splitlines()
            try:
                yield range(first, first + len(lines)), list(map(bytes.decode, lines))
            except UnicodeDecodeError:
                yield from _decodable(path, first, lines, on_error)
            first += len(lines)


def _decodable(
    path: Path, first: int, lines: Sequence[bytes], on_error: OnError
) -> Iterator[Block]:
    """Decode lines one by one; a new block begins after a line that is not UTF-8."""
    decoded: list[str] = []
    for number, raw in enumerate(lines, first):
        try:
            decoded.append(raw.decode())
        except UnicodeDecodeError as error:
            yield range(number - len(decoded), number), decoded
            decoded = []
            bad = f'byte 0x{raw[error.start]:02x} at position {error.start + 1}'
            on_error(LabelError(path, number, f'not UTF-8 text: {bad}'))
    yield range(first + len(lines) - len(decoded), first + len(lines)), decoded


def text_lines(path: Path, on_error: OnError) -> Iterator[tuple[int, str]]:
    """Read the numbers and lines of a file one by one, see `line_blocks`."""
    for numbers, lines in line_blocks(path, on_error):
        yield from zip(numbers, lines, strict=True)


def filled_blocks(file: LabelFile) -> Iterator[Block]:
    """Read the lines that are not blank in blocks of at least one, see `line_blocks`."""
    for numbers, lines in line_blocks(file.path, file.on_error):
        if all(map(str.strip, lines)):
            filled = numbers, lines
        else:
            pairs = zip(numbers, lines, strict=True)
            kept = [(number, line) for number, line in pairs if line.strip()]
            filled = [number for number, _ in kept], [line for _, line in kept]
        if filled[0]:
            yield filled


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


def split_rows(lines: Sequence[str]) -> list[list[str]]:
    """Split N lines of a table into fields, see `split_row`."""
    if '"' not in ''.join(lines):
        return [line.split(',') for line in lines]
    return list(map(split_row, lines))


def parse_numbers(fields: Sequence[str]) -> list[float]:
    """Turn fields into finite numbers, see `parse_number`."""
    try:
        values = list(map(float, fields))
    except ValueError:
        values = [math.nan]
    # A sum that overflows is no error, but takes the longer way as well.
    if math.isfinite(sum(values)) and '_' not in ''.join(fields):
        return values
    return [parse_number(field) for field in fields]


def parse_columns(columns: Sequence[Sequence[str]]) -> FloatArray:
    """Turn K columns of N fields into finite numbers, (N, K), see `parse_number`."""
    fields = list(chain.from_iterable(columns))
    try:
        values = np.fromiter(map(float, fields), np.float64, len(fields))
        plain = '_' not in ''.join(fields)
    except ValueError:
        plain = False
    if not (plain and np.isfinite(values).all()):
        values = np.array(parse_numbers(fields))
    return values.reshape(len(columns), -1).T


def parse_scores(fields: Sequence[str]) -> FloatArray:
    """Turn the fields of N scores into finite numbers, (N,), see `parse_score`."""
    if not any(fields):
        return np.ones(len(fields))
    if all(fields):
        with suppress(ValueError):
            return parse_columns((fields,))[:, 0]
    return np.array(list(map(parse_score, fields)), np.float64)


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
    """Turn the field of a score into a finite number; 1.0 if it is empty, or NaN as of pandas."""
    return 1.0 if field.lower() in {'', 'nan'} else parse_number(field)


def is_number(field: str) -> bool:
    """Return whether a field is a finite number."""
    if field[:1].isalpha():
        return False
    try:
        parse_number(field)
    except ValueError:
        return False
    return True


def is_index(field: str) -> bool:
    """Return whether a field is a whole number from 0, as class indices are."""
    return field.isascii() and field.isdigit()


def is_normalised(values: Iterable[float]) -> bool:
    """Return whether coordinates can be fractions of an image."""
    values = list(values)
    return not values or (min(values) >= LEAST_FRACTION and max(values) <= MOST_FRACTION)


def are_normalised(rows: FloatArray) -> npt.NDArray[np.bool_]:
    """Return for each of N rows, (N, K), whether it `is_normalised`, shape (N,)."""
    within: npt.NDArray[np.bool_] = (rows >= LEAST_FRACTION) & (rows <= MOST_FRACTION)
    return np.logical_and.reduce(within, axis=1)


def join_numbers(values: Iterable[float]) -> str:
    """Join Python floats with spaces, each as the shortest text that reads back unchanged."""
    return ' '.join(map(repr, values))


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """
    Write lines as UTF-8 with LF ends, and make missing folders.

    Raises OSError if that fails; an existing file then stays as it was.
    """
    write_pieces(path, (f'{line}\n' for line in lines))
