# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes in Pascal-VOC XML, as CVAT, SSDD, RSDD-SAR and others have them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.shapes import turned_box

if TYPE_CHECKING:
    from conftest import Put

# A ship of 200 x 40 px at 400, 300, turned by 30 degrees clockwise as seen.
CORNERS = [(323.4, 232.7), (496.6, 332.7), (476.6, 367.3), (303.4, 267.3)]
BOUNDS = (303.4, 232.7, 496.6, 367.3)
POINTS = ''.join(f'<x{n}>{x}</x{n}><y{n}>{y}</y{n}>' for n, (x, y) in enumerate(CORNERS, 1))
POLYGON = f'<polygon>{POINTS}</polygon>'
SSDD = (
    '<rotated_bndbox><rotated_bbox_cx>400</rotated_bbox_cx><rotated_bbox_cy>300</rotated_bbox_cy>'
    '<rotated_bbox_w>200</rotated_bbox_w><rotated_bbox_h>40</rotated_bbox_h>'
    f'<rotated_bbox_theta>30</rotated_bbox_theta>{POINTS}</rotated_bndbox>'
)
RSDD = '<robndbox><cx>400</cx><cy>300</cy><w>40</w><h>200</h><angle>0.5235988</angle></robndbox>'
ROTATION = (
    '<attributes><attribute><name>occluded</name><value>0</value></attribute>'
    '<attribute><name>rotation</name><value>{}</value></attribute></attributes>'
)


def _bndbox(*bounds: float) -> str:
    tags = ('xmin', 'ymin', 'xmax', 'ymax')
    values = zip(tags, bounds, strict=True)
    return f'<bndbox>{"".join(f"<{tag}>{value}</{tag}>" for tag, value in values)}</bndbox>'


UNTURNED = _bndbox(300, 280, 500, 320)


def _voc(*bodies: str, head: str = '') -> str:
    objects = '\n'.join(f'<object><name>ship</name>{body}</object>' for body in bodies)
    return f'<annotation>{head}\n{objects}\n</annotation>'


@pytest.mark.parametrize(
    ('body', 'head', 'reference'),
    [
        (UNTURNED + ROTATION.format(30.0), '', None),
        (UNTURNED + ROTATION.format(-330), '', None),
        (_bndbox(*BOUNDS) + POLYGON, '', BOUNDS),
        (_bndbox(*BOUNDS) + SSDD, '', BOUNDS),
        (_bndbox(*BOUNDS) + POLYGON + ROTATION.format(0.0), '', BOUNDS),
        (RSDD, '<polarization>HH</polarization>', None),
    ],
    ids=['CVAT', 'negative', 'ShipRSImageNet', 'SSDD', 'not turned', 'RSDD-SAR'],
)
def test_the_oriented_box_of_another_tool_is_read(
    put: Put, body: str, head: str, reference: tuple[float, ...] | None
) -> None:
    (labels,) = read_labels(put('P1.xml', _voc(body, head=head)))
    boxes = labels.boxes()
    np.testing.assert_allclose(boxes.center.ravel(), [400, 300], atol=0.05)
    np.testing.assert_allclose([boxes.length[0], boxes.width[0]], [200, 40], atol=0.05)
    np.testing.assert_allclose(boxes.theta % np.pi, np.radians(30), atol=1e-3)
    assert labels.image == 'P1'
    expected = [np.nan] * 4 if reference is None else reference
    np.testing.assert_allclose(labels.reference[0], expected)


def test_an_attribute_rotation_of_0_leaves_the_box_upright(put: Put) -> None:
    (labels,) = read_labels(put('P1.xml', _voc(UNTURNED + ROTATION.format(0.0))))
    assert labels.reference.tolist() == [[300, 280, 500, 320]]
    assert labels.corners[0].tolist() == [[300, 280], [500, 280], [500, 320], [300, 320]]


def test_other_attributes_are_properties(put: Put) -> None:
    (labels,) = read_labels(put('P1.xml', _voc(UNTURNED + ROTATION.format(30.0), UNTURNED)))
    assert labels.extras.properties == {'occluded': ('0', None)}


def test_without_polarization_a_robndbox_has_its_angle_along_w(put: Put) -> None:
    (labels,) = read_labels(put('P1.xml', _voc(RSDD)))
    np.testing.assert_allclose(labels.boxes().theta % np.pi, np.radians(120))


def test_a_polygon_of_more_points_is_the_hull(put: Put) -> None:
    hull = [(10, 10), (50, 10), (60, 20), (50, 30), (10, 30)]
    points = ''.join(f'<x{n}>{x}</x{n}><y{n}>{y}</y{n}>' for n, (x, y) in enumerate(hull, 1))
    (labels,) = read_labels(
        put('P1.xml', _voc(f'{_bndbox(10, 10, 60, 30)}<polygon>{points}</polygon>'))
    )
    assert labels.hulls[0] is not None
    assert labels.hulls[0].tolist() == [list(point) for point in hull]
    np.testing.assert_allclose(labels.boxes().length, [50])
    assert labels.reference.tolist() == [[10, 10, 60, 30]]


@pytest.mark.parametrize(
    ('body', 'message'),
    [
        (UNTURNED + ROTATION.format('x'), "attribute rotation: 'x' is not a number"),
        (UNTURNED + ROTATION.format('nan'), 'not a finite number'),
        (UNTURNED + POLYGON + ROTATION.format(30), 'a rotation of 30 beside <polygon>'),
        (UNTURNED + '<angle>30</angle>', '<angle> in <object>: its unit and sense are unknown'),
        (UNTURNED.replace('</bnd', '<theta>1</theta></bnd'), '<theta> in <bndbox>'),
        (POLYGON.replace('x2>', 'x9>'), 'no <x2> in <polygon>'),
        ('<polygon><x1>1</x1><y1>2</y1></polygon>', 'a polygon has 2 numbers'),
        ('<polygon><pt><x>1</x><y>2</y></pt></polygon>', 'a polygon has 0 numbers'),
        (POLYGON.replace('232.7', '1e999'), '<y1>: '),
        (SSDD.replace('x4>', 'x5>'), 'no <x4> in <rotated_bndbox>'),
        ('<polygon>' + '<x1>1</x1><y1>2</y1>' * 50_000 + '</polygon>', 'no <x2>'),
    ],
    ids=[
        'word', 'nan', 'both', 'angle', 'theta', 'gap', 'one point', 'LabelMe', 'huge', 'three',
        'long',
    ],
)  # fmt: skip
def test_an_oriented_box_that_is_not_understood_is_refused_by_its_field(
    put: Put, body: str, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('P1.xml', _voc(UNTURNED, body, UNTURNED))
    (labels,) = read_labels(path, 'voc', on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert (error.path, error.line) == (path, 3)
    assert error.message.startswith('object 2: ')
    assert message in error.message


@given(
    st.tuples(*[st.floats(-1e4, 1e4)] * 2),
    st.tuples(*[st.floats(1, 1e3)] * 2),
    st.floats(-720, 720).filter(bool),
)
def test_turning_a_box_keeps_its_centre_and_sizes(
    start: tuple[float, float], size: tuple[float, float], degrees: float
) -> None:
    bounds = (*start, start[0] + size[0], start[1] + size[1])
    corners, reference = turned_box(bounds, degrees)
    assert all(map(math.isnan, reference))
    boxes = OrientedBoxes.from_corners(np.array([corners]))
    center = np.add(bounds[:2], bounds[2:]) / 2
    np.testing.assert_allclose(boxes.center[0], center, atol=1e-6)
    found = sorted([boxes.length[0], boxes.width[0]])
    np.testing.assert_allclose(found, sorted(np.subtract(bounds[2:], bounds[:2])), atol=1e-6)
    upright, reference = turned_box(bounds, 0.0)
    assert reference == bounds
    np.testing.assert_allclose(upright, turned_box(bounds, 360.0)[0], atol=1e-6)
