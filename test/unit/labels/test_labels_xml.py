# SPDX-License-Identifier: Apache-2.0
"""HRSC2016 and Pascal-VOC XML, and what is refused of any XML."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros import convert
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

SHIP = """
    <HRSC_Object>
      <Object_ID>100000003</Object_ID>
      <Class_ID>100000013</Class_ID>
      <Object_NO>100000003</Object_NO>
      <truncated>0</truncated>
      <difficult>0</difficult>
      <box_xmin>628</box_xmin>
      <box_ymin>40</box_ymin>
      <box_xmax>815</box_xmax>
      <box_ymax>783</box_ymax>
      <mbox_cx>719.9324</mbox_cx>
      <mbox_cy>413.0048</mbox_cy>
      <mbox_w>741.8246</mbox_w>
      <mbox_h>172.6959</mbox_h>
      <mbox_ang>1.499893</mbox_ang>
      <segmented>0</segmented>
      <seg_color>
      </seg_color>
      <header_x>0</header_x>
      <header_y>0</header_y>
    </HRSC_Object>"""
HRSC = """<?xml version='1.0' encoding='utf-8'?>
<HRSC_Image>
  <Img_CusType>sealand</Img_CusType>
  <Img_Location>69.040297,33.070036</Img_Location>
  <Img_SizeWidth>1138</Img_SizeWidth>
  <Img_SizeHeight>833</Img_SizeHeight>
  <Img_SizeDepth>3</Img_SizeDepth>
  <Img_ID>100000001</Img_ID>
  <Img_FileName>100000001</Img_FileName>
  <Img_FileFmt>bmp</Img_FileFmt>
  <HRSC_Objects>{}
  </HRSC_Objects>
</HRSC_Image>
"""
VOC = """<annotation>
    <folder>VOC</folder>
    <filename>other.jpg</filename>
    <size>
        <width>1024</width>
        <height>768</height>
        <depth>3</depth>
    </size>
    <segmented>0</segmented>
    {}
</annotation>
"""
BNDBOX = '<bndbox><xmin>80</xmin><ymin>40</ymin><xmax>190.5</xmax><ymax>97</ymax></bndbox>'
ROLABELIMG = (
    '<type>robndbox</type><robndbox><cx>135.0</cx><cy>68.0</cy><w>110.0</w><h>30.0</h>'
    '<angle>0.36</angle></robndbox>'
)
DIOR = (
    '<robndbox><x_left_top>10</x_left_top><y_left_top>20</y_left_top>'
    '<x_right_top>50</x_right_top><y_right_top>22</y_right_top>'
    '<x_right_bottom>49</x_right_bottom><y_right_bottom>32</y_right_bottom>'
    '<x_left_bottom>9</x_left_bottom><y_left_bottom>30</y_left_bottom></robndbox>'
)


def _object(body: str) -> str:
    return f'<object><name>ship</name><difficult>0</difficult>{body}</object>'


def test_an_hrsc_file_of_the_data_set_is_read(put: Put) -> None:
    (labels,) = read_labels(put('x.xml', HRSC.format(SHIP)))
    assert labels.image == '100000001'
    assert labels.size == (1138, 833)
    assert (labels.class_ids, labels.ids) == (('100000013',), ('100000003',))
    assert labels.reference.tolist() == [[628, 40, 815, 783]]
    boxes = OrientedBoxes.from_corners(labels.corners)
    np.testing.assert_allclose(boxes.center.ravel(), [719.9324, 413.0048])
    np.testing.assert_allclose([boxes.length[0], boxes.width[0]], [741.8246, 172.6959])
    np.testing.assert_allclose(boxes.theta, [1.499893])


@pytest.mark.parametrize(
    ('size', 'angle'), [('60 20', 0.3), ('60 20', 2.0), ('20 60', 0.3), ('20 60', -1.2)]
)
@pytest.mark.parametrize('end', [1, -1])
def test_the_head_point_of_an_hrsc_ship_is_its_bow(
    put: Put, size: str, angle: float, end: int
) -> None:
    along = angle + (0 if size == '60 20' else math.pi / 2)
    ahead = end * np.array([math.cos(along), math.sin(along)])
    # Not quite at the end, and not quite on the axis.
    x, y = [200, 300] + 27 * ahead + 3 * ahead[::-1]
    (labels,) = read_labels(put('x.xml', HRSC.format(_hrsc_ship(size, angle, f'{x} {y}'))))
    assert labels.bow is not None
    boxes = labels.boxes('labels')
    assert boxes.bow is not None
    assert boxes.bow.tolist() == [True]
    np.testing.assert_allclose(boxes.first[0], 30 * ahead)
    (plain,) = read_labels(put('y.xml', HRSC.format(_hrsc_ship(size, angle, '0 0'))))
    np.testing.assert_array_equal(convert(labels.boxes(), f=0.9), convert(plain.boxes(), f=0.9))


@pytest.mark.parametrize('head', ['0 0', '200 300', '250 300', '230 320', 'left 300', ' ', 'inf 1'])
def test_a_head_point_far_from_both_ends_is_ignored(put: Put, head: str) -> None:
    (labels,) = read_labels(put('x.xml', HRSC.format(_hrsc_ship('60 20', 0.0, head + ' '))))
    assert len(labels.class_ids) == 1
    assert labels.bow is None


def test_a_head_point_of_0_0_is_ignored_even_beside_a_ship(put: Put) -> None:
    ship = _hrsc_ship('60 20', 0.0, '0 0').replace('>200<', '>31<').replace('>300<', '>0<')
    (labels,) = read_labels(put('x.xml', HRSC.format(ship)))
    assert labels.bow is None


def _hrsc_ship(size: str, angle: float, head: str) -> str:
    """Write a ship at 200, 300."""
    width, height = size.split()
    x, y = head.split(' ', 1)
    values = {
        'mbox_cx': 200,
        'mbox_cy': 300,
        'mbox_w': width,
        'mbox_h': height,
        'mbox_ang': angle,
        'header_x': x,
        'header_y': y,
    }
    tags = ''.join(f'<{tag}>{value}</{tag}>' for tag, value in values.items())
    return f'<HRSC_Object>{tags}</HRSC_Object>'


def test_an_hrsc_image_without_ships_has_no_boxes(put: Put) -> None:
    (labels,) = read_labels(put('x.xml', HRSC.format('')))
    assert labels.corners.shape == (0, 4, 2)


def test_an_hrsc_ship_without_an_oriented_box_is_upright(put: Put) -> None:
    bare = '\n'.join(line for line in SHIP.splitlines() if 'mbox' not in line)
    (labels,) = read_labels(put('x.xml', HRSC.format(bare)))
    assert labels.corners.tolist() == [[[628, 40], [815, 40], [815, 783], [628, 783]]]
    assert labels.reference.tolist() == [[628, 40, 815, 783]]


def test_an_hrsc_ship_without_bounds_has_no_reference(put: Put) -> None:
    bare = '\n'.join(line for line in SHIP.splitlines() if '<box_' not in line)
    (labels,) = read_labels(put('x.xml', HRSC.format(bare)))
    assert np.isnan(labels.reference).all()


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('<mbox_w>741.8246</mbox_w>', '', 'no <mbox_w> in <HRSC_Object>'),
        ('741.8246', 'wide', "<mbox_w>: 'wide' is not a number"),
        ('741.8246', '-1', 'negative size'),
        ('1.499893', 'inf', '<mbox_ang>'),
        ('<box_xmax>815</box_xmax>', '', 'no <box_xmax>'),
        ('741.8246', '', '<mbox_w>'),
    ],
)
def test_a_malformed_hrsc_ship_is_reported_with_number_and_line(
    put: Put, old: str, new: str, message: str
) -> None:
    path = put('x.xml', HRSC.format(SHIP + SHIP.replace(old, new) + SHIP))
    errors: list[LabelError] = []
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert error.line == 12 + SHIP.count('\n')
    assert error.message.startswith('object 2: ')
    assert message in error.message


def test_a_voc_object_is_upright_and_also_the_reference(put: Put) -> None:
    (labels,) = read_labels(put('P1.xml', VOC.format(_object(BNDBOX))))
    assert labels.image == 'P1'
    assert labels.size == (1024, 768)
    assert labels.class_ids == ('ship',)
    assert labels.reference.tolist() == [[80, 40, 190.5, 97]]
    assert labels.corners.tolist() == [[[80, 40], [190.5, 40], [190.5, 97], [80, 97]]]


def test_a_rolabelimg_angle_is_in_radians_clockwise(put: Put) -> None:
    (labels,) = read_labels(put('P1.xml', VOC.format(_object(ROLABELIMG + BNDBOX))))
    boxes = OrientedBoxes.from_corners(labels.corners)
    np.testing.assert_allclose(boxes.center.ravel(), [135, 68])
    np.testing.assert_allclose([boxes.length[0], boxes.width[0], boxes.theta[0]], [110, 30, 0.36])
    assert labels.reference.tolist() == [[80, 40, 190.5, 97]]
    # Clockwise as seen: the right end of the box hangs lower, where y is larger.
    right = labels.corners[0][labels.corners[0, :, 0].argmax()]
    assert right[1] > 68 + 55 * math.sin(0.36) - 15


def test_a_dior_r_box_has_corners(put: Put) -> None:
    (labels,) = read_labels(put('P1.xml', VOC.format(_object(DIOR))))
    assert labels.corners.tolist() == [[[10, 20], [50, 22], [49, 32], [9, 30]]]
    assert np.isnan(labels.reference).all()


def test_the_caller_overrides_the_image_size_and_an_unusable_one_counts_as_none(put: Put) -> None:
    path = put('P1.xml', VOC.format(''))
    assert next(read_labels(path, image_size=(5, 6))).size == (5, 6)
    path = put('P1.xml', VOC.format('').replace('1024', '0'))
    assert next(read_labels(path)).size is None


@pytest.mark.parametrize(
    ('body', 'message'),
    [
        (f'<object>{BNDBOX}</object>', 'no <name>'),
        (_object(''), 'none of <bndbox>, <robndbox>, <rotated_bndbox>, <polygon>'),
        (_object(BNDBOX.replace('190.5', '8')), 'below its minimum'),
        (_object(BNDBOX.replace('190.5', 'x')), "<xmax>: 'x' is not a number"),
        (_object('<robndbox/>'), 'no <cx> in <robndbox>'),
        (_object(DIOR.replace('<y_left_top>20</y_left_top>', '')), 'no <y_left_top>'),
        (_object(ROLABELIMG.replace('110.0', '-1')), 'negative size'),
    ],
)
def test_a_malformed_voc_object_is_reported_with_number_and_line(
    put: Put, body: str, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('P1.xml', VOC.format(f'{_object(BNDBOX)}\n{body}\n{_object(BNDBOX)}'))
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert (error.path, error.line) == (path, 11)
    assert error.message.startswith('object 2: ')
    assert message in error.message


LAUGHS = '<!DOCTYPE annotation [<!ENTITY a0 "ha">' + ''.join(
    f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12)
)


@pytest.mark.parametrize('format_name', ['hrsc', 'voc', 'cvat', 'fair1m'])
@pytest.mark.parametrize(
    ('text', 'line', 'message'),
    [
        ('<annotation>\n<object>\n', 3, 'not XML'),
        ('', 1, 'not XML'),
        ('<html/>', 1, 'the root is <html>'),
        (f'{LAUGHS}]><annotation>&a11;</annotation>', 1, 'DOCTYPE'),
        ('<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', 1, 'DOCTYPE'),
        ('<?xml version="1.0" encoding="klingon"?><a/>', 1, ''),
        ('<annotation>&x;</annotation>', 1, 'not XML'),
        (b'<annotation>\xff</annotation>', 1, 'not XML'),
    ],
    ids=['cut off', 'blank', 'other root', 'laughs', 'file', 'encoding', 'entity', 'not UTF-8'],
)
def test_a_file_that_cannot_be_used_is_one_error(
    put: Put, format_name: str, text: str | bytes, line: int, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('x.xml', text)
    assert list(read_labels(path, format_name, on_error=errors.append)) == []
    assert [(error.path, error.line) for error in errors] == [(path, line)]
    assert message in errors[0].message


def test_xml_may_be_deeply_nested_and_in_another_encoding(put: Put) -> None:
    deep = '<x>' * 20000 + '</x>' * 20000
    text = VOC.format(_object(BNDBOX + deep))
    (labels,) = read_labels(put('P1.xml', text))
    assert labels.class_ids == ('ship',)
    latin = f'<?xml version="1.0" encoding="iso-8859-1"?>{VOC.format(_object(BNDBOX))}'
    path = put('P1.xml', latin.replace('>ship<', '>fähre<').encode('latin-1'))
    assert next(read_labels(path)).class_ids == ('fähre',)
