# SPDX-License-Identifier: Apache-2.0
"""Writing axis-aligned boxes, and reading them back as reference boxes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import HealthCheck
from hypothesis import given
from hypothesis import settings
from hypothesis import strategies as st

from obbhbb_ros.geometry.converter import Conversion
from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import ImageBoxes
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_boxes

if TYPE_CHECKING:
    from conftest import Put

TARGETS = {
    'yolo': 'labels', 'coco': 'all.json', 'voc': 'annotations', 'geojson': 'all.geojson',
    'csv': 'all.csv', 'shapefile': 'all.shp', 'geopackage': 'all.gpkg', 'flatgeobuf': 'all.fgb',
    'parquet': 'all.parquet',
}  # fmt: skip
VECTOR_FILES = ('shapefile', 'geopackage', 'flatgeobuf')
DIAGNOSED = ('coco', 'geojson', 'csv', *VECTOR_FILES, 'parquet')
EXTRAS = {**dict.fromkeys(VECTOR_FILES, 'geopandas'), 'parquet': 'pyarrow'}
BOX = (10.25, 20.5, 50.125, 30.0)


def _boxes(
    image: str = 'P1',
    *boxes: tuple[float, float, float, float],
    scores: object = None,
    ids: tuple[str, ...] | None = None,
    size: tuple[int, int] | None = (128, 64),
    diagnosed: bool = False,
) -> ImageBoxes:
    xyxy = np.array(boxes, dtype=np.float64).reshape(-1, 4)
    count = len(xyxy)
    ones = np.ones(count)
    diagnostics = None
    if diagnosed:
        diagnostics = Conversion(
            xyxy, ones > 0, 40 * ones, 10 * ones, 0.5 * ones, 0.25 * ones, np.nan * ones, ones > 0
        )
    return ImageBoxes(
        image,
        xyxy,
        class_ids=('ship', 'tug')[:count],
        ids=ids or ('',) * count,
        scores=ones if scores is None else np.array(scores, dtype=np.float64),
        size=size,
        source=Path('made.by'),
        diagnostics=diagnostics,
    )


def _target(tmp_path: Path, format_name: str) -> Path:
    if format_name in EXTRAS:
        pytest.importorskip(EXTRAS[format_name])
    return tmp_path / TARGETS[format_name]


def test_these_formats_hold_axis_aligned_boxes() -> None:
    assert {name for name, each in FORMATS.items() if each.write_boxes} == set(TARGETS)
    holding = {name for name, form in FORMATS.items() if 'diagnostics' in form.holds}
    assert holding == set(DIAGNOSED)


@pytest.mark.parametrize('format_name', list(TARGETS))
def test_boxes_read_back_as_reference_boxes(tmp_path: Path, format_name: str) -> None:
    path = _target(tmp_path, format_name)
    images = [_boxes('P1', BOX, (0, 0, 8, 4), scores=[0.5, 1.0]), _boxes('P2', BOX)]
    write_boxes(path, images, format_name)
    read = list(read_labels(path, format_name, image_size=(128, 64)))
    assert [each.image for each in read] == ['P1', 'P2']
    for labels, image in zip(read, images, strict=True):
        np.testing.assert_allclose(labels.reference, image.xyxy, rtol=0, atol=1e-9)
        low, high = labels.corners.min(axis=1), labels.corners.max(axis=1)
        np.testing.assert_allclose(np.hstack((low, high)), image.xyxy, rtol=0, atol=1e-9)
        assert labels.class_ids == image.class_ids
        if format_name != 'voc':
            assert labels.scores.tolist() == image.scores.tolist()


@given(
    st.lists(
        st.tuples(*[st.floats(-1e4, 1e4)] * 2, *[st.floats(1e-3, 1e4)] * 2), min_size=1, max_size=2
    )
)
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None
)
@pytest.mark.parametrize('format_name', ['csv', 'geojson', 'voc'])
def test_no_digit_is_lost(tmp_path: Path, format_name: str, boxes: list) -> None:
    image = _boxes('P1', *[(x, y, x + w, y + h) for x, y, w, h in boxes])
    path = _target(tmp_path, format_name)
    write_boxes(path, [image], format_name)
    (labels,) = read_labels(path, format_name)
    np.testing.assert_array_equal(labels.reference, image.xyxy)


@pytest.mark.parametrize('format_name', ['yolo', 'voc', 'csv', 'coco'])
def test_an_image_without_boxes_is_kept(tmp_path: Path, format_name: str) -> None:
    path = _target(tmp_path, format_name)
    write_boxes(path, [_boxes('P1', size=None), _boxes('P2', BOX)], format_name)
    read = list(read_labels(path, format_name, image_size=(128, 64)))
    assert [(each.image, len(each.class_ids)) for each in read] == [('P1', 0), ('P2', 1)]


@pytest.mark.parametrize('format_name', ['geojson', 'shapefile', 'csv', 'coco'])
def test_a_data_set_without_boxes_is_a_valid_file(tmp_path: Path, format_name: str) -> None:
    path = _target(tmp_path, format_name)
    write_boxes(path, [], format_name)
    assert all(not each.class_ids for each in read_labels(path, format_name))


def _table_row(path: Path) -> dict[str, str]:
    with path.open(newline='') as stream:
        return next(csv.DictReader(stream))


def _coco_row(path: Path) -> dict[str, object]:
    return json.loads(path.read_text())['annotations'][0]


def _geojson_row(path: Path) -> dict[str, object]:
    return json.loads(path.read_text())['features'][0]['properties']


def _parquet_row(path: Path) -> dict[str, object]:
    return pytest.importorskip('pyarrow.parquet').read_table(path).to_pylist()[0]


def _shapefile_row(path: Path) -> dict[str, object]:
    geopandas = pytest.importorskip('geopandas')
    return geopandas.read_file(path).iloc[0].to_dict()


@pytest.mark.parametrize(
    ('format_name', 'row', 'unknown'),
    [
        ('csv', _table_row, ''),
        ('coco', _coco_row, None),
        ('geojson', _geojson_row, None),
        ('shapefile', _shapefile_row, float('nan')),
        ('parquet', _parquet_row, None),
    ],
)
def test_diagnostics_are_columns_and_unknown_ones_are_empty(
    tmp_path: Path, format_name: str, row: object, unknown: object
) -> None:
    path = _target(tmp_path, format_name)
    write_boxes(path, [_boxes('P1', BOX, diagnosed=True)], format_name)
    got = row(path)
    numbers = [float(got[name]) for name in ('length', 'width', 'theta', 't_x', 'capped')]
    assert numbers == [40.0, 10.0, 0.5, 0.25, 1.0]
    assert got['t_y'] is None or repr(got['t_y']) == repr(unknown)


@pytest.mark.parametrize('format_name', ['yolo', 'voc'])
def test_formats_that_cannot_hold_diagnostics_refuse_them(tmp_path: Path, format_name: str) -> None:
    with pytest.raises(ValueError, match='cannot hold diagnostics: use csv'):
        write_boxes(tmp_path / 'out', [_boxes('P1', BOX, diagnosed=True)], format_name)
    assert list(tmp_path.iterdir()) == []


def test_the_table_has_the_documented_columns(tmp_path: Path) -> None:
    write_boxes(tmp_path / 'a.csv', [_boxes('P1', BOX, diagnosed=True, ids=('7',))])
    header, row = (tmp_path / 'a.csv').read_text().splitlines()
    assert header == (
        'image,instance,class,score,x_min,y_min,x_max,y_max,length,width,theta,t_x,t_y,capped'
    )
    assert row == 'P1,7,ship,1.0,10.25,20.5,50.125,30.0,40.0,10.0,0.5,0.25,,1'


def test_a_coco_file_is_complete(tmp_path: Path) -> None:
    write_boxes(tmp_path / 'a.json', [_boxes('P1.png', (1, 2, 5, 10), ids=('42',))])
    assert json.loads((tmp_path / 'a.json').read_text()) == {
        'images': [{'id': 1, 'file_name': 'P1.png', 'width': 128, 'height': 64}],
        'categories': [{'id': 1, 'name': 'ship'}],
        'annotations': [
            {
                'id': 42, 'image_id': 1, 'category_id': 1, 'bbox': [1.0, 2.0, 4.0, 8.0],
                'area': 32.0, 'iscrowd': 0,
            }
        ],
    }  # fmt: skip


def test_coco_ids_that_are_not_unique_are_renumbered(tmp_path: Path) -> None:
    images = [_boxes(name, BOX, ids=('0',)) for name in ('a', 'b')]
    write_boxes(tmp_path / 'a.json', images)
    annotations = json.loads((tmp_path / 'a.json').read_text())['annotations']
    assert [(each['id'], each['instance']) for each in annotations] == [(1, '0'), (2, '0')]


def test_a_voc_file_has_the_elements_that_readers_need(tmp_path: Path) -> None:
    write_boxes(tmp_path / 'P1.xml', [_boxes('P1', BOX)])
    root = ElementTree.parse(tmp_path / 'P1.xml').getroot()
    assert root.findtext('filename') == 'P1'
    assert [root.findtext(f'size/{tag}') for tag in ('width', 'height', 'depth')] == [
        '128', '64', '3',
    ]  # fmt: skip
    assert root.findtext('object/name') == 'ship'
    assert [float(each.text) for each in root.find('object/bndbox')] == list(BOX)


def test_yolo_classes_are_numbered_by_a_file_beside_the_labels(put: Put, tmp_path: Path) -> None:
    put('out/classes.txt', 'tug\n')
    write_boxes(tmp_path / 'out', [_boxes('P1', (32, 16, 96, 48))], 'yolo')
    assert (tmp_path / 'out' / 'classes.txt').read_text() == 'tug\nship\n'
    assert (tmp_path / 'out' / 'P1.txt').read_text() == '1 0.5 0.5 0.5 0.5\n'


@pytest.mark.parametrize(
    ('format_name', 'bad', 'message'),
    [
        ('yolo', {'size': None}, 'YOLO needs its size'),
        ('yolo', {'size': (4, 4)}, 'far outside its size'),
        ('yolo', {'scores': [7.0]}, 'not within 0..1'),
        ('voc', {'image': 'a\x01'}, 'XML cannot hold'),
        ('csv', {'image': ''}, 'without a name'),
        ('shapefile', {'image': 'x' * 255}, 'too long for a shapefile'),
    ],
)
def test_values_that_a_format_cannot_hold_are_refused_and_nothing_is_written(
    tmp_path: Path, format_name: str, bad: dict, message: str
) -> None:
    path = _target(tmp_path, format_name)
    changes = dict(bad)
    image = changes.pop('image', 'P2')
    with pytest.raises(ValueError, match=message):
        write_boxes(path, [_boxes('P1', BOX), _boxes(image, BOX, **changes)], format_name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('name', 'format_name', 'message'),
    [
        ('out', None, 'name the label format'),
        ('out.pdf', None, 'name the label format'),
        ('out', 'dota', "cannot write axis-aligned boxes as 'dota': use yolo"),
        ('out', 'papyrus', "unknown label format 'papyrus'"),
        ('out.json', 'shapefile', r'ends in \.shp'),
    ],
)
def test_a_target_without_a_format_is_refused(
    tmp_path: Path, name: str, format_name: str | None, message: str
) -> None:
    if format_name in VECTOR_FILES:
        pytest.importorskip('geopandas')
    with pytest.raises(ValueError, match=message):
        write_boxes(tmp_path / name, [_boxes('P1', BOX)], format_name)


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('xyxy', np.full((1, 4), np.nan)),
        ('xyxy', np.zeros((2, 4))),
        ('xyxy', np.zeros((1, 3))),
        ('scores', np.array([np.inf])),
        ('ids', ()),
    ],
)
def test_fields_of_image_boxes_must_agree_and_be_finite(field: str, value: object) -> None:
    values = vars(_boxes('P1', BOX)) | {field: value}
    with pytest.raises(ValueError, match="image 'P1'"):
        ImageBoxes(**values)
