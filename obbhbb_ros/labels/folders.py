# SPDX-License-Identifier: Apache-2.0
"""Label files in a folder, and the file that the labels of an image are written to."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterable
from pathlib import Path

from obbhbb_ros.labels.image_labels import AnyImage
from obbhbb_ros.labels.image_names import IMAGE_SUFFIXES
from obbhbb_ros.labels.image_names import bare_name
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.text import write_lines

CLASSES_FILE = 'classes.txt'
# Folders of labels in the data sets of Ultralytics, Label Studio, DOTA, Pascal VOC and Darknet.
LABEL_FOLDERS = re.compile('labels|labelTxt.*|Annotations|obj_.*_data')
NO_FOLDERS = re.compile(r'\.|(images|JPEGImages|ImageSets|Segmentation\w+)$')
NO_LABELS = re.compile(
    rf'\.|({re.escape(CLASSES_FILE)}|labelmap\.txt|notes\.json)$|(readme|license)\b', re.IGNORECASE
)
# Beside the instances of COCO, files of the same images and boxes.
OF_INSTANCES = re.compile(
    r'(?:captions|image_info|labels|panoptic|person_keypoints|stuff)(_.+\.json)'
)
MAX_DEPTH = 3
LIST_BYTES = 4096


def label_files(path: Path, suffixes: Collection[str]) -> list[Path]:
    """
    List the label files of a path, at least one, sorted by name.

    The path is a file of any name, or a folder with label files directly in it, or else in its
    sub-folders: the root of a data set as tools export it, whose ``labels``, ``labelTxt``,
    ``Annotations`` or ``obj_train_data`` are read where there is one of them. Suffixes are in lower
    case. Hidden files, lists of classes, read-me files and, in a root, lists of images are not
    label files; nor are, beside the ``instances`` of COCO, ``stuff`` and others of the same images.
    Raises FileNotFoundError if there is no such path, ValueError for a pipe or a device, and
    LabelError if a folder holds no label file, or a root more than one folder of them.
    """
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, 'no such label file or folder', str(path))
    if path.is_file():
        return [path]
    if not path.is_dir():
        # A pipe can be read only once, and detecting the format would read it first.
        raise ValueError(f'{path}: neither a regular file nor a folder')
    entries = sorted(path.iterdir())
    files = _files_among(entries, suffixes)
    roots = [entry for entry in entries if LABEL_FOLDERS.fullmatch(entry.name) and entry.is_dir()]
    if not files or (roots and all(map(_is_list_of_images, files))):
        files = _files_below(path, roots, suffixes)
    if not files:
        expected = ', '.join(sorted(suffixes))
        raise LabelError(
            path, None, f'no label file in this folder or below (looked for {expected})'
        )
    return files


def unread_folders(path: Path, suffixes: Collection[str]) -> list[Path]:
    """
    List the sub-folders that `label_files` leaves out because label files lie beside them.

    They hold files of the same suffix at least.
    """
    if not path.is_dir():
        return []
    # Without sorting and without a look at the files: most folders have no sub-folder.
    with os.scandir(path) as entries:
        inner = (Path(entry) for entry in entries if entry.is_dir())
        folders = sorted(folder for folder in inner if not NO_FOLDERS.match(folder.name))
    files = _files_among(path.iterdir(), suffixes) if folders else []
    if all(map(_is_list_of_images, files)):
        return []
    beside = {file.suffix.lower() for file in files}
    return [folder for folder in folders if _files_of_tree(folder, beside, MAX_DEPTH - 1)]


def _files_below(path: Path, roots: list[Path], suffixes: Collection[str]) -> list[Path]:
    """List the label files in the folders of labels, or in all sub-folders if there are none."""
    by_kind: dict[str, list[Path]] = {}
    for root in roots:
        # Darknet has one folder for each part of a data set.
        kind = re.sub('obj_.*_data', 'obj_data', root.name)
        by_kind.setdefault(kind, []).extend(_files_of_tree(root, suffixes, MAX_DEPTH))
    several = [kind for kind, files in by_kind.items() if files]
    if len(several) > 1:
        raise LabelError(path, None, f'label files in {" and ".join(several)}: name one of them')
    if several:
        return by_kind[several[0]]
    return _files_of_tree(path, suffixes, MAX_DEPTH)


def _files_of_tree(folder: Path, suffixes: Collection[str], depth: int) -> list[Path]:
    entries = sorted(folder.iterdir())
    files = _files_among(entries, suffixes)
    for entry in entries if depth else ():
        if not NO_FOLDERS.match(entry.name) and entry.is_dir():
            files += _files_of_tree(entry, suffixes, depth - 1)
    return files


def _files_among(entries: Iterable[Path], suffixes: Collection[str]) -> list[Path]:
    files = [
        entry
        for entry in entries
        if entry.suffix.lower() in suffixes and entry.is_file() and not NO_LABELS.match(entry.name)
    ]
    names = {file.name for file in files}
    return [file for file in files if _instances_of(file.name) not in names]


def _instances_of(name: str) -> str | None:
    match = OF_INSTANCES.fullmatch(name)
    return match and f'instances{match[1]}'


def _is_list_of_images(file: Path) -> bool:
    with file.open('rb') as stream:
        lines = stream.read(LIST_BYTES).decode(errors='replace').split('\n')
    # The last one may be cut off.
    entries = [line.strip().lower() for line in lines[:-1] or lines if line.strip()]
    return bool(entries) and all(entry.endswith(IMAGE_SUFFIXES) for entry in entries)


def target_files(
    path: Path, images: Iterable[AnyImage], suffix: str
) -> list[tuple[Path, AnyImage]]:
    """
    Choose the label file of each image.

    The path is a folder, which need not exist, or, for a single image, a file that ends in
    `suffix`. Raises ValueError if the path is a file but there is not exactly one image, if two
    images would have the same file, or if no file can be named after an image.
    """
    images = list(images)
    if path.suffix.lower() == suffix and not path.is_dir():
        if len(images) != 1:
            raise ValueError(f'{path}: one file holds one image, not {len(images)}: use a folder')
        return [(path, images[0])]
    targets: dict[str, AnyImage] = {}
    for image in images:
        name = f'{_file_stem(image.image)}{suffix}'
        other = targets.setdefault(name, image)
        if other is not image:
            both = f'both {other.image!r} and {image.image!r}'
            raise ValueError(f'{path / name}: {both} would be written there')
    return [(path / name, image) for name, image in targets.items()]


def write_per_image(
    path: Path, images: Iterable[AnyImage], suffix: str, lines: Callable[[AnyImage], list[str]]
) -> None:
    """
    Write one file per image, see `target_files`, once all of them are turned into lines.

    `lines` returns the lines for an image, and raises ValueError if the format cannot hold them.
    """
    files = [(file, lines(image)) for file, image in target_files(path, images, suffix)]
    for file, text in files:
        write_lines(file, text)


def _file_stem(image: str) -> str:
    name = bare_name(image)
    if not name or name.startswith('.') or name == Path(CLASSES_FILE).stem:
        raise ValueError(f'image {image!r}: no label file can have this name')
    return name
