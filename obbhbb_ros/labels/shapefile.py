# SPDX-License-Identifier: Apache-2.0
"""
ESRI shapefile of polygons, one ship a feature; takes the extra `geo` (GeoPandas).

The fields ``image``, ``class``, ``score`` and ``instance`` or ``id`` may be absent, and others are
ignored. Coordinates are taken as they are and called pixels, see `geojson`; the reference system
in the ``.prj`` file is neither looked at nor written. Features that name no image belong to one
that is named after the file.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from obbhbb_ros.files import replacing_all
from obbhbb_ros.labels.converted import DIAGNOSTICS
from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.features import converted_features
from obbhbb_ros.labels.features import feature_record
from obbhbb_ros.labels.features import outer_rings
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.shapes import by_image
from obbhbb_ros.labels.shapes import enclose

DRIVER = 'ESRI Shapefile'
# Of the features that were there before.
INDEXES = ('.qix', '.sbn', '.sbx')
FILE_CODE = '\x00\x00\x27\x0a'
MAX_TEXT_BYTES = 254


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the images of a shapefile in the order in which it first names them.

    Parameters
    ----------
    path : Path
        The ``.shp`` file; those that belong to it lie beside it.
    image_size : tuple of int or None
        Width and height in pixels, passed on to the labels; the format does not need it.
    on_error : callable
        Gets a LabelError for each malformed feature, with its number from 0 as GIS tools count,
        or one where the file cannot be read.

    Yields
    ------
    ImageLabels
        At least one, which may have no boxes.

    Raises
    ------
    ImportError
        If GeoPandas is not installed.
    """
    try:
        frame = _frame(path)
    except LabelError as error:
        on_error(error)
        return
    fields = frame.drop(columns='geometry', errors='ignore').to_dict('records')
    geometries = frame.geometry if 'geometry' in frame else [None] * len(fields)
    records = []
    for index, (properties, geometry) in enumerate(zip(fields, geometries, strict=True)):
        place = f'feature {index}: '
        try:
            rings = outer_rings(geometry)
            records.append(feature_record(path.stem, place, None, properties, rings))
        except ValueError as error:
            on_error(LabelError(path, None, f'{place}{error}'))
    images = by_image(enclose(path, records, on_error)) or {path.stem: []}
    for image, boxes in images.items():
        yield assemble(image, boxes, image_size, path)


def _frame(path: Path) -> Any:
    import geopandas

    try:
        return geopandas.read_file(path)
    except ImportError:
        raise
    except Exception as error:
        # As wide as that because the two engines of GeoPandas raise what they like.
        raise LabelError(path, None, f'not a shapefile: {error}') from error


def write_boxes(path: Path, images: list[ConvertedImage]) -> None:
    """
    Write all boxes to one shapefile, each as a polygon with fields.

    Images without boxes have no feature, and an unknown diagnostic is null.

    Parameters
    ----------
    path : Path
        The ``.shp`` file; three others go beside it.
    images : list of ConvertedImage
        The images.

    Raises
    ------
    ValueError
        If the path has another suffix, or a text is longer than the 254 bytes of a field.
    OSError
        If it cannot be written.
    ImportError
        If GeoPandas is not installed.
    """
    import geopandas

    if path.suffix.lower() != '.shp':
        raise ValueError(f'{path}: a shapefile ends in .shp')
    properties, boxes = converted_features(images)
    _check_texts(properties)
    frame = geopandas.GeoDataFrame(_columns(properties), geometry=shapely.box(*boxes.T))
    # A file without features has to be told what it is without features of; one engine can.
    options = {'engine': 'pyogrio', 'geometry_type': 'Polygon'} if frame.empty else {}
    with replacing_all(path, INDEXES) as whole, warnings.catch_warnings():
        # It says that there is no reference system; there is none to write.
        warnings.filterwarnings('ignore', message=".*'crs' was not provided", category=UserWarning)
        try:
            frame.to_file(whole, driver=DRIVER, encoding='UTF-8', **options)
            # A full disk may show only in what is missing.
            written = len(geopandas.read_file(whole))
        except ImportError:
            raise
        except Exception as error:
            # As wide as that because the two engines of GeoPandas raise what they like.
            raise OSError(f'{path}: cannot be written: {error}') from error
        if written != len(frame):
            raise OSError(f'{path}: cannot be written: {written} of {len(frame)} boxes are there')


def _check_texts(properties: list[dict[str, Any]]) -> None:
    for fields in properties:
        for name, value in fields.items():
            if isinstance(value, str) and len(value.encode()) > MAX_TEXT_BYTES:
                raise ValueError(f'{name} {value!r} is too long for a shapefile')


def _columns(properties: list[dict[str, Any]]) -> dict[str, Any]:
    texts = ('image', 'instance', 'class')
    columns: dict[str, Any] = {
        name: np.array([fields[name] for fields in properties], dtype=object) for name in texts
    }
    columns['score'] = np.array([fields['score'] for fields in properties], dtype=np.float64)
    diagnosed = any(DIAGNOSTICS[0] in fields for fields in properties)
    for name in DIAGNOSTICS if diagnosed else ():
        # None becomes NaN, which is written as null.
        values = np.array([fields.get(name) for fields in properties], dtype=np.float64)
        columns[name] = values.astype(np.int32) if name == 'capped' else values
    return columns


def sniff(head: str) -> bool:
    """Tell whether the file code of a shapefile is there."""
    return head.startswith(FILE_CODE)


FORMAT = Format(
    name='shapefile',
    suffixes=('.shp',),
    summary='ESRI shapefile of polygons, with fields image, class, score, id (extra `geo`)',
    read=read,
    write=None,
    sniff=sniff,
    write_boxes=write_boxes,
    holds_diagnostics=True,
)
