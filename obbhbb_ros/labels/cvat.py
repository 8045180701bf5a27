# SPDX-License-Identifier: Apache-2.0
"""
CVAT XML 1.1 ("CVAT for images"): one file of many images, in pixels.

::

    <annotations>
      <version>1.1</version>
      <image id="0" name="P0706.png" width="1024" height="768">
        <box label="ship" xtl="80" ytl="40" xbr="190" ybr="70" rotation="30.0"/>
        <polygon label="ship" points="284.0,466.0;274.0,456.0;300.0,427.0;310.0,439.0"/>
        <mask label="ship" rle="3, 5, 7" left="80" top="40" width="5" height="3"/>
      </image>

``rotation`` turns a box about its centre, degrees clockwise as seen; Datumaro writes it as an
``attribute``. A box that is not turned is also the reference box. The oriented box of polygons and
masks is their minimum rotated rectangle, and the polygon or the convex hull of the mask is the
hull, unless it has four corners. Other shapes, and the tracks of videos, are reported one by one
and not read. Other attributes are properties.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from collections.abc import Mapping
from typing import TypeAlias
from xml.etree.ElementTree import Element

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import masks
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.text import is_index
from obbhbb_ros.labels.text import parse_number
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.xml_files import read_xml

ROOT = 'annotations'
BOUNDS = ('xtl', 'ytl', 'xbr', 'ybr')
ROTATION = 'rotation'
MAX_DIGITS = 18
PLACE = ('left', 'top', 'width', 'height')

Shape: TypeAlias = tuple[str, Element]
"""The number of the image in the file, and the shape."""


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    root, lines = read_xml(file, ROOT)
    boxes = shapes.enclose(file, file.parse_records(_records(root, lines), _parse))
    for key, image in enumerate(root.iterfind('image')):
        size = image_size_of(image.get('width'), image.get('height'))
        number = image.get('id', '')
        image_id = int(number) if is_index(number) and len(number) <= MAX_DIGITS else None
        rows = boxes.get(str(key), [])
        yield file.image(image.get('name', ''), rows, size, image_id=image_id)


def _records(root: Element, lines: Mapping[Element, int]) -> Iterator[Record[Shape]]:
    for track in root.iterfind('track'):
        yield lines[track], f'track {track.get("id", "")}: ', ('', track)
    for key, image in enumerate(root.iterfind('image')):
        for number, shape in enumerate(image, start=1):
            # A tag says something of the whole image.
            if shape.tag != 'tag':
                place = f'image {image.get("name")!r}: shape {number}: '
                yield lines[shape], place, (str(key), shape)


def _parse(record: Shape) -> shapes.Outlined:
    image, element = record
    if element.tag == 'track':
        raise ValueError('tracks of a video are not read: export as "CVAT for images"')
    label = _attribute(element, 'label')
    properties = _properties(element)
    box = Box((), label, properties=properties)
    if element.tag == 'box':
        rotation = _rotation(element.get(ROTATION), properties.pop(ROTATION, None))
        corners, reference = shapes.turned_box(_numbers(element, *BOUNDS), rotation)
        return shapes.Outlined(image, box._replace(corners=corners, reference=reference))
    if element.tag not in RINGS:
        raise ValueError(f'a shape <{element.tag}> is not read: only box, polygon and mask')
    return shapes.Outlined(image, box, [RINGS[element.tag](element)])


def _rotation(own: str | None, attribute: str | None) -> float:
    rotations = {parse_number(text) for text in (own, attribute) if text is not None}
    if len(rotations) > 1:
        raise ValueError(f'rotation {own} and an attribute rotation {attribute}: which one holds?')
    return rotations.pop() if rotations else 0.0


def _properties(element: Element) -> dict[str, str]:
    attributes = element.iterfind('attribute')
    return {item.get('name', ''): (item.text or '').strip() for item in attributes}


def _polygon(element: Element) -> FloatArray:
    points = _attribute(element, 'points')
    return shapes.ring_of_pairs(parse_numbers(re.split('[,;]', points)))


def _mask(element: Element) -> FloatArray:
    runs = masks.listed_runs(_attribute(element, 'rle'))
    left, top, width, height = _numbers(element, *PLACE)
    if not (width.is_integer() and height.is_integer()):
        raise ValueError('width and height of a mask are not whole numbers')
    return masks.mask_ring(runs, int(width), int(height))[:, ::-1] + (left, top)


RINGS = {'polygon': _polygon, 'mask': _mask}


def _numbers(element: Element, *names: str) -> list[float]:
    try:
        return parse_numbers([_attribute(element, name) for name in names])
    except ValueError as error:
        raise ValueError(f'<{element.tag}>: {error}') from None


def _attribute(element: Element, name: str) -> str:
    value = element.get(name)
    if value is None:
        raise ValueError(f'<{element.tag}> has no attribute {name}')
    return value


FORMAT = Format(
    name='cvat',
    suffixes=('.xml',),
    summary='CVAT XML 1.1 of many images: box with rotation, polygon, mask',
    sniff=lambda head: re.search(f'<{ROOT}[ >]', head) is not None,
    read=_read,
)
