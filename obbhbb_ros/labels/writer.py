# SPDX-License-Identifier: Apache-2.0
"""The one way to write labels, and the one to write converted boxes, whatever their format."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import Write
from obbhbb_ros.labels.format import names
from obbhbb_ros.labels.records import MIN_HULL_POINTS
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.registry import FORMATS
from obbhbb_ros.labels.registry import format_named
from obbhbb_ros.labels.registry import formats_for
from obbhbb_ros.labels.shapes import check_coordinates


def write_labels(
    path: str | os.PathLike[str],
    images: Iterable[ImageLabels],
    format: str | None = None,  # noqa: A002
) -> None:
    """
    Write labels to a file or, in formats of one image a file, to a folder.

    All labels are checked and turned into text before the first file is opened, so `images` may
    come from `read_labels` of the same path. What a format cannot hold is left out.

    Parameters
    ----------
    path : path-like
        File or folder; folders on the way to it are made. A folder of label files gets one file
        an image, named after it without folder and image suffix; files of other images in it
        stay. A single image may also go to a file.
    images : iterable of ImageLabels
        The images.
    format : str, optional
        Name of one of `FORMATS`; may be left out where the suffix of `path` says it.

    Raises
    ------
    ValueError
        If the format is unknown, read-only or not to be told from the suffix; if a number is not
        finite (a row of `reference` may be NaN as a whole) or a hull has fewer than three points;
        if the format cannot hold a name or value. Nothing is written then.
    OSError
        If a file cannot be written.
    """
    path = Path(path)
    write = _writer(path, format)
    checked = list(images)
    for labels in checked:
        _check(labels)
    write(path, checked)


def _writer(path: Path, name: str | None) -> Write:
    chosen = _format_by_suffix(path) if name is None else format_named(name)
    if chosen.write is None:
        raise ValueError(f'label format {chosen.name!r} is read-only: writable are {_writable()}')
    return chosen.write


def _format_by_suffix(path: Path) -> Format:
    candidates = [each for each in formats_for(path.suffix) if each.write is not None]
    if len(candidates) != 1:
        raise ValueError(f'{path}: name the label format to write: {_writable()}')
    return candidates[0]


def _writable() -> str:
    return names(each for each in FORMATS.values() if each.write is not None)


def write_boxes(
    path: str | os.PathLike[str],
    images: Iterable[ConvertedImage],
    format: str | None = None,  # noqa: A002
) -> None:
    """
    Write axis-aligned boxes to a file or, in formats of one image a file, to a folder.

    All boxes are checked and turned into text before the first file is opened. Names, ids and
    scores that a format cannot hold are left out.

    Parameters
    ----------
    path : path-like
        File or folder, as for `write_labels`.
    images : iterable of ConvertedImage
        The images.
    format : str, optional
        Name of one of `FORMATS`; may be left out where the suffix of `path` says it.

    Raises
    ------
    ValueError
        If the format is unknown, has no place for axis-aligned boxes or for diagnostics that are
        given, or is not to be told from the suffix; if it cannot hold a name or value. Nothing is
        written then.
    OSError
        If a file cannot be written.
    """
    path = Path(path)
    chosen = box_format(path, format)
    converted = list(images)
    if not chosen.holds_diagnostics and any(each.diagnostics is not None for each in converted):
        raise ValueError(no_diagnostics(chosen))
    assert chosen.write_boxes is not None
    chosen.write_boxes(path, converted)


def box_format(path: Path, name: str | None) -> Format:
    """
    Tell the format that `write_boxes` would write.

    Raises
    ------
    ValueError
        As `write_boxes`.
    """
    able = [each for each in FORMATS.values() if each.write_boxes is not None]
    if name is not None:
        chosen = format_named(name)
        if chosen not in able:
            raise ValueError(f'label format {name!r} is not for boxes: use {names(able)}')
        return chosen
    # A suffix that two formats share belongs to the one that has it first.
    candidates = [each for each in able if path.suffix.lower() == each.suffixes[0]]
    if len(candidates) != 1:
        raise ValueError(f'{path}: name the label format to write: {names(able)}')
    return candidates[0]


def no_diagnostics(chosen: Format) -> str:
    """Say that a format has no place for diagnostics, and which do."""
    able = names(each for each in FORMATS.values() if each.holds_diagnostics)
    return f'label format {chosen.name!r} has no place for diagnostics: use {able}'


def _check(labels: ImageLabels) -> None:
    hulls = [hull for hull in labels.hulls if hull is not None]
    referenced = ~np.isnan(labels.reference).all(axis=1)
    _check_finite(labels, 'corners', labels.corners)
    _check_finite(labels, 'scores', labels.scores)
    _check_finite(labels, 'reference', labels.reference[referenced])
    for hull in hulls:
        try:
            check_coordinates(hull)
        except ValueError as error:
            raise ValueError(f'image {labels.image!r}: hulls: {error}') from None
        if hull.ndim != 2 or hull.shape[1] != 2 or len(hull) < MIN_HULL_POINTS:
            raise ValueError(f'image {labels.image!r}: a hull has shape {hull.shape}')


def _check_finite(labels: ImageLabels, name: str, values: FloatArray) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f'image {labels.image!r}: {name} has a value that is not finite')
