# SPDX-License-Identifier: Apache-2.0
"""The one way to read labels, whatever their format."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path

from obbhbb_ros.labels.files import label_files
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import raise_error
from obbhbb_ros.labels.registry import detect_format
from obbhbb_ros.labels.registry import format_named


def read_labels(
    path: str | os.PathLike[str],
    format: str | None = None,  # noqa: A002
    *,
    image_size: tuple[int, int] | None = None,
    on_error: OnError | None = None,
) -> Iterator[ImageLabels]:
    """
    Read the labels of a file, or of the label files directly in a folder.

    What is wrong with the arguments is raised by the call; files are read one by one as the
    iterator gets to them.

    Parameters
    ----------
    path : path-like
        File or folder. The files of a folder are read in the order of their names.
    format : str, optional
        Name of one of `FORMATS`; by default it is detected.
    image_size : tuple of int, optional
        Width and height in pixels of every image. Formats of normalised coordinates otherwise
        take it from the image files.
    on_error : callable, optional
        Called with the LabelError of each malformed record, which is then skipped; a file that
        cannot be used as a whole counts as one record. By default the first one is raised.

    Returns
    -------
    iterator of ImageLabels
        In the order of the files and, within a file, of the first appearance of the image.

    Raises
    ------
    FileNotFoundError
        If there is no such path.
    LabelError
        If a folder holds no label file, whatever `on_error` is; while iterating, at a malformed
        record without `on_error`.
    ValueError
        If the format is unknown or cannot be told, or `image_size` is not two positive integers.
    """
    path = Path(path)
    size = None if image_size is None else _checked_size(image_size)
    chosen = format_named(format or detect_format(path))
    files = label_files(path, chosen.suffixes)
    return _read_files(files, chosen, size, on_error or raise_error)


def _read_files(
    files: Sequence[Path],
    chosen: Format,
    size: ImageSize | None,
    on_error: OnError,
) -> Iterator[ImageLabels]:
    for file in files:
        yield from chosen.read(file, size, on_error)


def _checked_size(image_size: tuple[int, int]) -> ImageSize:
    try:
        width, height = map(operator.index, image_size)
    except (TypeError, ValueError):
        raise ValueError(f'image_size {image_size!r} is not (width, height)') from None
    if width <= 0 or height <= 0:
        raise ValueError(f'image_size {image_size!r} is not positive')
    return width, height
