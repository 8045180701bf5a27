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
from functools import partial
from itertools import compress
from pathlib import Path

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import text
from obbhbb_ros.labels.documents import parse_difficulty
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import only_if_any
from obbhbb_ros.labels.folders import write_per_image
from obbhbb_ros.labels.image_grouper import concatenated
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.yolo_lines import skews

HEADER = re.compile(r'\W*(imagesource|gsd|acquisition dates)\W*:', re.IGNORECASE)
FIELDS = 'x1 y1 x2 y2 x3 y3 x4 y4 category [difficulty]'
COUNTS = (9, 10)
# How far the edges of a box may be from parallel where its category is a number, as `skews` says.
MAX_SKEW = 0.5
# Orders of the last three corners that differ by more than the direction.
ORDERS = ((2, 3, 4, 5, 6, 7), (2, 3, 6, 7, 4, 5), (4, 5, 2, 3, 6, 7))


def _read(file: LabelFile) -> list[ImageLabels]:
    tables = list(file.parse_blocks(text.filled_blocks(file), partial(_table, file)))
    labels = concatenated(tables) if tables else file.image(file.path.stem, [])
    if _are_fractions(labels.corners):
        raise file.error('the coordinates are fractions of the image, those of DOTA are pixels')
    return [labels]


def _are_fractions(corners: FloatArray) -> bool:
    within = ((corners >= 0.0) & (corners <= 1.0)).all()
    return bool(within and ((corners > 0.0) & (corners < 1.0)).any())


def _table(file: LabelFile, lines: Sequence[str]) -> ImageLabels:
    corners, categories, difficulties = _parse(lines)
    return file.table(
        file.path.stem,
        corners.reshape(-1, 4, 2),
        categories,
        extras=Extras(difficulty=only_if_any(difficulties, np.int64)),
    )


def _parse(lines: Sequence[str]) -> tuple[FloatArray, Sequence[str], Sequence[int]]:
    """Return the corners, (N, 8), categories and difficulties of lines; header lines have none."""
    rows = [_split(line) for line in lines if not HEADER.match(line)]
    if not rows:
        return np.zeros((0, 8)), (), ()
    if not {*map(len, rows)} <= {*COUNTS}:
        raise ValueError(f'{len(rows[0])} fields, expected 9 or 10: {FIELDS}')
    filled = (row if len(row) == COUNTS[1] else [*row, ''] for row in rows)
    *coordinates, categories, levels = zip(*filled, strict=True)
    corners = text.parse_columns(coordinates)
    _check_numbers(corners, categories)
    known = {level: parse_difficulty(level) for level in {*levels}}
    return corners, categories, [known[level] for level in levels]


def _check_numbers(corners: FloatArray, categories: Sequence[str]) -> None:
    """Raise ValueError unless lines of numbers are boxes with numbers as their categories."""
    numbers = {name: float(name) for name in {*categories} if text.is_number(name)}
    if not numbers:
        return
    for category in numbers:
        if not text.is_index(category):
            raise ValueError(f'category {category!r} is a number: the line is of another format')
    rows = [name in numbers for name in categories]
    corners, values = corners[rows], [numbers[name] for name in compress(categories, rows)]
    if text.are_normalised(corners).any():
        raise ValueError('fractions of the image and no name of a category: is it yolo_obb?')
    gap = np.min([skews(corners[:, [0, 1, *order]]) for order in ORDERS], axis=0)
    if not (gap <= MAX_SKEW).all():
        raise ValueError('the first eight of these numbers are not the corners of a box')
    if (skews(np.column_stack((corners[:, 1:], values))) <= gap).any():
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
        return bool(_parse([' '.join(fields)])[1])
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
