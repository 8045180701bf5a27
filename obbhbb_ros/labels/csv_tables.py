# SPDX-License-Identifier: Apache-2.0
"""
CSV: one file of many images, one box per row, in pixels.

With corners::

    image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,hx1,hy1,hx2,hy2,mask
    P0706,0,ship,284,466,274,456,300,427,310,439,278,429,307,461,301 429;300 430;299 430

The header gives the order of the columns; unknown columns are ignored. ``hx1`` to ``hy2``, the
reference box, may be empty or absent; so may ``mask``, the hull polygon, and ``score``, which is
then 1. A row is one line, quoted fields included, so that a stray quote damages one row and not
the rest of the file. A row with only an image name is an image without boxes. The eight
corners may be replaced by ``x_min,y_min,x_max,y_max``, as `obbhbb convert` writes them: the box is
then upright and also the reference box.

With a column of WKT::

    image,class,score,wkt
    P0706,ship,0.9,"POLYGON ((284 466, 274 456, 300 427, 310 439, 284 466))"

The geometry is in the first column that is called ``wkt``, ``geometry``, ``geom`` or ``the_geom``;
``image``, ``class``, ``score`` and ``instance`` or ``id`` may be absent, and others are ignored.
Upper and lower case are the same. Coordinates are read as pixels, see `geojson`; an ``SRID=…;``
before the geometry is ignored. Rows without an image name belong to an image named after the file.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import shapely

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.image_labels import DIAGNOSTICS
from obbhbb_ros.labels.image_labels import MIN_HULL_POINTS
from obbhbb_ros.labels.image_labels import AnyImage
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import Value
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import Item
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.label_format import Format

CORNERS = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
REFERENCE = ('hx1', 'hy1', 'hx2', 'hy2')
BOUNDS = ('x_min', 'y_min', 'x_max', 'y_max')
NAMES = ('image', 'instance', 'class')
COLUMNS = (*NAMES, *CORNERS, *REFERENCE, 'mask', 'score')
BOX_COLUMNS = (*NAMES, 'score', *BOUNDS)
GEOMETRY = ('wkt', 'geometry', 'geom', 'the_geom')
SRID = re.compile(r'\s*SRID\s*=\s*\d+\s*;', re.IGNORECASE)


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    images: dict[str, list[Box]] = {}
    for _, _, (image, box) in _read_rows(file, _row_parser):
        boxes = images.setdefault(image, [])
        if box is not None:
            boxes.append(box)
    return file.images(images)


def _read_wkt(file: LabelFile) -> Iterator[ImageLabels]:
    records = _read_rows(file, partial(_wkt_row_parser, file.path.stem))
    return file.images(shapes.enclose(file, records))


def _read_rows(
    file: LabelFile, parser_for: Callable[[list[str]], Callable[[list[str]], Item]]
) -> Iterator[Record[Item]]:
    """Parse the rows below a header; `parser_for` makes the row parser from the column names."""
    lines = text.filled_lines(file)
    number, _, header = next(lines, (None, '', ''))
    try:
        columns = [column.strip() for column in text.split_row(header)]
        parse = parser_for(columns)
    except ValueError as error:
        raise file.error(str(error), number) from None

    def parse_line(line: str) -> Item:
        fields = text.split_row(line)
        if len(fields) != len(columns):
            raise ValueError(f'{len(fields)} fields, the header has {len(columns)}')
        return parse(fields)

    return file.parse_records(lines, parse_line)


def _row_parser(columns: list[str]) -> Callable[[list[str]], tuple[str, Box | None]]:
    upright = not set(BOUNDS).isdisjoint(columns) and set(CORNERS).isdisjoint(columns)
    shape = BOUNDS if upright else CORNERS
    reference = () if set(REFERENCE).isdisjoint(columns) else REFERENCE
    missing = [column for column in (*NAMES, *shape, *reference) if column not in columns]
    if missing:
        raise ValueError(f'missing columns: {", ".join(missing)} (header: {",".join(columns)})')
    twice = [column for column in (*COLUMNS, *shape) if columns.count(column) > 1]
    if twice:
        raise ValueError(f'columns named more than once: {", ".join(dict.fromkeys(twice))}')
    return partial(_parse_row, columns, shape)


def _parse_row(
    columns: list[str], shape: Sequence[str], fields: list[str]
) -> tuple[str, Box | None]:
    """Parse image name and box; `shape` names the columns of the corners or of the bounds."""
    row = dict(zip(columns, fields, strict=True))
    if not row['image']:
        raise ValueError('no image name')
    if sum(map(bool, fields)) == 1:
        return row['image'], None
    corners: Sequence[float] = text.parse_numbers([row[column] for column in shape])
    bounds = [row.get(column, '') for column in REFERENCE]
    reference: Sequence[float] = text.parse_numbers(bounds) if any(bounds) else NO_REFERENCE
    if shape is BOUNDS:
        reference = corners if reference is NO_REFERENCE else reference
        corners = shapes.upright_corners(corners)
    score, hull = text.parse_score(row.get('score', '')), _parse_hull(row.get('mask', ''))
    return row['image'], Box(corners, row['class'], row['instance'], score, reference, hull)


def _parse_hull(field: str) -> FloatArray | None:
    if not field:
        return None
    points = [point.split() for point in field.split(';')]
    if len(points) < MIN_HULL_POINTS or any(len(point) != 2 for point in points):
        raise ValueError("mask is not a polygon 'x y;x y;x y' of at least three points")
    numbers = text.parse_numbers([number for point in points for number in point])
    hull = np.array(numbers, dtype=np.float64).reshape(-1, 2)
    shapes.check_coordinates(hull)
    return hull


def _wkt_row_parser(
    default_image: str, columns: list[str]
) -> Callable[[list[str]], shapes.Outlined]:
    lower = [column.lower() for column in columns]
    geometry = next((name for name in GEOMETRY if name in lower), None)
    if geometry is None:
        raise ValueError(f'no column of WKT: {", ".join(GEOMETRY)} (header: {",".join(columns)})')
    index = lower.index(geometry)

    def parse(fields: list[str]) -> shapes.Outlined:
        row = dict(zip(columns, fields, strict=True))
        return shapes.feature_record(default_image, row, _wkt_rings(fields[index]))

    return parse


def _wkt_rings(wkt: str) -> list[FloatArray]:
    try:
        geometry = shapely.from_wkt(SRID.sub('', wkt, count=1))
    except shapely.errors.GEOSException as error:
        raise ValueError(f'not WKT: {error}') from None
    return shapes.outer_rings(geometry)


def _write(path: Path, images: list[ImageLabels]) -> None:
    scored = any(np.any(labels.scores != 1.0) for labels in images)
    _write_rows(path, COLUMNS if scored else COLUMNS[:-1], images, _label_rows)


def _label_rows(labels: ImageLabels) -> Iterator[list[str]]:
    numbers = np.hstack((labels.corners.reshape(-1, 8), labels.reference)).tolist()
    columns = labels.ids, labels.class_ids, numbers, labels.hulls, labels.scores.tolist()
    for instance, class_id, row, hull, score in zip(*columns, strict=True):
        yield [labels.image, instance, class_id, *map(_field, row), _mask(hull), _field(score)]


def _mask(hull: FloatArray | None) -> str:
    return '' if hull is None else ';'.join(text.join_numbers(point) for point in hull.tolist())


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    diagnosed = any(image.diagnostics is not None for image in images)
    columns = (*BOX_COLUMNS, *DIAGNOSTICS) if diagnosed else BOX_COLUMNS
    _write_rows(path, columns, images, _box_rows)


def _box_rows(image: ImageBoxes) -> Iterator[list[str]]:
    for box in image.rows():
        values = map(_field, (box.score, *box.xyxy, *box.diagnostics.values()))
        yield [image.image, box.id, box.class_id, *values]


def _field(value: Value) -> str:
    if value is None or value != value:  # noqa: PLR0124
        return ''
    return str(int(value)) if isinstance(value, bool) else repr(value)


def _write_rows(
    path: Path,
    columns: Sequence[str],
    images: Iterable[AnyImage],
    rows_of: Callable[[AnyImage], Iterable[list[str]]],
) -> None:
    """Write one row per box, and one row with only the name for an image without boxes."""
    lines = [_join_row(columns)]
    for image in images:
        if not image.image:
            raise ValueError(f'a table cannot hold an image without a name (from {image.source})')
        rows = rows_of(image) if image.class_ids else [[image.image]]
        padding = [''] * len(columns)
        lines += [_join_row((row + padding)[: len(columns)]) for row in rows]
    text.write_lines(path, lines)


def _join_row(fields: Sequence[str]) -> str:
    row = io.StringIO()
    csv.writer(row, lineterminator='').writerow(fields)
    line = row.getvalue()
    if '\n' in line or '\r' in line:
        raise ValueError(f'a table row must be one line, but this one has a line break: {line!r}')
    return line


def _sniff(head: str) -> bool:
    columns = _first_columns(head)
    return any(column in CORNERS for column in columns) or set(BOUNDS) <= set(columns)


def _sniff_wkt(head: str) -> bool:
    return any(column.lower() in GEOMETRY for column in _first_columns(head))


def _first_columns(head: str) -> Sequence[str]:
    first = next((line for line in head.splitlines() if line.strip()), '')
    return [column.strip(' "') for column in first.split(',')]


CORNER_TABLE = Format(
    name='csv',
    suffixes=('.csv',),
    summary=(
        f'CSV of many images, one box per row: {",".join(COLUMNS[:-1])}; '
        f'or {",".join(BOUNDS)} instead of the corners'
    ),
    sniff=_sniff,
    read=_read,
    write=_write,
    write_boxes=_write_boxes,
    holds=('diagnostics', 'scores', 'ids', 'images without boxes'),
)
WKT_TABLE = Format(
    name='wkt',
    suffixes=('.csv',),
    summary='CSV with a column wkt or geometry of polygons, and image,class,score,instance',
    sniff=_sniff_wkt,
    read=_read_wkt,
)
