# SPDX-License-Identifier: Apache-2.0
"""JSON label files, and checks of the values in any document."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from obbhbb_ros.files import read_bounded
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.text import packing

TOKEN = re.compile(r'"((?:[^"\\]|\\.)*)("|$)|[][{},:]', re.DOTALL)
MAX_LEVEL = 4
# Of a file that is read as a whole; it takes several times as much in memory.
MAX_BYTES = 2**30
# How deep the value of a property may be nested.
MAX_DEPTH = 16


def image_size_of(width: object, height: object) -> ImageSize | None:
    """Return an image size if both are positive whole numbers or the text of one."""
    sides = str(width), str(height)
    if not all(side.isascii() and side.isdigit() and len(side) < 10 for side in sides):
        return None
    size = int(sides[0]), int(sides[1])
    return size if min(size) > 0 else None


def read_document(file: LabelFile) -> bytes:
    """Read a file as a whole; raise FileError if it is too large, or no regular file."""
    try:
        return read_bounded(file.path, MAX_BYTES)
    except ValueError as error:
        raise file.error(str(error)) from None


def read_json(file: LabelFile, shorten: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """
    Parse a JSON file, UTF-8 with or without BOM; raise FileError if it is not JSON.

    `shorten` is called with each JSON object as soon as it is complete; its result replaces the
    object.
    """
    data = read_document(file)
    if problem := packing(data):
        raise file.error(problem)
    try:
        return json.loads(data.decode('utf-8-sig'), object_hook=shorten)
    except json.JSONDecodeError as error:
        raise file.error(f'not JSON: {error.msg}', error.lineno) from None
    except RecursionError:
        raise file.error('not a label file: JSON nested too deeply') from None
    except ValueError as error:
        raise file.error(f'not JSON: {error}') from None


def json_paths(head: str) -> frozenset[str]:
    """
    Return what the beginning of a JSON file consists of, down to a few levels.

    A path is made of brackets and member names: ``{images[{id`` is the member ``id`` of the objects
    in the array ``images`` of the outermost object; ``{`` alone says that this is an object.
    """
    paths: set[str] = set()
    containers: list[str] = []
    name, named = '', False
    for token in TOKEN.finditer(head):
        mark = token[0]
        if mark in '{[':
            path = containers[-1] + name if containers else ''
            # Deeper ones are not told apart: their paths would grow with each level.
            containers.append(f'{path}{mark}' if len(containers) < MAX_LEVEL else mark)
            name, named = '', mark == '{'
        elif mark in '}]':
            del containers[-1:]
        elif mark == ',':
            name, named = '', bool(containers) and containers[-1].endswith('{')
        elif mark != ':' and named:
            name, named = token[1], False
        if containers and len(containers) <= MAX_LEVEL and mark not in '}]':
            paths.add(containers[-1] + name)
    return frozenset(paths)


def numbered(name: str, items: Iterable[Any]) -> Iterator[Record[Any]]:
    """Turn items into records for `LabelFile.parse_records`, numbered from 0: ``name[0]: ``."""
    return ((None, f'{name}[{index}]: ', item) for index, item in enumerate(items))


def json_member(record: object, name: str) -> Any:
    """Return a member of a JSON object; raise ValueError if it is no object or lacks the member."""
    if not isinstance(record, dict):
        raise ValueError('not a JSON object')
    if name not in record:
        raise ValueError(f'no {name!r}')
    return record[name]


def json_numbers(values: object, count: int | None, what: str) -> list[float]:
    """
    Check a JSON array of finite numbers: `count` of them, or any number if that is None.

    Raises ValueError if it is anything else; the message calls it `what`.
    """
    if not isinstance(values, list) or (count is not None and len(values) != count):
        raise ValueError(f'{what} is not an array of {"" if count is None else f"{count} "}numbers')
    if {*map(type, values)} <= {int, float}:
        with suppress(OverflowError):
            numbers = list(map(float, values))
            if math.isfinite(sum(numbers)):
                return numbers
    return [json_number(value, what) for value in values]


def json_number(value: object, what: str) -> float:
    """Check a finite number; raise ValueError, which calls it `what`, if it is anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f'{what} has {value!r}, which is not a number')
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f'{what} has a number that is not finite')
    return number


def parse_difficulty(value: str) -> int:
    """Parse how difficult a box is: a whole number below 1000; 0 if it is ''."""
    if value and not (value.isascii() and value.isdigit() and len(value) <= 3):
        raise ValueError(f'difficulty {value!r} is not a whole number')
    return int(value or 0)


def json_properties(record: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """
    Return the members of a JSON object that are not `known`; not a number becomes None.

    Raises ValueError if one is nested deeper than `MAX_DEPTH`, or is text that cannot be written.
    """
    return {
        plain_text(name): _json_property(name, value, 0)
        for name, value in record.items()
        if name not in known
    }


def _json_property(name: str, value: Any, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ValueError(f'{name!r} is nested deeper than {MAX_DEPTH}')
    if isinstance(value, list):
        return [_json_property(name, item, depth + 1) for item in value]
    if isinstance(value, dict):
        items = value.items()
        return {plain_text(key): _json_property(name, item, depth + 1) for key, item in items}
    if isinstance(value, str):
        return plain_text(value)
    if not isinstance(value, int | float | None):
        # The reader of a format has replaced the coordinates of a geometry.
        raise ValueError(f'{name!r} holds a geometry')
    return None if isinstance(value, float) and not math.isfinite(value) else value


def property_text(value: object) -> str:
    """Return the value of a property as text: JSON if it is no text, '' for none."""
    if isinstance(value, str):
        return value
    return '' if value is None else json.dumps(value, ensure_ascii=False)


def plain_text(value: object) -> str:
    """
    Turn a JSON or table value into the text of an id or a class; '' for none.

    Raises ValueError for text that cannot be written to a file: JSON can hold half a character.
    """
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise ValueError(f'{value!r} holds half a character (a lone surrogate)') from None
        return value
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ''
    if isinstance(value, float) and value.is_integer():
        # A table column with a missing value holds whole numbers as 3.0.
        return str(int(value))
    return str(value)
