# SPDX-License-Identifier: Apache-2.0
"""
HRSC2016 XML: one file per image with the oriented and the upright box of each ship, pixels.

::

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
missing, 0 0 or anywhere else, the bow is not known. Segmentation is not read.
An image without a file name or id is named after the label file.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.documents import parse_difficulty
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

ROOT = 'HRSC_Image'
ORIENTED = ('mbox_cx', 'mbox_cy', 'mbox_w', 'mbox_h', 'mbox_ang')
HEAD = ('header_x', 'header_y')
BOUNDS = ('box_xmin', 'box_ymin', 'box_xmax', 'box_ymax')


def _read(file: LabelFile) -> list[ImageLabels]:
    root, objects = read_objects(file, ROOT, 'HRSC_Objects/HRSC_Object')
    boxes = [box for _, _, box in file.parse_records(objects, _parse)]
    size = size_of(root, 'Img_SizeWidth', 'Img_SizeHeight')
    name = text_of(root, 'Img_FileName') or text_of(root, 'Img_ID') or file.path.stem
    return [file.image(name, boxes, size)]


def _parse(element: Element) -> Box:
    bounded = has_any(element, BOUNDS)
    reference = numbers_of(element, BOUNDS) if bounded else NO_REFERENCE
    bow = False
    if has_any(element, ORIENTED) or not bounded:
        corners = shapes.oriented_corners(*numbers_of(element, ORIENTED))
        if (head := _head(element)) is not None:
            corners, bow = shapes.bow_first(corners, head)
    else:
        corners = shapes.upright_corners(reference)
    class_id, number = text_of(element, 'Class_ID'), text_of(element, 'Object_ID')
    difficulty = parse_difficulty(text_of(element, 'difficult'))
    return Box(corners, class_id, number, reference=reference, bow=bow, difficulty=difficulty)


def _head(element: Element) -> tuple[float, float] | None:
    try:
        x, y = numbers_of(element, HEAD)
    except ValueError:
        # The box is valid without it.
        return None
    # The data set has 0, 0 for ships without a marked head.
    return (x, y) if (x, y) != (0.0, 0.0) else None


FORMAT = Format(
    name='hrsc',
    suffixes=('.xml',),
    summary='HRSC2016 XML, one file per image: mbox_cx … mbox_ang and box_xmin … of each ship',
    sniff=lambda head: f'<{ROOT}' in head,
    read=_read,
)
