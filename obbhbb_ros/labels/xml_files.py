# SPDX-License-Identifier: Apache-2.0
"""
HRSC2016 and Pascal-VOC XML: one file per image, in pixels as the file has them.

HRSC2016 has the oriented and the axis-aligned box of each ship::

    <HRSC_Image>
      <Img_FileName>100000001</Img_FileName>
      <Img_SizeWidth>1138</Img_SizeWidth> <Img_SizeHeight>833</Img_SizeHeight>
      <HRSC_Objects>
        <HRSC_Object>
          <Object_ID>100000003</Object_ID> <Class_ID>100000013</Class_ID>
          <box_xmin>628</box_xmin> … <box_ymax>783</box_ymax>
          <mbox_cx>719.9</mbox_cx> … <mbox_h>172.7</mbox_h> <mbox_ang>1.499893</mbox_ang>
          <header_x>692</header_x> <header_y>41</header_y>

``mbox_ang`` is in radians from image +x towards +y, along ``mbox_w``. A ship without ``mbox_…``
is read as the upright box of its ``box_…``. The head point, ``header_…``, says where the bow is if
it lies within a quarter of the length from the middle of one end of the oriented box; if it is
missing, 0 0 or anywhere else, the bow is not known. Difficulty and segmentation are not read.
An image without a file name or id is named after the label file.

Pascal VOC::

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
from collections.abc import Callable
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.etree.ElementTree import SubElement
from xml.etree.ElementTree import TreeBuilder
from xml.parsers import expat

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.folders import write_per_image
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.text import parse_number

HRSC_ROOT = 'HRSC_Image'
HRSC_ORIENTED = ('mbox_cx', 'mbox_cy', 'mbox_w', 'mbox_h', 'mbox_ang')
HRSC_HEAD = ('header_x', 'header_y')
HRSC_BOUNDS = ('box_xmin', 'box_ymin', 'box_xmax', 'box_ymax')
VOC_ROOT = 'annotation'
VOC_BOUNDS = ('xmin', 'ymin', 'xmax', 'ymax')
VOC_CENTRED = ('cx', 'cy', 'w', 'h', 'angle')
VOC_CORNERS = (
    'x_left_top', 'y_left_top', 'x_right_top', 'y_right_top',
    'x_right_bottom', 'y_right_bottom', 'x_left_bottom', 'y_left_bottom',
)  # fmt: skip
NOT_IN_XML = re.compile('[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]')
# After an error in a handler the parser still reads to the end of the block.
BLOCK_BYTES = 65536


def _read_hrsc(file: LabelFile) -> list[ImageLabels]:
    root, boxes = _read_boxes(file, HRSC_ROOT, 'HRSC_Objects/HRSC_Object', _parse_hrsc)
    size = image_size_of(_text(root, 'Img_SizeWidth'), _text(root, 'Img_SizeHeight'))
    name = _text(root, 'Img_FileName') or _text(root, 'Img_ID') or file.path.stem
    return [file.image(name, boxes, size)]


def _read_voc(file: LabelFile) -> list[ImageLabels]:
    root, boxes = _read_boxes(file, VOC_ROOT, 'object', _parse_voc)
    size = image_size_of(_text(root, 'size/width'), _text(root, 'size/height'))
    return [file.image(file.path.stem, boxes, size)]


def _read_boxes(
    file: LabelFile, root_tag: str, objects: str, parse: Callable[[Element], Box]
) -> tuple[Element, list[Box]]:
    """Read root and boxes; `objects` is the path from the root to the elements of the boxes."""
    root, lines = _parse_xml(file)
    if root.tag != root_tag:
        raise file.error(f'the root is <{root.tag}>, expected <{root_tag}>', lines[root])
    records = (
        (lines[element], f'object {number}: ', element)
        for number, element in enumerate(root.findall(objects), start=1)
    )
    return root, [box for _, _, box in file.parse_records(records, parse)]


def _parse_xml(file: LabelFile) -> tuple[Element, dict[Element, int]]:
    """Parse an XML file; also return the line of each element."""
    data = file.path.read_bytes()
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


def _parse_hrsc(element: Element) -> Box:
    bounded = _has_any(element, HRSC_BOUNDS)
    reference = _numbers(element, HRSC_BOUNDS) if bounded else NO_REFERENCE
    bow = False
    if _has_any(element, HRSC_ORIENTED) or not bounded:
        corners = shapes.oriented_corners(*_numbers(element, HRSC_ORIENTED))
        if (head := _head(element)) is not None:
            corners, bow = shapes.bow_first(corners, head)
    else:
        corners = shapes.upright_corners(reference)
    class_id, number = _text(element, 'Class_ID'), _text(element, 'Object_ID')
    return Box(corners, class_id, number, reference=reference, bow=bow)


def _head(element: Element) -> tuple[float, float] | None:
    try:
        x, y = _numbers(element, HRSC_HEAD)
    except ValueError:
        # The box is valid without it.
        return None
    # The data set has 0, 0 for ships without a marked head.
    return (x, y) if (x, y) != (0.0, 0.0) else None


def _parse_voc(element: Element) -> Box:
    name = _text(element, 'name')
    if not name:
        raise ValueError('no <name>')
    bounds, oriented = element.find('bndbox'), element.find('robndbox')
    if bounds is None and oriented is None:
        raise ValueError('neither <bndbox> nor <robndbox>')
    reference = NO_REFERENCE if bounds is None else _numbers(bounds, VOC_BOUNDS)
    corners: Sequence[float]
    if oriented is None:
        corners = shapes.upright_corners(reference)
    elif _has_any(oriented, VOC_CORNERS):
        corners = _numbers(oriented, VOC_CORNERS)
    else:
        corners = shapes.oriented_corners(*_numbers(oriented, VOC_CENTRED))
    return Box(corners, name, reference=reference)


def _has_any(element: Element, tags: Sequence[str]) -> bool:
    return any(element.find(tag) is not None for tag in tags)


def _text(element: Element, tag: str) -> str:
    return (element.findtext(tag) or '').strip()


def _numbers(element: Element, tags: Sequence[str]) -> list[float]:
    numbers = []
    for tag in tags:
        text = element.findtext(tag)
        if text is None:
            raise ValueError(f'no <{tag}> in <{element.tag}>')
        try:
            numbers.append(parse_number(text.strip()))
        except ValueError as error:
            raise ValueError(f'<{tag}>: {error}') from None
    return numbers


def _write_voc(path: Path, images: list[ImageBoxes]) -> None:
    write_per_image(path, images, '.xml', _voc_document)


def _voc_document(image: ImageBoxes) -> list[str]:
    root = Element(VOC_ROOT)
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
        _add(SubElement(element, 'bndbox'), **dict(zip(VOC_BOUNDS, bounds, strict=True)))
    ElementTree.indent(root)
    return [ElementTree.tostring(root, encoding='unicode')]


def _add(parent: Element, **texts: str) -> None:
    for tag, text in texts.items():
        if NOT_IN_XML.search(text):
            raise ValueError(f'{text!r} has a character that XML cannot hold')
        SubElement(parent, tag).text = text


HRSC = Format(
    name='hrsc',
    suffixes=('.xml',),
    summary='HRSC2016 XML, one file per image: mbox_cx … mbox_ang and box_xmin … of each ship',
    sniff=lambda head: f'<{HRSC_ROOT}' in head,
    read=_read_hrsc,
)
VOC = Format(
    name='voc',
    suffixes=('.xml',),
    summary='Pascal-VOC XML, one file per image: bndbox, and robndbox of roLabelImg and DIOR-R',
    sniff=lambda head: re.search(f'<{VOC_ROOT}[ >]', head) is not None,
    read=_read_voc,
    write_boxes=_write_voc,
)
