# SPDX-License-Identifier: Apache-2.0
"""The same four corners are the same box in every format, in any order."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import shapely

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.cli import main
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

Ring = list[list[float]]

SIZE = (256, 128)
TAGS = 'x_left_top y_left_top x_right_top y_right_top x_right_bottom y_right_bottom x_left_bottom'
CORNER_TAGS = [*TAGS.split(), 'y_left_bottom']

# A box as people draw it, one whose end is aslant, and a hull with bow, port, stern and starboard.
QUADS = {
    'box': [[16.0, 24.0], [200.0, 80.0], [190.0, 112.0], [6.0, 56.0]],
    'aslant': [[16.0, 24.0], [200.0, 80.0], [186.0, 112.0], [6.0, 54.0]],
    'hull': [[200.0, 60.0], [100.0, 74.0], [10.0, 62.0], [104.0, 50.0]],
    'upright': [[10.0, 20.0], [90.0, 20.0], [90.0, 40.0], [10.0, 40.0]],
}
ORDERS = {'in order': [0, 1, 2, 3], 'from another corner': [2, 1, 0, 3], 'Z': [0, 1, 3, 2]}


def _flat(ring: Ring) -> str:
    return ' '.join(str(value) for point in ring for value in point)


def _geometry(ring: Ring) -> dict[str, object]:
    return {'type': 'Polygon', 'coordinates': [[*ring, ring[0]]]}


def _dota(ring: Ring) -> str:
    return f'{_flat(ring)} ship 0\n'


def _yolo(ring: Ring) -> str:
    return f'0 {_flat([[x / SIZE[0], y / SIZE[1]] for x, y in ring])}\n'


def _csv(ring: Ring) -> str:
    names = ','.join(f'{axis}{number}' for number in range(1, 5) for axis in 'xy')
    return f'image,instance,class,{names}\na,,ship,{_flat(ring).replace(" ", ",")}\n'


def _wkt(ring: Ring) -> str:
    points = ', '.join(f'{x} {y}' for x, y in [*ring, ring[0]])
    return f'image,class,wkt\na,ship,"POLYGON (({points}))"\n'


def _voc(ring: Ring) -> str:
    numbers = zip(CORNER_TAGS, _flat(ring).split(), strict=True)
    corners = ''.join(f'<{tag}>{number}</{tag}>' for tag, number in numbers)
    ship = f'<object><name>ship</name><robndbox>{corners}</robndbox></object>'
    return f'<annotation>{ship}</annotation>'


def _coco(ring: Ring) -> str:
    ship = {'image_id': 1, 'category_id': 1, 'segmentation': [np.ravel(ring).tolist()]}
    categories = [{'id': 1, 'name': 'ship'}]
    return json.dumps(
        {'images': [{'id': 1, 'file_name': 'a'}], 'categories': categories, 'annotations': [ship]}
    )


def _geojson(ring: Ring) -> str:
    return json.dumps({'type': 'Feature', 'properties': {}, 'geometry': _geometry(ring)})


FORMATS: dict[str, tuple[str, Callable[[Ring], str]]] = {
    'dota': ('a.txt', _dota),
    'yolo_obb': ('a.txt', _yolo),
    'csv': ('a.csv', _csv),
    'wkt': ('a.csv', _wkt),
    'voc': ('a.xml', _voc),
    'coco': ('a.json', _coco),
    'geojson': ('a.geojson', _geojson),
}


@pytest.mark.parametrize('order', ORDERS.values(), ids=ORDERS)
@pytest.mark.parametrize('ring', QUADS.values(), ids=QUADS)
@pytest.mark.parametrize('name', FORMATS)
def test_the_same_corners_are_the_same_box(put: Put, name: str, ring: Ring, order: list[int]):
    file, text = FORMATS[name]
    drawn = [ring[i] for i in order]
    (labels,) = read_labels(put(file, text(drawn)), name, image_size=SIZE)
    np.testing.assert_allclose(labels.corners, [drawn])
    expected = OrientedBoxes.from_corners([ring])
    np.testing.assert_allclose(convert(labels.boxes()), convert(expected), rtol=0, atol=1e-9)


@pytest.mark.parametrize('order', ORDERS.values(), ids=ORDERS)
def test_shapefiles_have_the_same_boxes(tmp_path: Path, order: list[int]) -> None:
    geopandas = pytest.importorskip('geopandas')
    rings = [[ring[i] for i in order] for ring in QUADS.values()]
    path = tmp_path / 'ships.shp'
    polygons = shapely.polygons(rings)
    ships = geopandas.GeoDataFrame({'class': list(QUADS)}, geometry=polygons, crs='EPSG:32632')
    ships.to_file(path)
    (labels,) = read_labels(path)
    expected = OrientedBoxes.from_corners(list(QUADS.values()))
    np.testing.assert_allclose(convert(labels.boxes()), convert(expected), rtol=0, atol=1e-9)


@pytest.mark.parametrize('name', FORMATS)
def test_the_first_edge_is_that_of_the_file(put: Put, name: str) -> None:
    file, text = FORMATS[name]
    # The second edge of the ring is the short one.
    bow, *others = np.roll(QUADS['box'], -1, axis=0).tolist()
    in_order, crossed = [bow, *others], [others[0], bow, *others[1:]]
    for ring, known in ((in_order, True), (crossed, False)):
        (labels,) = read_labels(put(file, text(ring)), name, image_size=SIZE)
        boxes = labels.boxes('first-edge')
        assert boxes.bow.tolist() == [known]
        if known:
            tip = boxes.center[0] + boxes.first[0]
            np.testing.assert_allclose(tip, np.mean(ring[:2], axis=0), atol=1e-6)


@pytest.mark.parametrize('order', ORDERS.values(), ids=ORDERS)
def test_an_upright_ring_in_any_order_is_also_the_reference(put: Put, order: list[int]) -> None:
    ring = [QUADS['upright'][i] for i in order]
    (labels,) = read_labels(put('a.geojson', _geojson(ring)))
    assert labels.reference.tolist() == [[10.0, 20.0, 90.0, 40.0]]


@pytest.mark.parametrize('name', FORMATS)
def test_the_summary_counts_corners_that_were_put_in_order(
    put: Put, name: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    file, text = FORMATS[name]
    target = tmp_path / 'boxes.csv'
    for order, said in (('in order', False), ('Z', True)):
        source = put(file, text([QUADS['box'][i] for i in ORDERS[order]]))
        arguments = ['convert', source, target, '--from', name, '--image-size', *SIZE]
        assert main(list(map(str, arguments))) == 0
        summary = capsys.readouterr().out
        assert ('1 with crossed corners put in order' in summary) == said
