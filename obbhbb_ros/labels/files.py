# SPDX-License-Identifier: Apache-2.0
"""Which files of a folder are label files, and which file an image's labels go to."""

from __future__ import annotations

import errno
from collections.abc import Collection
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol
from typing import TypeVar

from obbhbb_ros.labels.records import LabelError

CLASSES_FILE = 'classes.txt'
IMAGE_SUFFIXES = ('.png', '.jpg', '.jpeg', '.tif', '.tiff', '.bmp', '.webp', '.jp2')


class Named(Protocol):
    """What goes to a file named after its image."""

    @property
    def image(self) -> str:
        """Image name."""


AnyImage = TypeVar('AnyImage', bound=Named)


def label_files(path: Path, suffixes: Collection[str]) -> list[Path]:
    """
    List the label files that a path stands for.

    Parameters
    ----------
    path : Path
        A file, which stands for itself whatever its name, or a folder, which stands for the files
        directly in it. Hidden files and ``classes.txt`` are not label files.
    suffixes : collection of str
        Suffixes to look for in a folder, lower case; files may have them in upper case.

    Returns
    -------
    list of Path
        Sorted by name, at least one.

    Raises
    ------
    FileNotFoundError
        If there is no such path.
    ValueError
        If it is a pipe or a device.
    LabelError
        If a folder holds no label file.
    """
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, 'no such label file or folder', str(path))
    if path.is_file():
        return [path]
    if not path.is_dir():
        # A pipe would be waited for, and formats are told from what is read twice.
        raise ValueError(f'{path}: neither a regular file nor a folder')
    files = sorted(each for each in path.iterdir() if _is_label_file(each, suffixes))
    if not files:
        wanted = ', '.join(sorted(suffixes))
        raise LabelError(path, None, f'no label file in this folder (looked for {wanted})')
    return files


def _is_label_file(path: Path, suffixes: Collection[str]) -> bool:
    if path.name.startswith('.') or path.name == CLASSES_FILE:
        return False
    return path.suffix.lower() in suffixes and path.is_file()


def target_files(
    path: Path,
    images: Iterable[AnyImage],
    suffix: str,
) -> list[tuple[Path, AnyImage]]:
    """
    Give each image a label file of its own.

    Parameters
    ----------
    path : Path
        A folder, which need not exist; or, for a single image, a file that ends in `suffix`.
    images : iterable of ImageLabels or ConvertedImage
        The images.
    suffix : str
        Suffix of the format's files, with the dot.

    Returns
    -------
    list of (Path, image)
        In the order of `images`.

    Raises
    ------
    ValueError
        If two images would share a file, a name makes no file name, or there is other than one
        image for a file.
    """
    images = list(images)
    if path.suffix.lower() == suffix and not path.is_dir():
        if len(images) != 1:
            raise ValueError(f'{path}: one file holds one image, not {len(images)}: name a folder')
        return [(path, images[0])]
    targets: dict[str, AnyImage] = {}
    for labels in images:
        name = f'{_stem(labels.image)}{suffix}'
        other = targets.setdefault(name, labels)
        if other is not labels:
            raise ValueError(f'{path / name}: both {other.image!r} and {labels.image!r} go there')
    return [(path / name, labels) for name, labels in targets.items()]


def bare_name(image: str) -> str:
    """Strip folders and an image suffix from an image name, as label files are named."""
    # A table may name images by path and suffix; a label file has the bare name of its image.
    name = image.replace('\\', '/').rpartition('/')[2]
    stem, dot, suffix = name.rpartition('.')
    return stem if f'{dot}{suffix}'.lower() in IMAGE_SUFFIXES else name


def _stem(image: str) -> str:
    name = bare_name(image)
    if not name or name.startswith('.') or name == Path(CLASSES_FILE).stem:
        raise ValueError(f'image {image!r} makes no name for a label file')
    return name
