# SPDX-License-Identifier: Apache-2.0
"""
ESRI shapefile of polygons, one ship per feature; needs the extra `geo` (GeoPandas).

The fields ``image``, ``class``, ``score`` and ``instance`` or ``id`` may be absent, and others are
ignored. Coordinates are read as pixels, see `geojson`; the reference system in the ``.prj`` file is
neither read nor written. Features that name no image belong to an image named after the file.
Errors give the number of a feature from 0, as GIS tools count. Images without boxes have no
feature, and an unknown diagnostic is null.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from obbhbb_ros.files import replacing_all
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.image_labels import DIAGNOSTICS
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

DRIVER = 'ESRI Shapefile'
# Indexes of a file that is replaced; they would not match the new features.
INDEXES = ('.qix', '.sbn', '.sbx')
FILE_CODE = '\x00\x00\x27\x0a'
MAX_TEXT_BYTES = 254


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    import geopandas

    try:
        frame = geopandas.read_file(file.path)
    except ImportError:
        raise
    except Exception as error:
        # Any exception: the two engines of GeoPandas raise errors of many kinds.
        raise file.error(f'not a shapefile: {error}') from error
    fields = frame.drop(columns='geometry', errors='ignore').to_dict('records')
    geometries = frame.geometry if 'geometry' in frame else [None] * len(fields)
    features = (
        (None, f'feature {index}: ', feature)
        for index, feature in enumerate(zip(fields, geometries, strict=True))
    )
    records = file.parse_records(features, partial(_record, file.path.stem))
    return file.images(shapes.enclose(file, records) or {file.path.stem: []})


def _record(default_image: str, feature: tuple[dict[str, Any], Any]) -> shapes.Outlined:
    properties, geometry = feature
    return shapes.feature_record(default_image, properties, shapes.outer_rings(geometry))


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    import geopandas

    if path.suffix.lower() != '.shp':
        raise ValueError(f'{path}: a shapefile ends in .shp')
    properties, boxes = shapes.box_features(images)
    for name, value in (item for fields in properties for item in fields.items()):
        if isinstance(value, str) and len(value.encode()) > MAX_TEXT_BYTES:
            raise ValueError(f'{name} {value!r} is too long for a shapefile')
    frame = geopandas.GeoDataFrame(_columns(properties), geometry=shapely.box(*boxes.T))
    # An empty file needs the type of geometry, which only pyogrio accepts.
    options = {'engine': 'pyogrio', 'geometry_type': 'Polygon'} if frame.empty else {}
    with replacing_all(path, INDEXES) as whole, warnings.catch_warnings():
        # The warning is about a missing reference system; there is none to write.
        warnings.filterwarnings('ignore', message=".*'crs' was not provided", category=UserWarning)
        try:
            frame.to_file(whole, driver=DRIVER, encoding='UTF-8', **options)
            # A full disk may only show as missing features.
            written = len(geopandas.read_file(whole))
        except ImportError:
            raise
        except Exception as error:
            # Any exception, as in `_read`.
            raise OSError(f'{path}: cannot be written: {error}') from error
        if written != len(frame):
            raise OSError(f'{path}: only {written} of {len(frame)} boxes were written')


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


FORMAT = Format(
    name='shapefile',
    suffixes=('.shp',),
    summary='ESRI shapefile of polygons, with fields image, class, score, id (extra `geo`)',
    sniff=lambda head: head.startswith(FILE_CODE),
    read=_read,
    write_boxes=_write_boxes,
    holds=('diagnostics', 'scores', 'ids'),
)
