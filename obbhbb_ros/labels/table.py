# SPDX-License-Identifier: Apache-2.0
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

In the place of the eight corners may stand ``x_min,y_min,x_max,y_max``, as `obbhbb convert` writes
them: the box is upright then, and its own reference box.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from obbhbb_ros.labels.converted import DIAGNOSTICS
from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.converted import Value
from obbhbb_ros.labels.converted import converted_boxes
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import MIN_HULL_POINTS
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.rows import ParseRow
from obbhbb_ros.labels.rows import first_columns
from obbhbb_ros.labels.rows import join_row
from obbhbb_ros.labels.rows import read_rows
from obbhbb_ros.labels.shapes import check_coordinates
from obbhbb_ros.labels.shapes import upright_corners
from obbhbb_ros.labels.text import join_numbers
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.text import write_lines

CORNERS = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
REFERENCE = ('hx1', 'hy1', 'hx2', 'hy2')
BOUNDS = ('x_min', 'y_min', 'x_max', 'y_max')
NAMES = ('image', 'instance', 'class')
COLUMNS = (*NAMES, *CORNERS, *REFERENCE, 'mask', 'score')
BOX_COLUMNS = (*NAMES, 'score', *BOUNDS)


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
    images: dict[str, list[Box]] = {}
    for _, (image, box) in read_rows(path, on_error, _header):
        boxes = images.setdefault(image, [])
        if box is not None:
            boxes.append(box)
    for image, boxes in images.items():
        yield assemble(image, boxes, image_size, path)


def _header(columns: list[str]) -> ParseRow[tuple[str, Box | None]]:
    upright = any(column in columns for column in BOUNDS)
    upright = upright and not any(column in columns for column in CORNERS)
    shape = BOUNDS if upright else CORNERS
    _check_columns(columns, shape)
    return _Rows(columns, shape).parse


class _Rows:
    """Where the columns of a file are, and what they make of a row."""

    def __init__(self, columns: Sequence[str], shape: Sequence[str]) -> None:
        """Find the columns."""
        index = {column: number for number, column in enumerate(columns)}
        self._image = index['image']
        self._instance = index['instance']
        self._class = index['class']
        self._shape = [index[column] for column in shape]
        self._reference = [index[column] for column in REFERENCE if column in index]
        self._mask = index.get('mask')
        self._score = index.get('score')

    def parse(self, fields: list[str]) -> tuple[str, Box | None]:
        """Turn a row into image name and box; raise ValueError where it is malformed."""
        image = fields[self._image]
        if not image:
            raise ValueError('no image name')
        if not any(fields[: self._image]) and not any(fields[self._image + 1 :]):
            return image, None
        return image, self._box(fields)

    def _box(self, fields: Sequence[str]) -> Box:
        score = '' if self._score is None else fields[self._score]
        shape: Sequence[float] = parse_numbers([fields[index] for index in self._shape])
        reference = _parse_reference([fields[index] for index in self._reference])
        if len(shape) == len(BOUNDS):
            reference = shape if reference is NO_REFERENCE else reference
            shape = upright_corners(shape)
        return Box(
            corners=shape,
            class_id=fields[self._class],
            id=fields[self._instance],
            score=parse_numbers([score])[0] if score else 1.0,
            reference=reference,
            hull=None if self._mask is None else _parse_hull(fields[self._mask]),
        )


def _check_columns(columns: Sequence[str], shape: Sequence[str]) -> None:
    missing = [column for column in (*NAMES, *shape) if column not in columns]
    if any(column in columns for column in REFERENCE):
        missing += [column for column in REFERENCE if column not in columns]
    if missing:
        raise ValueError(f'missing columns: {", ".join(missing)} (header: {",".join(columns)})')
    twice = [column for column in (*COLUMNS, *shape) if columns.count(column) > 1]
    if twice:
        raise ValueError(f'columns named more than once: {", ".join(dict.fromkeys(twice))}')


def _parse_reference(fields: Sequence[str]) -> Sequence[float]:
    return parse_numbers(fields) if any(fields) else NO_REFERENCE


def _parse_hull(field: str) -> FloatArray | None:
    if not field:
        return None
    points = [point.split() for point in field.split(';')]
    if len(points) < MIN_HULL_POINTS or any(len(point) != 2 for point in points):
        raise ValueError("mask is not a polygon 'x y;x y;x y', three points or more")
    numbers = parse_numbers([number for point in points for number in point])
    hull = np.array(numbers, dtype=np.float64).reshape(-1, 2)
    check_coordinates(hull)
    return hull


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
    write_lines(path, [join_row(columns), *map(join_row, rows)])


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


def write_boxes(path: Path, images: list[ConvertedImage]) -> None:
    """
    Write axis-aligned boxes to one CSV file; numbers read back as the very same.

    The six diagnostics follow if any image has them; an unknown one is empty, `capped` 0 or 1.

    Parameters
    ----------
    path : Path
        The file.
    images : list of ConvertedImage
        The images; several of the same name become one.

    Raises
    ------
    ValueError
        If an image has no name, or a name, class or id holds a line break.
    """
    diagnosed = any(converted.diagnostics is not None for converted in images)
    columns = (*BOX_COLUMNS, *DIAGNOSTICS) if diagnosed else BOX_COLUMNS
    rows = (row for converted in images for row in _box_rows(converted, len(columns)))
    write_lines(path, [join_row(columns), *map(join_row, rows)])


def _box_rows(converted: ConvertedImage, count: int) -> Iterator[Sequence[str]]:
    if not converted.image:
        raise ValueError(f'an image without a name cannot stand in a table ({converted.source})')
    if not converted.class_ids:
        yield (converted.image, *[''] * (count - 1))
    for box in converted_boxes(converted):
        values = [_field(value) for value in box.diagnostics.values()]
        blank = [''] * (count - len(BOX_COLUMNS) - len(values))
        bounds = map(repr, box.xyxy)
        yield (converted.image, box.id, box.class_id, repr(box.score), *bounds, *values, *blank)


def _field(value: Value) -> str:
    if value is None:
        return ''
    return str(int(value)) if isinstance(value, bool) else repr(value)


def sniff(head: str) -> bool:
    """Tell whether the first line names a column of corners, or all four of bounds."""
    columns = first_columns(head)
    return any(column in CORNERS for column in columns) or set(BOUNDS) <= set(columns)


FORMAT = Format(
    name='csv',
    suffixes=('.csv',),
    summary=(
        f'CSV of many images, one box a row: {",".join(COLUMNS[:-1])}; '
        f'or {",".join(BOUNDS)} instead of the corners'
    ),
    read=read,
    write=write,
    sniff=sniff,
    write_boxes=write_boxes,
    holds_diagnostics=True,
)
