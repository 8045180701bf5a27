# SPDX-License-Identifier: Apache-2.0
"""
FAIR1M XML: one file per image, in pixels.

::

    <annotation>
      <source><filename>7.tif</filename><origin>GF2/GF3</origin></source>
      <size><width>1000</width><height>800</height><depth>3</depth></size>
      <objects>
        <object>
          <coordinate>pixel</coordinate><type>rectangle</type>
          <possibleresult><name>Dry Cargo Ship</name><probability>0.9</probability></possibleresult>
          <points>
            <point>323.4,232.7</point> … <point>323.4,232.7</point>

The points are the corners, the first one again at the end. The first ``possibleresult`` is the
class; its ``probability``, which predictions have, is the score. The image is named after the label
file. Objects in other coordinates than pixels are reported.
"""

from __future__ import annotations

from functools import partial
from xml.etree.ElementTree import Element

from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.text import parse_numbers
from obbhbb_ros.labels.text import parse_score
from obbhbb_ros.labels.xml_files import read_objects
from obbhbb_ros.labels.xml_files import size_of
from obbhbb_ros.labels.xml_files import text_of

ROOT = 'annotation'
OBJECTS = 'objects'


def _read(file: LabelFile) -> list[ImageLabels]:
    root, objects = read_objects(file, ROOT, f'{OBJECTS}/object')
    if root.find(OBJECTS) is None:
        raise file.error(f'not FAIR1M: no <{OBJECTS}>')
    image = file.path.stem
    boxes = shapes.enclose(file, file.parse_records(objects, partial(_parse, image)))
    size, file_name = size_of(root, 'size/width', 'size/height'), text_of(root, 'source/filename')
    return [file.image(image, boxes.get(image, []), size, file_name=file_name)]


def _parse(image: str, element: Element) -> shapes.Outlined:
    coordinate = text_of(element, 'coordinate')
    if coordinate not in {'', 'pixel'}:
        raise ValueError(f'<coordinate> is {coordinate!r}: only pixel is read')
    name = text_of(element, 'possibleresult/name')
    if not name:
        raise ValueError('no <name> in <possibleresult>')
    score = parse_score(text_of(element, 'possibleresult/probability'))
    points = [(point.text or '').split(',') for point in element.iterfind('points/point')]
    if not all(len(point) == 2 for point in points):
        raise ValueError('a <point> is not x,y')
    ring = shapes.ring_of_pairs(parse_numbers([field for point in points for field in point]))
    return shapes.Outlined(image, Box((), name, score=score), [ring])


FORMAT = Format(
    name='fair1m',
    suffixes=('.xml',),
    summary='FAIR1M XML, one file per image: points of each object, in pixels',
    sniff=lambda head: f'<{ROOT}' in head and f'<{OBJECTS}>' in head,
    read=_read,
)
