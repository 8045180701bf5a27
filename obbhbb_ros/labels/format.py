# SPDX-License-Identifier: Apache-2.0
"""What a label format has to offer to be read and written like the others."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import OnError

ImageSize = tuple[int, int]
Read = Callable[[Path, ImageSize | None, OnError], Iterator[ImageLabels]]
Write = Callable[[Path, list[ImageLabels]], None]
WriteBoxes = Callable[[Path, list[ConvertedImage]], None]


@dataclass(frozen=True)
class Format:
    """
    A label format: a module of this package holds one as ``FORMAT``.

    Attributes
    ----------
    name : str
        What users call it.
    suffixes : tuple of str
        Suffixes of its files, lower case with the dot.
    summary : str
        One line for help texts.
    read : callable
        ``read(path, image_size, on_error)`` yields the images of one file, one or many. It passes
        every malformed record to `on_error` and, should that return, goes on without the record.
    write : callable or None
        ``write(path, images)`` writes checked labels to a file or, for formats of one image a
        file, a folder. None for a format that is only read.
    sniff : callable
        ``sniff(head)`` tells whether the beginning of a file looks like this format and like no
        other one that shares a suffix.
    write_boxes : callable or None
        ``write_boxes(path, images)`` writes checked axis-aligned boxes, as `write` does oriented
        ones. None for a format that has no place for them.
    holds_diagnostics : bool
        Whether `write_boxes` writes the diagnostics of a conversion.
    """

    name: str
    suffixes: tuple[str, ...]
    summary: str
    read: Read
    write: Write | None
    sniff: Callable[[str], bool]
    write_boxes: WriteBoxes | None = None
    holds_diagnostics: bool = False


def names(formats: Iterable[Format]) -> str:
    """List formats for a message: ``csv (.csv), dota (.txt)``."""
    return ', '.join(f'{each.name} ({", ".join(each.suffixes)})' for each in formats)
