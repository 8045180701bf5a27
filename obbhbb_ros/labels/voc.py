# SPDX-License-Identifier: Apache-2.0
"""
Pascal-VOC XML: one file per image, in pixels as the file has them.

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
Without a ``robndbox`` the upright box of ``bndbox`` is read. Difficulty and parts of objects are
not read. The image is named after the label file, since ``filename`` is often that of another
image.

Coordinates are written to VOC with their fractions: rounding would undo the conversion. ``size`` is
written if it is known. VOC has no ids and scores: these are not written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import SubElement

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.folders import write_per_image
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.xml_files import has_any
from obbhbb_ros.labels.xml_files import numbers_of
from obbhbb_ros.labels.xml_files import read_objects
from obbhbb_ros.labels.xml_files import size_of
from obbhbb_ros.labels.xml_files import text_of

ROOT = 'annotation'
BOUNDS = ('xmin', 'ymin', 'xmax', 'ymax')
CENTRED = ('cx', 'cy', 'w', 'h', 'angle')
CORNERS = (
    'x_left_top', 'y_left_top', 'x_right_top', 'y_right_top',
    'x_right_bottom', 'y_right_bottom', 'x_left_bottom', 'y_left_bottom',
)  # fmt: skip
NOT_IN_XML = re.compile('[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')


def _read(file: LabelFile) -> list[ImageLabels]:
    root, objects = read_objects(file, ROOT, 'object')
    boxes = [box for _, _, box in file.parse_records(objects, _parse)]
    return [file.image(file.path.stem, boxes, size_of(root, 'size/width', 'size/height'))]


def _parse(element: Element) -> Box:
    name = text_of(element, 'name')
    if not name:
        raise ValueError('no <name>')
    bounds, oriented = element.find('bndbox'), element.find('robndbox')
    if bounds is None and oriented is None:
        raise ValueError('neither <bndbox> nor <robndbox>')
    reference = NO_REFERENCE if bounds is None else numbers_of(bounds, BOUNDS)
    corners: Sequence[float]
    if oriented is None:
        corners = shapes.upright_corners(reference)
    elif has_any(oriented, CORNERS):
        corners = numbers_of(oriented, CORNERS)
    else:
        corners = shapes.oriented_corners(*numbers_of(oriented, CENTRED))
    return Box(corners, name, reference=reference)


def _write(path: Path, images: list[ImageBoxes]) -> None:
    write_per_image(path, images, '.xml', _document)


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
    write_boxes=_write,
    holds=('image sizes', 'images without boxes'),
)
