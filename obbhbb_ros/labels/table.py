"""
CSV: one file of many images, one box a row, in pixels.

::

    image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,hx1,hy1,hx2,hy2,mask
    P0706,0,ship,284,466,274,456,300,427,310,439,278,429,307,461,301 429;300 430;299 430

The header tells the order of the columns; columns it does not know are ignored. ``hx1`` to
``hy2``, the reference box, may be empty or absent, and so may ``mask``, the hull polygon. So may
``score``; it counts as 1. A row is one line, quoted fields included, so that a stray quote costs
one row and not the rest of the file. A row of an image name and nothing else is an image without
boxes.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import MIN_HULL_POINTS
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.text import join_numbers
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.text import text_lines
from obbhbb_ros.labels.text import write_lines

CORNERS = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
REFERENCE = ('hx1', 'hy1', 'hx2', 'hy2')
REQUIRED = ('image', 'instance', 'class', *CORNERS)
COLUMNS = (*REQUIRED, *REFERENCE, 'mask', 'score')


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the images of a CSV file in the order in which it first names them.

    Parameters
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height in pixels, passed on to the labels; the format does not need it.
    on_error : callable
        Gets a LabelError for each malformed row, or one where the header cannot be used; then
        the file is left out.

    Yields
    ------
    ImageLabels
        Boxes in the order of the file, even where the rows of several images alternate.
    """
    lines = ((number, line) for number, line in text_lines(path, on_error) if line.strip())
    number, first = next(lines, (None, ''))
    try:
        header = _Header(path, number, first)
    except LabelError as error:
        on_error(error)
        return
    images: dict[str, list[Box]] = {}
    for row, line in lines:
        try:
            image, box = header.parse(line)
        except ValueError as error:
            on_error(LabelError(path, row, str(error)))
            continue
        boxes = images.setdefault(image, [])
        if box is not None:
            boxes.append(box)
    for image, boxes in images.items():
        yield assemble(image, boxes, image_size, path)


class _Header:
    """The header of a file, and what it makes of the rows below it."""

    def __init__(self, path: Path, line: int | None, text: str) -> None:
        """Find the columns; raise a LabelError where they do not serve."""
        try:
            columns = [column.strip() for column in _split(text)]
            _check_columns(columns)
        except ValueError as error:
            raise LabelError(path, line, str(error)) from None
        index = {column: columns.index(column) for column in COLUMNS if column in columns}
        self._count = len(columns)
        self._image = index['image']
        self._instance = index['instance']
        self._class = index['class']
        self._corners = [index[column] for column in CORNERS]
        self._reference = [index[column] for column in REFERENCE if column in index]
        self._mask = index.get('mask')
        self._score = index.get('score')

    def parse(self, line: str) -> tuple[str, Box | None]:
        """Split a row into image name and box; raise ValueError where it is malformed."""
        fields = _split(line)
        if len(fields) != self._count:
            raise ValueError(f'{len(fields)} fields, the header has {self._count}')
        image = fields[self._image]
        if not image:
            raise ValueError('no image name')
        if not any(fields[: self._image]) and not any(fields[self._image + 1 :]):
            return image, None
        return image, self._box(fields)

    def _box(self, fields: Sequence[str]) -> Box:
        score = '' if self._score is None else fields[self._score]
        return Box(
            corners=parse_numbers([fields[index] for index in self._corners]),
            class_id=fields[self._class],
            id=fields[self._instance],
            score=parse_numbers([score])[0] if score else 1.0,
            reference=_parse_reference([fields[index] for index in self._reference]),
            hull=None if self._mask is None else _parse_hull(fields[self._mask]),
        )


def _check_columns(columns: Sequence[str]) -> None:
    missing = [column for column in REQUIRED if column not in columns]
    if any(column in columns for column in REFERENCE):
        missing += [column for column in REFERENCE if column not in columns]
    if missing:
        raise ValueError(f'missing columns: {", ".join(missing)} (header: {",".join(columns)})')
    twice = [column for column in COLUMNS if columns.count(column) > 1]
    if twice:
        raise ValueError(f'columns named more than once: {", ".join(twice)}')


def _split(line: str) -> list[str]:
    if '"' not in line:
        return line.split(',')
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise ValueError(f'not a CSV row: {error}') from None


def _parse_reference(fields: Sequence[str]) -> Sequence[float]:
    return parse_numbers(fields) if any(fields) else NO_REFERENCE


def _parse_hull(field: str) -> FloatArray | None:
    if not field:
        return None
    points = [point.split() for point in field.split(';')]
    if len(points) < MIN_HULL_POINTS or any(len(point) != 2 for point in points):
        raise ValueError("mask is not a polygon 'x y;x y;x y', three points or more")
    numbers = parse_numbers([number for point in points for number in point])
    return np.array(numbers, dtype=np.float64).reshape(-1, 2)


def write(path: Path, images: list[ImageLabels]) -> None:
    """
    Write all images to one CSV file; numbers read back as the very same.

    The column ``score`` is there if any score is not 1.

    Parameters
    ----------
    path : Path
        The file.
    images : list of ImageLabels
        The images; several of the same name become one.

    Raises
    ------
    ValueError
        If an image has no name, or a name, class or id holds a line break.
    """
    scored = any(np.any(labels.scores != 1.0) for labels in images)
    columns = COLUMNS if scored else COLUMNS[:-1]
    rows = (row[: len(columns)] for labels in images for row in _rows(labels))
    write_lines(path, [_join(columns), *map(_join, rows)])


def _rows(labels: ImageLabels) -> Iterator[Sequence[str]]:
    if not labels.image:
        raise ValueError(f'an image without a name cannot stand in a table (from {labels.source})')
    if not labels.class_ids:
        yield (labels.image, *[''] * (len(COLUMNS) - 1))
    references = [row if np.isfinite(row).all() else None for row in labels.reference]
    for index, (class_id, instance) in enumerate(zip(labels.class_ids, labels.ids, strict=True)):
        reference = references[index]
        yield (
            labels.image,
            instance,
            class_id,
            *map(repr, labels.corners[index].ravel().tolist()),
            *([''] * len(REFERENCE) if reference is None else map(repr, reference.tolist())),
            _mask(labels.hulls[index]),
            repr(float(labels.scores[index])),
        )


def _mask(hull: FloatArray | None) -> str:
    return '' if hull is None else ';'.join(join_numbers(point) for point in hull.tolist())


def _join(fields: Iterable[str]) -> str:
    row = io.StringIO()
    csv.writer(row, lineterminator='').writerow(fields)
    line = row.getvalue()
    if '\n' in line or '\r' in line:
        raise ValueError(f'a row of a table is one line, this one has a line break: {line!r}')
    return line


def sniff(head: str) -> bool:
    """Tell whether the first line names a column of corners."""
    first = next((line for line in head.splitlines() if line.strip()), '')
    return any(column.strip(' "') in CORNERS for column in first.split(','))


FORMAT = Format(
    name='csv',
    suffixes=('.csv',),
    summary='CSV of many images, one box a row: ' + ','.join(COLUMNS[:-1]),
    read=read,
    write=write,
    sniff=sniff,
)
