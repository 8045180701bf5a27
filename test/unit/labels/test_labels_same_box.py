# SPDX-License-Identifier: Apache-2.0
"""The same oriented box is the same box, whatever format says it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st

from obbhbb_ros import convert
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels import read_labels

SIZE = (1000, 800)


class Ship(NamedTuple):
    """A box by centre, length, width in px and degrees clockwise as seen."""

    x: float
    y: float
    length: float
    width: float
    degrees: float

    @property
    def boxes(self) -> OrientedBoxes:
        """The box as the converter takes it."""
        return OrientedBoxes.from_xywhr(np.array([[*self[:4], math.radians(self.degrees)]]))

    @property
    def corners(self) -> list[float]:
        """The corners x1 y1 … x4 y4."""
        return self.boxes.corners.reshape(8).tolist()

    @property
    def unturned(self) -> list[float]:
        """The left, top, right and bottom of the box before it is turned."""
        half = self.length / 2, self.width / 2
        return [self.x - half[0], self.y - half[1], self.x + half[0], self.y + half[1]]

    @property
    def xywh(self) -> list[float]:
        """The left, top, length and width of the box before it is turned."""
        return [*self.unturned[:2], self.length, self.width]


def _tags(**values: float) -> str:
    return ''.join(f'<{name}>{value!r}</{name}>' for name, value in values.items())


def _points(ship: Ship) -> str:
    names = [f'{axis}{number}' for number in range(1, 5) for axis in 'xy']
    return _tags(**dict(zip(names, ship.corners, strict=True)))


def _voc(body: str, head: str = '') -> str:
    return f'<annotation>{head}<object><name>ship</name>{body}</object></annotation>'


def _turned_voc(ship: Ship) -> str:
    bounds = dict(zip(('xmin', 'ymin', 'xmax', 'ymax'), ship.unturned, strict=True))
    attribute = f'<attribute><name>rotation</name><value>{ship.degrees!r}</value></attribute>'
    return _voc(f'<bndbox>{_tags(**bounds)}</bndbox><attributes>{attribute}</attributes>')


def _rsdd(ship: Ship) -> str:
    angle = math.radians(ship.degrees)
    box = _tags(cx=ship.x, cy=ship.y, w=ship.width, h=ship.length, angle=angle)
    return _voc(f'<robndbox>{box}</robndbox>', '<polarization>VV</polarization>')


def _cvat(ship: Ship) -> str:
    names = zip(('xtl', 'ytl', 'xbr', 'ybr'), ship.unturned, strict=True)
    bounds = ' '.join(f'{name}="{value!r}"' for name, value in names)
    return (
        '<annotations><image name="a" width="1000" height="800">'
        f'<box label="ship" {bounds} rotation="{ship.degrees!r}"/></image></annotations>'
    )


def _cvat_polygon(ship: Ship) -> str:
    pairs = zip(ship.corners[::2], ship.corners[1::2], strict=True)
    points = ';'.join(f'{x!r},{y!r}' for x, y in pairs)
    return (
        '<annotations><image name="a" width="1000" height="800">'
        f'<polygon label="ship" points="{points}"/></image></annotations>'
    )


def _fair1m(ship: Ship) -> str:
    pairs = list(zip(ship.corners[::2], ship.corners[1::2], strict=True))
    points = ''.join(f'<point>{x!r},{y!r}</point>' for x, y in [*pairs, pairs[0]])
    return (
        '<annotation><objects><object><possibleresult><name>ship</name></possibleresult>'
        f'<points>{points}</points></object></objects></annotation>'
    )


def _coco(**members: object) -> str:
    # The second box says that angles are degrees.
    others = [{'bbox': [4, 3, 2, 1, 90]}]
    annotations = [
        {'image_id': 1, 'category_id': 1, **annotation} for annotation in [members, *others]
    ]
    images = [{'id': 1, 'file_name': 'a'}]
    categories = [{'id': 1, 'name': 'ship'}]
    document = {'images': images, 'categories': categories, 'annotations': annotations}
    return json.dumps(document)


def _datumaro(**members: object) -> str:
    annotation = {'label_id': 0, 'attributes': {}, **members}
    labels = {'label': {'labels': [{'name': 'ship'}]}}
    return json.dumps({'categories': labels, 'items': [{'id': 'a', 'annotations': [annotation]}]})


WRITERS: dict[str, tuple[str, Callable[[Ship], str]]] = {
    'VOC, rotation': ('voc', _turned_voc),
    'VOC, polygon': ('voc', lambda ship: _voc(f'<polygon>{_points(ship)}</polygon>')),
    'SSDD': ('voc', lambda ship: _voc(f'<rotated_bndbox>{_points(ship)}</rotated_bndbox>')),
    'RSDD-SAR': ('voc', _rsdd),
    'CVAT': ('cvat', _cvat),
    'CVAT, polygon': ('cvat', _cvat_polygon),
    'FAIR1M': ('fair1m', _fair1m),
    'COCO, polygon': ('coco', lambda ship: _coco(segmentation=[ship.corners])),
    'COCO, rotation': (
        'coco',
        lambda ship: _coco(bbox=ship.xywh, attributes={'rotation': ship.degrees}),
    ),
    'Detectron2': ('coco', lambda ship: _coco(bbox=[*ship[:4], -ship.degrees])),
    'Datumaro, rotation': (
        'datumaro',
        lambda ship: _datumaro(
            type='bbox', bbox=ship.xywh, attributes={'rotation': ship.degrees}
        ),
    ),
    'Datumaro, rotated': (
        'datumaro',
        lambda ship: _datumaro(type='rotated_bbox', rotated_bbox=[*ship]),
    ),
    'Datumaro, polygon': (
        'datumaro',
        lambda ship: _datumaro(type='polygon', points=ship.corners),
    ),
}  # fmt: skip

SHIPS = st.builds(
    Ship,
    st.floats(-100, 1100),
    st.floats(-100, 900),
    st.floats(20, 400),
    st.floats(2, 19),
    st.floats(-360, 360),
)


@pytest.mark.parametrize('what', list(WRITERS))
@given(ship=SHIPS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_box_is_the_same_in_every_format(tmp_path: Path, what: str, ship: Ship) -> None:
    format_name, write = WRITERS[what]
    path = tmp_path / 'file'
    path.write_text(write(ship))
    (labels,) = read_labels(path, format_name)
    assert labels.class_ids[0] == 'ship'
    boxes = labels.boxes()[:1]
    for q in (2.0, 3.0, 5.0):
        np.testing.assert_allclose(convert(boxes, q=q), convert(ship.boxes, q=q), atol=1e-6)
