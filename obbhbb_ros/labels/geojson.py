# SPDX-License-Identifier: Apache-2.0
"""
GeoJSON: a FeatureCollection of polygons, one ship a feature.

::

    {"type": "FeatureCollection", "features": [
      {"type": "Feature", "id": 7, "properties": {"image": "P0706", "class": "ship", "score": 0.9},
       "geometry": {"type": "Polygon", "coordinates": [[[284, 466], [274, 456], [300, 427]]]}}]}

Coordinates are taken as they are and called pixels; their reference system is neither looked at
nor written. Axis-aligned is along its axes, and both axes need the same unit: give metres or
pixels, not degrees. The oriented box is the minimum rotated rectangle of the polygon, or of all
parts of a multi-polygon. Features that name no image belong to one that is named after the file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

from obbhbb_ros.files import write_pieces
from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.documents import json_member
from obbhbb_ros.labels.documents import read_json
from obbhbb_ros.labels.features import converted_features
from obbhbb_ros.labels.features import feature_record
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.shapes import Outlined
from obbhbb_ros.labels.shapes import by_image
from obbhbb_ros.labels.shapes import enclose
from obbhbb_ros.labels.shapes import ring_of

MARKS = ('"FeatureCollection"', '"Feature"')


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the images of a GeoJSON file in the order in which it first names them.

    Parameters
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height in pixels, passed on to the labels; the format does not need it.
    on_error : callable
        Gets a LabelError for each malformed feature, with its place as ``features[3]``, or one
        where the file is no GeoJSON.

    Yields
    ------
    ImageLabels
        At least one, which may have no boxes.
    """
    try:
        features = _features(path, read_json(path, _shorten))
    except LabelError as error:
        on_error(error)
        return
    records, stem = [], path.stem
    for index, feature in enumerate(features):
        try:
            records.append(_record(stem, f'features[{index}]: ', feature))
            # A long file is held once: as the feature goes, the record comes.
            features[index] = None
        except ValueError as error:
            on_error(LabelError(path, None, f'features[{index}]: {error}'))
    images = by_image(enclose(path, records, on_error)) or {path.stem: []}
    for image, boxes in images.items():
        yield assemble(image, boxes, image_size, path)


def _shorten(member: dict[str, Any]) -> dict[str, Any]:
    """Keep the outer rings of a polygon as arrays, a tenth of what lists of lists take."""
    if member.get('type') in ('Polygon', 'MultiPolygon'):
        try:
            member['coordinates'] = _Rings(_outer_rings(member))
        except ValueError as error:
            member['coordinates'] = _Rings(error=error)
    return member


class _Rings:
    """The outer rings of a polygon, or why it has none."""

    __slots__ = ('_error', '_rings')

    def __init__(
        self, rings: list[FloatArray] | None = None, error: ValueError | None = None
    ) -> None:
        self._rings, self._error = rings, error

    def get(self) -> list[FloatArray]:
        """Give the rings, or raise the error where it can be told which feature it is."""
        if self._error is not None:
            raise self._error
        return self._rings or []


def _features(path: Path, document: Any) -> list[Any]:
    kind = document.get('type') if isinstance(document, dict) else None
    if kind == 'Feature':
        return [document]
    if kind != 'FeatureCollection' or not isinstance(document.get('features'), list):
        raise LabelError(path, None, 'not GeoJSON: no FeatureCollection with an array of features')
    return list(document['features'])


def _record(default_image: str, place: str, feature: object) -> Outlined:
    geometry = json_member(feature, 'geometry')
    properties = json_member(feature, 'properties') or {}
    if not isinstance(properties, dict):
        raise ValueError("'properties' is not a JSON object")
    own_id = {} if not isinstance(feature, dict) else {'id': feature.get('id')}
    # An id among the properties is the user's own; the one beside them may be a running number.
    fields = {**own_id, **properties}
    return feature_record(default_image, place, None, fields, _rings(geometry))


def _rings(geometry: object) -> list[FloatArray]:
    if geometry is None:
        raise ValueError('no geometry')
    kind = json_member(geometry, 'type')
    if kind not in ('Polygon', 'MultiPolygon'):
        raise ValueError(f'a {kind} is no polygon')
    rings: _Rings = json_member(geometry, 'coordinates')
    return rings.get()


def _outer_rings(geometry: dict[str, Any]) -> list[FloatArray]:
    coordinates = json_member(geometry, 'coordinates')
    polygons = [coordinates] if geometry['type'] == 'Polygon' else coordinates
    if not isinstance(polygons, list) or not all(isinstance(each, list) for each in polygons):
        raise ValueError("'coordinates' is not an array of rings")
    # The first ring is the outer one, the others are holes.
    return [ring_of(polygon[0]) for polygon in polygons if polygon]


def write_boxes(path: Path, images: list[ConvertedImage]) -> None:
    """
    Write all boxes to one file, each as a polygon with properties.

    Images without boxes have no feature. There are no diagnostics but where they are given.

    Parameters
    ----------
    path : Path
        The file.
    images : list of ConvertedImage
        The images.
    """
    properties, bounds = converted_features(images)
    boxes = bounds.tolist()
    dump = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
    features = (
        f'{", " if index else ""}'
        + dump({'type': 'Feature', 'properties': fields, 'geometry': _polygon(*boxes[index])})
        for index, fields in enumerate(properties)
    )
    write_pieces(path, chain(['{"type": "FeatureCollection", "features": ['], features, [']}\n']))


def _polygon(x_min: float, y_min: float, x_max: float, y_max: float) -> dict[str, object]:
    # Counter-clockwise where y is up, as the standard asks of an outer ring.
    ring = [[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max], [x_min, y_min]]
    return {'type': 'Polygon', 'coordinates': [ring]}


def sniff(head: str) -> bool:
    """Tell whether a type of GeoJSON is there."""
    return any(mark in head for mark in MARKS)


FORMAT = Format(
    name='geojson',
    suffixes=('.geojson', '.json'),
    summary='GeoJSON features of polygons, with properties image, class, score, id',
    read=read,
    write=None,
    sniff=sniff,
    write_boxes=write_boxes,
    holds_diagnostics=True,
)
