# SPDX-License-Identifier: Apache-2.0
"""Parquet and GeoParquet files of many images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from obbhbb_ros import cli
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import detect_format
from obbhbb_ros.labels import read_labels

pa = pytest.importorskip('pyarrow')
parquet = pytest.importorskip('pyarrow.parquet')

NAMES = ('x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4')
BOUNDS = ('x_min', 'y_min', 'x_max', 'y_max')
BOX = (20.0, 30.0, 80.0, 30.0, 80.0, 50.0, 20.0, 50.0)
POLYGON = 'POLYGON ((20 30, 80 30, 80 50, 20 50, 20 30))'
ID = {'authority': 'EPSG', 'code': 32632}
UTM = {'type': 'ProjectedCRS', 'name': 'WGS 84 / UTM zone 32N', 'id': ID}
CRS84 = {'type': 'GeographicCRS', 'id': {'authority': 'OGC', 'code': 'CRS84'}}
WGS84 = {'type': 'GeographicCRS', 'id': {'authority': 'EPSG', 'code': 4326}}
SHIP_IN_DEGREES = 'POLYGON ((10.0 60,10.003 60.002,10.0032 60.0018,10.0002 59.9998,10.0 60))'


def put_rows(path: Path, rows: int = 1, **columns: Any) -> Path:
    """Write a file of boxes with further columns."""
    corners = {name: [value] * rows for name, value in zip(NAMES, BOX, strict=True)}
    parquet.write_table(pa.table({**corners, **columns}), path)
    return path


def put_geo(path: Path, *polygons: str | None, encoding: str = 'WKB', **column: Any) -> Path:
    """Write a file of polygons, GeoParquet with this description of its geometry."""
    geometry = pa.array([text and shapely.to_wkb(shapely.from_wkt(text)) for text in polygons])
    table = pa.table({'mmsi': range(len(polygons)), 'geometry': geometry})
    columns = {'geometry': {'encoding': encoding, 'geometry_types': [], **column}}
    geo = {'version': '1.0.0', 'primary_column': 'geometry', 'columns': columns}
    parquet.write_table(table.replace_schema_metadata({'geo': json.dumps(geo)}), path)
    return path


def convert(*words: object) -> int:
    return cli.main(['convert', *map(str, words)])


def test_corners_are_read_with_all_columns(tmp_path: Path) -> None:
    path = put_rows(
        tmp_path / 'all.parquet',
        rows=3,
        image=['a', 'b', 'a'],
        Class=['ship', None, 'tug'],
        id=[7, 8, 9],
        confidence=[0.5, None, float('nan')],
        mmsi=[211, None, 244],
    )
    assert detect_format(path) == 'parquet'
    first, second = read_labels(path)
    assert (first.image, first.class_ids, first.ids) == ('a', ('ship', 'tug'), ('7', '9'))
    assert (second.image, second.class_ids, second.ids) == ('b', ('',), ('8',))
    assert first.corners.reshape(-1, 8).tolist() == [list(BOX)] * 2
    assert [*first.scores, *second.scores] == [0.5, 1.0, 1.0]
    assert first.extras.properties == {'mmsi': (211, 244)}


def test_boxes_without_an_image_belong_to_one_named_after_the_file(tmp_path: Path) -> None:
    (labels,) = read_labels(put_rows(tmp_path / 'P0706.parquet', rows=2))
    assert (labels.image, len(labels.class_ids)) == ('P0706', 2)


def test_bounds_are_upright_boxes_and_reference_boxes(tmp_path: Path) -> None:
    bounds = dict(zip(BOUNDS, ([1, 9], [2, 2], [5, 5], [4, 4]), strict=True))
    parquet.write_table(pa.table(bounds), tmp_path / 'a.parquet')
    errors: list[LabelError] = []
    (labels,) = read_labels(tmp_path / 'a.parquet', on_error=errors.append)
    assert labels.reference.tolist() == [[1, 2, 5, 4]]
    assert [error.message for error in errors] == ['row 1: the box has a maximum below its minimum']


@pytest.mark.parametrize('missing', [None, float('nan'), float('inf')])
def test_a_row_without_a_coordinate_is_reported_and_the_others_are_read(
    tmp_path: Path, missing: float | None
) -> None:
    path = put_rows(tmp_path / 'a.parquet', rows=3, x4=[20.0, missing, 20.0])
    errors: list[LabelError] = []
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.ids) == 2
    assert [str(error) for error in errors] == [
        f'{path}: row 1: a coordinate or the score is null or not finite'
    ]


def test_geoparquet_is_read_with_its_reference_system(tmp_path: Path) -> None:
    path = put_geo(tmp_path / 'a.parquet', POLYGON, None, 'POINT (1 2)', crs=UTM)
    errors: list[LabelError] = []
    (labels,) = read_labels(path, on_error=errors.append)
    assert labels.corners.shape == (1, 4, 2)
    assert labels.extras.label_set.crs == 'EPSG:32632'
    assert [error.message for error in errors] == [
        'row 1: no geometry', 'row 2: a Point is not a polygon',
    ]  # fmt: skip


@pytest.mark.parametrize('column', [{}, {'crs': CRS84}, {'crs': WGS84}, {'crs': None}])
def test_degrees_give_the_box_that_geojson_in_degrees_gives(
    tmp_path: Path, column: dict[str, Any]
) -> None:
    source, target = tmp_path / 'in.parquet', tmp_path / 'out.parquet'
    put_geo(source, SHIP_IN_DEGREES, None, **column)
    ring = [
        [float(number) for number in pair.split()] for pair in SHIP_IN_DEGREES[10:-2].split(',')
    ]
    geometry = {'type': 'Polygon', 'coordinates': [ring]}
    feature = {'type': 'Feature', 'properties': {}, 'geometry': geometry}
    (tmp_path / 'in.geojson').write_text(json.dumps(feature))
    assert convert(source, target) == convert(tmp_path / 'in.geojson', tmp_path / 'b.csv') == 0
    (row,) = parquet.read_table(target).to_pylist()
    (labels,) = read_labels(tmp_path / 'b.csv')
    assert [row[name] for name in BOUNDS] == labels.reference[0].tolist()
    assert row['mmsi'] == 0
    assert shapely.from_wkb(row['geometry']).bounds == tuple(labels.reference[0])


def test_geoparquet_in_degrees_has_its_reference_system_again(tmp_path: Path) -> None:
    geopandas = pytest.importorskip('geopandas')
    frame = geopandas.GeoDataFrame(geometry=shapely.from_wkt([SHIP_IN_DEGREES]), crs='EPSG:4326')
    frame.to_parquet(tmp_path / 'in.parquet')
    assert convert(tmp_path / 'in.parquet', tmp_path / 'out.parquet') == 0
    assert geopandas.read_parquet(tmp_path / 'out.parquet').crs == 'EPSG:4326'


def test_a_reference_system_that_is_no_projjson_is_an_error(tmp_path: Path) -> None:
    path = put_geo(tmp_path / 'a.parquet', POLYGON, crs='EPSG:4326')
    with pytest.raises(LabelError, match='the reference system of the geometry is no PROJJSON'):
        list(read_labels(path))


def test_a_geometry_of_unknown_system_is_read_as_pixels(tmp_path: Path) -> None:
    (labels,) = read_labels(put_geo(tmp_path / 'a.parquet', POLYGON, crs=None))
    assert labels.extras.label_set.crs == ''


def test_parquet_to_parquet_keeps_rows_columns_and_types(tmp_path: Path) -> None:
    source, target = tmp_path / 'in.parquet', tmp_path / 'out.parquet'
    mmsi = pa.array([211, None, 244, 5], pa.uint32())
    put_rows(source, rows=4, image=['b', 'a', 'b', 'c'], mmsi=mmsi, x3=[80, None, 80, 80])
    assert convert(source, target) == 0
    table = parquet.read_table(target)
    assert table.schema.names == ['image', 'mmsi', *BOUNDS]
    assert table.schema.field('mmsi').type == pa.uint32()
    assert table['mmsi'].to_pylist() == [211, 244, 5]
    assert table.select(BOUNDS).to_pylist()[0] == dict(zip(BOUNDS, (20, 30, 80, 50), strict=True))


def test_texts_have_a_dictionary_and_coordinates_do_not(tmp_path: Path) -> None:
    """A dictionary of coordinates took four fifths of the time, and a fifth of the file."""
    put_rows(tmp_path / 'in.parquet', rows=4, image=['b', 'a', 'b', 'c'])
    assert convert(tmp_path / 'in.parquet', tmp_path / 'out.parquet') == 0
    group = parquet.ParquetFile(tmp_path / 'out.parquet').metadata.row_group(0)
    columns = [group.column(number) for number in range(group.num_columns)]
    dictionaries = [column.path_in_schema for column in columns if column.has_dictionary_page]
    assert dictionaries == ['image']


def test_the_summary_counts_images_and_what_was_left_out(tmp_path: Path, capsys) -> None:
    source = put_rows(
        tmp_path / 'in.parquet',
        rows=4,
        image=['a', 'a', 'b', 'c'],
        **dict(zip(('x3', 'x2'), ([80.0, 20, 80, None], [80.0, 20, 80, 80]), strict=True)),
    )
    assert convert(source, tmp_path / 'out.parquet') == 0
    out, err = capsys.readouterr()
    assert out.startswith('2 images, 2 boxes converted, 1 left out (1 empty), 1 malformed')
    assert 'row 3: a coordinate or the score is null or not finite' in err


def test_the_boxes_are_those_of_every_other_format(tmp_path: Path) -> None:
    corners = np.random.default_rng(1).uniform(0, 99, (500, 8))
    images = [f'{row % 7}' for row in range(500)]
    columns = dict(zip(NAMES, corners.T, strict=True))
    parquet.write_table(pa.table({'image': images, **columns}), tmp_path / 'in.parquet')
    for name in ('direct.parquet', 'by.csv', 'again.parquet'):
        source = 'by.csv' if name == 'again.parquet' else 'in.parquet'
        assert convert(tmp_path / source, tmp_path / name, '--method', 'superellipse') == 0
    direct = parquet.read_table(tmp_path / 'direct.parquet')
    (*by,) = read_labels(tmp_path / 'by.csv')
    expected = np.concatenate([labels.reference for labels in by])
    order = np.argsort([int(image) for image in direct['image'].to_pylist()], kind='stable')
    bounds = np.column_stack([direct[name].to_numpy() for name in BOUNDS])
    np.testing.assert_array_equal(bounds[order], expected)


@pytest.mark.parametrize('options', [(), ('--diagnostics',)])
def test_geoparquet_to_parquet_has_the_boxes_as_geometry(
    tmp_path: Path, options: tuple[str, ...]
) -> None:
    geopandas = pytest.importorskip('geopandas')
    source, target = tmp_path / 'in.parquet', tmp_path / 'out.parquet'
    columns = {'mmsi': [211]}
    polygons = shapely.from_wkt([POLYGON])
    geopandas.GeoDataFrame(columns, geometry=polygons, crs='EPSG:32632').to_parquet(source)
    assert convert(source, target, *options) == 0
    frame = geopandas.read_parquet(target)
    assert frame.crs.to_epsg() == 32632
    assert frame.geometry.iloc[0].bounds == (20, 30, 80, 50)
    assert frame[['x_min', 'y_max']].to_numpy().tolist() == [[20, 50]]


def test_other_formats_are_written_as_parquet_with_diagnostics(tmp_path: Path) -> None:
    (tmp_path / 'P1.txt').write_text('20 30 80 30 80 50 20 50 ship 0\n')
    assert convert(tmp_path / 'P1.txt', tmp_path / 'out.parquet', '--diagnostics') == 0
    (row,) = parquet.read_table(tmp_path / 'out.parquet').to_pylist()
    assert (row['image'], row['class'], row['score']) == ('P1', 'ship', 1.0)
    assert (row['length'], row['width'], row['capped']) == (60.0, 20.0, False)


def test_if_nothing_can_be_read_nothing_is_written(tmp_path: Path) -> None:
    source = put_rows(tmp_path / 'in.parquet', x1=pa.array([None], pa.float64()))
    assert convert(source, tmp_path / 'out.parquet') == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ['in.parquet']


@pytest.mark.parametrize('part', [slice(0, 500), slice(500, None), slice(0, 4)])
def test_a_damaged_file_is_an_error(tmp_path: Path, part: slice) -> None:
    path = put_rows(tmp_path / 'a.parquet', rows=50)
    path.write_bytes(b'PAR1' + path.read_bytes()[part])
    with pytest.raises(LabelError, match=r'a\.parquet: not Parquet: '):
        list(read_labels(path))


@pytest.mark.parametrize('at', range(40, 400, 40))
def test_a_damaged_page_is_an_error_or_still_boxes(tmp_path: Path, at: int) -> None:
    path = put_rows(tmp_path / 'a.parquet', rows=50)
    data = bytearray(path.read_bytes())
    data[at : at + 8] = b'\xff' * 8
    path.write_bytes(data)
    errors: list[LabelError] = []
    images = list(read_labels(path, on_error=errors.append))
    assert images or errors


@pytest.mark.parametrize(
    ('columns', 'message'),
    [
        ({'x1': ['a']}, "column 'x1' holds string, not numbers"),
        ({'score': ['high']}, "column 'score' holds string, not numbers"),
    ],
)
def test_columns_of_another_type_are_an_error(
    tmp_path: Path, columns: dict[str, Any], message: str
) -> None:
    with pytest.raises(LabelError, match=message):
        list(read_labels(put_rows(tmp_path / 'a.parquet', **columns)))


def test_a_file_without_boxes_is_an_error_that_names_its_columns(tmp_path: Path) -> None:
    parquet.write_table(pa.table({'x1': [1.0], 'y1': [1.0]}), tmp_path / 'a.parquet')
    with pytest.raises(LabelError, match=r'no corners, bounds or geometry .*: x1, y1'):
        list(read_labels(tmp_path / 'a.parquet'))


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = put_rows(tmp_path / 'a.parquet', rows=1_000_000)
    with pytest.raises(LabelError, match=r'1000000 rows in \d+ bytes: less than a byte'):
        list(read_labels(path))


def test_a_column_of_the_result_that_exists_is_refused(tmp_path: Path, capsys) -> None:
    source = put_rows(tmp_path / 'in.parquet', x_min=[1])
    assert convert(source, tmp_path / 'out.parquet') == 1
    assert "in.parquet: there is a column 'x_min' already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ('geo', 'message'),
    [
        ('[' * 100_000, 'metadata cannot be read'),
        ('{}', 'metadata cannot be read'),
        ('{"primary_column": "g", "columns": {"g": {"encoding": "point"}}}', "encoded as 'point'"),
        ('{"primary_column": "g", "columns": {"g": {"encoding": "WKB"}}}', 'no corners, bounds'),
    ],
)
def test_metadata_that_cannot_be_used_is_an_error(tmp_path: Path, geo: str, message: str) -> None:
    table = pa.table({'geometry': [b'']}).replace_schema_metadata({'geo': geo})
    parquet.write_table(table, tmp_path / 'a.parquet')
    with pytest.raises(LabelError, match=message):
        list(read_labels(tmp_path / 'a.parquet'))
