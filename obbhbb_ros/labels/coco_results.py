# SPDX-License-Identifier: Apache-2.0
"""
COCO results: what a detector found in the images of a COCO data set, in pixels.

::

    [{"image_id": 42, "category_id": 1, "bbox": [274, 427, 36, 39], "score": 0.91}]

Boxes are read as in ``coco``. The file has no names: images and classes are named by their ids, and
images without boxes are not in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from obbhbb_ros.labels import coco_boxes
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.extras import Id
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

PATHS = {'[{image_id', '[{category_id'}
BOX_PATHS = {'[{bbox[', '[{segmentation[', '[{segmentation{'}
# Predictions of Ultralytics have these, keypoints need not be a ship's outline.
OTHER_PATHS = {'[{rbox[', '[{poly[', '[{keypoints['}


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    if not isinstance(document, list):
        raise file.error('not COCO results: not a JSON array')
    ids: dict[str, Id] = {}
    widest = coco_boxes.widest_angle(document)
    parse = partial(_result, ids, widest)
    boxes = shapes.enclose(file, file.parse_records(documents.numbered('', document), parse))
    for key, rows in boxes.items():
        yield file.image(documents.plain_text(ids[key]), rows, image_id=ids[key])


def _result(ids: dict[str, Id], widest: float, record: dict[str, Any]) -> shapes.Outlined:
    image_id = coco_boxes.id_of(record, 'image_id')
    ids[repr(image_id)] = image_id
    class_id = documents.plain_text(coco_boxes.id_of(record, 'category_id'))
    return coco_boxes.annotated_box(record, repr(image_id), class_id, widest)


def _sniff(head: str) -> bool:
    paths = documents.json_paths(head)
    return paths >= PATHS and bool(paths & BOX_PATHS) and not paths & OTHER_PATHS


FORMAT = Format(
    name='coco_results',
    suffixes=('.json',),
    summary='COCO results of a detector, a JSON array: image_id, category_id, bbox, score',
    sniff=_sniff,
    read=_read,
)
