# SPDX-License-Identifier: Apache-2.0
"""XML and JSON label files: whole documents in, with what is wrong with them as a LabelError."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.text import parse_numbers

# The parser goes on to the end of a block after a handler has raised.
BLOCK_BYTES = 65536


@dataclass(frozen=True, eq=False)
class XmlDocument:
    """
    A parsed XML file.

    Attributes
    ----------
    root : Element
        Its root.
    lines : dict of Element to int
        The line that each element begins in, counted from 1.
    """

    root: ElementTree.Element
    lines: dict[ElementTree.Element, int]


def read_xml(path: Path, root: str) -> XmlDocument:
    """
    Parse an XML file that may come from anywhere.

    A document type declaration is refused: label files have none, and its entities may expand to
    gigabytes or name other files.

    Parameters
    ----------
    path : Path
        The file.
    root : str
        Tag that its root must have.

    Returns
    -------
    XmlDocument
        The tree with line numbers.

    Raises
    ------
    LabelError
        If it is not well-formed XML, has a document type declaration or another root.
    OSError
        If the file cannot be read.
    """
    data = path.read_bytes()
    builder = ElementTree.TreeBuilder()
    lines: dict[ElementTree.Element, int] = {}
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
        message = f'not XML: {expat.ErrorString(error.code)}'
        raise LabelError(path, error.lineno, message) from None
    except (ValueError, LookupError) as error:
        # An encoding that Python cannot supply to the parser is a LookupError or a ValueError.
        raise LabelError(path, parser.CurrentLineNumber, str(error)) from None
    document = XmlDocument(builder.close(), lines)
    if document.root.tag != root:
        message = f'the root is <{document.root.tag}>, expected <{root}>'
        raise LabelError(path, lines[document.root], message)
    return document


def read_xml_records(
    path: Path,
    document: XmlDocument,
    elements: Sequence[ElementTree.Element],
    parse: Callable[[ElementTree.Element], Box],
    on_error: OnError,
) -> list[Box]:
    """
    Parse the objects of a file one by one.

    Parameters
    ----------
    path : Path
        The file.
    document : XmlDocument
        What was read of it.
    elements : sequence of Element
        The objects.
    parse : callable
        Element to Box; raises ValueError where malformed.
    on_error : callable
        Gets a LabelError with line and number for each object that `parse` refuses; it is left
        out.

    Returns
    -------
    list of Box
        In the order of the file.
    """
    boxes = []
    for number, element in enumerate(elements, start=1):
        try:
            boxes.append(parse(element))
        except ValueError as error:
            message = f'object {number}: {error}'
            on_error(LabelError(path, document.lines[element], message))
    return boxes


def xml_text(element: ElementTree.Element, *tags: str) -> str:
    """Return the stripped text of the first of some child elements that has any, else ''."""
    for tag in tags:
        text = (element.findtext(tag) or '').strip()
        if text:
            return text
    return ''


def xml_numbers(element: ElementTree.Element, tags: Sequence[str]) -> list[float]:
    """
    Read child elements that hold a number each.

    Raises
    ------
    ValueError
        If one is missing, or is not a finite number.
    """
    return [_xml_number(element, tag) for tag in tags]


def _xml_number(element: ElementTree.Element, tag: str) -> float:
    child = element.find(tag)
    if child is None:
        raise ValueError(f'no <{tag}> in <{element.tag}>')
    try:
        (number,) = parse_numbers([(child.text or '').strip()])
    except ValueError as error:
        raise ValueError(f'<{tag}>: {error}') from None
    return number


def has_any(element: ElementTree.Element, tags: Sequence[str]) -> bool:
    """Tell whether an element has one of some children."""
    return any(element.find(tag) is not None for tag in tags)


def image_size_of(width: object, height: object) -> tuple[int, int] | None:
    """Return an image size where both are positive whole numbers or the text of one."""
    sides = []
    for value in (width, height):
        text = str(value)
        if isinstance(value, bool) or not (text.isascii() and text.isdigit() and len(text) < 10):
            return None
        sides.append(int(text))
    return (sides[0], sides[1]) if min(sides) > 0 else None


def read_json(path: Path, shorten: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """
    Parse a JSON file.

    Parameters
    ----------
    path : Path
        The file, UTF-8 with or without BOM.
    shorten : callable, optional
        Called with each JSON object as soon as it is complete; what it returns takes its place.

    Returns
    -------
    dict, list, str, float, int, bool or None
        What it holds.

    Raises
    ------
    LabelError
        If it is not JSON or nested too deeply.
    OSError
        If the file cannot be read.
    """
    data = path.read_bytes()
    try:
        return json.loads(data.decode('utf-8-sig'), object_hook=shorten)
    except json.JSONDecodeError as error:
        raise LabelError(path, error.lineno, f'not JSON: {error.msg}') from None
    except RecursionError:
        raise LabelError(path, None, 'not a label file: JSON nested too deeply') from None
    except ValueError as error:
        raise LabelError(path, None, f'not JSON: {error}') from None


def json_member(record: object, name: str) -> Any:
    """
    Return a member of a JSON object.

    Raises
    ------
    ValueError
        If `record` is no object, or has no such member.
    """
    if not isinstance(record, dict):
        raise ValueError('not a JSON object')
    if name not in record:
        raise ValueError(f'no {name!r}')
    return record[name]


def json_numbers(values: object, count: int | None, what: str) -> list[float]:
    """
    Check a JSON array of finite numbers.

    Parameters
    ----------
    values : object
        What the file has.
    count : int or None
        How many there must be; None for any number.
    what : str
        Its name, for the message.

    Returns
    -------
    list of float
        The numbers.

    Raises
    ------
    ValueError
        If it is anything else.
    """
    if not isinstance(values, list) or (count is not None and len(values) != count):
        raise ValueError(f'{what} is not an array of {"" if count is None else f"{count} "}numbers')
    return [_finite(value, what) for value in values]


def json_score(value: object) -> float:
    """
    Check a score; 1.0 where there is none.

    Raises
    ------
    ValueError
        If it is not a finite number.
    """
    return 1.0 if value is None else _finite(value, 'score')


def _finite(value: object, what: str) -> float:
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
        If it holds half a character, which JSON can name and no file can hold.
    """
    if isinstance(value, str):
        return checked_text(value)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ''
    if isinstance(value, float) and value.is_integer():
        # Tables that have a missing value somewhere keep whole numbers as 3.0.
        return str(int(value))
    return str(value)


def checked_text(text: str) -> str:
    """
    Give a text that can be written to a file.

    Raises
    ------
    ValueError
        If it cannot.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f'{text!r} holds half a character (a lone surrogate)') from None
    return text
