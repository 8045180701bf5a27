# SPDX-License-Identifier: Apache-2.0
"""All label formats by name; reading and writing of label files in any of them."""

from __future__ import annotations

import codecs
import operator
import os
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from obbhbb_ros.labels import coco
from obbhbb_ros.labels import coco_results
from obbhbb_ros.labels import csv_tables
from obbhbb_ros.labels import cvat
from obbhbb_ros.labels import datumaro
from obbhbb_ros.labels import dota
from obbhbb_ros.labels import dota_results
from obbhbb_ros.labels import fair1m
from obbhbb_ros.labels import flatgeobuf
from obbhbb_ros.labels import geojson
from obbhbb_ros.labels import geopackage
from obbhbb_ros.labels import hrsc
from obbhbb_ros.labels import label_studio
from obbhbb_ros.labels import labelme
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import parquet
from obbhbb_ros.labels import shapefile
from obbhbb_ros.labels import ultralytics_json
from obbhbb_ros.labels import voc
from obbhbb_ros.labels import yolo
from obbhbb_ros.labels.folders import label_files
from obbhbb_ros.labels.image_grouper import concatenated
from obbhbb_ros.labels.image_labels import MIN_HULL_POINTS
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import FileError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import OnError
from obbhbb_ros.labels.label_file import raise_error
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.label_format import names
from obbhbb_ros.labels.shapes import check_coordinates
from obbhbb_ros.labels.text import packing
from obbhbb_ros.labels.unread import describe
from obbhbb_ros.labels.unread import unread_format

# Blank files have the first format of their suffix.
_ALL = (
    dota.FORMAT,
    dota_results.FORMAT,
    yolo.ORIENTED,
    yolo.UPRIGHT,
    csv_tables.CORNER_TABLE,
    csv_tables.WKT_TABLE,
    hrsc.FORMAT,
    voc.FORMAT,
    cvat.FORMAT,
    fair1m.FORMAT,
    coco.FORMAT,
    coco_results.FORMAT,
    datumaro.FORMAT,
    geojson.FORMAT,
    labelme.FORMAT,
    label_studio.FORMAT,
    ultralytics_json.FORMAT,
    shapefile.FORMAT,
    geopackage.FORMAT,
    flatgeobuf.FORMAT,
    parquet.FORMAT,
)
FORMATS: dict[str, Format] = {entry.name: entry for entry in _ALL}

_HEAD_BYTES = 16384
_CHECKED_FILES = 100


def format_named(name: str) -> Format:
    """Return the format of that name; raise ValueError, which lists all names, if none has it."""
    if name not in FORMATS:
        raise ValueError(f'unknown label format {name!r}: use {names(FORMATS.values())}')
    return FORMATS[name]


@dataclass(frozen=True)
class LabelSource:
    """
    The label files of a path, listed once, and their format.

    Attributes
    ----------
    format : Format
        The format, as the caller named it or as it was detected.
    files : list of Path
        The files, in the order in which they are read.
    """

    format: Format
    files: list[Path]

    def read(
        self, image_size: tuple[int, int] | None = None, on_error: OnError | None = None
    ) -> Iterator[ImageLabels]:
        """Read the files one by one; options and errors are those of `read_labels`."""
        size = None if image_size is None else _checked_size(image_size)
        images = self._images(size, on_error or raise_error)
        return _gathered(images) if self.format.spread else images

    def _images(self, size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
        for file in self.files:
            try:
                yield from self.format.read(LabelFile(file, size, on_error))
            except FileError as error:
                on_error(self._explained(error))

    def _explained(self, error: FileError) -> FileError:
        """Say what the file is, if it is in another format."""
        try:
            head = _head(error.path)
        except OSError:
            return error
        other, fitting = unread_format(_suffix(error.path), head), _only_fitting(error.path)
        if other is not None:
            return FileError(error.path, None, other.message)
        if fitting is None or fitting is self.format:
            return error
        message = f'{error.message} (it looks like {fitting.name})'
        return FileError(error.path, error.line, message)


def _gathered(images: Iterable[ImageLabels]) -> Iterator[ImageLabels]:
    """Join the boxes of each image from all files; source is the first file that has it."""
    parts: dict[str, list[ImageLabels]] = {}
    for image in images:
        parts.setdefault(image.image, []).append(image)
    return map(concatenated, parts.values())


def find_labels(path: Path, name: str | None = None) -> LabelSource:
    """
    List the label files of a file or folder, in the named format or in the one detected.

    Errors are those of `detect_format`; ValueError too if no format has the name.
    """
    if name:
        chosen = format_named(name)
        return _checked(LabelSource(chosen, label_files(path, chosen.suffixes)))
    suffixes = {suffix for format_ in FORMATS.values() for suffix in format_.suffixes}
    files = label_files(path, suffixes)
    candidates = _formats_by_content(files)
    if len(candidates) > 1:
        raise ValueError(f'{path}: more than one label format: name one of {names(candidates)}')
    chosen = candidates[0] if candidates else _format_by_suffix(path, files)
    files = [file for file in files if _suffix(file) in chosen.suffixes]
    return _checked(LabelSource(chosen, files))


def _checked(source: LabelSource) -> LabelSource:
    """
    Raise ValueError if the first files of a folder mean something else than their format.

    Angles, for example, show in some files, and look like confidences in others.
    """
    for file in source.files[:_CHECKED_FILES] if len(source.files) > 1 else ():
        if problem := source.format.problem(_head(file)):
            raise ValueError(f'{file}: {problem}')
    return source


def detect_format(path: str | os.PathLike[str]) -> str:
    """
    Detect the format of a label file, or of the label files in a folder: a key of `FORMATS`.

    The beginning of the file is compared with the formats of its suffix: one line that fits exactly
    one of them is enough. In a folder, the first file of each suffix whose format can be detected
    decides for all files of that suffix. If the content does not decide, the suffix does, provided
    only one format has it. Blank files get the first format of their suffix: in every format they
    are an image without boxes.

    Raises
    ------
    FileNotFoundError
        If the path does not exist.
    LabelError
        If a folder holds no label file.
    ValueError
        If the format cannot be detected, or a folder holds files of more than one format.
    """
    return find_labels(Path(path)).format.name


def _formats_by_content(files: Iterable[Path]) -> list[Format]:
    """Return the format that decides for each suffix, if any, without repetition."""
    formats: dict[str, Format] = {}
    for _, group in groupby(sorted(files, key=_suffix), key=_suffix):
        first = next(filter(None, map(_only_fitting, group)), None)
        if first is not None:
            formats[first.name] = first
    return list(formats.values())


def _only_fitting(file: Path) -> Format | None:
    head = _head(file)
    if unread_format(_suffix(file), head) is not None:
        return None
    fitting = [candidate for candidate in _formats_of(file) if candidate.sniff(head)]
    return fitting[0] if len(fitting) == 1 else None


def _format_by_suffix(path: Path, files: Sequence[Path]) -> Format:
    for file in files:
        if (other := unread_format(_suffix(file), _head(file))) is not None:
            raise ValueError(f'{file}: {other.message}')
    candidates = {fitting.name: fitting for file in files for fitting in _formats_of(file)}
    blank = all(not _head(file).strip() for file in files)
    if len(candidates) == 1 or (candidates and blank):
        return next(iter(candidates.values()))
    file = next((file for file in files if _head(file).strip()), path)
    problem = f'cannot detect the label format: {_problem(file)}'
    raise ValueError(f'{file}: {problem}: use {names(FORMATS.values())}')


def _problem(file: Path) -> str:
    head = _head(file)
    fitting = [candidate for candidate in _formats_of(file) if candidate.sniff(head)]
    if len(fitting) > 1:
        return f'it fits {names(fitting)}, name one of them'
    with file.open('rb') as stream:
        return packing(stream.read(4)) or describe(head)


def _formats_of(file: Path) -> list[Format]:
    return [candidate for candidate in FORMATS.values() if _suffix(file) in candidate.suffixes]


def _suffix(file: Path) -> str:
    return file.suffix.lower()


def _head(file: Path) -> str:
    with file.open('rb') as stream:
        data = stream.read(_HEAD_BYTES)
    return data.removeprefix(codecs.BOM_UTF8).decode(errors='replace')


def read_labels(
    path: str | os.PathLike[str],
    format: str | None = None,  # noqa: A002
    *,
    image_size: tuple[int, int] | None = None,
    on_error: OnError | None = None,
) -> Iterator[ImageLabels]:
    """
    Read the labels of a file, of the label files in a folder, or of a data set.

    Errors in the arguments are raised by the call; files are read one by one during iteration.

    Parameters
    ----------
    path : path-like
        File, folder, or root of a data set, whose sub-folders are read. The files of a folder are
        read in the order of their names.
    format : str, optional
        Name of one of `FORMATS`; detected by default.
    image_size : tuple of int, optional
        Width and height in pixels of every image. By default from the labels or, in formats with
        normalised coordinates, from the image files.
    on_error : callable, optional
        Gets the LabelError of each malformed record, which is then skipped; a file that cannot be
        used as a whole counts as one record. By default the first error is raised.

    Returns
    -------
    iterator of ImageLabels
        In the order of the files and, within a file, of the first appearance of the image.

    Raises
    ------
    FileNotFoundError
        If the path does not exist.
    LabelError
        If a folder holds no label file, also with `on_error`; while iterating, at a malformed
        record without `on_error`.
    ValueError
        If the format is unknown or cannot be detected, or `image_size` is not two positive
        integers.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, 'P0706.txt').write_text('10 20 50 20 50 30 10 30 ship 0')
    ...     (labels,) = read_labels(folder)
    >>> labels.image, labels.class_ids
    ('P0706', ('ship',))
    >>> labels.corners.tolist()
    [[[10.0, 20.0], [50.0, 20.0], [50.0, 30.0], [10.0, 30.0]]]
    """
    return find_labels(Path(path), format).read(image_size, on_error)


def _checked_size(image_size: tuple[int, int]) -> ImageSize:
    try:
        width, height = map(operator.index, image_size)
    except (TypeError, ValueError):
        raise ValueError(f'image_size {image_size!r} is not (width, height)') from None
    if width <= 0 or height <= 0:
        raise ValueError(f'image_size {image_size!r} is not two positive numbers')
    return width, height


def write_labels(
    path: str | os.PathLike[str],
    images: Iterable[ImageLabels],
    format: str | None = None,  # noqa: A002
) -> None:
    """
    Write labels to a file or, in formats with one file per image, to a folder.

    All labels are checked and turned into text before the first file is opened, so `images` may
    come from `read_labels` of the same path. Values that the format cannot hold are left out.

    Parameters
    ----------
    path : path-like
        File or folder; missing folders are created. In a folder each image gets a file, named
        after it without folder and image suffix; files of other images stay. A single image may
        also be written to a file.
    images : iterable of ImageLabels
        The images.
    format : str, optional
        Name of one of `FORMATS`; by default from the suffix of `path`.

    Raises
    ------
    ValueError
        If the format is unknown, cannot be written or does not follow from the suffix; if a number
        is not finite (a row of `reference` may be all NaN) or a hull has fewer than three points;
        if the format cannot hold a name or value. Nothing is written then.
    OSError
        If a file cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     dota, table = Path(folder, 'P0706.txt'), Path(folder, 'ships.csv')
    ...     _ = dota.write_text('10 20 50 20 50 30 10 30 ship 0')
    ...     write_labels(table, read_labels(dota))
    ...     print(table.read_text().splitlines()[1])
    P0706,,ship,10.0,20.0,50.0,20.0,50.0,30.0,10.0,30.0,,,,,
    """
    path = Path(path)
    able = [entry for entry in FORMATS.values() if entry.write is not None]
    write = _format_to_write(path, format, able, 'oriented boxes').write
    assert write is not None
    checked = [maps.restored(labels) for labels in images]
    for labels in checked:
        _check(labels)
    write(path, checked)


def write_boxes(
    path: str | os.PathLike[str],
    images: Iterable[ImageBoxes],
    format: str | None = None,  # noqa: A002
    variant: str | None = None,
) -> None:
    """
    Write axis-aligned boxes to a file or, in formats with one file per image, to a folder.

    Parameters and errors are those of `write_labels`; `variant` is one of `Format.variants`, by
    name, a way of writing the format that some tools need. It is also an error if there is no such
    variant, or if the images have diagnostics and the format cannot hold them. Names, ids and
    scores it cannot hold are left out.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> boxes = ImageBoxes(
    ...     'P0706', np.array([[10.0, 20.0, 50.0, 30.0]]), ('ship',), ('7',), np.ones(1),
    ...     size=(1024, 768), source=Path('P0706.txt'),
    ... )
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder, 'ships.csv')
    ...     write_boxes(path, [boxes])
    ...     print(path.read_text(), end='')
    image,instance,class,score,x_min,y_min,x_max,y_max
    P0706,7,ship,1.0,10.0,20.0,50.0,30.0
    """
    path = Path(path)
    images = list(images)
    diagnosed = any(image.diagnostics is not None for image in images)
    box_format(path, format, diagnosed).box_writer(variant)(path, images)


def box_format(path: Path, name: str | None, diagnosed: bool = False) -> Format:
    """Choose the format that `write_boxes` writes, or raise its ValueError."""
    able = [entry for entry in FORMATS.values() if entry.write_boxes is not None]
    chosen = _format_to_write(path, name, able, 'axis-aligned boxes')
    if diagnosed and 'diagnostics' not in chosen.holds:
        able = [entry for entry in able if 'diagnostics' in entry.holds]
        raise ValueError(f'label format {chosen.name!r} cannot hold diagnostics: use {names(able)}')
    return chosen


def _format_to_write(path: Path, name: str | None, able: list[Format], what: str) -> Format:
    if name is None:
        # A suffix of two formats belongs to the one whose first suffix it is.
        fitting = [entry for entry in able if _suffix(path) == entry.suffixes[0]]
        if len(fitting) != 1:
            raise ValueError(f'{path}: name the label format to write: {names(able)}')
        return fitting[0]
    chosen = format_named(name)
    if chosen not in able:
        raise ValueError(f'cannot write {what} as {name!r}: use {names(able)}')
    return chosen


def _check(labels: ImageLabels) -> None:
    reference = labels.reference[~np.isnan(labels.reference).all(axis=1)]
    columns = {'corners': labels.corners, 'scores': labels.scores, 'reference': reference}
    for name, values in columns.items():
        if not np.isfinite(values).all():
            raise ValueError(f'image {labels.image!r}: {name} has a value that is not finite')
    for hull in labels.hulls:
        if hull is None:
            continue
        try:
            check_coordinates(hull)
        except ValueError as error:
            raise ValueError(f'image {labels.image!r}: hulls: {error}') from None
        if hull.ndim != 2 or hull.shape[1] != 2 or len(hull) < MIN_HULL_POINTS:
            raise ValueError(f'image {labels.image!r}: a hull has shape {hull.shape}')
