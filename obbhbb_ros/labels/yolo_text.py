# SPDX-License-Identifier: Apache-2.0
"""What the text formats of Ultralytics share: class indices, scores, fractions of an image."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.files import CLASSES_FILE
from obbhbb_ros.labels.files import target_files
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.image_size import stored_size
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.records import raise_error
from obbhbb_ros.labels.text import is_index
from obbhbb_ros.labels.text import join_numbers
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.text import read_boxes
from obbhbb_ros.labels.text import text_lines
from obbhbb_ros.labels.text import write_lines

Parse = Callable[[str, Sequence[str]], Box]
_ImageT = TypeVar('_ImageT', ImageLabels, ConvertedImage)


def read_image(
    path: Path, image_size: ImageSize | None, on_error: OnError, parse: Parse
) -> Iterator[ImageLabels]:
    """
    Read the one image of a file of boxes that are fractions of it.

    Parameters
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height in pixels; None to take them from the image that belongs to the file.
    on_error : callable
        Gets a LabelError for each malformed line, and one where the size or ``classes.txt``
        cannot be read; then the file is left out.
    parse : callable
        ``parse(line, names)`` gives a Box whose corners and reference are fractions of the image,
        or raises ValueError.

    Yields
    ------
    ImageLabels
        Named after the file. Without boxes it needs no size: `size` is None where unknown.
    """
    try:
        names = class_names(path.parent)
    except LabelError as error:
        on_error(error)
        return
    boxes = read_boxes(path, on_error, lambda line: parse(line, names))
    try:
        size = image_size or stored_size(path)
    except LabelError as error:
        if boxes:
            on_error(error)
            return
        size = None
    labels = assemble(path.stem, boxes, size, path)
    scale = np.array(size or (1, 1), dtype=np.float64)
    yield replace(
        labels, corners=labels.corners * scale, reference=labels.reference * np.tile(scale, 2)
    )


def class_names(folder: Path) -> list[str]:
    """
    Read ``classes.txt``: the name of class i is in line i + 1.

    Parameters
    ----------
    folder : Path
        Folder of the label files.

    Returns
    -------
    list of str
        Names, '' for a blank line; empty where there is no such file.

    Raises
    ------
    LabelError
        If the file is not UTF-8 text.
    """
    path = folder / CLASSES_FILE
    if not path.is_file():
        return []
    return [line.strip() for _, line in text_lines(path, raise_error)]


def parse_score(field: str) -> float:
    """Read a confidence; raise ValueError where it is not a number within 0..1."""
    (score,) = parse_numbers([field])
    if not 0.0 <= score <= 1.0:
        raise ValueError(f'confidence {field} is not within 0..1')
    return score


def parse_class(field: str, names: Sequence[str]) -> str:
    """Give the class of an index its name; raise ValueError where it is no index or has none."""
    if not is_index(field):
        raise ValueError(f'class index {field!r} is not a whole number')
    index = int(field)
    if not names:
        return str(index)
    if index >= len(names) or not names[index]:
        raise ValueError(f'class {index} has no name in {CLASSES_FILE}')
    return names[index]


def numbered_names(folder: Path, used: Iterable[str]) -> list[str]:
    """
    List the class names for ``classes.txt``, those it has first.

    Parameters
    ----------
    folder : Path
        Folder of the label files.
    used : iterable of str
        The class of every box.

    Returns
    -------
    list of str
        Names, or nothing where all classes are indices already.

    Raises
    ------
    ValueError
        If a name cannot stand in a line.
    LabelError
        If a ``classes.txt`` is there and cannot be read.
    """
    distinct = list(dict.fromkeys(used))
    if all(is_index(name) and name == str(int(name)) for name in distinct):
        return []
    for name in distinct:
        if not name or name != name.strip() or name.splitlines() != [name]:
            raise ValueError(f'class {name!r} cannot stand as a line of {CLASSES_FILE}')
    known = class_names(folder)
    return known + [name for name in distinct if name not in known]


def unit_scores(image: str, scores: FloatArray) -> list[float]:
    """Check that scores can be confidences; raise ValueError where one is outside 0..1."""
    values: list[float] = scores.tolist()
    if min(values) < 0.0 or max(values) > 1.0:
        raise ValueError(f'image {image!r}: scores are not within 0..1')
    return values

def write_images(
    path: Path, images: list[_ImageT], normalised: Callable[[_ImageT], FloatArray]
) -> None:
    """
    Write one file an image, after everything was found to be writable.

    Parameters
    ----------
    path : Path
        File, or folder of files.
    images : list of ImageLabels or of ConvertedImage
        What to write.
    normalised : callable
        Gives an image's boxes as fractions of it, a row a box.

    Raises
    ------
    ValueError
        If scores lie outside 0..1, a class cannot stand in a line, or images and files do not fit.
    LabelError
        If a ``classes.txt`` is there and cannot be read.
    """
    targets = target_files(path, images, '.txt')
    folder = path if not targets else targets[0][0].parent
    names = numbered_names(folder, [name for each in images for name in each.class_ids])
    files = [(file, _lines(image, names, normalised(image))) for file, image in targets]
    if names:
        write_lines(folder / CLASSES_FILE, names)
    for file, lines in files:
        write_lines(file, lines)


def _lines(
    image: ImageLabels | ConvertedImage, names: Sequence[str], boxes: FloatArray
) -> list[str]:
    """Write a line a box: class number, fractions, and the score where any is given."""
    numbers = {name: str(index) for index, name in enumerate(names)}
    rows = boxes.tolist()
    if np.any(image.scores != 1.0):
        scores = unit_scores(image.image, image.scores)
        rows = [[*row, score] for row, score in zip(rows, scores, strict=True)]
    pairs = zip(image.class_ids, rows, strict=True)
    return [f'{numbers.get(name, name)} {join_numbers(row)}' for name, row in pairs]
