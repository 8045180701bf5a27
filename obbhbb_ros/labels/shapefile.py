# SPDX-License-Identifier: Apache-2.0
"""
ESRI shapefile of polygons, see `vector_files`.

The reference system is in the ``.prj`` file. A shapefile shortens the names of fields to ten
characters, and cannot hold texts of more than 254 bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import vector_files
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

DRIVER = 'ESRI Shapefile'
# Indexes and reference system of a file that is replaced; they would not match the new features.
STALE = ('.qix', '.sbn', '.sbx', '.prj', '.qpj')
FILE_CODE = '\x00\x00\x27\x0a'
MAX_TEXT_BYTES = 254
MAX_NAME_BYTES = 10


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    return vector_files.read_features(file, 'a shapefile')


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    if path.suffix.lower() != '.shp':
        raise ValueError(f'{path}: a shapefile ends in .shp')
    properties, _ = shapes.box_features(images, vector_files.RESERVED)
    for name, value in (item for fields in properties for item in fields.items()):
        if isinstance(value, str) and len(value.encode()) > MAX_TEXT_BYTES:
            raise ValueError(f'{name} {value!r} is too long for a shapefile')
    vector_files.write_features(path, DRIVER, images, STALE)


FORMAT = Format(
    name='shapefile',
    suffixes=('.shp',),
    summary='ESRI shapefile of polygons, with fields image, class, score, id (extra `geo`)',
    sniff=lambda head: head.startswith(FILE_CODE),
    read=_read,
    write_boxes=_write_boxes,
    holds=shapes.FEATURES_HOLD,
    reserved=vector_files.RESERVED,
    longest_name=MAX_NAME_BYTES,
)
