# SPDX-License-Identifier: Apache-2.0
"""
The predictions of Ultralytics' OBB models, ``predictions.json``: many images, in pixels.

::

    [{"image_id": "P0706", "file_name": "P0706.png", "category_id": 1, "score": 0.91,
      "rbox": [292.0, 447.1, 38.6, 16.2, 2.31],
      "poly": [284.1, 466.0, 274.2, 456.3, 300.0, 427.1, 310.2, 439.4]}]

``poly`` has the corners; without it, ``rbox`` has centre, size and angle, in radians from image +x
towards +y, along the first size. Classes are numbers: the file has no names. Images without
predictions are not in the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format

PATHS = {'[{image_id', '[{score'}
BOX_PATHS = {'[{rbox[', '[{poly['}


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    if not isinstance(document, list):
        raise file.error('not predictions of Ultralytics: not a JSON array')
    images: dict[str, list[Box]] = {}
    records = file.parse_records(documents.numbered('', document), _prediction)
    for _, _, (image, box) in records:
        images.setdefault(image, []).append(box)
    return file.images(images)


def _prediction(record: Any) -> tuple[str, Box]:
    documents.json_member(record, 'image_id')
    image = documents.plain_text(record.get('file_name') or record['image_id'])
    if not image:
        raise ValueError('no image name')
    box = Box(
        corners=_corners(record),
        class_id=documents.plain_text(documents.json_member(record, 'category_id')),
        score=documents.json_number(documents.json_member(record, 'score'), 'score'),
    )
    return image, box


def _corners(record: dict[str, Any]) -> list[float] | shapes.Corners:
    if 'poly' in record:
        return documents.json_numbers(record['poly'], 8, 'poly')
    if 'rbox' not in record:
        raise ValueError("neither 'poly' nor 'rbox'")
    return shapes.oriented_corners(*documents.json_numbers(record['rbox'], 5, 'rbox'))


def _sniff(head: str) -> bool:
    paths = documents.json_paths(head)
    return paths >= PATHS and not paths.isdisjoint(BOX_PATHS)


FORMAT = Format(
    name='ultralytics',
    suffixes=('.json',),
    summary='predictions.json of Ultralytics OBB models: rbox and poly of many images',
    sniff=_sniff,
    read=_read,
)
