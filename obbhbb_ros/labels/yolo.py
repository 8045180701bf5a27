# SPDX-License-Identifier: Apache-2.0
"""
Ultralytics YOLO: one text file an image, one axis-aligned box a line, as fractions of the image.

::

    0 0.512 0.734 0.322 0.481

Predictions end in a confidence, those of a tracker in confidence and track id. A file
``classes.txt`` in the folder gives names to the class indices. A box reads as an upright oriented
box that is its own reference box.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.shapes import bounds_of_xywh
from obbhbb_ros.labels.shapes import upright_corners
from obbhbb_ros.labels.text import is_normalised
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.yolo_text import parse_class
from obbhbb_ros.labels.yolo_text import parse_score
from obbhbb_ros.labels.yolo_text import read_image
from obbhbb_ros.labels.yolo_text import write_images

FIELDS = 'class x_center y_center width height [confidence [track]]'
COUNTS = (5, 6, 7)


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the one image of a YOLO file.

    Parameters
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height in pixels; None to take them from the image that belongs to the file.
    on_error : callable
        Gets a LabelError for each malformed line, and one where the size or ``classes.txt``
        cannot be read; then the file is left out.

    Yields
    ------
    ImageLabels
        Named after the file. Without boxes it needs no size: `size` is None where unknown.
    """
    yield from read_image(path, image_size, on_error, _parse)


def _parse(line: str, names: Sequence[str]) -> Box:
    fields = line.split()
    if len(fields) not in COUNTS:
        raise ValueError(f'{len(fields)} fields, expected 5 to 7: {FIELDS}')
    x, y, width, height = numbers = parse_numbers(fields[1:5])
    if not is_normalised(numbers):
        raise ValueError('the box is not normalised to 0..1')
    reference = bounds_of_xywh(x - width / 2, y - height / 2, width, height)
    score = parse_score(fields[5]) if len(fields) > COUNTS[0] else 1.0
    track = fields[6] if len(fields) == COUNTS[-1] else ''
    class_id = parse_class(fields[0], names)
    return Box(upright_corners(reference), class_id, track, score, reference)


def write_boxes(path: Path, images: list[ConvertedImage]) -> None:
    """
    Write one YOLO file an image, with confidences where a score is not 1.

    Classes that all are indices are written as they are. Otherwise they are names, and
    ``classes.txt`` beside the files numbers them: names it has keep their number, others follow.

    Parameters
    ----------
    path : Path
        Folder, or a ``.txt`` file for a single image.
    images : list of ConvertedImage
        The images; those with boxes need a `size`.

    Raises
    ------
    ValueError
        If an image has boxes but no size, boxes far outside of it, scores outside 0..1 or a class
        that cannot stand in a line, or if images and files do not fit.
    LabelError
        If a ``classes.txt`` is there and cannot be read.
    """
    write_images(path, images, _normalised)


def _normalised(converted: ConvertedImage) -> FloatArray:
    if not converted.class_ids:
        return converted.xyxy
    if converted.size is None:
        raise ValueError(f'image {converted.image!r}: its size is not known, YOLO needs it')
    low, high = converted.xyxy[:, :2], converted.xyxy[:, 2:]
    xywh = np.hstack(((low + high) / 2, high - low)) / np.tile(converted.size, 2)
    if not is_normalised(xywh.flat):
        size = converted.size
        raise ValueError(f'image {converted.image!r}: a box lies far outside its size {size}')
    return xywh


def sniff(head: str) -> bool:
    """Tell whether a line is a class index and a normalised box."""
    return any(map(_looks_like_box, head.splitlines()))


def _looks_like_box(line: str) -> bool:
    try:
        _parse(line, ())
    except ValueError:
        return False
    return True


FORMAT = Format(
    name='yolo',
    suffixes=('.txt',),
    summary=f'Ultralytics YOLO, axis-aligned, one file an image: {FIELDS}, normalised to 0..1',
    read=read,
    write=None,
    sniff=sniff,
    write_boxes=write_boxes,
)
