# SPDX-License-Identifier: Apache-2.0
"""Labels in map coordinates: reference systems, degrees, and caps in metres."""

from __future__ import annotations

import json
import sqlite3
import warnings
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Put
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.degrees import ground_scale
from obbhbb_ros.labels.degrees import to_degrees
from obbhbb_ros.labels.degrees import to_plane

convert = partial(convert_file, report=print)

UTM = {'type': 'name', 'properties': {'name': 'urn:ogc:def:crs:EPSG::32633'}}


def _feature(ring: Any, **properties: Any) -> dict[str, Any]:
    return {
        'type': 'Feature',
        'properties': properties,
        'geometry': {'type': 'Polygon', 'coordinates': [np.asarray(ring).tolist()]},
    }


def _collection(*features: dict[str, Any], **members: Any) -> str:
    return json.dumps({'type': 'FeatureCollection', **members, 'features': features})


def _ring(x: float, y: float, length: float, width: float, angle: float) -> FloatArray:
    corners = OrientedBoxes.from_xywhr([[x, y, length, width, angle]]).corners[0]
    return np.vstack((corners, corners[:1]))


def _written(path: Path) -> tuple[dict[str, Any], FloatArray]:
    document = json.loads(path.read_text())
    rings = [feature['geometry']['coordinates'][0] for feature in document['features']]
    boxes = [[*np.min(ring, axis=0), *np.max(ring, axis=0)] for ring in rings]
    return document, np.array(boxes)


def test_geojson_keeps_the_reference_system_and_all_properties(put: Put) -> None:
    pytest.importorskip('pyproj')
    properties = {'mmsi': 219000001, 'time': '12:00', 'tags': ['a', {'b': None}], 'class': 'ship'}
    ring = _ring(500311.0, 6649643.0, 130.0, 20.0, 0.5)
    path = put('in.geojson', _collection(_feature(ring, **properties), crs=UTM))
    tally = convert(path, path.with_name('out.geojson'), HullRule())
    assert tally.losses == ''
    document, boxes = _written(path.with_name('out.geojson'))
    assert document['crs'] == UTM
    written = document['features'][0]['properties']
    assert {name: written[name] for name in properties} == properties
    assert boxes[0][0] == pytest.approx(500311.0 - 60, abs=10.0)


@pytest.mark.parametrize('latitude', [0.0, 35.0, -60.0, 75.0])
@pytest.mark.parametrize('given_crs', [False, True])
def test_degrees_give_the_box_of_the_ship_on_the_ground(
    put: Put, latitude: float, given_crs: bool
) -> None:
    rule = HullRule('superellipse')
    metres = np.vstack([_ring(0.0, 0.0, 200.0, 30.0, angle) for angle in (0.3, 1.2)])
    pyproj = pytest.importorskip('pyproj')
    local = pyproj.Transformer.from_crs(
        f'+proj=aeqd +lat_0={latitude} +lon_0=12 +ellps=WGS84', 'OGC:CRS84', always_xy=True
    )
    rings = np.column_stack(local.transform(*metres.T)).reshape(2, 5, 2)
    crs = {'crs': {'type': 'name', 'properties': {'name': 'urn:ogc:def:crs:OGC:1.3:CRS84'}}}
    text = _collection(*map(_feature, rings), **(crs if given_crs else {}))
    path = put('in.geojson', text)
    convert(path, path.with_name('out.geojson'), rule, diagnostics=True)
    document, boxes = _written(path.with_name('out.geojson'))
    assert 'crs' not in document
    lengths = [feature['properties']['length'] for feature in document['features']]
    assert lengths == pytest.approx([200.0, 200.0], abs=0.05)
    expected = OrientedBoxes.from_corners(metres.reshape(2, 5, 2)[:, :4])
    low = np.column_stack(local.transform(*boxes[:, :2].T, direction='INVERSE'))
    high = np.column_stack(local.transform(*boxes[:, 2:].T, direction='INVERSE'))
    np.testing.assert_allclose(np.hstack((low, high)), convert_by_rule(expected, rule), atol=0.05)


def test_pixels_without_a_reference_system_stay_pixels(put: Put) -> None:
    path = put('in.geojson', _collection(_feature(_ring(40.0, 30.0, 20.0, 4.0, 0.5))))
    (labels,) = read_labels(path)
    assert labels.extras.label_set.crs == ''
    np.testing.assert_allclose(labels.corners[0].mean(axis=0), [40.0, 30.0])


def test_labels_in_degrees_are_written_in_degrees(put: Put) -> None:
    ring = np.array([[12.0, 60.0], [12.002, 60.0], [12.002, 60.001], [12.0, 60.001], [12.0, 60.0]])
    path = put('in.geojson', _collection(_feature(ring)))
    write_labels(path.with_name('out.csv'), read_labels(path))
    (labels,) = read_labels(path.with_name('out.csv'))
    np.testing.assert_allclose(np.sort(labels.corners[0], axis=0), np.sort(ring[:4], axis=0))


@pytest.mark.parametrize(
    ('ring', 'message'),
    [
        ([[179.9, 0], [-179.9, 0], [-179.9, 0.1], [179.9, 0]], 'antimeridian'),
        ([[10, 89.5], [10.1, 89.5], [10.1, 89.6], [10, 89.5]], 'beyond 89 degrees'),
        ([[500311, 6649643], [500321, 6649643], [500321, 6649653], [500311, 6649643]], 'no longi'),
    ],
)
def test_degrees_that_cannot_be_converted_are_reported(
    put: Put, ring: list[list[float]], message: str
) -> None:
    crs = {'type': 'name', 'properties': {'name': 'urn:ogc:def:crs:OGC:1.3:CRS84'}}
    path = put('in.geojson', _collection(_feature(ring), crs=crs))
    with pytest.raises(LabelError, match=rf'features\[0\]: .*{message}'):
        list(read_labels(path))


@pytest.mark.parametrize(
    'crs', [7, {}, {'type': 'name', 'properties': {'name': 'EPSG:nonsense'}}, {'properties': []}]
)
def test_a_reference_system_that_is_not_known_is_refused(put: Put, crs: object) -> None:
    pytest.importorskip('pyproj')
    path = put('in.geojson', _collection(_feature(_ring(0, 0, 4, 2, 0)), crs=crs))
    with pytest.raises(LabelError, match='reference system'):
        list(read_labels(path))


def test_caps_in_metres_are_those_on_the_ground(put: Put) -> None:
    path = put('in.geojson', _collection(_feature(_ring(0, 0, 4e-3, 4e-4, 0) + [12.0, 60.0])))
    target = path.with_name('out.geojson')
    convert(path, target, HullRule('outer'), Caps(max_length=100.0), metres=True)
    _, (box,) = _written(target)
    assert (box[2] - box[0]) * 111320.0 * np.cos(np.radians(60.0)) == pytest.approx(100.0, rel=5e-3)
    with pytest.raises(ValueError, match='in degrees: give the caps in metres'):
        convert(path, target, HullRule(), Caps(max_length=100.0))


@pytest.mark.parametrize(('code', 'unit'), [('EPSG:32633', 1.0), ('EPSG:2263', 0.3048006096)])
def test_caps_in_metres_follow_the_unit_of_the_system(put: Put, code: str, unit: float) -> None:
    pytest.importorskip('pyproj')
    crs = {'type': 'name', 'properties': {'name': code}}
    ring = _ring(9e5, 2e5 if unit < 1.0 else 6.6e6, 400.0 / unit, 40.0 / unit, 0.0)
    path = put('in.geojson', _collection(_feature(ring), crs=crs))
    convert(path, path.with_name('o.geojson'), HullRule('outer'), Caps(100.0), metres=True)
    _, (box,) = _written(path.with_name('o.geojson'))
    assert (box[2] - box[0]) * unit == pytest.approx(100.0, rel=2e-3)


def test_caps_in_metres_need_a_reference_system(put: Put) -> None:
    path = put('in.geojson', _collection(_feature(_ring(40, 30, 20, 4, 0))))
    with pytest.raises(ValueError, match='no reference system'):
        convert(path, path.with_name('o.geojson'), HullRule(), Caps(100.0), metres=True)


POSITIONS = st.tuples(st.floats(-180.0, 180.0), st.floats(-89.0, 89.0))


@given(POSITIONS)
def test_the_plane_leads_back_to_degrees(position: tuple[float, float]) -> None:
    there = to_plane(np.array([position]))
    np.testing.assert_allclose(to_degrees(there)[0], position, atol=1e-12)


@given(POSITIONS)
def test_the_plane_is_the_ellipsoidal_mercator_projection(position: tuple[float, float]) -> None:
    pyproj = pytest.importorskip('pyproj')
    there = to_plane(np.array([position]))
    transformer = pyproj.Transformer.from_crs('OGC:CRS84', 'EPSG:3395', always_xy=True)
    np.testing.assert_allclose(there[0], transformer.transform(*position), atol=1e-5)
    factor = pyproj.Proj('EPSG:3395').get_factors(*position).meridional_scale
    assert ground_scale(there[:, 1])[0] == pytest.approx(1.0 / factor, rel=1e-6)


VECTOR_FILES = ('shp', 'gpkg', 'fgb')


def _frame(crs: str | None) -> Any:
    geopandas = pytest.importorskip('geopandas')
    shapely = pytest.importorskip('shapely')
    rings = [_ring(500311.0 + 500 * row, 6649643.0, 130.0, 20.0, 0.5) for row in range(2)]
    return geopandas.GeoDataFrame(
        {'mmsi': [219000001, 219000002], 'flag': ['DK', None], 'class': ['ship', 'tug']},
        geometry=[shapely.Polygon(ring) for ring in rings],
        crs=crs,
    )


def _save(frame: Any, path: Path) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', message=".*'crs' was not provided")
        frame.to_file(path, **({'SPATIAL_INDEX': 'NO'} if path.suffix == '.fgb' else {}))


@pytest.mark.parametrize('suffix', VECTOR_FILES)
@pytest.mark.parametrize('crs', ['EPSG:32633', None])
def test_vector_files_keep_fields_and_reference_system(
    tmp_path: Path, suffix: str, crs: str | None
) -> None:
    geopandas = pytest.importorskip('geopandas')
    source, target = tmp_path / f'in.{suffix}', tmp_path / f'out.{suffix}'
    _save(_frame(crs), source)
    tally = convert(source, target, HullRule())
    assert (tally.boxes, tally.losses) == (2, '')
    written = geopandas.read_file(target, engine='pyogrio')
    assert (written.crs and written.crs.to_string()) == crs
    assert written['mmsi'].tolist() == [219000001, 219000002]
    assert written['flag'][0] == 'DK'
    assert written['flag'].isna().tolist() == [False, True]
    assert written['class'].tolist() == ['ship', 'tug']


@pytest.mark.parametrize('suffix', VECTOR_FILES)
def test_vector_files_in_degrees_are_converted_on_the_ground(tmp_path: Path, suffix: str) -> None:
    geopandas = pytest.importorskip('geopandas')
    _frame('EPSG:32633').to_crs('EPSG:4326').to_file(tmp_path / f'in.{suffix}')
    convert(tmp_path / f'in.{suffix}', tmp_path / 'out.geojson', HullRule(), diagnostics=True)
    written = geopandas.read_file(tmp_path / 'out.geojson')
    assert written['length'].tolist() == pytest.approx([130.0, 130.0], rel=2e-3)
    assert written.crs.to_string() in {'OGC:CRS84', 'EPSG:4326'}


def test_a_geopackage_is_of_a_version_that_old_readers_know(tmp_path: Path) -> None:
    pytest.importorskip('pyogrio')
    _frame('EPSG:32633').to_file(tmp_path / 'in.fgb')
    convert(tmp_path / 'in.fgb', tmp_path / 'out.gpkg', HullRule())
    with closing(sqlite3.connect(tmp_path / 'out.gpkg')) as database:
        assert database.execute('PRAGMA user_version').fetchone() == (10200,)


def test_an_undefined_system_of_a_geopackage_is_none(tmp_path: Path) -> None:
    fiona = pytest.importorskip('fiona')
    schema = {'geometry': 'Polygon', 'properties': {'class': 'str'}}
    ring = [(10.0, 10.0), (110.0, 10.0), (110.0, 30.0), (10.0, 30.0), (10.0, 10.0)]
    feature = {
        'geometry': {'type': 'Polygon', 'coordinates': [ring]},
        'properties': {'class': 'ship'},
    }
    with fiona.open(tmp_path / 'in.gpkg', 'w', driver='GPKG', schema=schema) as file:
        file.write(feature)
    (labels,) = read_labels(tmp_path / 'in.gpkg')
    assert labels.extras.label_set.crs == ''
    assert np.ptp(labels.corners[0], axis=0).tolist() == [100.0, 20.0]


def test_a_geopackage_of_several_layers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / 'in.gpkg'
    _frame('EPSG:32633').to_file(path, layer='ships')
    _frame('EPSG:32633').to_file(path, layer='quays')
    with pytest.raises(LabelError, match='more than one layer'):
        list(read_labels(path))


@pytest.mark.parametrize('suffix', VECTOR_FILES)
@pytest.mark.parametrize('keep', [0.3, 0.9])
def test_a_vector_file_that_is_cut_off_is_reported(
    tmp_path: Path, suffix: str, keep: float
) -> None:
    path = tmp_path / f'in.{suffix}'
    _frame('EPSG:32633').to_file(path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * keep)])
    with pytest.raises(LabelError, match=f'in.{suffix}'):
        list(read_labels(path))


@pytest.mark.parametrize(('srid', 'crs'), [('', ''), ('SRID=32633; ', 'EPSG:32633')])
def test_wkt_is_found_in_any_column_and_the_others_are_kept(put: Put, srid: str, crs: str) -> None:
    pytest.importorskip('pyproj')
    ring = '(500000 6000000, 500100 6000000, 500100 6000020, 500000 6000000)'
    path = put('a.csv', f'ship,outline,mmsi\ntug,"{srid}POLYGON ({ring})",7\n')
    (labels,) = read_labels(path)
    assert labels.extras.label_set.crs == crs
    assert labels.extras.properties == {'ship': ('tug',), 'mmsi': ('7',)}
    tally = convert(path, path.with_name('out.csv'), HullRule())
    assert ('reference system' in tally.losses) == bool(crs)
    header, row = path.with_name('out.csv').read_text().splitlines()
    assert header.endswith(',ship,mmsi')
    assert row.endswith(',tug,7')


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('a,b\n"POLYGON ((1 2, 3 4, 3 2, 1 2))","POLYGON ((1 2, 3 4, 3 2, 1 2))"', 'several col'),
        ('a,wkt\n1,"SRID=99999999;POLYGON ((1 2, 3 4, 3 2, 1 2))"', 'is not known'),
        (
            'a,wkt\n1,"SRID=32633;POLYGON ((1 2, 3 4, 3 2, 1 2))"\n'
            '1,"SRID=32634;POLYGON ((1 2, 3 4, 3 2, 1 2))"',
            'EPSG:32634, but the rows above have EPSG:32633',
        ),
    ],
)
def test_wkt_that_cannot_be_placed_is_refused(put: Put, text: str, message: str) -> None:
    pytest.importorskip('pyproj')
    with pytest.raises(LabelError, match=message):
        list(read_labels(put('a.csv', text)))


def test_csv_keeps_other_columns_crowds_and_difficulties(put: Put) -> None:
    path = put(
        'a.csv',
        ',image,class,instance,x1,y1,x2,y2,x3,y3,x4,y4,mmsi,crowd,difficulty\n'
        '0,P1,ship,7,10,20,50,20,50,30,10,30,219000001,1,2\n'
        '1,P2,tug,8,10,20,50,20,50,30,10,30,,0,0\n',
    )
    tally = convert(path, path.with_name('out.csv'), HullRule(), diagnostics=True)
    assert tally.losses == ''
    header, *rows = path.with_name('out.csv').read_text().splitlines()
    assert header.endswith('capped,crowd,difficulty,mmsi')
    assert [row.rsplit(',', 3)[1:] for row in rows] == [['1', '2', '219000001'], ['0', '0', '']]


def test_names_that_a_shapefile_shortens_are_counted(put: Put, tmp_path: Path) -> None:
    pytest.importorskip('geopandas')
    fields = {'time_of_day': '12:00', 'mmsi': 7}
    ring = _ring(500311.0, 6649643.0, 130.0, 20.0, 0.5)
    path = put('in.geojson', _collection(_feature(ring, **fields), crs=UTM))
    tally = convert(path, tmp_path / 'out.shp', HullRule())
    assert tally.losses == 'shapefile: 1 long name (time_of_day)'


def test_the_summary_says_how_many_boxes_are_in_degrees(put: Put) -> None:
    path = put('in.geojson', _collection(_feature(_ring(0, 0, 4e-3, 4e-4, 0) + [12.0, 60.0])))
    tally = convert(path, path.with_name('out.geojson'), HullRule())
    assert tally.in_degrees == 1
    assert '1 in degrees computed in metres' in str(tally)
