# SPDX-License-Identifier: Apache-2.0
"""
GeoJSON: a FeatureCollection of polygons, one ship per feature.

::

    {"type": "FeatureCollection", "features": [
      {"type": "Feature", "id": 7, "properties": {"image": "P0706", "class": "ship", "score": 0.9},
       "geometry": {"type": "Polygon", "coordinates": [[[284, 466], [274, 456], [300, 427]]]}}]}

Coordinates are pixels, or in the reference system of ``crs``, which is written again. Without one
they are in degrees, as the standard has it, if the ships are smaller than a tenth of a unit, see
`obbhbb_ros.labels.maps`. Boxes are aligned with the axes of the system. All other properties are
kept. The oriented box is the minimum rotated rectangle of the polygon, or of all parts of a
multi-polygon; four corners are a box. The ``id`` of a feature is that of its box, or the property
``feature_id`` if the properties have an id, too. Features that name no image belong to an image
named after the file. Images without boxes have no feature: a file without features is read as one
image without boxes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from obbhbb_ros.files import write_pieces
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import json_member
from obbhbb_ros.labels.documents import json_properties
from obbhbb_ros.labels.documents import numbered
from obbhbb_ros.labels.documents import plain_text
from obbhbb_ros.labels.documents import read_json
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

MARKS = ('"FeatureCollection"', '"Feature"')
POLYGONS = ('Polygon', 'MultiPolygon')
FEATURE_ID = 'feature_id'


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = read_json(file, _shorten)
    features = numbered('features', _consumed(_features(file, document)))
    records = file.parse_records(features, partial(_record, file.path.stem))
    crs = _system(file, document)
    return maps.map_images(file, records, lambda: crs)


def _system(file: LabelFile, document: dict[str, Any]) -> str | None:
    """Return the reference system, '' if it is null, and None if there is none."""
    if 'crs' not in document:
        return None
    if document['crs'] is None:
        return ''
    try:
        name = json_member(json_member(document['crs'], 'properties'), 'name')
    except ValueError as error:
        raise file.error(f"'crs' does not name a reference system: {error}") from None
    return maps.LONGITUDE_LATITUDE if str(name).endswith(':CRS84') else str(name)


def _shorten(member: dict[str, Any]) -> dict[str, Any]:
    """Replace the coordinates of a polygon by arrays of its outer rings: a tenth of the memory."""
    if member.get('type') in POLYGONS:
        try:
            member['coordinates'] = _outer_rings(member)
        except ValueError as error:
            # Raised by `_rings`, which knows the feature.
            member['coordinates'] = error
    return member


def _outer_rings(geometry: dict[str, Any]) -> list[FloatArray]:
    coordinates = json_member(geometry, 'coordinates')
    polygons = [coordinates] if geometry['type'] == 'Polygon' else coordinates
    if not isinstance(polygons, list) or not all(isinstance(rings, list) for rings in polygons):
        raise ValueError("'coordinates' is not an array of rings")
    # The first ring is the outer one, the others are holes.
    return [shapes.ring_of(polygon[0]) for polygon in polygons if polygon]


def _features(file: LabelFile, document: Any) -> list[Any]:
    kind = document.get('type') if isinstance(document, dict) else None
    if kind == 'Feature':
        return [document]
    if kind != 'FeatureCollection' or not isinstance(document.get('features'), list):
        raise file.error('not GeoJSON: no FeatureCollection with an array of features')
    return list(document['features'])


def _consumed(features: list[Any]) -> Iterator[Any]:
    """Yield the features and forget them, so that a large file is in memory only once."""
    for index, feature in enumerate(features):
        features[index] = None
        yield feature


def _record(default_image: str, feature: Any) -> shapes.Outlined:
    geometry = json_member(feature, 'geometry')
    properties = json_member(feature, 'properties') or {}
    if not isinstance(properties, dict):
        raise ValueError("'properties' is not a JSON object")
    rings, fields = _rings(geometry), json_properties(properties, ())
    record = shapes.feature_record(default_image, fields, rings, feature.get('id'))
    return _with_feature_id(record, feature.get('id'))


def _with_feature_id(record: shapes.Outlined, identifier: object) -> shapes.Outlined:
    """Keep the id of a feature as a property if a property is the id of its box."""
    # An id in the properties is the user's; the one of the feature may be a running number.
    box = record.box
    if plain_text(identifier) in ('', box.id):
        return record
    name = FEATURE_ID
    while name in box.properties:
        name += '_'
    properties = {**box.properties, **json_properties({name: identifier}, ())}
    return record._replace(box=box._replace(properties=properties))


def _rings(geometry: object) -> list[FloatArray]:
    if geometry is None:
        raise ValueError('no geometry')
    kind = json_member(geometry, 'type')
    if kind not in POLYGONS:
        raise ValueError(f'a {kind} is not a polygon')
    rings: list[FloatArray] | ValueError = json_member(geometry, 'coordinates')
    if isinstance(rings, ValueError):
        raise rings
    return rings


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    properties, boxes = shapes.box_features(images)
    crs = shapes.only_system(images)
    start = f'{{"type": "FeatureCollection", {_crs_member(crs)}"features": ['
    dump = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
    features = (
        f'{", " if index else ""}'
        + dump({'type': 'Feature', 'properties': fields, 'geometry': _polygon(*box)})
        for index, (fields, box) in enumerate(zip(properties, boxes.tolist(), strict=True))
    )
    write_pieces(path, chain([start], features, [']}\n']))


def _crs_member(crs: str) -> str:
    """Return the member that names a reference system; none for degrees, as the standard has it."""
    if not crs:
        return '"crs": null, '
    code = maps.code_of(crs)
    if code in (maps.LONGITUDE_LATITUDE, 'EPSG:4326'):
        return ''
    name = f'urn:ogc:def:crs:{code.replace(":", "::")}'
    return f'"crs": {json.dumps({"type": "name", "properties": {"name": name}})}, '


def _polygon(x_min: float, y_min: float, x_max: float, y_max: float) -> dict[str, object]:
    # Counter-clockwise if y is up, as the standard requires of an outer ring.
    ring = [[x_min, y_min], [x_max, y_min], [x_max, y_max], [x_min, y_max], [x_min, y_min]]
    return {'type': 'Polygon', 'coordinates': [ring]}


FORMAT = Format(
    name='geojson',
    suffixes=('.geojson', '.json'),
    summary='GeoJSON features of polygons, with properties image, class, score, id',
    sniff=lambda head: any(mark in head for mark in MARKS),
    read=_read,
    write_boxes=_write_boxes,
    holds=shapes.FEATURES_HOLD,
    reserved=shapes.FEATURE_FIELDS,
)
