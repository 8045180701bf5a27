# SPDX-License-Identifier: Apache-2.0
"""
Ultralytics YOLO and YOLO-OBB: one text file per image, one box per line, as fractions of the image.

YOLO has an axis-aligned box, which is read as an upright box and as the reference box; YOLO-OBB has
the corners of an oriented box::

    0 0.512 0.734 0.322 0.481
    0 0.780811 0.743961 0.782371 0.74686 0.777691 0.752174 0.776131 0.749758

Predictions end with a confidence, those of a tracker with a track id or with both, see
`yolo_lines`. More than four points are a hull, as segmentation labels have it; a first point that
is repeated at the end is ignored. The nearest ``classes.txt``, ``obj.names`` or ``data.yaml`` gives
the names of the class indices, see `class_names`.

The caller passes the width and height of an image with boxes, or they are read from its image file.
Confidences are written if a score is not 1. Classes that are all indices are written unchanged;
otherwise they are names, whose numbers the files of `yolo_classes` list. Axis-aligned boxes are cut
at the border of their image. Hulls, ids and the reference boxes of oriented boxes are not written.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.class_names import ClassNames
from obbhbb_ros.labels.class_names import find_class_names
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.folders import target_files
from obbhbb_ros.labels.image_border import clip_to_image
from obbhbb_ros.labels.image_files import stored_size
from obbhbb_ros.labels.image_labels import AnyImage
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.yolo_classes import number_classes
from obbhbb_ros.labels.yolo_lines import CORNERS_COUNT
from obbhbb_ros.labels.yolo_lines import POLYGON_FIELDS
from obbhbb_ros.labels.yolo_lines import UPRIGHT_COUNT
from obbhbb_ros.labels.yolo_lines import UPRIGHT_FIELDS
from obbhbb_ros.labels.yolo_lines import Ends
from obbhbb_ros.labels.yolo_lines import Fields
from obbhbb_ros.labels.yolo_lines import YoloLine
from obbhbb_ros.labels.yolo_lines import parse_polygon
from obbhbb_ros.labels.yolo_lines import parse_table
from obbhbb_ros.labels.yolo_lines import parse_upright
from obbhbb_ros.labels.yolo_lines import polygon_ends
from obbhbb_ros.labels.yolo_lines import split_lines
from obbhbb_ros.labels.yolo_lines import upright_ends

ONE_IMAGE = ''


class Layout(NamedTuple):
    """
    How to read the lines of a format.

    Attributes
    ----------
    size : int
        Coordinates of plain lines, which are read by columns.
    ends : callable
        What follows the coordinates.
    parse : callable
        Parses a line.
    place : callable
        Returns the box of a line in pixels.
    table : callable
        Returns the corners, (N, 4, 2), and reference boxes, (N, 4) or None, of the coordinates of
        N plain lines in pixels.
    """

    size: int
    ends: Callable[[Sequence[Fields]], Ends]
    parse: Callable[[str, Ends], YoloLine]
    place: Callable[[Box, list[float], ImageSize], shapes.Outlined]
    table: Callable[[FloatArray], tuple[FloatArray, FloatArray | None]]


def _place_upright(box: Box, coordinates: list[float], size: ImageSize) -> shapes.Outlined:
    x, y, width, height = _scaled(coordinates, size)
    reference = shapes.bounds_of_xywh(x - width / 2, y - height / 2, width, height)
    corners = shapes.upright_corners(reference)
    return shapes.Outlined(ONE_IMAGE, box._replace(corners=corners, reference=reference))


def _upright_table(coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
    low, sides = coordinates[:, :2] - coordinates[:, 2:] / 2, coordinates[:, 2:]
    reference = np.hstack((low, low + sides))
    return shapes.upright_rows(reference), reference


def _place_polygon(box: Box, coordinates: list[float], size: ImageSize) -> shapes.Outlined:
    points = _scaled(coordinates, size)
    if len(points) == CORNERS_COUNT:
        return shapes.Outlined(ONE_IMAGE, box._replace(corners=points))
    return shapes.Outlined(ONE_IMAGE, box, [np.array(points).reshape(-1, 2)])


def _polygon_table(coordinates: FloatArray) -> tuple[FloatArray, None]:
    return coordinates.reshape(-1, 4, 2), None


def _scaled(coordinates: list[float], size: ImageSize) -> list[float]:
    return [value * side for value, side in zip(coordinates, cycle(size))]


def _read(layout: Layout, file: LabelFile) -> list[ImageLabels]:
    names = find_class_names(file.path.parent)
    lines = list(text.filled_lines(file))
    size = file.image_size or _stored_size(file, needed=False)
    if lines and size is not None:
        # What one line makes impossible is said of that line below.
        with suppress(ValueError):
            return [_read_table(layout, file, names, [line for _, _, line in lines], size)]
    return [_read_lines(layout, file, names, lines, size)]


def _read_table(
    layout: Layout, file: LabelFile, names: ClassNames, lines: Sequence[str], size: ImageSize
) -> ImageLabels:
    """Read lines by columns; raise ValueError, without a reason, if one is not plain."""
    table = parse_table(list(map(str.split, lines)), layout.ends, layout.size)
    corners, reference = layout.table(table.coordinates * np.resize(size, layout.size))
    known = {index: names.name(index) for index in {*table.class_indices}}
    return file.table(
        file.path.stem,
        corners,
        [known[index] for index in table.class_indices],
        ids=table.tracks,
        scores=table.scores,
        reference=reference,
        size=size,
        extras=Extras(label_set=LabelSet(class_names=names.names)),
    )


def _read_lines(
    layout: Layout,
    file: LabelFile,
    names: ClassNames,
    lines: Sequence[Record[str]],
    size: ImageSize | None,
) -> ImageLabels:
    """Read lines one by one; report and skip those that are malformed."""
    try:
        ends = layout.ends(split_lines([line for _, _, line in lines]))
    except ValueError as error:
        raise file.error(str(error)) from None

    def parse(line: str) -> shapes.Outlined:
        parsed = layout.parse(line, ends)
        score = text.parse_score(parsed.confidence)
        box = Box((), names.name(parsed.class_index), parsed.track, score)
        return layout.place(box, parsed.coordinates, size or (1, 1))

    boxes = shapes.enclose(file, file.parse_records(lines, parse)).get(ONE_IMAGE, [])
    if boxes and size is None:
        _stored_size(file, needed=True)
    label_set = LabelSet(class_names=names.names)
    return file.image(file.path.stem, boxes, size, label_set=label_set)


def _stored_size(file: LabelFile, needed: bool) -> ImageSize | None:
    try:
        return stored_size(file.path)
    except LabelError as error:
        if not needed:
            return None
        raise file.error(f'{error.message}: pass image_size=(width, height)') from None


def _write(path: Path, images: list[AnyImage]) -> None:
    """Write one file per image, once all of them are turned into lines."""
    targets = target_files(path, images, '.txt')
    folder = path if not targets else targets[0][0].parent
    classes = number_classes(folder, images)
    files = [(file, _lines(image, classes.numbers)) for file, image in targets]
    classes.write()
    for file, lines in files:
        text.write_lines(file, lines)


def _lines(image: ImageLabels | ImageBoxes, numbers: Mapping[str, str]) -> list[str]:
    if image.class_ids and image.size is None:
        raise ValueError(f'image {image.image!r}: YOLO needs its size, which is unknown')
    if isinstance(image, ImageLabels):
        boxes = image.corners.reshape(-1, 8)
    else:
        image = clip_to_image(image).boxes
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


def _problem(layout: Layout, head: str) -> str:
    try:
        layout.ends(split_lines(head.splitlines()))
    except ValueError as error:
        return str(error)
    return ''


def _fits(layout: Layout, head: str) -> bool:
    lines = head.splitlines()
    try:
        ends = layout.ends(split_lines(lines))
    except ValueError:
        # The reader says why.
        return True
    for line in lines:
        with suppress(ValueError):
            layout.parse(line, ends)
            return True
    return False


UPRIGHT_LAYOUT = Layout(UPRIGHT_COUNT, upright_ends, parse_upright, _place_upright, _upright_table)
POLYGON_LAYOUT = Layout(CORNERS_COUNT, polygon_ends, parse_polygon, _place_polygon, _polygon_table)
UPRIGHT = Format(
    name='yolo',
    suffixes=('.txt',),
    summary=(
        f'Ultralytics YOLO, axis-aligned, one file per image: {UPRIGHT_FIELDS}, normalised to 0..1'
    ),
    sniff=partial(_fits, UPRIGHT_LAYOUT),
    problem=partial(_problem, UPRIGHT_LAYOUT),
    read=partial(_read, UPRIGHT_LAYOUT),
    write_boxes=_write,
    needs_sizes=True,
    in_pixels=True,
    holds=('scores', 'images without boxes'),
)
ORIENTED = Format(
    name='yolo_obb',
    suffixes=('.txt',),
    summary=f'Ultralytics YOLO-OBB, one file per image: {POLYGON_FIELDS}, normalised to 0..1',
    sniff=partial(_fits, POLYGON_LAYOUT),
    problem=partial(_problem, POLYGON_LAYOUT),
    read=partial(_read, POLYGON_LAYOUT),
    write=_write,
)
