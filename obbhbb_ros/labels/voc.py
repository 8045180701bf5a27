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

The oriented box is one of these; ``bndbox`` beside it is then the reference box:

- ``robndbox`` as roLabelImg writes it: radians, clockwise as seen, along ``w``. In a file with
  ``polarization`` it is that of RSDD-SAR, whose angle is that of the longer edge: there ``h``.
- ``robndbox`` as DIOR-R has it: ``x_left_top`` … ``y_left_bottom``.
- ``rotated_bndbox`` of SSDD: ``x1`` … ``y4``.
- ``polygon`` as ShipRSImageNet, X-AnyLabeling and supervision write it, ``x1`` … ``yK``: the
  minimum rotated rectangle. The polygon is also the hull unless it has four corners.
- ``bndbox`` turned about its centre by the attribute ``rotation``, degrees clockwise as seen, as
  CVAT and Datumaro write it: ``attributes``, ``attribute``, ``name`` and ``value``. It is then no
  reference box.

Without any, the upright box of ``bndbox`` is read. An object with another field for an angle is
refused. Other attributes are properties; parts of objects are not read. The image is named after
the label file, since ``filename`` is often that of another image.

Coordinates are written to VOC with their fractions: rounding would undo the conversion. In the
variant ``integers`` they are whole numbers around the box; ``one-based`` counts the first pixel as
1 and includes the last one, as supervision and Detectron2 read it; ``devkit`` does both, as the VOC
devkit. ``size`` is written if it is known. VOC has no ids and scores: these are not written.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import SubElement

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import parse_difficulty
from obbhbb_ros.labels.folders import write_per_image
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.text import parse_number
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
DRAWN = ('robndbox', 'rotated_bndbox', 'polygon')
# Names of an angle whose meaning differs from tool to tool.
ANGLES = ('angle', 'rotation', 'theta')
MEMBERS = ('pose', 'truncated', 'occluded')
UNSAID = ('', '0', 'unspecified')
IMAGE = ''
NOT_IN_XML = re.compile('[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')


def _read(file: LabelFile) -> list[ImageLabels]:
    root, objects = read_objects(file, ROOT, 'object')
    if root.find('objects') is not None:
        raise file.error('not Pascal VOC: <objects>, as FAIR1M has it')
    # Only RSDD-SAR has it.
    long_edge = root.find('polarization') is not None
    records = file.parse_records(objects, partial(_parse, long_edge))
    boxes = shapes.enclose(file, records).get(IMAGE, [])
    size = size_of(root, 'size/width', 'size/height')
    return [file.image(file.path.stem, boxes, size, file_name=text_of(root, 'filename'))]


def _parse(long_edge: bool, element: Element) -> shapes.Outlined:
    name = text_of(element, 'name')
    if not name:
        raise ValueError('no <name>')
    bounds, attributes = element.find('bndbox'), _attributes(element)
    rotation = _rotation(attributes.pop('rotation', '0'))
    reference: Sequence[float] = NO_REFERENCE if bounds is None else numbers_of(bounds, BOUNDS)
    corners: Sequence[float] = ()
    rings = []
    drawn = next((node for tag in DRAWN if (node := element.find(tag)) is not None), None)
    if drawn is None:
        if bounds is None:
            raise ValueError(f'none of {", ".join(f"<{tag}>" for tag in ("bndbox", *DRAWN))}')
        _refuse_angles(element, bounds)
        corners, reference = shapes.turned_box(reference, rotation)
    elif rotation != 0.0:
        raise ValueError(f'a rotation of {rotation:g} beside <{drawn.tag}>: which one holds?')
    elif drawn.tag == 'robndbox':
        corners = _oriented(drawn, long_edge)
    elif drawn.tag == 'rotated_bndbox':
        corners = numbers_of(drawn, _points(4))
    else:
        rings = [shapes.ring_of_pairs(numbers_of(drawn, _points(len(drawn) // 2)))]
    difficulty = parse_difficulty(text_of(element, 'difficult'))
    properties = {**_members(element), **attributes}
    box = Box(corners, name, reference=reference, difficulty=difficulty, properties=properties)
    return shapes.Outlined(IMAGE, box, rings)


def _oriented(element: Element, long_edge: bool) -> Sequence[float]:
    if has_any(element, CORNERS):
        return numbers_of(element, CORNERS)
    x, y, width, height, angle = numbers_of(element, CENTRED)
    if long_edge:
        width, height = max(width, height), min(width, height)
    return shapes.oriented_corners(x, y, width, height, angle)


def _points(count: int) -> list[str]:
    return [f'{axis}{number}' for number in range(1, count + 1) for axis in 'xy']


def _attributes(element: Element) -> dict[str, str]:
    attributes = element.iterfind('attributes/attribute')
    return {text_of(attribute, 'name'): text_of(attribute, 'value') for attribute in attributes}


def _members(element: Element) -> dict[str, str]:
    """Return what is said of the object besides, unless it says nothing."""
    values = {name: text_of(element, name) for name in MEMBERS}
    return {name: value for name, value in values.items() if value.lower() not in UNSAID}


def _rotation(text: str) -> float:
    try:
        return parse_number(text)
    except ValueError as error:
        raise ValueError(f'attribute rotation: {error}') from None


def _refuse_angles(*elements: Element) -> None:
    for element in elements:
        for tag in ANGLES:
            if element.find(tag) is not None:
                raise ValueError(f'<{tag}> in <{element.tag}>: its unit and sense are unknown')


def _write(
    path: Path,
    images: list[ImageBoxes],
    place: Callable[[FloatArray], FloatArray] = lambda xyxy: xyxy,
    number: Callable[[float], str] = repr,
) -> None:
    placed = [replace(image, xyxy=place(image.xyxy)) for image in images]
    write_per_image(path, placed, '.xml', partial(_document, number))


def _outward(xyxy: FloatArray) -> FloatArray:
    return np.hstack((np.floor(xyxy[:, :2]), np.ceil(xyxy[:, 2:])))


def _from_one(xyxy: FloatArray) -> FloatArray:
    # The last pixel is included, so that its number stays.
    return xyxy + np.array([1.0, 1.0, 0.0, 0.0])


def _whole(value: float) -> str:
    return str(int(value))


def _document(number: Callable[[float], str], image: ImageBoxes) -> list[str]:
    root = Element(ROOT)
    _add(root, filename=image.extras.file_name or image.image)
    if image.size is not None:
        width, height = image.size
        _add(SubElement(root, 'size'), width=str(width), height=str(height), depth='3')
    for box in image.rows():
        if not box.class_id.strip():
            raise ValueError(f'image {image.image!r}: VOC needs a name for every class')
        element = SubElement(root, 'object')
        _add(element, name=box.class_id, pose='Unspecified', truncated='0')
        _add(element, difficult=str(box.difficulty))
        bounds = map(number, box.xyxy)
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
    summary='Pascal-VOC XML, one file per image: bndbox, oriented by rotation, robndbox or polygon',
    sniff=lambda head: re.search(f'<{ROOT}[ >]', head) is not None and '<objects>' not in head,
    read=_read,
    write_boxes=_write,
    variants={
        'integers': partial(_write, place=_outward, number=_whole),
        'one-based': partial(_write, place=_from_one),
        'devkit': partial(_write, place=lambda xyxy: _from_one(_outward(xyxy)), number=_whole),
    },
    holds=('difficulties', 'file names', 'image suffixes', 'image sizes', 'images without boxes'),
    in_pixels=True,
)
