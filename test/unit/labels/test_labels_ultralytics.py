# SPDX-License-Identifier: Apache-2.0
"""The predictions.json of Ultralytics' OBB models."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

RBOX = [100.0, 50.0, 60.0, 20.0, 0.5]
COS, SIN = np.cos(0.5), np.sin(0.5)
POLY = [
    round(float(100 * (axis == 'x') + 50 * (axis == 'y') + u * along + v * across), 3)
    for u, v in ((30, 10), (30, -10), (-30, -10), (-30, 10))
    for axis, along, across in (('x', COS, -SIN), ('y', SIN, COS))
]
RECORD = {'image_id': 'P1', 'file_name': 'P1.png', 'category_id': 3, 'score': 0.9}


def test_predictions_are_grouped_by_image(put: Put) -> None:
    other = {**RECORD, 'image_id': 17, 'file_name': '17.png', 'score': 0.25}
    document = [{**record, 'rbox': RBOX, 'poly': POLY} for record in (RECORD, other, RECORD)]
    first, second = read_labels(put('predictions.json', json.dumps(document)))
    assert (first.image, second.image) == ('P1.png', '17.png')
    assert first.class_ids == ('3', '3')
    assert first.corners.reshape(-1, 8).tolist() == [POLY, POLY]
    assert (first.scores.tolist(), second.scores.tolist()) == ([0.9, 0.9], [0.25])


@pytest.mark.parametrize('shape', [{'poly': POLY}, {'rbox': RBOX}], ids=['poly', 'rbox'])
def test_either_shape_is_enough(put: Put, shape: dict[str, object]) -> None:
    (labels,) = read_labels(put('predictions.json', json.dumps([{**RECORD, **shape}])))
    np.testing.assert_allclose(labels.boxes().xywhr, [RBOX], atol=1e-3)


def test_without_a_file_name_the_id_names_the_image(put: Put) -> None:
    document = [{'image_id': 17, 'category_id': 0, 'score': 1, 'rbox': RBOX}]
    (labels,) = read_labels(put('predictions.json', json.dumps(document)))
    assert labels.image == '17'


def _put(put: Put, *numbers: int, old: bool = False) -> Path:
    """Write predictions of these classes, as versions before 8.3.49 if `old`, and class names."""
    put('data.yaml', 'names: [ship, tug, barge]')
    record = {name: value for name, value in RECORD.items() if not (old and name == 'file_name')}
    document = [{**record, 'rbox': RBOX, 'category_id': number} for number in numbers]
    return put('predictions.json', json.dumps(document))


@pytest.mark.parametrize(
    ('numbers', 'old', 'classes'),
    [
        ((1, 2), False, ('ship', 'tug')),
        ((2, 3), True, ('tug', 'barge')),
        ((0, 2), True, ('ship', 'barge')),
        ((0, 2), False, ('ship', 'barge')),
    ],
)
def test_a_file_beside_names_the_classes(
    put: Put, numbers: tuple[int, ...], old: bool, classes: tuple[str, ...]
) -> None:
    (labels,) = read_labels(_put(put, *numbers, old=old))
    assert labels.class_ids == classes


def test_names_that_do_not_fit_for_certain_are_refused(put: Put) -> None:
    with pytest.raises(LabelError, match=r'may begin with 0 or with 1, so the names in data\.yaml'):
        list(read_labels(_put(put, 1, 2, old=True)))


def test_a_number_without_a_name_is_reported(put: Put) -> None:
    errors: list[LabelError] = []
    (labels,) = read_labels(_put(put, 1, 4), on_error=errors.append)
    assert labels.class_ids == ('ship',)
    assert [error.message for error in errors] == ['[1]: class 3 has no name in data.yaml']


@pytest.mark.parametrize(
    ('record', 'message'),
    [
        ({**RECORD, 'bbox': [1, 2, 3, 4]}, "neither 'poly' nor 'rbox'"),
        ({**RECORD, 'rbox': RBOX[:4]}, 'rbox is not an array of 5 numbers'),
        ({**RECORD, 'rbox': [*RBOX[:4], float('nan')]}, 'rbox has a number that is not finite'),
        ({**RECORD, 'rbox': [1, 2, -3, 4, 0]}, 'negative size'),
        ({**RECORD, 'poly': POLY[:6]}, 'poly is not an array of 8 numbers'),
        ({**RECORD, 'poly': POLY, 'score': None}, 'score has None'),
        ({'image_id': '', 'poly': POLY}, 'no image name'),
        ({'poly': POLY}, "no 'image_id'"),
        ([], 'not a JSON object'),
    ],
)
def test_a_malformed_prediction_is_reported_with_its_number(
    put: Put, record: object, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('predictions.json', json.dumps([{**RECORD, 'poly': POLY}, record]))
    (labels,) = read_labels(path, 'ultralytics', on_error=errors.append)
    assert len(labels.ids) == 1
    (error,) = errors
    assert error.message.startswith('[1]: ')
    assert message in error.message


def test_another_document_is_refused(put: Put) -> None:
    with pytest.raises(LabelError, match='not predictions of Ultralytics'):
        list(read_labels(put('predictions.json', '{}'), 'ultralytics'))
