# SPDX-License-Identifier: Apache-2.0
"""All label formats by name, and the one that a path holds."""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterable
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from obbhbb_ros.labels import coco
from obbhbb_ros.labels import dota
from obbhbb_ros.labels import geojson
from obbhbb_ros.labels import hrsc
from obbhbb_ros.labels import shapefile
from obbhbb_ros.labels import table
from obbhbb_ros.labels import voc
from obbhbb_ros.labels import wkt
from obbhbb_ros.labels import yolo
from obbhbb_ros.labels import yolo_obb
from obbhbb_ros.labels.files import label_files
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import names

# A new format is a module with a FORMAT, named here.
_MODULES = (dota, yolo_obb, yolo, table, wkt, hrsc, voc, coco, geojson, shapefile)

FORMATS: dict[str, Format] = {module.FORMAT.name: module.FORMAT for module in _MODULES}

_HEAD_BYTES = 16384


def format_named(name: str) -> Format:
    """
    Look up a format.

    Raises
    ------
    ValueError
        If there is no format of that name; the message has those there are.
    """
    if name not in FORMATS:
        raise ValueError(f'unknown label format {name!r}: known are {names(FORMATS.values())}')
    return FORMATS[name]


def formats_for(suffix: str) -> list[Format]:
    """List the formats of a file suffix (any case) in the order of the registry."""
    return [each for each in FORMATS.values() if suffix.lower() in each.suffixes]


def detect_format(path: str | os.PathLike[str]) -> str:
    """
    Tell the format of a label file, or of the label files in a folder.

    The suffix says which formats may be meant, and the beginning of the file which of them is:
    one line of it that fits just one format will do, whatever surrounds it. In a folder the first
    file that can be told speaks for those of its suffix. Where nothing can be told from the
    content, the suffix decides if only one format has it; and blank files count as the first
    format of theirs, since for all of them they are an image without boxes.

    Parameters
    ----------
    path : path-like
        A file or a folder.

    Returns
    -------
    str
        Name of one of `FORMATS`.

    Raises
    ------
    FileNotFoundError
        If there is no such path.
    LabelError
        If a folder holds no label file.
    ValueError
        If the format cannot be told, or a folder holds files of more than one.
    """
    path = Path(path)
    suffixes = {suffix for each in FORMATS.values() for suffix in each.suffixes}
    files = label_files(path, suffixes)
    found = _sniff_files(files)
    if len(found) > 1:
        raise ValueError(f'{path}: holds more than one label format: {names(found)}: name one')
    return (found[0] if found else _by_suffix(path, files)).name


def _sniff_files(files: Iterable[Path]) -> list[Format]:
    found: dict[str, Format] = {}
    by_suffix = sorted(files, key=_suffix)
    for _, group in groupby(by_suffix, key=_suffix):
        told = next((each for each in map(_sniff_file, group) if each is not None), None)
        if told is not None:
            found[told.name] = told
    return list(found.values())


def _sniff_file(file: Path) -> Format | None:
    head = _head(file)
    fitting = [each for each in formats_for(_suffix(file)) if each.sniff(head)]
    return fitting[0] if len(fitting) == 1 else None


def _by_suffix(path: Path, files: Sequence[Path]) -> Format:
    candidates = {each.name: each for file in files for each in formats_for(_suffix(file))}
    blank = all(not _head(file).strip() for file in files)
    if len(candidates) == 1 or (candidates and blank):
        return next(iter(candidates.values()))
    raise ValueError(f'{path}: cannot tell the label format: known are {names(FORMATS.values())}')


def _suffix(file: Path) -> str:
    return file.suffix.lower()


def _head(file: Path) -> str:
    with file.open('rb') as stream:
        data = stream.read(_HEAD_BYTES)
    return data.removeprefix(codecs.BOM_UTF8).decode(errors='replace')
