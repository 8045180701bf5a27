# SPDX-License-Identifier: Apache-2.0
"""
CVAT XML 1.1, for images or for video: one file of many images, in pixels.

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
from typing import NamedTuple
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
from obbhbb_ros.labels.xml_files import size_of
from obbhbb_ros.labels.xml_files import text_of

ROOT = 'annotations'
BOUNDS = ('xtl', 'ytl', 'xbr', 'ybr')
ROTATION = 'rotation'
MAX_DIGITS = 18
FRAME_STEP = re.compile(r'\bstep=(\d{1,9})\b')
PLACE = ('left', 'top', 'width', 'height')


class Shape(NamedTuple):
    """
    A shape of an image or of a track.

    `image` is the number of the image in the file, or the name of the frame. `track` is the id of
    the track, '' for none. `problem` says why the shape is not one, '' for a shape.
    """

    image: str
    element: Element
    label: str | None
    track: str = ''
    problem: str = ''


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    root, lines = read_xml(file, ROOT)
    boxes = shapes.enclose(file, file.parse_records(_records(root, lines), _parse))
    for key, image in enumerate(root.iterfind('image')):
        size = image_size_of(image.get('width'), image.get('height'))
        number = image.get('id', '')
        image_id = int(number) if is_index(number) and len(number) <= MAX_DIGITS else None
        rows = boxes.pop(str(key), [])
        yield file.image(image.get('name', ''), rows, size, image_id=image_id)
    size = size_of(root, 'meta//original_size/width', 'meta//original_size/height')
    for frame in sorted(boxes):
        yield file.image(frame, boxes[frame], size)


def _records(root: Element, lines: Mapping[Element, int]) -> Iterator[Record[Shape]]:
    for key, image in enumerate(root.iterfind('image')):
        for number, element in enumerate(image, start=1):
            # A tag says something of the whole image.
            if element.tag != 'tag':
                place = f'image {image.get("name")!r}: shape {number}: '
                yield lines[element], place, Shape(str(key), element, element.get('label'))
    filtered = FRAME_STEP.search(text_of(root, 'meta//frame_filter'))
    step = int(filtered[1]) if filtered else 1
    for track in root.iterfind('track'):
        for shape in _track_shapes(track, step):
            place = f'track {shape.track}: frame {shape.element.get("frame")}: '
            yield lines[shape.element], place, shape


def _track_shapes(track: Element, step: int) -> Iterator[Shape]:
    previous: int | None = None
    for element in track:
        frame, outside = element.get('frame', ''), element.get('outside') == '1'
        number = int(frame) if is_index(frame) and len(frame) <= MAX_DIGITS else None
        name = '' if number is None else f'frame_{number:06}'
        shape = Shape(name, element, track.get('label'), track.get('id', ''))
        if number is None:
            yield shape._replace(problem='the frame has no number')
            continue
        if previous is not None and number > previous + step:
            yield shape._replace(problem=f'the shapes since frame {previous} are not there')
        if not outside:
            yield shape
        previous = None if outside else number


def _parse(record: Shape) -> shapes.Outlined:
    element = record.element
    if record.problem:
        raise ValueError(record.problem)
    if record.label is None:
        raise ValueError(f'<{element.tag}> has no attribute label')
    properties = _properties(element)
    box = Box((), record.label, record.track, properties=properties)
    if element.tag in BOUNDS_OF:
        rotation = _rotation(element.get(ROTATION), properties.pop(ROTATION, None))
        corners, reference = shapes.turned_box(BOUNDS_OF[element.tag](element), rotation)
        return shapes.Outlined(record.image, box._replace(corners=corners, reference=reference))
    if element.tag not in RINGS:
        known = ', '.join((*BOUNDS_OF, *RINGS))
        raise ValueError(f'a shape <{element.tag}> is not read, only {known}')
    return shapes.Outlined(record.image, box, [RINGS[element.tag](element)])


def _rotation(own: str | None, attribute: str | None) -> float:
    rotations = {parse_number(text) for text in (own, attribute) if text is not None}
    if len(rotations) > 1:
        raise ValueError(f'rotation {own} and an attribute rotation {attribute}: which one holds?')
    return rotations.pop() if rotations else 0.0


def _properties(element: Element) -> dict[str, str]:
    attributes = element.iterfind('attribute')
    return {item.get('name', ''): (item.text or '').strip() for item in attributes}


def _box(element: Element) -> list[float]:
    return _numbers(element, *BOUNDS)


def _ellipse(element: Element) -> list[float]:
    x, y, rx, ry = _numbers(element, 'cx', 'cy', 'rx', 'ry')
    return shapes.bounds_of_xywh(x - rx, y - ry, 2.0 * rx, 2.0 * ry)


def _polygon(element: Element) -> FloatArray:
    points = _attribute(element, 'points')
    return shapes.ring_of_pairs(parse_numbers(re.split('[,;]', points)))


def _mask(element: Element) -> FloatArray:
    runs = masks.listed_runs(_attribute(element, 'rle'))
    left, top, width, height = _numbers(element, *PLACE)
    if not (width.is_integer() and height.is_integer()):
        raise ValueError('width and height of a mask are not whole numbers')
    return masks.mask_ring(runs, int(width), int(height))[:, ::-1] + (left, top)


BOUNDS_OF = {'box': _box, 'ellipse': _ellipse}
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
    summary='CVAT XML 1.1 of many images or of a video: box with rotation, ellipse, polygon, mask',
    sniff=lambda head: re.search(f'<{ROOT}[ >]', head) is not None,
    read=_read,
)
