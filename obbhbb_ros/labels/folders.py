# SPDX-License-Identifier: Apache-2.0
"""Label files in a folder, and the file that the labels of an image are written to."""

from __future__ import annotations

import errno
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterable
from pathlib import Path

from obbhbb_ros.labels.image_labels import AnyImage
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.text import write_lines

CLASSES_FILE = 'classes.txt'
IMAGE_SUFFIXES = ('.png', '.jpg', '.jpeg', '.tif', '.tiff', '.bmp', '.webp', '.jp2')


def label_files(path: Path, suffixes: Collection[str]) -> list[Path]:
    """
    List the label files of a path, at least one, sorted by name.

    The path is a file of any name, or a folder with label files directly in it. Suffixes are in
    lower case. Hidden files and ``classes.txt`` are not label files.
    Raises FileNotFoundError if there is no such path, ValueError for a pipe or a device, and
    LabelError if a folder holds no label file.
    """
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, 'no such label file or folder', str(path))
    if path.is_file():
        return [path]
    if not path.is_dir():
        # A pipe can be read only once, and detecting the format would read it first.
        raise ValueError(f'{path}: neither a regular file nor a folder')
    files = sorted(
        file
        for file in path.iterdir()
        if file.suffix.lower() in suffixes
        and file.is_file()
        and not file.name.startswith('.')
        and file.name != CLASSES_FILE
    )
    if not files:
        expected = ', '.join(sorted(suffixes))
        raise LabelError(path, None, f'no label file in this folder (looked for {expected})')
    return files


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


def bare_name(image: str) -> str:
    """Strip folders and an image suffix from an image name, as label files are named."""
    name = image.replace('\\', '/').rpartition('/')[2]
    stem, dot, suffix = name.rpartition('.')
    return stem if f'{dot}{suffix}'.lower() in IMAGE_SUFFIXES else name


def _file_stem(image: str) -> str:
    name = bare_name(image)
    if not name or name.startswith('.') or name == Path(CLASSES_FILE).stem:
        raise ValueError(f'image {image!r}: no label file can have this name')
    return name
