# SPDX-License-Identifier: Apache-2.0
"""
CSV: one file of many images, one box per row, in pixels.

With corners::

    image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,hx1,hy1,hx2,hy2,mask
    P0706,0,ship,284,466,274,456,300,427,310,439,278,429,307,461,301 429;300 430;299 430

The header gives the order of the columns; other columns are kept, ``crowd`` (0 or 1) and
``difficulty`` as such. ``hx1`` to ``hy2``, the reference box, may be empty or absent; so may
``mask``, the hull polygon, and ``score``, which is then 1. Quoted fields may have line breaks, see
`table_rows`. A row with only an image name is an image without boxes. The eight corners may be
replaced by ``x_min,y_min,x_max,y_max``, as `obbhbb convert` writes them: the box is then upright
and also the reference box; by ``cx,cy,w,h`` and ``angle_deg`` or ``angle_rad``, from x towards y,
along ``w``; or by ``xyxyxyxy``, a list, as supervision writes it. Upper and lower case are the
same, and columns may have the names that other tools give them, see `table_columns`.

With a column of WKT::

    image,class,score,wkt
    P0706,ship,0.9,"POLYGON ((284 466, 274 456, 300 427, 310 439, 284 466))"

The geometry is in the first column that is called ``wkt``, ``geometry``, ``geom`` or ``the_geom``;
otherwise in the first one whose first value is a polygon. ``image``, ``class``, ``score`` and
``instance`` or ``id`` may be absent, and others are kept. Upper and lower case are the same.
Coordinates are in the reference system of ``SRID=…;`` before the geometry, or
pixels or degrees, see `obbhbb_ros.labels.maps`. Rows without an image name belong to an image named
after the file.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from functools import partial
from itertools import chain
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.documents import parse_difficulty
from obbhbb_ros.labels.documents import property_text
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import only_if_any
from obbhbb_ros.labels.image_grouper import ImageGrouper
from obbhbb_ros.labels.image_labels import DIAGNOSTICS
from obbhbb_ros.labels.image_labels import MIN_HULL_POINTS
from obbhbb_ros.labels.image_labels import AnyImage
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Item
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.table_columns import BOUNDS
from obbhbb_ros.labels.table_columns import COLUMNS
from obbhbb_ros.labels.table_columns import CORNER_LIST
from obbhbb_ros.labels.table_columns import CORNERS
from obbhbb_ros.labels.table_columns import IN_DEGREES
from obbhbb_ros.labels.table_columns import IN_RADIANS
from obbhbb_ros.labels.table_columns import NAMES
from obbhbb_ros.labels.table_columns import REFERENCE
from obbhbb_ros.labels.table_columns import box_columns
from obbhbb_ros.labels.table_columns import has_boxes
from obbhbb_ros.labels.table_rows import row_blocks
from obbhbb_ros.labels.table_rows import table_rows

BOX_COLUMNS = (*NAMES, 'score', *BOUNDS)
MARKS = ('crowd', 'difficulty')
GEOMETRY = ('wkt', 'geometry', 'geom', 'the_geom')
BRACKETS = str.maketrans('[],', '   ')
RESERVED = (*COLUMNS, *BOUNDS, *MARKS, *GEOMETRY)
# What the csv module puts in quotes, besides commas and line feeds.
QUOTED = re.compile('["\r]')
POLYGON = re.compile(r'\s*(SRID\s*=\s*\d+\s*;)?\s*(MULTI)?POLYGON\b', re.IGNORECASE)
POLYGON_FIELD = re.compile(f'(^|,)"?{POLYGON.pattern}', re.IGNORECASE)
SRID = re.compile(r'\s*SRID\s*=\s*(\d{1,9})\s*;', re.IGNORECASE)


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    blocks = row_blocks(file)
    numbers, lines = next(blocks, ((), ('',)))
    _, (columns, shape) = _header(file, lines[0], next(iter(numbers), None), box_columns)
    rest = chain([(numbers[1:], lines[1:])], blocks)
    images = ImageGrouper()
    for part in file.parse_blocks(rest, partial(_parse_lines, file, columns, shape)):
        images.add(*part)
    return images.images()


def _read_wkt(file: LabelFile) -> Iterator[ImageLabels]:
    system = OnlySystem()
    records = _read_rows(file, partial(_wkt_row_parser, file.path.stem, system))
    return maps.map_images(file, records, system.settle)


class OnlySystem:
    """The reference system that the rows of a table have in common; rows may leave it out."""

    def __init__(self) -> None:
        self._crs: str | None = None

    def check(self, crs: str) -> None:
        """Raise ValueError if a row names another system than the rows above."""
        if crs and self._crs is None:
            self._crs = crs
        elif crs and crs != self._crs:
            raise ValueError(f'{crs}, but the rows above have {self._crs or "none"}')

    def settle(self) -> str | None:
        """Return the system; if it is None, no row below may name one."""
        crs, self._crs = self._crs, self._crs or ''
        return crs


def _read_rows(
    file: LabelFile, parser_for: Callable[[list[str]], Callable[[list[str]], Item]]
) -> Iterator[Record[Item]]:
    """Parse the rows below a header; `parser_for` makes the row parser from the column names."""
    lines = table_rows(file)
    number, _, header = next(lines, (None, '', ''))
    columns, parse = _header(file, header, number, parser_for)

    def parse_line(line: str) -> Item:
        fields = text.split_row(line)
        if len(fields) != len(columns):
            raise ValueError(f'{len(fields)} fields, the header has {len(columns)}')
        return parse(fields)

    return file.parse_records(lines, parse_line)


def _header(
    file: LabelFile, line: str, number: int | None, check: Callable[[list[str]], Item]
) -> tuple[list[str], Item]:
    """Return the names of the columns, and what `check` makes of them."""
    try:
        columns = [column.strip() for column in text.split_row(line)]
        if len(columns) == 1 and line.strip():
            raise ValueError(text.describe_text(line))
        return columns, check(columns)
    except ValueError as error:
        raise file.error(str(error), number) from None


def _parse_lines(
    file: LabelFile, columns: Sequence[str], shape: Sequence[str], lines: Sequence[str]
) -> tuple[Sequence[str], Sequence[bool], ImageLabels]:
    """
    Parse rows; `shape` names the columns of the corners or of the bounds.

    Returns the image of each row, whether it has a box, and the boxes.
    """
    rows = text.split_rows(lines)
    if {*map(len, rows)} != {len(columns)}:
        raise ValueError(f'{len(rows[0])} fields, the header has {len(columns)}')
    table = dict(zip(columns, zip(*rows, strict=True), strict=True))
    images = table.setdefault('image', (file.path.stem,) * len(rows))
    table.setdefault('instance', ('',) * len(rows))
    filled = [True] * len(rows)
    if not all(images):
        raise ValueError('no image name')
    if not all(table[shape[0]]):
        # A column without a name is the row number of pandas.
        fields = zip(*(table[name] for name in columns if name), strict=True)
        filled = [sum(map(bool, row)) != 1 for row in fields]
        table = {name: tuple(compress(values, filled)) for name, values in table.items()}
    return images, filled, _parse_boxes(file, table, shape)


def _parse_boxes(
    file: LabelFile, table: Mapping[str, Sequence[str]], shape: Sequence[str]
) -> ImageLabels:
    """Turn columns of N fields into N boxes."""
    count = len(table['image'])
    if shape is CORNER_LIST:
        coordinates = np.array(list(map(_parse_corner_list, table[CORNER_LIST[0]]))).reshape(-1, 8)
    else:
        coordinates = text.parse_columns([table[name] for name in shape])
    reference = _parse_reference([table.get(name, ('',) * count) for name in REFERENCE])
    if shape is BOUNDS:
        corners = shapes.upright_rows(coordinates)
    elif shape in (IN_DEGREES, IN_RADIANS):
        corners = _oriented_rows(coordinates, shape is IN_DEGREES)
    else:
        corners = coordinates.reshape(-1, 4, 2)
    if shape is BOUNDS:
        reference = np.where(np.isnan(reference), coordinates, reference)
    masks = table.get('mask', ())
    return ImageLabels(
        image='',
        corners=corners,
        class_ids=tuple(map(sys.intern, table['class'])),
        ids=tuple(map(sys.intern, table['instance'])),
        scores=text.parse_scores(table.get('score', ('',) * count)),
        reference=reference,
        hulls=tuple(map(_parse_hull, masks)) if any(masks) else (None,) * count,
        size=file.image_size,
        source=file.path,
        extras=_parse_extras(table, known={*COLUMNS, *shape, *MARKS}),
    )


def _parse_extras(table: Mapping[str, Sequence[str]], known: Collection[str]) -> Extras:
    """Keep the columns that are not `known`; one without a name is the row number of pandas."""
    crowds = map(shapes.parse_crowd, table.get('crowd', ()))
    difficulties = map(parse_difficulty, table.get('difficulty', ()))
    return Extras(
        crowd=only_if_any(crowds, np.bool_),
        difficulty=only_if_any(difficulties, np.int64),
        properties={
            name: tuple(value or None for value in values)
            for name, values in table.items()
            if name and name not in known
        },
    )


def _parse_corner_list(field: str) -> list[float]:
    numbers = text.parse_numbers(field.translate(BRACKETS).split())
    if len(numbers) != len(CORNERS):
        raise ValueError(f'xyxyxyxy has {len(numbers)} numbers, expected 8')
    return numbers


def _oriented_rows(xywhr: FloatArray, degrees: bool) -> FloatArray:
    """Return the corners, (N, 4, 2), of boxes given by centre, size and angle, (N, 5)."""
    if any(max(row[:4]) <= 1.0 for row in xywhr.tolist()):
        raise ValueError('a box within a pixel: are the numbers fractions of the image?')
    angles = np.radians(xywhr[:, 4]) if degrees else xywhr[:, 4]
    rows = np.column_stack((xywhr[:, :4], angles)).tolist()
    corners = [shapes.oriented_corners(*row) for row in rows]
    return np.array(corners, np.float64).reshape(-1, 4, 2)


def _parse_reference(columns: Sequence[Sequence[str]]) -> FloatArray:
    """Parse the reference boxes, (N, 4), NaN where all four fields are blank."""
    given = list(map(any, zip(*columns, strict=True)))
    reference = np.full((len(given), 4), np.nan)
    if any(given):
        reference[given] = text.parse_columns(
            [tuple(compress(column, given)) for column in columns]
        )
    return reference


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
    default_image: str, only: OnlySystem, columns: list[str]
) -> Callable[[list[str]], shapes.Outlined]:
    """Return the parser of a row, which checks its reference system."""
    index = next((columns.index(name) for name in columns if name.lower() in GEOMETRY), None)

    def parse(fields: list[str]) -> shapes.Outlined:
        nonlocal index
        if index is None:
            index = _geometry_index(columns, fields)
        system, rings = _wkt_rings(fields[index])
        only.check(system)
        row = {name: value or None for name, value in zip(columns, fields, strict=True)}
        del row[columns[index]]
        return shapes.feature_record(default_image, row, rings)

    return parse


def _geometry_index(columns: Sequence[str], fields: Sequence[str]) -> int:
    """Return the number of the only field that is a polygon; raise ValueError for none, or two."""
    polygons = [index for index, field in enumerate(fields) if POLYGON.match(field)]
    if len(polygons) > 1:
        several = ', '.join(columns[index] for index in polygons)
        raise ValueError(f'several columns of WKT ({several}): call the one of the ships wkt')
    if not polygons:
        raise ValueError(f'no column of WKT: {", ".join(GEOMETRY)} (header: {",".join(columns)})')
    return polygons[0]


def _wkt_rings(wkt: str) -> tuple[str, list[FloatArray]]:
    """Return the reference system, '' for none, and the rings of a geometry."""
    code = SRID.match(wkt)
    try:
        # Infinite coordinates are reported with the box.
        with np.errstate(over='ignore', invalid='ignore'):
            geometry = shapely.from_wkt(wkt[code.end() :] if code else wkt)
    except shapely.errors.GEOSException as error:
        raise ValueError(f'not WKT: {error}') from None
    return f'EPSG:{code[1]}' if code and int(code[1]) else '', shapes.outer_rings(geometry)


def _write(path: Path, images: list[ImageLabels]) -> None:
    scored = any(np.any(labels.scores != 1.0) for labels in images)
    columns = COLUMNS if scored else COLUMNS[:-1]
    text.write_lines(path, _table_lines(columns, images, _label_columns))


def _label_columns(labels: ImageLabels) -> list[Sequence[str]]:
    numbers = np.hstack((labels.corners.reshape(-1, 8), labels.reference)).T
    masks = list(map(_mask, labels.hulls))
    return [labels.ids, labels.class_ids, *map(_texts, numbers), masks, _texts(labels.scores)]


def _mask(hull: FloatArray | None) -> str:
    return '' if hull is None else ';'.join(text.join_numbers(point) for point in hull.tolist())


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    diagnosed = any(image.diagnostics is not None for image in images)
    own = (*BOX_COLUMNS, *DIAGNOSTICS) if diagnosed else BOX_COLUMNS
    marks = [
        name for name in MARKS if any(getattr(image.extras, name) is not None for image in images)
    ]
    names = dict.fromkeys(name for image in images for name in image.extras.properties)
    others = [name for name in names if name.lower() not in {*own, *RESERVED}]
    columns_of = partial(_box_columns, marks, others, diagnosed)
    text.write_lines(path, _table_lines((*own, *marks, *others), images, columns_of))


def _box_columns(
    marks: Sequence[str], others: Sequence[str], diagnosed: bool, image: ImageBoxes
) -> list[Sequence[str]]:
    blank = ('',) * len(image.class_ids)
    numbers = [image.scores, *image.xyxy.T]
    if image.diagnostics is not None:
        numbers += [getattr(image.diagnostics, name) for name in DIAGNOSTICS]
    columns = [image.ids, image.class_ids, *map(_texts, numbers)]
    if diagnosed and image.diagnostics is None:
        columns += [blank] * len(DIAGNOSTICS)
    given = [getattr(image.extras, name) for name in marks]
    columns += [blank if values is None else _texts(values.astype(np.int64)) for values in given]
    properties = image.extras.properties
    return columns + [list(map(property_text, properties.get(name, blank))) for name in others]


def _texts(values: npt.NDArray[Any]) -> list[str]:
    """Turn numbers into the shortest text that reads back unchanged; NaN into ''."""
    if values.dtype == np.bool_:
        return [str(int(value)) for value in values]
    texts = list(map(repr, values.tolist()))
    for row in np.flatnonzero(np.isnan(values)).tolist():
        texts[row] = ''
    return texts


def _table_lines(
    columns: Sequence[str],
    images: Iterable[AnyImage],
    columns_of: Callable[[AnyImage], list[Sequence[str]]],
) -> Iterator[str]:
    """Return one row per box, and one row with only the name for an image without boxes."""
    yield _join_rows([[name] for name in columns])
    for image in images:
        if not image.image:
            raise ValueError(f'a table cannot hold an image without a name (from {image.source})')
        count = max(len(image.class_ids), 1)
        texts: list[Sequence[str]] = [[image.image] * count]
        texts += columns_of(image) if image.class_ids else []
        texts += [[''] * count] * len(columns)
        yield _join_rows(texts[: len(columns)])


def _join_rows(columns: Sequence[Sequence[str]]) -> str:
    """Join columns of N fields to N rows."""
    lines = list(map(','.join, zip(*columns, strict=True)))
    joined = '\n'.join(lines)
    commas, breaks = (len(columns) - 1) * len(lines), len(lines) - 1
    if joined.count(',') == commas and joined.count('\n') == breaks and not QUOTED.search(joined):
        return joined
    rows = io.StringIO()
    # With these ends, it puts both kinds of line break in quotes.
    csv.writer(rows, lineterminator='\r\n').writerows(zip(*columns, strict=True))
    return rows.getvalue().replace('\r\n', '\n').removesuffix('\n')


def _sniff(head: str) -> bool:
    return has_boxes(_first_columns(head))


def _sniff_wkt(head: str) -> bool:
    lines = [line for line in head.splitlines() if line.strip()][:2]
    columns = _first_columns(head)
    named = any(column.lower() in GEOMETRY for column in columns)
    if named or has_boxes(columns):
        return named
    return len(lines) > 1 and POLYGON_FIELD.search(lines[1]) is not None


def _first_columns(head: str) -> Sequence[str]:
    first = next((line for line in head.splitlines() if line.strip()), '')
    return [column.strip(' "') for column in first.split(',')]


CORNER_TABLE = Format(
    name='csv',
    suffixes=('.csv',),
    summary=(
        f'CSV of many images, one box per row: {",".join(COLUMNS[:-1])}; '
        f'or {",".join(BOUNDS)}, or {",".join(IN_DEGREES)} (or angle_rad) instead of the corners'
    ),
    sniff=_sniff,
    read=_read,
    write=_write,
    write_boxes=_write_boxes,
    holds=(
        'diagnostics',
        'scores',
        'ids',
        'crowd marks',
        'difficulties',
        'properties',
        'images without boxes',
    ),
    reserved=RESERVED,
)
WKT_TABLE = Format(
    name='wkt',
    suffixes=('.csv',),
    summary='CSV with a column wkt or geometry of polygons, and image,class,score,instance',
    sniff=_sniff_wkt,
    read=_read_wkt,
)
