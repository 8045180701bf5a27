# SPDX-License-Identifier: Apache-2.0
"""
DOTA labelTxt (v1.0, v1.5, v2.0): one text file per image, one box per line, in pixels.

::

    imagesource:GoogleEarth
    gsd:0.146343590398
    2753 2408 2861 2385 2888 2468 2805 2502 ship 0

Header lines and the difficulty at the end are optional; fields may be separated by commas, as on
the page that describes the format. Files are written with difficulty and without header lines.
The format has no ids, scores, hulls or reference boxes: these are not written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from obbhbb_ros.labels import text
from obbhbb_ros.labels.documents import parse_difficulty
from obbhbb_ros.labels.folders import write_per_image
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.yolo_lines import skew

HEADER = re.compile(r'\W*(imagesource|gsd|acquisition dates)\W*:', re.IGNORECASE)
FIELDS = 'x1 y1 x2 y2 x3 y3 x4 y4 category [difficulty]'
COUNTS = (9, 10)
# How far the edges of a box may be from parallel where its category is a number, as `skew` says.
MAX_SKEW = 0.5
# Orders of the last three corners that differ by more than the direction.
ORDERS = ((2, 3, 4, 5, 6, 7), (2, 3, 6, 7, 4, 5), (4, 5, 2, 3, 6, 7))


def _read(file: LabelFile) -> list[ImageLabels]:
    boxes = text.read_boxes(file, _parse)
    if _are_fractions(boxes):
        raise file.error('the coordinates are fractions of the image, those of DOTA are pixels')
    return [file.image(file.path.stem, boxes)]


def _are_fractions(boxes: Sequence[Box]) -> bool:
    return all(0.0 <= value <= 1.0 for box in boxes for value in box.corners) and any(
        0.0 < value < 1.0 for box in boxes for value in box.corners
    )


def _parse(line: str) -> Box | None:
    if HEADER.match(line):
        return None
    fields = _split(line)
    if len(fields) not in COUNTS:
        raise ValueError(f'{len(fields)} fields, expected 9 or 10: {FIELDS}')
    corners = text.parse_numbers(fields[:8])
    if text.is_number(fields[8]):
        _check_number(corners, fields[8])
    difficulty = parse_difficulty(fields[9] if len(fields) > COUNTS[0] else '')
    return Box(corners, fields[8], difficulty=difficulty)


def _check_number(corners: list[float], category: str) -> None:
    """Raise ValueError unless a line of numbers is a box with a number as its category."""
    if not text.is_index(category):
        raise ValueError(f'category {category!r} is a number: the line is of another format')
    if text.is_normalised(corners):
        raise ValueError('fractions of the image and no name of a category: is it yolo_obb?')
    gap = min(skew([*corners[:2], *(corners[i] for i in order)]) for order in ORDERS)
    if not gap <= MAX_SKEW:
        raise ValueError('the first eight of these numbers are not the corners of a box')
    if skew([*corners[1:], float(category)]) <= gap:
        raise ValueError('a number, then corners: YOLO-OBB in pixels? They would be dota, too')


def _split(line: str) -> list[str]:
    return line.replace(',', ' ').split()


def _write(path: Path, images: list[ImageLabels]) -> None:
    write_per_image(path, images, '.txt', _lines)


def _lines(labels: ImageLabels) -> list[str]:
    for category in labels.class_ids:
        if _split(category) != [category]:
            raise ValueError(
                f'image {labels.image!r}: class {category!r} is empty or has a space or comma, '
                'which a DOTA category cannot'
            )
    corners = labels.corners.reshape(-1, 8).tolist()
    rows = zip(corners, labels.class_ids, labels.difficulties, strict=True)
    return [f'{text.join_numbers(box)} {category} {level}' for box, category, level in rows]


def _sniff(head: str) -> bool:
    return any(HEADER.match(line) or _looks_like_box(_split(line)) for line in head.splitlines())


def _looks_like_box(fields: list[str]) -> bool:
    if len(fields) not in COUNTS or not all(map(text.is_number, fields[:8])):
        return False
    try:
        return _parse(' '.join(fields)) is not None
    except ValueError:
        return False


FORMAT = Format(
    name='dota',
    suffixes=('.txt',),
    summary=f'DOTA labelTxt, one file per image: {FIELDS}, in pixels',
    sniff=_sniff,
    read=_read,
    write=_write,
)
