# SPDX-License-Identifier: Apache-2.0
"""The names of class numbers, from the file that a tool writes beside the labels or above them."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any
from typing import NamedTuple

from obbhbb_ros.labels.folders import CLASSES_FILE
from obbhbb_ros.labels.label_file import FileError
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import raise_error
from obbhbb_ros.labels.text import is_index
from obbhbb_ros.labels.text import text_lines

DATA_FILE = 'data.yaml'
MAX_BYTES = 2**20


class ClassNames(NamedTuple):
    """Names by class number, '' for a number without one, and the file that they are from."""

    path: Path | None = None
    names: tuple[str, ...] = ()

    def name(self, index: str) -> str:
        """Return the name of a class, or its number if there is no file; may raise ValueError."""
        number = int(index)
        if self.path is None:
            return str(number)
        if number >= len(self.names) or not self.names[number]:
            raise ValueError(f'class {number} has no name in {self.path.name}')
        return self.names[number]


def find_class_names(folder: Path) -> ClassNames:
    """
    Read the class names of the label files in a folder; none if there is no file of names.

    The nearest of these is read: ``classes.txt``, ``obj.names`` (Darknet, Datumaro) and
    ``data.yaml`` (Ultralytics) in the folder or in the one above; ``data.yaml`` also in the one
    above that, since Ultralytics has ``labels/train``. Raises FileError if it cannot be read.
    """
    path = next((path for path in _candidates(folder.absolute()) if path.is_file()), None)
    if path is None:
        return ClassNames()
    try:
        status = path.stat()
        names = _read_names(path, status.st_mtime_ns, status.st_size)
        return ClassNames(path, names) if names else ClassNames()
    except LabelError as error:
        raise FileError(*error.args) from None


def _candidates(folder: Path) -> Iterator[Path]:
    for place in (folder, folder.parent):
        for name in (CLASSES_FILE, 'obj.names', DATA_FILE):
            yield place / name
    yield folder.parent.parent / DATA_FILE


def listed_names(path: Path) -> tuple[str, ...]:
    """Read one name per line, '' for a blank line."""
    return tuple(line.strip() for _, line in text_lines(path, raise_error))


@lru_cache(maxsize=16)
def _read_names(path: Path, _modified: int, size: int) -> tuple[str, ...]:
    """Read names once for all label files: time and size tell a file that has changed."""
    if size > MAX_BYTES:
        raise LabelError(path, None, f'{size} bytes are too many for a list of class names')
    return READERS.get(path.suffix, listed_names)(path)


def _names_in_yaml(path: Path) -> tuple[str, ...]:
    try:
        import yaml
    except ImportError:
        message = 'reading the class names needs PyYAML, which is not installed'
        raise LabelError(path, None, message) from None
    try:
        # Every scalar is text: a class may be called `no` or `1e3`.
        document = yaml.load(path.read_bytes(), yaml.BaseLoader)
    except (yaml.YAMLError, ValueError) as error:
        problem = str(error).replace('\n', ' ')
        raise LabelError(path, None, f'not YAML: {problem}') from None
    except RecursionError:
        raise LabelError(path, None, 'not class names: YAML nested too deeply') from None
    try:
        return _names_in_order(document.get('names', []) if isinstance(document, dict) else [])
    except ValueError as error:
        raise LabelError(path, None, f"'names' {error}") from None


def _names_in_order(names: Any) -> tuple[str, ...]:
    if isinstance(names, list):
        names = {str(index): name for index, name in enumerate(names)}
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise ValueError('is neither a list of names nor names by number')
    return _by_number(names)


def _by_number(names: Mapping[str, str]) -> tuple[str, ...]:
    wrong = next((key for key in names if not is_index(key) or len(key) > 5), None)
    if wrong is not None:
        raise ValueError(f'has {wrong!r}, which is not the number of a class')
    numbered = {int(key): name.strip() for key, name in names.items()}
    return tuple(numbered.get(number, '') for number in range(max(numbered, default=-1) + 1))


READERS: Mapping[str, Callable[[Path], tuple[str, ...]]] = {'.yaml': _names_in_yaml}
