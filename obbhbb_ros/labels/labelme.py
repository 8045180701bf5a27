# SPDX-License-Identifier: Apache-2.0
"""
LabelMe and X-AnyLabeling JSON: one file per image, in pixels.

::

    {"version": "6.3.1", "flags": {}, "imagePath": "P0706.png", "imageData": null,
     "imageHeight": 768, "imageWidth": 1024,
     "shapes": [{"label": "ship", "shape_type": "oriented_rectangle", "group_id": null, "flags": {},
                 "points": [[284, 466], [274, 456], [300, 427], [310, 439]]}]}

A shape is a box if its type is ``oriented_rectangle`` (LabelMe), ``rotation`` or ``quadrilateral``
(X-AnyLabeling), each of four corners; a ``rectangle`` of two opposite corners or of four is upright
and also the reference box. A ``polygon`` is a hull, unless it has four points. Other types are
reported and not read. The image is named after ``imagePath``; ``group_id`` is the id of a box,
``score`` its score, and ``difficult`` says that it is. Other members that are not empty are
properties.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.image_labels import MIN_HULL_POINTS
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_names import bare_name
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

CORNERED = ('oriented_rectangle', 'rotation', 'quadrilateral')
# The direction of a rotated box is that of its first edge.
KNOWN = ('points', 'label', 'shape_type', 'score', 'group_id', 'difficult', 'direction', 'mask')
OF_IMAGE = ('shapes', 'version', 'imagePath', 'imageData', 'imageHeight', 'imageWidth')


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    if not isinstance(document, dict) or not isinstance(document.get('shapes'), list):
        raise file.error("not LabelMe: no array 'shapes'")
    name = _image_name(document.get('imagePath')) or file.path.stem
    size = documents.image_size_of(document.get('imageWidth'), document.get('imageHeight'))
    records = file.parse_records(
        documents.numbered('shapes', document['shapes']), partial(_shape, name)
    )
    boxes = shapes.enclose(file, records).get(name, [])
    others = tuple(member for member, value in document.items() if value and member not in OF_IMAGE)
    yield file.image(name, boxes, size, label_set=LabelSet(others=others))


def _image_name(path: object) -> str:
    try:
        return bare_name(documents.plain_text(path)) if isinstance(path, str) else ''
    except ValueError:
        return ''


def _shape(image: str, shape: Any) -> shapes.Outlined:
    points = _points(documents.json_member(shape, 'points'))
    # Old files have no types: their shapes are polygons.
    kind = shape.get('shape_type')
    kind = 'polygon' if kind is None else kind
    if not isinstance(kind, str) or kind not in READERS:
        raise ValueError(f'a shape of type {kind!r} is not read, only {", ".join(READERS)}')
    score = shape.get('score')
    box = Box(
        corners=(),
        class_id=documents.plain_text(documents.json_member(shape, 'label')),
        id=documents.plain_text(shape.get('group_id')),
        score=1.0 if score is None else documents.json_number(score, 'score'),
        difficulty=int(shape.get('difficult') is True),
        properties=documents.json_properties({n: v for n, v in shape.items() if v}, KNOWN),
    )
    return READERS[kind](image, box, points)


def _points(values: object) -> FloatArray:
    if not isinstance(values, list):
        raise ValueError('points is not an array')
    points = [documents.json_numbers(point, 2, 'a point') for point in values]
    return np.array(points, np.float64).reshape(-1, 2)


def _cornered(image: str, box: Box, points: FloatArray) -> shapes.Outlined:
    if len(points) != shapes.BOX_CORNERS:
        raise ValueError(f'an oriented box of {len(points)} points, expected 4')
    return shapes.Outlined(image, box, [points])


def _polygon(image: str, box: Box, points: FloatArray) -> shapes.Outlined:
    if len(points) < MIN_HULL_POINTS:
        raise ValueError(f'a polygon of {len(points)} points, expected at least 3')
    return shapes.Outlined(image, box, [points])


def _rectangle(image: str, box: Box, points: FloatArray) -> shapes.Outlined:
    if len(points) == 2:
        bounds = [*points.min(axis=0).tolist(), *points.max(axis=0).tolist()]
        upright = shapes.upright_corners(bounds)
        return shapes.Outlined(image, box._replace(corners=upright, reference=bounds))
    return _cornered(image, box, points)


READERS: Mapping[str, Callable[[str, Box, FloatArray], shapes.Outlined]] = {
    'polygon': _polygon,
    'rectangle': _rectangle,
    **dict.fromkeys(CORNERED, _cornered),
}


FORMAT = Format(
    name='labelme',
    suffixes=('.json',),
    summary=(
        f'LabelMe and X-AnyLabeling JSON, one file per image: shapes of type {", ".join(READERS)}'
    ),
    sniff=lambda head: '{shapes[' in documents.json_paths(head),
    read=_read,
)
