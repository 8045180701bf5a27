# SPDX-License-Identifier: Apache-2.0
"""
CSV with a column of WKT: one file of many images, one polygon a row.

::

    image,class,score,wkt
    P0706,ship,0.9,"POLYGON ((284 466, 274 456, 300 427, 310 439, 284 466))"

The geometry is in the first column that is called ``wkt``, ``geometry``, ``geom`` or ``the_geom``;
``image``, ``class``, ``score`` and ``instance`` or ``id`` may be absent, and others are ignored.
Upper and lower case are the same. Coordinates are taken as they are and called pixels, see
`geojson`; an ``SRID=…;`` before the geometry is ignored. Rows that name no image belong to one that
is named after the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import shapely

from obbhbb_ros.labels.features import feature_record
from obbhbb_ros.labels.features import outer_rings
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.rows import ParseRow
from obbhbb_ros.labels.rows import first_columns
from obbhbb_ros.labels.rows import read_rows
from obbhbb_ros.labels.shapes import Outlined
from obbhbb_ros.labels.shapes import by_image
from obbhbb_ros.labels.shapes import enclose

GEOMETRY = ('wkt', 'geometry', 'geom', 'the_geom')
SRID = re.compile(r'\s*SRID\s*=\s*\d+\s*;', re.IGNORECASE)


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the images of a CSV file with WKT in the order in which it first names them.

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
    rows = read_rows(path, on_error, partial(_header, path.stem))
    records = [record._replace(line=line) for line, record in rows]
    for image, boxes in by_image(enclose(path, records, on_error)).items():
        yield assemble(image, boxes, image_size, path)


def _header(default_image: str, columns: list[str]) -> ParseRow[Outlined]:
    lower = [column.lower() for column in columns]
    geometry = next((name for name in GEOMETRY if name in lower), None)
    if geometry is None:
        raise ValueError(f'no column of WKT: {", ".join(GEOMETRY)} (header: {",".join(columns)})')
    place = lower.index(geometry)

    def parse(fields: list[str]) -> Outlined:
        properties = dict(zip(lower, fields, strict=True))
        return feature_record(default_image, '', None, properties, _rings(fields[place]))

    return parse


def _rings(text: str) -> list[FloatArray]:
    try:
        geometry = shapely.from_wkt(SRID.sub('', text, count=1))
    except shapely.errors.GEOSException as error:
        raise ValueError(f'not WKT: {error}') from None
    return outer_rings(geometry)


def sniff(head: str) -> bool:
    """Tell whether the first line names a column of WKT."""
    return any(column.lower() in GEOMETRY for column in first_columns(head))


FORMAT = Format(
    name='wkt',
    suffixes=('.csv',),
    summary='CSV with a column wkt or geometry of polygons, and image,class,score,instance',
    read=read,
    write=None,
    sniff=sniff,
)
