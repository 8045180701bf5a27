# SPDX-License-Identifier: Apache-2.0
"""COCO JSON."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

# A hull of six corners, twice as long as wide, and its box.
HULL = [10.0, 25.0, 15.0, 20.0, 25.0, 20.0, 30.0, 25.0, 25.0, 30.0, 15.0, 30.0]


def _document(**changes: Any) -> dict[str, Any]:
    return {
        'info': {'description': 'ships', 'version': '1.0', 'year': 2026},
        'licenses': [{'id': 1, 'name': 'none', 'url': ''}],
        'images': [
            {'id': 3, 'file_name': 'P0706.png', 'width': 1024, 'height': 768, 'license': 1},
            {'id': 4, 'file_name': 'train/P0707.png', 'width': 640, 'height': 480},
        ],
        'categories': [{'id': 7, 'name': 'ship', 'supercategory': 'vessel'}],
        'annotations': [_annotation()],
    } | changes


def _annotation(**changes: Any) -> dict[str, Any]:
    return {
        'id': 17, 'image_id': 3, 'category_id': 7, 'iscrowd': 0, 'area': 150.0,
        'bbox': [9.5, 19.5, 21.0, 11.0], 'segmentation': [HULL],
    } | changes  # fmt: skip


def _without(record: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key != name}


def test_a_file_as_the_documentation_describes_it(put: Put) -> None:
    labels, empty = read_labels(put('instances.json', json.dumps(_document())))
    assert (labels.image, labels.size) == ('P0706.png', (1024, 768))
    assert (labels.class_ids, labels.ids) == (('ship',), ('17',))
    assert labels.reference.tolist() == [[9.5, 19.5, 30.5, 30.5]]
    assert labels.hulls[0] is not None
    assert labels.hulls[0].ravel().tolist() == HULL
    box = shapely.Polygon(labels.corners[0])
    # Of two rectangles of the same area: releases of GEOS differ in which they find.
    assert box.area == pytest.approx(200.0)
    assert box.buffer(1e-9).covers(shapely.Polygon(labels.hulls[0]))
    assert (empty.image, empty.size, len(empty.ids)) == ('train/P0707.png', (640, 480), 0)


def test_four_corners_are_the_box_and_no_hull(put: Put) -> None:
    corners = [[284, 466, 274, 456, 300, 430, 310, 440]]
    document = _document(annotations=[_annotation(segmentation=corners)])
    labels, _ = read_labels(put('a.json', json.dumps(document)))
    assert labels.hulls == (None,)
    got = shapely.Polygon(labels.corners[0]).normalize()
    expected = shapely.Polygon(np.array(corners).reshape(-1, 2)).normalize()
    assert shapely.equals_exact(got, expected, tolerance=1e-9)


def test_several_polygons_are_one_box_and_one_hull(put: Put) -> None:
    parts = [[0, 0, 4, 0, 4, 2, 0, 2], [6, 0, 10, 0, 10, 2, 6, 2]]
    document = _document(annotations=[_annotation(segmentation=parts)])
    labels, _ = read_labels(put('a.json', json.dumps(document)))
    assert labels.hulls[0] is not None
    assert shapely.Polygon(labels.hulls[0]).area == pytest.approx(20.0)
    assert shapely.Polygon(labels.corners[0]).area == pytest.approx(20.0)


@pytest.mark.parametrize('segmentation', [None, []])
def test_without_polygons_the_box_is_upright(put: Put, segmentation: object) -> None:
    document = _document(annotations=[_annotation(segmentation=segmentation, score=0.5)])
    labels, _ = read_labels(put('a.json', json.dumps(document)))
    assert labels.reference.tolist() == [[9.5, 19.5, 30.5, 30.5]]
    assert labels.corners[0].tolist() == [[9.5, 19.5], [30.5, 19.5], [30.5, 30.5], [9.5, 30.5]]
    assert labels.scores.tolist() == [0.5]


def test_without_a_bbox_there_is_no_reference(put: Put) -> None:
    document = _document(annotations=[_without(_annotation(), 'bbox')])
    labels, _ = read_labels(put('a.json', json.dumps(document)))
    assert np.isnan(labels.reference).all()


def test_without_categories_their_ids_are_the_classes(put: Put) -> None:
    labels, _ = read_labels(put('a.json', json.dumps(_without(_document(), 'categories'))))
    assert labels.class_ids == ('7',)


RLE = {'size': [768, 1024], 'counts': 'X`2'}


@pytest.mark.parametrize(
    ('bad', 'message'),
    [
        (_annotation(segmentation=RLE), 'the runs of the mask do not fill'),
        (_annotation(segmentation='x'), 'segmentation is not an array'),
        (_annotation(segmentation=[[1, 2, 3, 4]]), 'a polygon has 4 numbers'),
        (_annotation(segmentation=[[1, 2, 3, 4, 5, 6, 7]]), 'a polygon has 7 numbers'),
        (_annotation(segmentation=[[1, 2, 3, 4, 5, 'x']]), "segmentation has 'x'"),
        (_annotation(segmentation=[[1, 1, 2, 2, 3, 3]]), 'no area'),
        (_annotation(segmentation=[[1, 1, 1, 1, 3, 3]]), 'fewer than three'),
        (_annotation(segmentation=[[1, 2, 3, 4, 5, float('nan')]]), 'not finite'),
        (_annotation(segmentation=[[1, 2, 3, 4, 5, 10**400]]), 'not finite'),
        (_annotation(segmentation=[[1, 2, 3, 4, 5, True]]), 'True'),
        (_annotation(bbox=[1, 2, 3]), 'bbox is not an array of 4 numbers'),
        (_annotation(bbox=[1, 2, -3, 4]), 'negative size'),
        (_annotation(bbox=None, segmentation=None), "neither 'segmentation' nor 'bbox'"),
        (_annotation(image_id=99), "'image_id' is 99, which is not in the file"),
        (_annotation(category_id=99), "'category_id' is 99"),
        (_annotation(image_id=[3]), 'not an id'),
        (_annotation(score='high'), "score has 'high'"),
        (_without(_annotation(), 'image_id'), "no 'image_id'"),
        (17, 'not a JSON object'),
    ],
)
def test_a_malformed_annotation_is_reported_with_its_number(
    put: Put, bad: object, message: str
) -> None:
    errors: list[LabelError] = []
    document = _document(annotations=[_annotation(), bad, _annotation()])
    labels, _ = read_labels(put('a.json', json.dumps(document)), on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert error.message.startswith('annotations[1]: ')
    assert message in error.message


@pytest.mark.parametrize(
    ('name', 'bad', 'place'),
    [
        ('images', {'id': 5}, "images[1]: no 'file_name'"),
        ('images', {'file_name': 'a.png'}, "images[1]: no 'id'"),
        ('images', {'id': 3, 'file_name': 'a.png'}, 'images[1]: id 3 is already used'),
        ('images', 5, 'images[1]: not a JSON object'),
        ('categories', {'id': 5}, "categories[1]: no 'name'"),
        ('categories', {'id': None, 'name': 'x'}, "categories[1]: 'id' is None"),
    ],
)
def test_a_malformed_image_or_category_is_reported_with_its_number(
    put: Put, name: str, bad: object, place: str
) -> None:
    errors: list[LabelError] = []
    document = _document()
    document[name].insert(1, bad)
    images = list(read_labels(put('a.json', json.dumps(document)), on_error=errors.append))
    assert [len(each.class_ids) for each in images] == [1, 0]
    assert len(errors) == 1
    assert errors[0].message.startswith(place)


@pytest.mark.parametrize('format_name', ['coco', 'geojson'])
@pytest.mark.parametrize(
    ('text', 'line', 'message'),
    [
        ('{"images": [\n}', 2, 'not JSON'),
        ('', 1, 'not JSON'),
        ('[]', None, 'not '),
        ('{"images": {}}', None, 'not '),
        ('[' * 200_000, None, 'nested too deeply'),
        (b'{"images": "\xff"}', None, 'not JSON'),
        ('{"images": ' + '9' * 5000 + '}', None, 'not '),
    ],
    ids=['cut off', 'blank', 'list', 'no arrays', 'deep', 'not UTF-8', 'number'],
)
def test_a_file_that_cannot_be_used_is_one_error(
    put: Put, format_name: str, text: str | bytes, line: int | None, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('a.json', text)
    assert list(read_labels(path, format_name, on_error=errors.append)) == []
    assert [(error.path, error.line) for error in errors] == [(path, line)]
    assert message in errors[0].message


PLAIN = {
    'id': 9, 'image_id': 1, 'category_id': 1, 'bbox': [1, 2, 8, 2],
    'segmentation': [[1, 2, 9, 2, 9, 4, 1, 4]],
}  # fmt: skip
NUMBERS = st.integers(-1000, 1000) | st.floats(-1e4, 1e4)
QUADRILATERALS = st.lists(NUMBERS, min_size=8, max_size=8) | st.just([1, 2, 9, 2, 9, 4, 1, 4])
ODD = [
    {'segmentation': [[1, 2, 9, 2, 9, 4]]},
    {'segmentation': [[1, 2, 9, 2, 9, 4, 1, 2]]},
    {'segmentation': [[1, 2, 9, 2, 9, 4, 1, True]]},
    {'segmentation': [[1, 2, 9, 2, 9, 4, 1, 10**400]]},
    {'segmentation': [[1, 2, 9, 2, 9, 4, 1, 1e16]]},
    {'bbox': [1, 2, -3, 4]},
    {'iscrowd': []},
    {'iscrowd': True},
    {'id': 7.0},
    {'id': None},
    {'image_id': '1'},
    {'image_id': True},
    {'category_id': 5},
]


@given(
    ships=st.lists(QUADRILATERALS, max_size=6),
    odd=st.none() | st.tuples(st.integers(0, 6), st.sampled_from(ODD)),
)
def test_many_annotations_are_read_as_one_by_one(
    ships: list[list[float]],
    odd: tuple[int, dict[str, object]] | None,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    annotations: list[dict[str, object]] = [
        {
            'id': number,
            'image_id': 2 if number % 3 else 1,
            'category_id': 1,
            'bbox': [1, 2, 3, 4],
            'segmentation': [ship],
            'iscrowd': number % 2,
        }
        for number, ship in enumerate(ships)
    ]
    if odd is not None:
        annotations[odd[0] : odd[0] + 1] = [{**PLAIN, **odd[1]}]
    read = []
    for more in ({}, {'score': 1.0}):
        # With a score, every annotation is read by itself.
        document = {
            'images': [{'id': 1, 'file_name': 'a'}, {'id': 2, 'file_name': 'b'}],
            'categories': [{'id': 1, 'name': 'ship'}],
            'annotations': [{**annotation, **more} for annotation in annotations],
        }
        path = tmp_path_factory.mktemp('coco') / 'all.json'
        path.write_text(json.dumps(document))
        errors: list[LabelError] = []
        images = list(read_labels(path, on_error=errors.append))
        read.append((images, [error.message for error in errors]))
    (plain, plain_errors), (single, errors) = read
    assert plain_errors == errors
    for labels, expected in zip(plain, single, strict=True):
        for name in ('image', 'class_ids', 'ids'):
            assert getattr(labels, name) == getattr(expected, name)
        np.testing.assert_array_equal(labels.corners, expected.corners)
        np.testing.assert_array_equal(labels.reference, expected.reference)
        np.testing.assert_array_equal(labels.extras.crowd, expected.extras.crowd)
