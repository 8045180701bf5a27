# SPDX-License-Identifier: Apache-2.0
"""
Pascal-VOC XML: one file per image, in pixels as they stand in the file.

::

    <annotation>
      <size><width>1024</width><height>1024</height><depth>3</depth></size>
      <object>
        <name>ship</name>
        <bndbox><xmin>80</xmin><ymin>40</ymin><xmax>190</xmax><ymax>97</ymax></bndbox>
        <robndbox><cx>135</cx><cy>68</cy><w>110</w><h>30</h><angle>0.36</angle></robndbox>
      </object>

An oriented box is a ``robndbox`` as roLabelImg writes it (radians, clockwise as seen, along ``w``)
or as DIOR-R has it (``x_left_top`` … ``y_left_bottom``); ``bndbox`` is then the reference box.
Without one the upright box of ``bndbox`` is read. Difficulty and parts of objects are not read. The
image is named after the file, since ``filename`` often is that of another image.

Coordinates are written with their fractions, which make the conversion worth its while; ``size`` is
written if it is known. The format has no ids and scores: these are not written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import SubElement

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import has_any
from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.documents import read_xml_boxes
from obbhbb_ros.labels.documents import xml_numbers
from obbhbb_ros.labels.documents import xml_text
from obbhbb_ros.labels.files import write_each
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import Format
from obbhbb_ros.labels.records import ImageBoxes
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelFile

ROOT = 'annotation'
BOUNDS = ('xmin', 'ymin', 'xmax', 'ymax')
CENTRED = ('cx', 'cy', 'w', 'h', 'angle')
CORNERS = (
    'x_left_top', 'y_left_top', 'x_right_top', 'y_right_top',
    'x_right_bottom', 'y_right_bottom', 'x_left_bottom', 'y_left_bottom',
)  # fmt: skip
NOT_IN_XML = re.compile('[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')


def _read(file: LabelFile) -> list[ImageLabels]:
    root, boxes = read_xml_boxes(file, ROOT, 'object', _parse)
    size = image_size_of(xml_text(root, 'size/width'), xml_text(root, 'size/height'))
    return [file.image(file.path.stem, boxes, size)]


def _parse(element: Element) -> Box:
    name = xml_text(element, 'name')
    if not name:
        raise ValueError('no <name>')
    bounds, oriented = element.find('bndbox'), element.find('robndbox')
    if bounds is None and oriented is None:
        raise ValueError('neither <bndbox> nor <robndbox>')
    reference = NO_REFERENCE if bounds is None else xml_numbers(bounds, BOUNDS)
    if oriented is None:
        return Box(shapes.upright_corners(reference), name, reference=reference)
    return Box(_oriented(oriented), name, reference=reference)


def _oriented(element: Element) -> Sequence[float]:
    if has_any(element, CORNERS):
        return xml_numbers(element, CORNERS)
    return shapes.oriented_corners(*xml_numbers(element, CENTRED))


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    write_each(path, images, '.xml', _document)


def _document(image: ImageBoxes) -> list[str]:
    root = Element(ROOT)
    _add(root, filename=image.image)
    if image.size is not None:
        width, height = image.size
        _add(SubElement(root, 'size'), width=str(width), height=str(height), depth='3')
    for box in image.rows():
        if not box.class_id.strip():
            raise ValueError(f'image {image.image!r}: VOC needs a name for every class')
        element = SubElement(root, 'object')
        _add(element, name=box.class_id, pose='Unspecified', truncated='0', difficult='0')
        bounds = map(repr, box.xyxy)
        _add(SubElement(element, 'bndbox'), **dict(zip(BOUNDS, bounds, strict=True)))
    ElementTree.indent(root)
    return [ElementTree.tostring(root, encoding='unicode')]


def _add(parent: Element, **texts: str) -> None:
    for tag, text in texts.items():
        if NOT_IN_XML.search(text):
            raise ValueError(f'{text!r} has a character that XML cannot hold')
        SubElement(parent, tag).text = text


FORMAT = Format(
    name='voc',
    suffixes=('.xml',),
    summary='Pascal-VOC XML, one file per image: bndbox, and robndbox of roLabelImg and DIOR-R',
    sniff=lambda head: re.search(f'<{ROOT}[ >]', head) is not None,
    read=_read,
    write_boxes=_write_boxes,
)
