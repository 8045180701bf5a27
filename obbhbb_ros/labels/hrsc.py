# SPDX-License-Identifier: Apache-2.0
"""
HRSC2016: one XML file per image, oriented and axis-aligned box of each ship, in pixels.

::

    <HRSC_Image>
      <Img_FileName>100000001</Img_FileName>
      <Img_SizeWidth>1138</Img_SizeWidth> <Img_SizeHeight>833</Img_SizeHeight>
      <HRSC_Objects>
        <HRSC_Object>
          <Object_ID>100000003</Object_ID> <Class_ID>100000013</Class_ID>
          <box_xmin>628</box_xmin> … <box_ymax>783</box_ymax>
          <mbox_cx>719.9</mbox_cx> … <mbox_h>172.7</mbox_h> <mbox_ang>1.499893</mbox_ang>

``mbox_ang`` is in radians from image +x towards +y, along ``mbox_w``. A ship without ``mbox_…``
is read as the upright box of its ``box_…``. Difficulty, head point and segmentation are not read.
An image without a file name or id is named after the label file.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import has_any
from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.documents import read_xml_boxes
from obbhbb_ros.labels.documents import xml_numbers
from obbhbb_ros.labels.documents import xml_text
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import Format
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelFile

ROOT = 'HRSC_Image'
ORIENTED = ('mbox_cx', 'mbox_cy', 'mbox_w', 'mbox_h', 'mbox_ang')
BOUNDS = ('box_xmin', 'box_ymin', 'box_xmax', 'box_ymax')


def _read(file: LabelFile) -> list[ImageLabels]:
    root, boxes = read_xml_boxes(file, ROOT, 'HRSC_Objects/HRSC_Object', _parse)
    size = image_size_of(xml_text(root, 'Img_SizeWidth'), xml_text(root, 'Img_SizeHeight'))
    return [file.image(xml_text(root, 'Img_FileName', 'Img_ID') or file.path.stem, boxes, size)]


def _parse(element: Element) -> Box:
    reference = xml_numbers(element, BOUNDS) if has_any(element, BOUNDS) else NO_REFERENCE
    if has_any(element, ORIENTED) or reference is NO_REFERENCE:
        corners = shapes.oriented_corners(*xml_numbers(element, ORIENTED))
    else:
        corners = shapes.upright_corners(reference)
    return Box(
        corners,
        class_id=xml_text(element, 'Class_ID'),
        id=xml_text(element, 'Object_ID'),
        reference=reference,
    )


FORMAT = Format(
    name='hrsc',
    suffixes=('.xml',),
    summary='HRSC2016 XML, one file per image: mbox_cx … mbox_ang and box_xmin … of each ship',
    sniff=lambda head: f'<{ROOT}' in head,
    read=_read,
)
