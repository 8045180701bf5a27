# SPDX-License-Identifier: Apache-2.0
"""GeoPackage: one table of polygons, see `vector_files`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import vector_files
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    return vector_files.read_features(file, 'a GeoPackage')


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    vector_files.write_features(path, 'GPKG', images, **vector_files.GEOPACKAGE_OPTIONS)


FORMAT = Format(
    name='geopackage',
    suffixes=('.gpkg',),
    summary='GeoPackage of polygons, with fields image, class, score, id (extra `geo`)',
    sniff=lambda head: head.startswith('SQLite format 3'),
    read=_read,
    write_boxes=_write_boxes,
    holds=shapes.FEATURES_HOLD,
    reserved=vector_files.RESERVED,
)
