# SPDX-License-Identifier: Apache-2.0
"""Polygons of geographic tools: GeoJSON, CSV with WKT, shapefiles."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any

import numpy as np
import pytest
import shapely

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

TILTED = [[0.0, 3.0], [1.0, 0.0], [7.0, 2.0], [6.0, 5.0], [0.0, 3.0]]
HULL = [[0.0, 1.0], [2.0, 0.0], [8.0, 0.0], [10.0, 1.0], [8.0, 2.0], [2.0, 2.0], [0.0, 1.0]]
HOLE = [[4.0, 0.5], [5.0, 0.5], [5.0, 1.5], [4.0, 0.5]]
PARTS = [[[[0, 0], [4, 0], [4, 2], [0, 2], [0, 0]]], [[[6, 0], [9, 0], [9, 2], [6, 2], [6, 0]]]]


def _feature(coordinates: Any, kind: str = 'Polygon', **properties: Any) -> dict[str, Any]:
    geometry = {'type': kind, 'coordinates': coordinates}
    return {'type': 'Feature', 'properties': properties, 'geometry': geometry}


def _collection(*features: Any) -> str:
    return json.dumps({'type': 'FeatureCollection', 'features': features})


def _area(labels: ImageLabels, row: int = 0) -> float:
    return float(shapely.Polygon(labels.corners[row]).area)


def test_a_feature_collection_of_the_standard_is_read(put: Put) -> None:
    feature = _feature([TILTED], **{'class': 'ship', 'score': 0.5, 'image': 'P1', 'note': None})
    path = put('scene.geojson', _collection(feature | {'id': 7}))
    (labels,) = read_labels(path)
    assert (labels.image, labels.class_ids, labels.ids) == ('P1', ('ship',), ('7',))
    assert labels.scores.tolist() == [0.5]
    assert labels.hulls == (None,)
    assert np.isnan(labels.reference).all()
    assert _area(labels) == pytest.approx(shapely.Polygon(TILTED).area)


def test_a_feature_may_have_only_a_polygon(put: Put) -> None:
    feature = _feature([TILTED]) | {'properties': None}
    (labels,) = read_labels(put('scene.json', json.dumps(feature)))
    assert (labels.image, labels.class_ids, labels.ids) == ('scene', ('',), ('',))
    assert labels.scores.tolist() == [1.0]


@pytest.mark.parametrize(
    ('properties', 'instance', 'kept'),
    [
        ({}, '7', {}),
        ({'id': 12}, '12', {'id': 12, 'feature_id': 7}),
        ({'id': 7.0}, '7', {'id': 7.0}),
        ({'instance': 'x'}, 'x', {'feature_id': 7}),
        ({'id': 12, 'feature_id': 3}, '12', {'id': 12, 'feature_id': 3, 'feature_id_': 7}),
    ],
)
def test_the_id_of_a_feature_is_kept_beside_that_of_its_properties(
    put: Put, properties: dict[str, Any], instance: str, kept: dict[str, Any]
) -> None:
    feature = _feature([TILTED], **properties) | {'id': 7}
    (labels,) = read_labels(put('scene.geojson', _collection(feature)))
    assert labels.ids == (instance,)
    assert {name: values[0] for name, values in labels.extras.properties.items()} == kept


def test_more_than_four_corners_are_a_hull_and_holes_are_part_of_it(put: Put) -> None:
    (labels,) = read_labels(put('a.geojson', _collection(_feature([HULL, HOLE]))))
    assert labels.hulls[0] is not None
    assert labels.hulls[0].tolist() == HULL[:-1]
    assert _area(labels) == pytest.approx(20.0)


def test_several_polygons_with_heights_are_one_ship(put: Put) -> None:
    (labels,) = read_labels(put('a.geojson', _collection(_feature(PARTS, 'MultiPolygon'))))
    assert labels.hulls[0] is not None
    assert _area(labels) == pytest.approx(18.0)
    high = [[x, y, 5.0] for x, y in TILTED]
    (labels,) = read_labels(put('a.geojson', _collection(_feature([high]))))
    assert labels.hulls == (None,)


def test_an_upright_rectangle_is_also_the_reference(put: Put) -> None:
    (labels,) = read_labels(put('a.geojson', _collection(_feature(PARTS[0]))))
    assert labels.reference.tolist() == [[0, 0, 4, 2]]


@pytest.mark.parametrize('start', range(4))
@pytest.mark.parametrize('closed', [True, False])
@pytest.mark.parametrize('step', [1, -1])
def test_an_upright_rectangle_may_start_at_any_corner_and_run_in_either_direction(
    put: Put, start: int, closed: bool, step: int
) -> None:
    corners = PARTS[0][0][:-1][::step]
    ring = corners[start:] + corners[:start]
    ring = [*ring, ring[0]] if closed else ring
    (labels,) = read_labels(put('a.geojson', _collection(_feature([ring]))))
    assert labels.reference.tolist() == [[0, 0, 4, 2]]
    assert labels.hulls == (None,)


@pytest.mark.parametrize(
    'ring', [[[0, 0], [4, 0], [4, 2], [0, 2.001]], [[0, 0], [4, 0], [0, 2], [4, 2.5]]]
)
def test_four_corners_that_are_not_upright_have_no_reference(put: Put, ring: list) -> None:
    (labels,) = read_labels(put('a.geojson', _collection(_feature([ring]))))
    assert np.isnan(labels.reference).all()
    assert labels.hulls == (None,)


def test_order_and_errors_are_kept_across_blocks_of_features(put: Put) -> None:
    flat = [[0, 0], [1, 1], [2, 2], [0, 0]]
    count = BLOCK + 3
    features = [_feature([flat if i % 4000 == 7 else HULL], id=i) for i in range(count)]
    errors: list[LabelError] = []
    (labels,) = read_labels(put('a.geojson', _collection(*features)), on_error=errors.append)
    bad = [i for i in range(count) if i % 4000 == 7]
    assert [error.message for error in errors] == [
        f'features[{i}]: the polygon has no area' for i in bad
    ]
    assert labels.ids == tuple(str(i) for i in range(count) if i not in bad)
    assert all(len(hull) == len(HULL) - 1 for hull in labels.hulls)


def test_a_collection_without_features_is_an_image_without_boxes(put: Put) -> None:
    (labels,) = read_labels(put('scene.geojson', _collection()))
    assert (labels.image, len(labels.class_ids)) == ('scene', 0)


@pytest.mark.parametrize(
    ('bad', 'message'),
    [
        (_feature([1, 2], 'Point'), 'a Point is not a polygon'),
        (_feature([TILTED], ['Polygon']), 'is not a polygon'),
        (_feature([]), 'empty'),
        (_feature('x'), 'not an array of rings'),
        (_feature(['x']), 'not a list of positions'),
        (_feature([[[1, 2], [3]]]), 'not a list of positions'),
        (_feature([[1, 2, 3]]), 'not a list of positions'),
        (_feature([[[0, 0], [1, 1], [2, 2], [0, 0]]]), 'no area'),
        (_feature([[[0, 0], [1, 1], [0, 0]]]), 'fewer than three'),
        (_feature([[[0, 0], [1, None], [0, 5]]]), 'not finite'),
        (_feature([[[0, 0], [1, 10**400], [0, 5]]]), 'not a list of positions'),
        (_feature([{}]), 'not a list of positions'),
        (_feature([[[[0, 0]]]]), 'not a list of positions'),
        (_feature([TILTED], score='high'), "'high' is not a number"),
        (_feature([TILTED]) | {'geometry': None}, 'no geometry'),
        (_feature([TILTED]) | {'properties': []} | {'geometry': 5}, 'not a JSON object'),
        (_feature([TILTED]) | {'properties': 'x'}, "'properties' is not a JSON object"),
        ({'type': 'Feature'}, "no 'geometry'"),
        (5, 'not a JSON object'),
    ],
)
def test_a_malformed_feature_is_reported_with_its_number(
    put: Put, bad: object, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('a.geojson', _collection(_feature([TILTED]), bad, _feature([TILTED])))
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert error.message.startswith('features[1]: ')
    assert message in error.message


WKT = shapely.Polygon(TILTED).wkt


def test_a_wkt_table_of_gdal_is_read(put: Put) -> None:
    path = put('scene.csv', f'WKT,class,id\n"{WKT}",ship,7\n"{WKT}",,\n')
    (labels,) = read_labels(path)
    assert (labels.image, labels.class_ids, labels.ids) == ('scene', ('ship', ''), ('7', ''))
    assert _area(labels) == pytest.approx(20.0)


def test_a_wkt_table_may_have_images_and_scores(put: Put) -> None:
    parts = shapely.MultiPolygon([shapely.Polygon(part[0]) for part in PARTS]).wkt
    rows = f'a.png,0.5,"SRID=32632;{WKT}"\nb.png,,"{parts}"\na.png,,"{WKT}"\n'
    path = put('scene.csv', f'image,score,geometry\n{rows}')
    first, second = read_labels(path)
    assert (first.image, second.image) == ('a.png', 'b.png')
    assert first.scores.tolist() == [0.5, 1.0]
    assert second.hulls[0] is not None


@pytest.mark.parametrize(
    ('row', 'message'),
    [
        ('"POLYGON ((0 0, 1"', 'not WKT'),
        ('hello', 'not WKT'),
        ('', ''),
        ('POINT (1 2)', 'a Point is not a polygon'),
        ('POLYGON EMPTY', 'no geometry'),
        ('"POLYGON ((0 0, 1 1, 2 2, 0 0))"', 'no area'),
        ('"POLYGON ((0 0, 1 1))"', 'not WKT'),
        (f'"{WKT}",ship', '3 fields'),
    ],
)
def test_a_malformed_wkt_row_is_reported_with_its_line(put: Put, row: str, message: str) -> None:
    errors: list[LabelError] = []
    path = put('a.csv', f'class,wkt\nship,"{WKT}"\nship,{row}\nship,"{WKT}"\n')
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    assert [(error.path, error.line) for error in errors] == [(path, 3)]
    assert message in errors[0].message


def test_a_table_without_wkt_is_an_error_that_names_the_columns(put: Put) -> None:
    with pytest.raises(LabelError, match=r'a\.csv:2: no column of WKT: wkt, geometry'):
        list(read_labels(put('a.csv', 'image,x\na,b\n'), 'wkt'))


def _shapefile(path: Path, geometries: list[object], **columns: list[object]) -> Path:
    geopandas = pytest.importorskip('geopandas')
    frame = geopandas.GeoDataFrame(columns, geometry=geometries, crs='EPSG:32632')
    frame.to_file(path, driver='ESRI Shapefile')
    return path


def test_a_shapefile_of_geopandas_is_read(tmp_path: Path) -> None:
    parts = shapely.MultiPolygon([shapely.Polygon(part[0]) for part in PARTS])
    path = _shapefile(
        tmp_path / 'scene.shp',
        [shapely.Polygon(TILTED), parts],
        Class=['ship', 'tug'], score=[0.5, 0.25], id=[7, 8],
    )  # fmt: skip
    for source in (path, tmp_path):
        (labels,) = read_labels(source)
        assert labels.image == 'scene'
        assert (labels.class_ids, labels.ids) == (('ship', 'tug'), ('7', '8'))
        assert labels.scores.tolist() == [0.5, 0.25]
        assert _area(labels) == pytest.approx(20.0)
        assert [hull is None for hull in labels.hulls] == [True, False]


def test_a_feature_without_a_polygon_is_reported_with_its_number(tmp_path: Path) -> None:
    errors: list[LabelError] = []
    path = _shapefile(
        tmp_path / 'a.shp', [shapely.Polygon(TILTED), None, shapely.Polygon(TILTED)], n=[1, 2, 3]
    )
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    assert [error.message for error in errors] == ['feature 1: no geometry']


def test_a_shapefile_of_points_has_no_polygons(tmp_path: Path) -> None:
    errors: list[LabelError] = []
    path = _shapefile(tmp_path / 'a.shp', [shapely.Point(1, 2)], n=[1])
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 0
    assert [error.message for error in errors] == ['feature 0: a Point is not a polygon']


@pytest.mark.parametrize('content', [b'', b'hello', b'\x00\x00\x27\x0a' + b'\x00' * 40])
def test_a_file_that_is_not_a_shapefile_is_one_error(put: Put, content: bytes) -> None:
    pytest.importorskip('geopandas')
    errors: list[LabelError] = []
    path = put('a.shp', content)
    assert list(read_labels(path, on_error=errors.append)) == []
    assert [error.path for error in errors] == [path]
    assert 'not a shapefile' in errors[0].message
