# SPDX-License-Identifier: Apache-2.0
"""
Detections for Task 1 of DOTA: one file per class, ``Task1_ship.txt``, of many images, in pixels.

::

    P0706 0.91 284.1 466.0 274.2 456.3 300.0 427.1 310.2 439.4

The image, the score and the corners; the class is in the name of the file. mmrotate, Ultralytics
and the DOTA_devkit write this. Images without detections are in no file.
"""

from __future__ import annotations

from collections.abc import Iterator

from obbhbb_ros.labels import text
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.yolo_lines import SKEW
from obbhbb_ros.labels.yolo_lines import skew

FIELDS = 'image score x1 y1 x2 y2 x3 y3 x4 y4'
COUNT = 10


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    class_id = file.path.stem.removeprefix('Task1_')
    images: dict[str, list[Box]] = {}
    for _, _, (image, box) in file.parse_records(text.filled_lines(file), _parse):
        images.setdefault(image, []).append(box._replace(class_id=class_id))
    return file.images(images)


def _parse(line: str) -> tuple[str, Box]:
    fields = line.split()
    if len(fields) != COUNT:
        raise ValueError(f'{len(fields)} fields, expected {COUNT}: {FIELDS}')
    score, *corners = text.parse_numbers(fields[1:])
    if not 0.0 <= score <= 1.0:
        raise ValueError(f'score {fields[1]} is not within 0..1')
    return fields[0], Box(corners, '', score=score)


def _sniff(head: str) -> bool:
    return any(map(_looks_like_detection, head.splitlines()))


def _looks_like_detection(line: str) -> bool:
    try:
        image, box = _parse(line)
    except ValueError:
        return False
    if text.is_normalised(box.corners):
        return False
    if not text.is_number(image):
        return True
    # Ten numbers: the box and what precedes it, or a box whose category is a number.
    shifted = [float(image), box.score, *box.corners[:6]]
    return skew(box.corners) <= SKEW < skew(shifted)


FORMAT = Format(
    name='dota_results',
    suffixes=('.txt',),
    summary=f'Detections for Task 1 of DOTA, Task1_ship.txt, one file per class: {FIELDS}',
    sniff=_sniff,
    read=_read,
    spread=True,
)
