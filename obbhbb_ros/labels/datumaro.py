# SPDX-License-Identifier: Apache-2.0
"""
Datumaro JSON: one file of many images, in pixels.

::

    {"categories": {"label": {"labels": [{"name": "ship"}]}},
     "items": [{"id": "P0706", "image": {"path": "P0706.png", "size": [768, 1024]},
                "annotations": [
                  {"id": 7, "type": "bbox", "label_id": 0, "bbox": [80, 40, 110, 30],
                   "attributes": {"rotation": 30.0}},
                  {"type": "rotated_bbox", "label_id": 0, "rotated_bbox": [135, 68, 110, 30, 30]},
                  {"type": "polygon", "label_id": 0, "points": [284, 466, 274, 456, 300, 427]},
                  {"type": "mask", "label_id": 0, "rle": {"counts": "...", "size": [768, 1024]}}]}]}

``rotation`` turns a ``bbox`` about its centre, degrees clockwise as seen; a ``rotated_bbox`` has
centre, size and such an angle. A box that is not turned is also the reference box. Polygons and
masks are read as in ``coco``. A label of a whole image is no box; other annotations are reported
one by one. Other attributes are properties.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from collections.abc import Sequence
from functools import partial
from typing import Any
from typing import NamedTuple

from obbhbb_ros.labels import documents
from obbhbb_ros.labels import masks
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

ITEMS = 'items'
ANNOTATIONS = 'annotations'
ROTATION = 'rotation'
CROWD = 'is_crowd'
# What is said of a whole image.
IMAGE_TYPES = ('label', 'caption')


class DatumaroItem(NamedTuple):
    """An image: its names, its size where it is known, and its annotations."""

    name: str
    file_name: str
    size: ImageSize | None
    annotations: list[Any]


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    if not isinstance(document, dict) or not isinstance(document.get(ITEMS), list):
        raise file.error(f'not Datumaro JSON: no array {ITEMS!r}')
    parse = partial(_annotation, _class_names(document))
    items = list(file.parse_records(documents.numbered(ITEMS, document[ITEMS]), _item))
    records = (
        (line, f'{place.removesuffix(": ")}.{part}', (str(key), annotation))
        for key, (_, place, item) in enumerate(items)
        for line, part, annotation in documents.numbered(ANNOTATIONS, item.annotations)
        if not _is_of_image(annotation)
    )
    boxes = shapes.enclose(file, file.parse_records(records, parse))
    for key, (_, _, item) in enumerate(items):
        rows = boxes.get(str(key), [])
        yield file.image(item.name, rows, item.size, file_name=item.file_name)


def _class_names(document: dict[str, Any]) -> list[str]:
    try:
        labels = document['categories']['label']['labels']
        return [documents.plain_text(label['name']) for label in labels]
    except (KeyError, TypeError):
        return []


def _item(item: Any) -> DatumaroItem:
    name = documents.json_member(item, 'id')
    if not isinstance(name, str) or not name:
        raise ValueError("'id' is not a name")
    annotations = item.get(ANNOTATIONS, [])
    if not isinstance(annotations, list):
        raise ValueError(f'{ANNOTATIONS!r} is not an array')
    image = item.get('image')
    image = image if isinstance(image, dict) else {}
    path = documents.plain_text(image.get('path'))
    return DatumaroItem(documents.plain_text(name), path, _size(image.get('size')), annotations)


def _size(size: object) -> ImageSize | None:
    if not isinstance(size, list) or len(size) < 2:
        return None
    return documents.image_size_of(size[1], size[0])


def _is_of_image(annotation: object) -> bool:
    return isinstance(annotation, dict) and annotation.get('type') in IMAGE_TYPES


def _annotation(names: Sequence[str], record: tuple[str, Any]) -> shapes.Outlined:
    image, annotation = record
    kind = documents.json_member(annotation, 'type')
    if not isinstance(kind, str) or kind not in READERS:
        raise ValueError(f'an annotation of type {kind!r} is not read: only {", ".join(READERS)}')
    attributes = annotation.get('attributes') or {}
    if not isinstance(attributes, dict):
        raise ValueError("'attributes' is not a JSON object")
    box = Box(
        (),
        _class_id(names, annotation.get('label_id')),
        documents.plain_text(annotation.get('id')),
        crowd=attributes.get(CROWD) is True,
        properties=documents.json_properties(attributes, (ROTATION, CROWD)),
    )
    rotation = attributes.get(ROTATION)
    turn = 0.0 if rotation is None else documents.json_number(rotation, ROTATION)
    if turn != 0.0 and kind != 'bbox':
        raise ValueError(f'a rotation of {turn:g} of type {kind}')
    return READERS[kind](shapes.Outlined(image, box), annotation, turn)


def _class_id(names: Sequence[str], label: object) -> str:
    if label is None:
        return ''
    if isinstance(label, bool) or not isinstance(label, int) or not 0 <= label < len(names):
        raise ValueError(f"'label_id' is {label!r}, which is not in the file")
    return names[label]


def _bbox(record: shapes.Outlined, annotation: dict[str, Any], turn: float) -> shapes.Outlined:
    numbers = documents.json_numbers(documents.json_member(annotation, 'bbox'), 4, 'bbox')
    corners, reference = shapes.turned_box(shapes.bounds_of_xywh(*numbers), turn)
    return record._replace(box=record.box._replace(corners=corners, reference=reference))


def _rotated_bbox(record: shapes.Outlined, annotation: dict[str, Any], _: float) -> shapes.Outlined:
    values = documents.json_member(annotation, 'rotated_bbox')
    x, y, width, height, degrees = documents.json_numbers(values, 5, 'rotated_bbox')
    corners = shapes.oriented_corners(x, y, width, height, math.radians(degrees))
    return record._replace(box=record.box._replace(corners=corners, reference=NO_REFERENCE))


def _polygon(record: shapes.Outlined, annotation: dict[str, Any], _: float) -> shapes.Outlined:
    points = documents.json_numbers(documents.json_member(annotation, 'points'), None, 'points')
    return record._replace(rings=[shapes.ring_of_pairs(points)])


def _mask(record: shapes.Outlined, annotation: dict[str, Any], _: float) -> shapes.Outlined:
    rle = documents.json_member(annotation, 'rle')
    return record._replace(rings=[masks.coco_mask_ring(rle)])


READERS = {'bbox': _bbox, 'rotated_bbox': _rotated_bbox, 'polygon': _polygon, 'mask': _mask}

FORMAT = Format(
    name='datumaro',
    suffixes=('.json',),
    summary=f'Datumaro JSON of many images: annotations of type {", ".join(READERS)}',
    sniff=lambda head: documents.json_paths(head).issuperset({'{categories{', '{items['}),
    read=_read,
)
