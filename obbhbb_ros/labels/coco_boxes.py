# SPDX-License-Identifier: Apache-2.0
"""The box of a COCO annotation, as data sets and lists of results have it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from typing import Any

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import masks
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.extras import Id
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box

# Members of an annotation that are not its properties.
MEMBERS = (
    'id', 'image_id', 'category_id', 'bbox', 'area', 'segmentation', 'iscrowd', 'score', 'instance',
    'difficulty',
)  # fmt: skip
ATTRIBUTES = 'attributes'
ROTATION = 'rotation'
# Members that may turn the bbox; what they mean differs from tool to tool.
TURNING = ('rotation', 'angle', 'rbox', 'obb', 'poly', 'rotated_bbox')
TURNED_BBOX = 5


def id_of(record: object, name: str) -> Id:
    """Return a member that is an id; raise ValueError if it is missing or anything else."""
    key = documents.json_member(record, name)
    if isinstance(key, bool) or not isinstance(key, int | str):
        raise ValueError(f'{name!r} is {key!r}, which is not an id')
    return key


def widest_angle(annotations: Iterable[object]) -> float:
    """Return the largest angle, regardless of its sign, of the boxes of five numbers; 0 if none."""
    boxes = (record.get('bbox') for record in annotations if isinstance(record, dict))
    angles = (box[4] for box in boxes if isinstance(box, list) and len(box) == TURNED_BBOX)
    sizes = (abs(angle) for angle in angles if isinstance(angle, int | float))
    return max((size for size in sizes if size < math.inf), default=0.0)


def annotated_box(
    annotation: Mapping[str, Any], image: str, class_id: str, widest: float
) -> shapes.Outlined:
    """
    Turn an annotation into a record of `image`, which identifies the image in the file.

    `widest` is the `widest_angle` of the file. Raises ValueError if there is no box, or if it is
    not known how it is turned.
    """
    rings = _rings(annotation.get('segmentation'))
    attributes = annotation.get(ATTRIBUTES)
    rotation = _rotation(attributes)
    corners: Sequence[float] = ()
    if not rings:
        corners, reference = _box(annotation, rotation, widest)
    elif rotation != 0.0:
        raise ValueError(f'a rotation of {rotation:g} beside a segmentation: which one holds?')
    else:
        reference = _bounds(annotation.get('bbox'))
    score = annotation.get('score')
    properties = documents.json_properties(annotation, MEMBERS)
    if isinstance(attributes, dict) and ROTATION in attributes:
        # It would turn the upright box that is written.
        del properties[ATTRIBUTES]
        if others := documents.json_properties(attributes, (ROTATION,)):
            properties[ATTRIBUTES] = others
    box = Box(
        corners,
        class_id,
        documents.plain_text(annotation.get('instance', annotation.get('id'))),
        1.0 if score is None else documents.json_number(score, 'score'),
        reference,
        crowd=_crowd(annotation.get('iscrowd')),
        difficulty=documents.parse_difficulty(documents.plain_text(annotation.get('difficulty'))),
        properties=properties,
    )
    return shapes.Outlined(image, box, rings)


def _box(
    annotation: Mapping[str, Any], rotation: float, widest: float
) -> tuple[Sequence[float], Sequence[float]]:
    """Return corners and reference box of an annotation without a segmentation."""
    if (member := next((name for name in TURNING if name in annotation), None)) is not None:
        raise ValueError(f'{member!r} may turn the bbox: its unit and sense are unknown')
    bbox = annotation.get('bbox')
    if bbox is None:
        raise ValueError("neither 'segmentation' nor 'bbox'")
    if not _is_turned(bbox):
        return shapes.turned_box(_bounds(bbox), rotation)
    x, y, width, height, angle = documents.json_numbers(bbox, TURNED_BBOX, 'bbox')
    if rotation != 0.0:
        raise ValueError(f'a rotation of {rotation:g} beside a bbox with an angle')
    if angle != 0.0 and widest <= math.pi:
        raise ValueError(
            f'bbox has an angle of {angle:g}, degrees as Detectron2 writes it or radians? '
            'No angle of the file is beyond 3.14'
        )
    return shapes.oriented_corners(x, y, width, height, -math.radians(angle)), NO_REFERENCE


def _bounds(bbox: object) -> Sequence[float]:
    if bbox is None or _is_turned(bbox):
        return NO_REFERENCE
    return shapes.bounds_of_xywh(*documents.json_numbers(bbox, 4, 'bbox'))


def _is_turned(bbox: object) -> bool:
    return isinstance(bbox, list) and len(bbox) == TURNED_BBOX


def _rotation(attributes: object) -> float:
    if not isinstance(attributes, dict) or attributes.get(ROTATION) is None:
        return 0.0
    return documents.json_number(attributes[ROTATION], f'{ATTRIBUTES}.{ROTATION}')


def _rings(segmentation: object) -> list[FloatArray]:
    if isinstance(segmentation, dict):
        return [masks.coco_mask_ring(segmentation)]
    if segmentation is None:
        return []
    if not isinstance(segmentation, list):
        raise ValueError('segmentation is not an array of polygons')
    return [
        shapes.ring_of_pairs(documents.json_numbers(polygon, None, 'segmentation'))
        for polygon in segmentation
    ]


def _crowd(value: object) -> bool:
    if value not in (None, 0, 1):
        raise ValueError(f"'iscrowd' is {value!r}, neither 0 nor 1")
    return bool(value)
