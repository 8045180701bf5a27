# SPDX-License-Identifier: Apache-2.0
"""
Pascal-VOC XML: one file an image, in pixels as they stand in the file.

::

    <annotation>
      <size><width>1024</width><height>1024</height><depth>3</depth></size>
      <object>
        <name>ship</name>
        <bndbox><xmin>80</xmin><ymin>40</ymin><xmax>190</xmax><ymax>97</ymax></bndbox>
        <robndbox><cx>135</cx><cy>68</cy><w>110</w><h>30</h><angle>0.36</angle></robndbox>
      </object>

An oriented box is a ``robndbox`` as roLabelImg writes it (radians, clockwise as seen, along ``w``)
or as DIOR-R has it (``x_left_top`` … ``y_left_bottom``); ``bndbox`` is the reference box then.
Without one the upright box of ``bndbox`` is read. Difficulty and parts of objects are not read,
and the format has no ids and scores: these are not written.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import SubElement

from obbhbb_ros.labels.converted import ConvertedBox
from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.converted import converted_boxes
from obbhbb_ros.labels.documents import has_any
from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.documents import read_xml
from obbhbb_ros.labels.documents import read_xml_records
from obbhbb_ros.labels.documents import xml_numbers
from obbhbb_ros.labels.documents import xml_text
from obbhbb_ros.labels.files import target_files
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.shapes import oriented_corners
from obbhbb_ros.labels.shapes import upright_corners
from obbhbb_ros.labels.text import write_lines

ROOT = 'annotation'
BOUNDS = ('xmin', 'ymin', 'xmax', 'ymax')
CENTRED = ('cx', 'cy', 'w', 'h', 'angle')
CORNERS = (
    'x_left_top', 'y_left_top', 'x_right_top', 'y_right_top',
    'x_right_bottom', 'y_right_bottom', 'x_left_bottom', 'y_left_bottom',
)  # fmt: skip
NOT_IN_XML = re.compile('[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the one image of a VOC file.

    Parameters
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height in pixels; None to take them from the file.
    on_error : callable
        Gets a LabelError for each malformed object, or one where the file is no VOC XML.

    Yields
    ------
    ImageLabels
        Named after the file, since what stands in ``filename`` often is another's.
    """
    try:
        document = read_xml(path, ROOT)
    except LabelError as error:
        on_error(error)
        return
    root = document.root
    boxes = read_xml_records(path, document, root.findall('object'), _parse, on_error)
    own_size = image_size_of(xml_text(root, 'size/width'), xml_text(root, 'size/height'))
    yield assemble(path.stem, boxes, image_size or own_size, path)


def _parse(element: Element) -> Box:
    name = xml_text(element, 'name')
    if not name:
        raise ValueError('no <name>')
    bounds, oriented = element.find('bndbox'), element.find('robndbox')
    if bounds is None and oriented is None:
        raise ValueError('neither <bndbox> nor <robndbox>')
    reference = NO_REFERENCE if bounds is None else xml_numbers(bounds, BOUNDS)
    if oriented is None:
        return Box(upright_corners(reference), name, reference=reference)
    return Box(_oriented(oriented), name, reference=reference)


def _oriented(element: Element) -> Sequence[float]:
    if has_any(element, CORNERS):
        return xml_numbers(element, CORNERS)
    return oriented_corners(*xml_numbers(element, CENTRED))


def write_boxes(path: Path, images: list[ConvertedImage]) -> None:
    """
    Write one VOC file an image; ``size`` is there where it is known.

    Coordinates keep their fractions: rounding them would undo what the conversion gained.

    Parameters
    ----------
    path : Path
        Folder, or an ``.xml`` file for a single image.
    images : list of ConvertedImage
        The images.

    Raises
    ------
    ValueError
        If a class is empty or a name has a character that XML cannot hold, or if images and files
        do not fit.
    """
    files = [(file, _document(converted)) for file, converted in target_files(path, images, '.xml')]
    for file, text in files:
        write_lines(file, [text])


def _document(converted: ConvertedImage) -> str:
    root = Element(ROOT)
    _add(root, 'filename', converted.image)
    if converted.size is not None:
        size = SubElement(root, 'size')
        for tag, side in zip(('width', 'height'), converted.size, strict=True):
            _add(size, tag, str(side))
        _add(size, 'depth', '3')
    for box in converted_boxes(converted):
        _add_object(root, box, converted.image)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding='unicode')


def _add_object(root: Element, box: ConvertedBox, image: str) -> None:
    if not box.class_id.strip():
        raise ValueError(f'image {image!r}: a class without a name cannot stand in VOC')
    element = SubElement(root, 'object')
    _add(element, 'name', box.class_id)
    for tag, text in (('pose', 'Unspecified'), ('truncated', '0'), ('difficult', '0')):
        _add(element, tag, text)
    bounds = SubElement(element, 'bndbox')
    for tag, value in zip(BOUNDS, box.xyxy, strict=True):
        _add(bounds, tag, repr(value))


def _add(parent: Element, tag: str, text: str) -> None:
    if NOT_IN_XML.search(text):
        raise ValueError(f'{text!r} has a character that XML cannot hold')
    SubElement(parent, tag).text = text


def sniff(head: str) -> bool:
    """Tell whether the root of VOC is there."""
    return re.search(f'<{ROOT}[ >]', head) is not None


FORMAT = Format(
    name='voc',
    suffixes=('.xml',),
    summary='Pascal-VOC XML, one file an image: bndbox, and robndbox of roLabelImg and DIOR-R',
    read=read,
    write=None,
    sniff=sniff,
    write_boxes=write_boxes,
)
