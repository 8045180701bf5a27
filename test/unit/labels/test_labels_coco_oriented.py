# SPDX-License-Identifier: Apache-2.0
"""Boxes of COCO with rotation, five numbers or masks; lists of results; Datumaro JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any

import numpy as np
import pytest

from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

# A ship of 200 x 40 px at 400, 300, turned by 30 degrees clockwise as seen.
CORNERS = [323.4, 232.68, 496.6, 332.68, 476.6, 367.32, 303.4, 267.32]
UNTURNED = [300.0, 280.0, 200.0, 40.0]
# The columns 50 to 90 of the rows 100 to 120.
RUNS = [40100, *[20, 780] * 39, 20, 728680]
RLE = {'size': [800, 1000], 'counts': RUNS}


def _coco(*annotations: dict[str, Any]) -> str:
    return json.dumps(
        {
            'images': [{'id': 1, 'file_name': 'a.jpg', 'width': 1000, 'height': 800}],
            'categories': [{'id': 1, 'name': 'ship'}],
            'annotations': [
                {'id': number, 'image_id': 1, 'category_id': 1, **annotation}
                for number, annotation in enumerate(annotations, start=1)
            ],
        }
    )


def _assert_turned(labels: ImageLabels) -> None:
    boxes = labels.boxes()
    np.testing.assert_allclose(boxes.center[0], [400, 300], atol=0.01)
    np.testing.assert_allclose([boxes.length[0], boxes.width[0]], [200, 40], atol=0.01)
    np.testing.assert_allclose(boxes.theta[0] % np.pi, np.radians(30), atol=1e-4)


@pytest.mark.parametrize(
    'annotation',
    [
        {'bbox': UNTURNED, 'segmentation': [], 'attributes': {'rotation': 30.0}},
        {'bbox': UNTURNED, 'attributes': {'rotation': -330}},
        {'bbox': [400, 300, 200, 40, -30.0]},
        {'bbox': [400, 300, 40, 200, 60]},
        {'bbox': [400, 300, 200, 40, 0.52], 'segmentation': [CORNERS]},
    ],
    ids=['Datumaro', 'negative', 'Detectron2', 'other edge', 'polygon beside'],
)
def test_the_box_is_turned_as_the_annotation_says(put: Put, annotation: dict[str, Any]) -> None:
    (labels,) = read_labels(put('a.json', _coco(annotation)))
    _assert_turned(labels)
    assert np.isnan(labels.reference).all()


def test_a_rotation_that_is_used_is_not_kept_as_a_property(put: Put) -> None:
    attributes = {'rotation': 30.0, 'occluded': False}
    annotation = {'bbox': UNTURNED, 'attributes': attributes, 'mmsi': 7}
    (labels,) = read_labels(put('a.json', _coco(annotation)))
    assert labels.extras.properties == {'attributes': ({'occluded': False},), 'mmsi': (7,)}
    del attributes['occluded']
    (labels,) = read_labels(put('a.json', _coco(annotation)))
    assert labels.extras.properties == {'mmsi': (7,)}


@pytest.mark.parametrize('rotation', [0, 0.0, None])
def test_a_box_that_is_not_turned_is_also_the_reference(put: Put, rotation: object) -> None:
    annotation = {'bbox': UNTURNED, 'attributes': {'rotation': rotation}}
    (labels,) = read_labels(put('a.json', _coco(annotation)))
    assert labels.reference.tolist() == [[300, 280, 500, 320]]
    assert labels.corners[0].tolist() == [[300, 280], [500, 280], [500, 320], [300, 320]]


def test_a_mask_counts_as_the_polygon_around_it(put: Put) -> None:
    annotation = {'bbox': [50, 100, 40, 20], 'segmentation': RLE, 'iscrowd': 1}
    (labels,) = read_labels(put('a.json', _coco(annotation)))
    assert labels.corners[0].min(axis=0).tolist() == [50, 100]
    assert labels.corners[0].max(axis=0).tolist() == [90, 120]
    assert labels.reference.tolist() == [[50, 100, 90, 120]]


@pytest.mark.parametrize(
    ('bad', 'message'),
    [
        ({'bbox': UNTURNED, 'attributes': {'rotation': 'x'}}, "attributes.rotation has 'x'"),
        ({'bbox': UNTURNED, 'attributes': {'rotation': float('nan')}}, 'not finite'),
        (
            {'bbox': UNTURNED, 'segmentation': [CORNERS], 'attributes': {'rotation': 30}},
            'a rotation of 30 beside a segmentation',
        ),
        ({'bbox': [4, 3, 2, 1, 9], 'attributes': {'rotation': 30}}, 'a bbox with an angle'),
        ({'bbox': UNTURNED, 'angle': 30}, "'angle' may turn the bbox"),
        ({'bbox': UNTURNED, 'poly': CORNERS}, "'poly' may turn the bbox"),
        ({'bbox': [400, 300, 200, 40, 'x']}, "bbox has 'x'"),
        ({'bbox': [400, 300, 200, 40, float('inf')]}, 'not finite'),
        ({'bbox': [400, 300, -200, 40, 60]}, 'negative size'),
        ({'bbox': [400, 300, 200, 40, 10**400]}, 'not finite'),
        ({'bbox': UNTURNED, 'segmentation': {'size': [800, 1000]}}, "no 'counts'"),
        ({'bbox': UNTURNED, 'segmentation': {**RLE, 'counts': 'X`2'}}, 'do not fill'),
    ],
)
def test_a_rotation_that_is_not_understood_is_refused(
    put: Put, bad: dict[str, Any], message: str
) -> None:
    errors: list[LabelError] = []
    good = {'bbox': [400, 300, 200, 40, 30]}
    (labels,) = read_labels(put('a.json', _coco(good, bad, good)), on_error=errors.append)
    assert len(labels.class_ids) == 2
    (error,) = errors
    assert error.message.startswith('annotations[1]: ')
    assert message in error.message


@pytest.mark.parametrize('other', [0.0, -3.1, float('nan')])
def test_angles_that_could_be_radians_are_refused(put: Put, other: float) -> None:
    errors: list[LabelError] = []
    turned = [{'bbox': [4, 3, 2, 1, angle]} for angle in (other, 0.5236)]
    list(read_labels(put('a.json', _coco(*turned)), on_error=errors.append))
    assert 'bbox has an angle of 0.5236, degrees as Detectron2 writes it or radians?' in (
        errors[-1].message
    )


def test_results_are_named_by_their_ids(put: Put) -> None:
    results = [
        {'image_id': 42, 'category_id': 3, 'bbox': [10, 20, 4, 2], 'score': 0.5},
        {'image_id': 7, 'category_id': 1, 'bbox': [400, 300, 200, 40, -30], 'score': 0.25},
        {'image_id': 42, 'category_id': 1, 'segmentation': RLE, 'score': 0.75},
    ]
    first, second = read_labels(put('bbox.json', json.dumps(results)))
    assert (first.image, first.extras.image_id) == ('42', 42)
    assert (first.class_ids, first.scores.tolist()) == (('3', '1'), [0.5, 0.75])
    assert first.reference[0].tolist() == [10, 20, 14, 22]
    assert second.image == '7'
    _assert_turned(second)


@pytest.mark.parametrize(
    ('bad', 'message'),
    [
        ({'category_id': 1, 'bbox': UNTURNED}, "no 'image_id'"),
        ({'image_id': 1, 'bbox': UNTURNED}, "no 'category_id'"),
        ({'image_id': 1, 'category_id': 1, 'bbox': UNTURNED, 'rbox': [1]}, "'rbox' may turn"),
        ({'image_id': 1, 'category_id': 1}, "neither 'segmentation' nor 'bbox'"),
        ([], 'not a JSON object'),
    ],
)
def test_a_result_that_is_not_understood_is_reported(put: Put, bad: object, message: str) -> None:
    errors: list[LabelError] = []
    good = {'image_id': 1, 'category_id': 1, 'bbox': UNTURNED, 'score': 1}
    path = put('a.json', json.dumps([good, bad, good]))
    (labels,) = read_labels(path, 'coco_results', on_error=errors.append)
    assert len(labels.class_ids) == 2
    assert [error.message.startswith('[1]: ') for error in errors] == [True]
    assert message in errors[0].message


def _datumaro(*annotations: object, **item: object) -> str:
    image = {'path': 'a.jpg', 'size': [800, 1000]}
    labels = [{'name': 'ship', 'parent': '', 'attributes': []}, {'name': 'tug'}]
    items = [{'id': 'a', 'annotations': annotations, 'attr': {'id': 1}, 'image': image, **item}]
    categories = {'label': {'labels': labels, 'attributes': []}}
    document = {'dm_format_version': '1.0', 'infos': {}, 'categories': categories, 'items': items}
    return json.dumps(document)


BBOX = {'id': 1, 'type': 'bbox', 'label_id': 1, 'bbox': UNTURNED, 'attributes': {'rotation': 30.0}}


@pytest.mark.parametrize(
    'annotation',
    [
        BBOX,
        {'type': 'rotated_bbox', 'label_id': 1, 'rotated_bbox': [400, 300, 200, 40, 30]},
        {'type': 'polygon', 'label_id': 1, 'points': CORNERS, 'attributes': {}},
    ],
)
def test_datumaro_boxes_and_polygons_are_read(put: Put, annotation: dict[str, Any]) -> None:
    (labels,) = read_labels(put('a.json', _datumaro(annotation, {'type': 'label', 'label_id': 0})))
    assert (labels.image, labels.size, labels.class_ids) == ('a', (1000, 800), ('tug',))
    assert labels.extras.file_name == 'a.jpg'
    _assert_turned(labels)


def test_a_datumaro_mask_is_read_and_attributes_are_kept(put: Put) -> None:
    attributes = {'is_crowd': True, 'occluded': False}
    mask = {'type': 'mask', 'label_id': 0, 'rle': RLE, 'attributes': attributes}
    (labels,) = read_labels(put('a.json', _datumaro(mask)))
    assert labels.corners[0].max(axis=0).tolist() == [90, 120]
    assert labels.extras.crowd is not None
    assert labels.extras.properties == {'occluded': (False,)}


@pytest.mark.parametrize(
    ('bad', 'message'),
    [
        ({'type': 'points', 'points': [1, 2]}, "an annotation of type 'points' is not read"),
        ({'type': ['bbox']}, "an annotation of type ['bbox'] is not read"),
        ({**BBOX, 'label_id': 2}, "'label_id' is 2, which is not in the file"),
        ({**BBOX, 'label_id': True}, "'label_id' is True"),
        ({**BBOX, 'attributes': {'rotation': '30'}}, "rotation has '30'"),
        ({**BBOX, 'attributes': [30]}, "'attributes' is not a JSON object"),
        ({**BBOX, 'type': 'mask', 'rle': RLE}, 'a rotation of 30 of type mask'),
        ({'type': 'bbox', 'bbox': [1, 2, 3]}, 'bbox is not an array of 4 numbers'),
        ({'type': 'bbox'}, "no 'bbox'"),
        ({'type': 'rotated_bbox', 'rotated_bbox': [1, 2, 3, 4]}, 'not an array of 5 numbers'),
        ({'type': 'polygon', 'points': [1, 2, 3, 4, 5, float('inf')]}, 'not finite'),
        ({'type': 'mask', 'rle': [1]}, 'not a JSON object'),
        ({'bbox': UNTURNED}, "no 'type'"),
        (7, 'not a JSON object'),
    ],
)
def test_a_datumaro_annotation_that_is_not_understood_is_reported(
    put: Put, bad: object, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('a.json', _datumaro(BBOX, bad, BBOX))
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.class_ids) == 2
    assert [error.message.startswith('items[0].annotations[1]: ') for error in errors] == [True]
    assert message in errors[0].message


@pytest.mark.parametrize(
    ('item', 'message'),
    [({'id': None}, "items[0]: 'id' is not a name"), ({'annotations': {}}, 'is not an array')],
)
def test_a_malformed_datumaro_item_is_reported(
    put: Put, item: dict[str, Any], message: str
) -> None:
    errors: list[LabelError] = []
    assert list(read_labels(put('a.json', _datumaro(**item)), on_error=errors.append)) == []
    assert message in errors[0].message


@pytest.mark.parametrize('format_name', ['coco_results', 'datumaro'])
@pytest.mark.parametrize('text', ['', '{}', '[' * 200_000, '{"items": 3}', '"', '[{', '7'])
def test_a_file_that_cannot_be_used_is_one_error(put: Put, format_name: str, text: str) -> None:
    errors: list[LabelError] = []
    path = put('a.json', text)
    assert list(read_labels(path, format_name, on_error=errors.append)) == []
    assert [error.path for error in errors] == [Path(path)]
