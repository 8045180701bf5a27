# SPDX-License-Identifier: Apache-2.0
"""XML label files: elements with their lines, and checks of what they hold."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import TreeBuilder
from xml.parsers import expat

from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.documents import read_document
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.text import parse_number

# After an error in a handler the parser still reads to the end of the block.
BLOCK_BYTES = 65536


def read_xml(file: LabelFile, root_tag: str) -> tuple[Element, dict[Element, int]]:
    """
    Read the root of an XML file, and the line of each element in it.

    Raises FileError if it is not XML or has another root.
    """
    root, lines = _parse_xml(file)
    if root.tag != root_tag:
        raise file.error(f'the root is <{root.tag}>, expected <{root_tag}>', lines[root])
    return root, lines


def read_objects(
    file: LabelFile, root_tag: str, path: str
) -> tuple[Element, Iterator[Record[Element]]]:
    """
    Read the root and, as records for `LabelFile.parse_records`, the elements of the objects.

    `path` leads from the root to them. Errors are those of `read_xml`.
    """
    root, lines = read_xml(file, root_tag)
    objects = (
        (lines[element], f'object {number}: ', element)
        for number, element in enumerate(root.findall(path), start=1)
    )
    return root, objects


def _parse_xml(file: LabelFile) -> tuple[Element, dict[Element, int]]:
    data = read_document(file)
    builder = TreeBuilder()
    lines: dict[Element, int] = {}
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def start(tag: str, attributes: dict[str, str]) -> None:
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    def refuse(*_: object) -> None:
        # Label files have none; its entities could expand to gigabytes or read other files.
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
        # An encoding that Python does not support is a LookupError or a ValueError.
        raise file.error(str(error), parser.CurrentLineNumber) from None
    return builder.close(), lines


def has_any(element: Element, tags: Sequence[str]) -> bool:
    """Return whether the element has a child of one of these tags."""
    return any(element.find(tag) is not None for tag in tags)


def text_of(element: Element, path: str) -> str:
    """Return the text of a descendant without blanks around it, '' if it is missing."""
    return (element.findtext(path) or '').strip()


def size_of(root: Element, width: str, height: str) -> ImageSize | None:
    """Return the image size that the two descendants hold, see `image_size_of`."""
    return image_size_of(text_of(root, width), text_of(root, height))


def numbers_of(element: Element, tags: Sequence[str]) -> list[float]:
    """Return the finite numbers in the children; raise ValueError if one is missing or another."""
    # The first of several, as `Element.find` has it; a search for each tag would be quadratic.
    texts = {child.tag: child.text or '' for child in reversed(element)}
    numbers = []
    for tag in tags:
        if tag not in texts:
            raise ValueError(f'no <{tag}> in <{element.tag}>')
        try:
            numbers.append(parse_number(texts[tag].strip()))
        except ValueError as error:
            raise ValueError(f'<{tag}>: {error}') from None
    return numbers
