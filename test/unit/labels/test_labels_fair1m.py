# SPDX-License-Identifier: Apache-2.0
"""FAIR1M XML."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

CORNERS = ['323.4,232.7', '496.6,332.7', '476.6,367.3', '303.4,267.3', '323.4,232.7']
SHIP = (
    '<object><coordinate>pixel</coordinate><type>rectangle</type><description>None</description>'
    '<possibleresult><name>Dry Cargo Ship</name></possibleresult><points>'
    + ''.join(f'<point>{corner}</point>' for corner in CORNERS)
    + '</points></object>'
)
FAIR1M = """<?xml version="1.0" encoding="utf-8"?>
<annotation>
  <source><filename>7.tif</filename><origin>GF2/GF3</origin></source>
  <size><width>1000</width><height>800</height><depth>3</depth></size>
  <objects>
{}
  </objects>
</annotation>"""


def test_corners_class_and_size_are_read(put: Put) -> None:
    (labels,) = read_labels(put('7.xml', FAIR1M.format(SHIP)))
    assert (labels.image, labels.size, labels.class_ids) == ('7', (1000, 800), ('Dry Cargo Ship',))
    assert labels.extras.file_name == '7.tif'
    assert labels.hulls == (None,)
    assert np.isnan(labels.reference).all()
    boxes = labels.boxes()
    np.testing.assert_allclose(boxes.center[0], [400, 300], atol=0.05)
    np.testing.assert_allclose([boxes.length[0], boxes.width[0]], [200, 40], atol=0.05)
    np.testing.assert_allclose(boxes.theta % np.pi, np.radians(30), atol=1e-3)


def test_a_prediction_has_its_probability_as_score(put: Put) -> None:
    ship = SHIP.replace('</name>', '</name><probability>0.25</probability>')
    (labels,) = read_labels(put('7.xml', FAIR1M.format(ship)))
    assert labels.scores.tolist() == [0.25]


def test_an_image_without_objects_has_no_boxes(put: Put) -> None:
    (labels,) = read_labels(put('7.xml', FAIR1M.format('')))
    assert labels.class_ids == ()


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('>pixel<', '>geographic<', "<coordinate> is 'geographic': only pixel is read"),
        ('Dry Cargo Ship', '', 'no <name> in <possibleresult>'),
        ('496.6,332.7', '496.6', 'a <point> is not x,y'),
        ('496.6,332.7', '496.6,x', "'x' is not a number"),
        ('496.6,332.7', '496.6,1e999', 'not a finite number'),
        ('points>', 'point>', 'a polygon has 0 numbers'),
        ('</name>', '</name><probability>high</probability>', "'high' is not a number"),
    ],
)
def test_an_object_that_is_not_understood_is_reported(
    put: Put, old: str, new: str, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('7.xml', FAIR1M.format('\n'.join([SHIP, SHIP.replace(old, new), SHIP])))
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert (error.path, error.line) == (path, 7)
    assert error.message.startswith('object 2: ')
    assert message in error.message


@pytest.mark.parametrize(
    ('format_name', 'text', 'message'),
    [
        ('voc', FAIR1M.format(SHIP), 'not Pascal VOC: <objects>, as FAIR1M has it'),
        ('fair1m', '<annotation><object><name>a</name></object></annotation>', 'no <objects>'),
    ],
)
def test_fair1m_and_voc_are_not_taken_for_each_other(
    put: Put, format_name: str, text: str, message: str
) -> None:
    errors: list[LabelError] = []
    assert list(read_labels(put('7.xml', text), format_name, on_error=errors.append)) == []
    assert [message in error.message for error in errors] == [True]
