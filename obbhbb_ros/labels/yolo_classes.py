# SPDX-License-Identifier: Apache-2.0
"""
The numbers of the classes of YOLO labels that are written, and the files that name them.

``data.yaml`` is written as Ultralytics needs it: above ``labels`` or ``labels/train`` if one of
these is the folder of the labels, else among them. Above ``labels`` there is a ``classes.txt`` too,
for Label Studio; among the labels it would stop globox and pylabel, and is only kept up to date.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from obbhbb_ros.files import write_text
from obbhbb_ros.labels import text
from obbhbb_ros.labels.class_names import DATA_FILE
from obbhbb_ros.labels.class_names import find_class_names
from obbhbb_ros.labels.class_order import ordered_classes
from obbhbb_ros.labels.folders import CLASSES_FILE
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels

# A file that begins so is ours to write again.
HEAD = '# Images and classes of a data set for Ultralytics, written by obbhbb convert.\n'
LABELS = 'labels'
VALIDATION = ('val', 'valid', 'validation')


class YoloClasses(NamedTuple):
    """The names of the class numbers of a folder of labels; none if classes are numbers."""

    folder: Path
    names: tuple[str, ...]

    @property
    def numbers(self) -> dict[str, str]:
        """The number of each class."""
        return {name: str(number) for number, name in enumerate(self.names) if name}

    def write(self) -> None:
        """Write the files that name the classes."""
        if not self.names:
            return
        root = _root(self.folder)
        if (self.folder / CLASSES_FILE).is_file():
            text.write_lines(self.folder / CLASSES_FILE, self.names)
        if root != self.folder:
            text.write_lines(root / CLASSES_FILE, self.names)
        if _is_ours(root / DATA_FILE):
            write_text(root / DATA_FILE, _data_set(self.folder, self.names))


def number_classes(folder: Path, images: Sequence[ImageLabels | ImageBoxes]) -> YoloClasses:
    """
    Give classes of images the numbers that they have in a folder of labels.

    Classes that are all numbers stay as they are. Else names that a file there or the source lists
    keep their number, and the others of `ordered_classes` follow. Raises ValueError if a class
    cannot be named in a file, or if it is missing in a file that somebody else wrote.
    """
    used = {name for image in images for name in image.class_ids}
    if all(text.is_index(name) and name == str(int(name)) for name in used):
        return YoloClasses(folder, ())
    for name in used:
        if not name or name != name.strip() or name.splitlines() != [name]:
            raise ValueError(f'class {name!r} cannot be a line of {CLASSES_FILE}')
    path, listed = find_class_names(folder)
    if path is None or path.parent not in (folder.absolute(), _root(folder).absolute()):
        path, listed = _root(folder) / DATA_FILE, ()
    if path.name != CLASSES_FILE and not _is_ours(path) and (missing := used - set(listed)):
        raise ValueError(f'{path}: class {min(missing)!r} is missing there: add its name')
    # Numbers without a name stay free.
    of_source = (image.extras.label_set.class_names for image in images)
    listed = listed or next(filter(None, of_source), ())
    new = [name for name in ordered_classes(images) if name not in listed]
    return YoloClasses(folder, (*listed, *new))


def _root(folder: Path) -> Path:
    """Return the folder above ``labels``, or the folder itself if it is neither that nor in it."""
    if folder.name == LABELS:
        return folder.parent
    return folder.parent.parent if folder.parent.name == LABELS else folder


def _is_ours(path: Path) -> bool:
    if not path.is_file():
        return path.name == DATA_FILE
    with path.open('rb') as stream:
        return stream.read(len(HEAD)) == HEAD.encode()


def _data_set(folder: Path, names: Sequence[str]) -> str:
    lines = [f'  {number}: {_quoted(name)}\n' for number, name in enumerate(names)]
    return ''.join([HEAD, *_parts(folder), 'names:\n', *lines])


def _parts(folder: Path) -> list[str]:
    """Return the lines of the parts of the data set, images for training first."""
    root = _root(folder)
    if root == folder or folder.name == LABELS:
        path = '.' if root == folder else 'images'
        return [f'train: {path}\n', f'val: {path}\n']
    others = folder.parent.iterdir() if folder.parent.is_dir() else ()
    names = sorted({folder.name, *(path.name for path in others if path.is_dir())})
    train = 'train' if 'train' in names else names[0]
    val = next((name for name in VALIDATION if name in names), train)
    test = ['test: images/test\n'] if 'test' in names else []
    return [f'train: {_quoted(f"images/{train}")}\n', f'val: {_quoted(f"images/{val}")}\n', *test]


def _quoted(name: str) -> str:
    """Quote a name for YAML, which has no characters that cannot be seen."""
    quoted = json.dumps(name, ensure_ascii=False)
    return ''.join(c if c.isprintable() else f'\\U{ord(c):08x}' for c in quoted)
