# SPDX-License-Identifier: Apache-2.0
"""
Ultralytics YOLO-OBB: one text file an image, one box a line, corners as fractions of the image.

::

    0 0.780811 0.743961 0.782371 0.74686 0.777691 0.752174 0.776131 0.749758

Predictions saved by Ultralytics end in a confidence, those of a tracker in confidence and track
id. A file ``classes.txt`` in the folder, one name a line, gives names to the class indices. The
format has no hulls or reference boxes, and its labels no ids: these are not written.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.text import is_normalised
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.yolo_text import parse_class
from obbhbb_ros.labels.yolo_text import parse_score
from obbhbb_ros.labels.yolo_text import read_image
from obbhbb_ros.labels.yolo_text import write_images

FIELDS = 'class x1 y1 x2 y2 x3 y3 x4 y4 [confidence [track]]'
COUNTS = (9, 10, 11)


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the one image of a YOLO-OBB file.

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
        raise ValueError(f'{len(fields)} fields, expected 9 to 11: {FIELDS}')
    corners = parse_numbers(fields[1:9])
    if not is_normalised(corners):
        raise ValueError('corners are not normalised to 0..1')
    score = parse_score(fields[9]) if len(fields) > COUNTS[0] else 1.0
    track = fields[10] if len(fields) == COUNTS[-1] else ''
    return Box(corners, parse_class(fields[0], names), track, score)


def write(path: Path, images: list[ImageLabels]) -> None:
    """
    Write one YOLO-OBB file an image, with confidences where a score is not 1.

    Classes that all are indices are written as they are. Otherwise they are names, and
    ``classes.txt`` beside the files numbers them: names it has keep their number, others follow.

    Parameters
    ----------
    path : Path
        Folder, or a ``.txt`` file for a single image.
    images : list of ImageLabels
        The images; those with boxes need a `size`.

    Raises
    ------
    ValueError
        If an image has boxes but no size, corners far outside of it, scores outside 0..1 or a
        class that cannot stand in a line, or if images and files do not fit.
    LabelError
        If a ``classes.txt`` is there and cannot be read.
    """
    write_images(path, images, _normalised)


def _normalised(labels: ImageLabels) -> FloatArray:
    if not labels.class_ids:
        return labels.corners.reshape(-1, 8)
    if labels.size is None:
        raise ValueError(f'image {labels.image!r}: its size is not known, YOLO-OBB needs it')
    corners = (labels.corners / np.array(labels.size, dtype=np.float64)).reshape(-1, 8)
    if not is_normalised(corners.flat):
        raise ValueError(f'image {labels.image!r}: corners far outside its size {labels.size}')
    return corners


def sniff(head: str) -> bool:
    """Tell whether a line is a class index and four normalised corners."""
    return any(map(_looks_like_box, head.splitlines()))


def _looks_like_box(line: str) -> bool:
    try:
        _parse(line, ())
    except ValueError:
        return False
    return True


FORMAT = Format(
    name='yolo_obb',
    suffixes=('.txt',),
    summary=f'Ultralytics YOLO-OBB, one file an image: {FIELDS}, normalised to 0..1',
    read=read,
    write=write,
    sniff=sniff,
)
