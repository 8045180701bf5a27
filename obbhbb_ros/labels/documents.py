# SPDX-License-Identifier: Apache-2.0
"""XML and JSON label files: parsing of whole documents, and checks of what they hold."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import TreeBuilder
from xml.parsers import expat

from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import ImageSize
from obbhbb_ros.labels.records import LabelFile
from obbhbb_ros.labels.text import parse_numbers

# The parser goes on to the end of a block after a handler has raised.
BLOCK_BYTES = 65536


def read_xml_boxes(
    file: LabelFile, root_tag: str, objects: str, parse: Callable[[Element], Box]
) -> tuple[Element, list[Box]]:
    """
    Read an XML file with one element per box.

    Parameters
    ----------
    file : LabelFile
        The file. A document type declaration is refused: label files have none, and its entities
        may expand to gigabytes or name other files.
    root_tag, objects : str
        Tag that the root must have, and path of the objects below it.
    parse : callable
        Element to Box; raises ValueError if it is malformed.

    Returns
    -------
    Element, list of Box
        The root, and the boxes in the order of the file.

    Raises
    ------
    FileError
        If it is not well-formed XML, has a document type declaration or another root.
    """
    root, lines = _parse_xml(file)
    if root.tag != root_tag:
        raise file.error(f'the root is <{root.tag}>, expected <{root_tag}>', lines[root])
    records = (
        (lines[element], f'object {number}: ', element)
        for number, element in enumerate(root.findall(objects), start=1)
    )
    return root, [box for _, _, box in file.parse_each(records, parse)]


def _parse_xml(file: LabelFile) -> tuple[Element, dict[Element, int]]:
    """Parse an XML file; also return the line that each element begins in."""
    data = file.path.read_bytes()
    builder = TreeBuilder()
    lines: dict[Element, int] = {}
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def start(tag: str, attributes: dict[str, str]) -> None:
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    def refuse(*_: object) -> None:
        raise ValueError('a document type declaration (DOCTYPE) is not accepted')

    parser.StartElementHandler = start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        for begin in range(0, len(data), BLOCK_BYTES):
            parser.Parse(data[begin : begin + BLOCK_BYTES], False)
        parser.Parse(b'', True)
    except expat.ExpatError as error:
        raise file.error(f'not XML: {expat.ErrorString(error.code)}', error.lineno) from None
    except (ValueError, LookupError) as error:
        # An encoding that Python cannot supply to the parser is a LookupError or a ValueError.
        raise file.error(str(error), parser.CurrentLineNumber) from None
    return builder.close(), lines


def xml_text(element: Element, *tags: str) -> str:
    """Return the stripped text of the first child element that has any, else ''."""
    texts = ((element.findtext(tag) or '').strip() for tag in tags)
    return next(filter(None, texts), '')


def xml_numbers(element: Element, tags: Sequence[str]) -> list[float]:
    """
    Read child elements that hold a number each.

    Raises
    ------
    ValueError
        If one is missing, or is not a finite number.
    """
    return [_xml_number(element, tag) for tag in tags]


def _xml_number(element: Element, tag: str) -> float:
    text = element.findtext(tag)
    if text is None:
        raise ValueError(f'no <{tag}> in <{element.tag}>')
    try:
        (number,) = parse_numbers([text.strip()])
    except ValueError as error:
        raise ValueError(f'<{tag}>: {error}') from None
    return number


def has_any(element: Element, tags: Sequence[str]) -> bool:
    """Return whether an element has one of these children."""
    return any(element.find(tag) is not None for tag in tags)


def image_size_of(width: object, height: object) -> ImageSize | None:
    """Return an image size if both are positive whole numbers or the text of one."""
    sides = []
    for value in (width, height):
        text = str(value)
        if isinstance(value, bool) or not (text.isascii() and text.isdigit() and len(text) < 10):
            return None
        sides.append(int(text))
    return (sides[0], sides[1]) if min(sides) > 0 else None


def read_json(file: LabelFile, shorten: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """
    Parse a JSON file, UTF-8 with or without BOM.

    `shorten` is called with each JSON object as soon as it is complete; its result replaces the
    object.

    Raises
    ------
    FileError
        If it is not JSON or nested too deeply.
    """
    data = file.path.read_bytes()
    try:
        return json.loads(data.decode('utf-8-sig'), object_hook=shorten)
    except json.JSONDecodeError as error:
        raise file.error(f'not JSON: {error.msg}', error.lineno) from None
    except RecursionError:
        raise file.error('not a label file: JSON nested too deeply') from None
    except ValueError as error:
        raise file.error(f'not JSON: {error}') from None


def numbered(name: str, records: Iterable[Any]) -> Iterator[tuple[None, str, Any]]:
    """Give records, for `LabelFile.parse_each`, a place: their number from 0."""
    return ((None, f'{name}[{index}]: ', record) for index, record in enumerate(records))


def json_member(record: object, name: str) -> Any:
    """
    Return a member of a JSON object.

    Raises
    ------
    ValueError
        If `record` is not an object, or has no such member.
    """
    if not isinstance(record, dict):
        raise ValueError('not a JSON object')
    if name not in record:
        raise ValueError(f'no {name!r}')
    return record[name]


def json_numbers(values: object, count: int | None, what: str) -> list[float]:
    """
    Check a JSON array of finite numbers: `count` of them, or any number if that is None.

    Raises
    ------
    ValueError
        If it is anything else; the message calls it `what`.
    """
    if not isinstance(values, list) or (count is not None and len(values) != count):
        raise ValueError(f'{what} is not an array of {"" if count is None else f"{count} "}numbers')
    return [json_number(value, what) for value in values]


def json_number(value: object, what: str) -> float:
    """
    Check a finite number.

    Raises
    ------
    ValueError
        If it is anything else; the message calls it `what`.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f'{what} has {value!r}, which is not a number')
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f'{what} has a number that is not finite')
    return number


def plain_text(value: object) -> str:
    """
    Turn a JSON or table value into the text of an id or a class; '' for none.

    Raises
    ------
    ValueError
        If it is text that cannot be written to a file: JSON can hold half a character.
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
        # Tables with a missing value somewhere keep whole numbers as 3.0.
        return str(int(value))
    return str(value)
