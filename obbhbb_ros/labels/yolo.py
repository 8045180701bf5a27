# SPDX-License-Identifier: Apache-2.0
"""
Ultralytics YOLO and YOLO-OBB: one text file per image, one box per line, as fractions of the image.

YOLO has an axis-aligned box, which is read as an upright box and as the reference box; YOLO-OBB has
the corners of an oriented box::

    0 0.512 0.734 0.322 0.481
    0 0.780811 0.743961 0.782371 0.74686 0.777691 0.752174 0.776131 0.749758

Predictions end with a confidence; those of a tracker, with a confidence and a track id. A file
``classes.txt`` in the folder, one name per line, gives the names of the class indices.

The caller passes the width and height of an image with boxes, or they are read from its image file.
Confidences are written if a score is not 1. Classes that are all indices are written unchanged;
otherwise they are names, numbered by ``classes.txt``: names already in it keep their number, others
are added. Hulls, ids and the reference boxes of oriented boxes are not written.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.folders import CLASSES_FILE
from obbhbb_ros.labels.folders import target_files
from obbhbb_ros.labels.image_files import stored_size
from obbhbb_ros.labels.image_labels import AnyImage
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import FileError
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import raise_error
from obbhbb_ros.labels.label_format import Format

UPRIGHT_FIELDS = 'class x_center y_center width height [confidence [track]]'
CORNER_FIELDS = 'class x1 y1 x2 y2 x3 y3 x4 y4 [confidence [track]]'

# Turns a line and the class names into a box, in fractions of the image.
Parse = Callable[[str, Sequence[str]], Box]


def _parse(line: str, names: Sequence[str], count: int, expected: str) -> Box:
    """Parse a line; the `count` coordinates are returned as corners."""
    fields = line.split()
    if not count < len(fields) <= count + 3:
        raise ValueError(f'{len(fields)} fields, expected {count + 1} to {count + 3}: {expected}')
    coordinates = text.parse_numbers(fields[1 : count + 1])
    if not text.is_normalised(coordinates):
        raise ValueError('the box is not normalised to 0..1')
    confidence, track = (*fields[count + 1 :], '', '')[:2]
    score = text.parse_score(confidence)
    if not 0.0 <= score <= 1.0:
        raise ValueError(f'confidence {confidence} is not within 0..1')
    return Box(coordinates, _parse_class(fields[0], names), track, score)


def _parse_corners(line: str, names: Sequence[str]) -> Box:
    return _parse(line, names, 8, CORNER_FIELDS)


def _parse_upright(line: str, names: Sequence[str]) -> Box:
    box = _parse(line, names, 4, UPRIGHT_FIELDS)
    x, y, width, height = box.corners
    reference = shapes.bounds_of_xywh(x - width / 2, y - height / 2, width, height)
    return box._replace(corners=shapes.upright_corners(reference), reference=reference)


def _parse_class(field: str, names: Sequence[str]) -> str:
    if not text.is_index(field):
        raise ValueError(f'class index {field!r} is not a whole number')
    index = int(field)
    if not names:
        return str(index)
    if index >= len(names) or not names[index]:
        raise ValueError(f'class {index} has no name in {CLASSES_FILE}')
    return names[index]


def _read(parse: Parse, file: LabelFile) -> list[ImageLabels]:
    try:
        names = _class_names(file.path.parent)
    except LabelError as error:
        raise FileError(*error.args) from None
    boxes = text.read_boxes(file, lambda line: parse(line, names))
    size = file.image_size or _stored_size(file, needed=bool(boxes))
    labels = file.image(file.path.stem, boxes, size)
    scale = np.array(size or (1, 1), dtype=np.float64)
    corners, reference = labels.corners * scale, labels.reference * np.tile(scale, 2)
    return [replace(labels, corners=corners, reference=reference)]


def _stored_size(file: LabelFile, needed: bool) -> ImageSize | None:
    try:
        return stored_size(file.path)
    except LabelError as error:
        if not needed:
            return None
        raise file.error(f'{error.message}: pass image_size=(width, height)') from None


def _class_names(folder: Path) -> list[str]:
    """Read the names in ``classes.txt``, '' for a blank line; none if there is no such file."""
    path = folder / CLASSES_FILE
    if not path.is_file():
        return []
    return [line.strip() for _, line in text.text_lines(path, raise_error)]


def _write(path: Path, images: list[AnyImage]) -> None:
    """Write one file per image, once all of them are turned into lines."""
    targets = target_files(path, images, '.txt')
    folder = path if not targets else targets[0][0].parent
    names = _numbered_names(folder, [name for image in images for name in image.class_ids])
    numbers = {name: str(index) for index, name in enumerate(names)}
    files = [(file, _lines(image, numbers)) for file, image in targets]
    if names:
        text.write_lines(folder / CLASSES_FILE, names)
    for file, lines in files:
        text.write_lines(file, lines)


def _numbered_names(folder: Path, used: Iterable[str]) -> list[str]:
    """List the names for ``classes.txt``, those already in it first; none if all are indices."""
    distinct = list(dict.fromkeys(used))
    if all(text.is_index(name) and name == str(int(name)) for name in distinct):
        return []
    for name in distinct:
        if not name or name != name.strip() or name.splitlines() != [name]:
            raise ValueError(f'class {name!r} cannot be a line of {CLASSES_FILE}')
    listed = _class_names(folder)
    return listed + [name for name in distinct if name not in listed]


def _lines(image: ImageLabels | ImageBoxes, numbers: Mapping[str, str]) -> list[str]:
    if image.class_ids and image.size is None:
        raise ValueError(f'image {image.image!r}: YOLO needs its size, which is unknown')
    if isinstance(image, ImageLabels):
        boxes = image.corners.reshape(-1, 8)
    else:
        low, high = image.xyxy[:, :2], image.xyxy[:, 2:]
        boxes = np.hstack(((low + high) / 2, high - low))
    boxes = boxes / np.tile(np.array(image.size or (1, 1), np.float64), boxes.shape[1] // 2)
    if not text.is_normalised(boxes.flat):
        raise ValueError(f'image {image.image!r}: a box lies far outside its size {image.size}')
    if np.any((image.scores < 0.0) | (image.scores > 1.0)):
        raise ValueError(f'image {image.image!r}: scores are not within 0..1')
    if np.any(image.scores != 1.0):
        boxes = np.column_stack((boxes, image.scores))
    pairs = zip(image.class_ids, boxes.tolist(), strict=True)
    return [f'{numbers.get(name, name)} {text.join_numbers(row)}' for name, row in pairs]


def _fits(parse: Parse, head: str) -> bool:
    for line in head.splitlines():
        with suppress(ValueError):
            parse(line, ())
            return True
    return False


UPRIGHT = Format(
    name='yolo',
    suffixes=('.txt',),
    summary=(
        f'Ultralytics YOLO, axis-aligned, one file per image: {UPRIGHT_FIELDS}, normalised to 0..1'
    ),
    sniff=partial(_fits, _parse_upright),
    read=partial(_read, _parse_upright),
    write_boxes=_write,
    holds=('scores', 'images without boxes'),
)
ORIENTED = Format(
    name='yolo_obb',
    suffixes=('.txt',),
    summary=f'Ultralytics YOLO-OBB, one file per image: {CORNER_FIELDS}, normalised to 0..1',
    sniff=partial(_fits, _parse_corners),
    read=partial(_read, _parse_corners),
    write=_write,
)
