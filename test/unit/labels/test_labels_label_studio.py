# SPDX-License-Identifier: Apache-2.0
"""The exports of Label Studio: JSON, JSON-MIN, CSV and TSV."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

URL = '/data/upload/1/5c2f8a1e-P0706.png'
# 200 x 20 pixels at 30 degrees about (300, 200), in an image of 1000 x 500.
TURNED = {'x': 30.0, 'y': 40.0, 'width': 20.0, 'height': 4.0, 'rotation': 30.0}
XYWHR = [300 + 100 * 0.75**0.5 - 5, 200 + 50 + 10 * 0.75**0.5, 200, 20, np.pi / 6]
SHIP = {'rectanglelabels': ['ship']}
SIZE = {'original_width': 1000, 'original_height': 500, 'image_rotation': 0}


def _result(
    value: object, kind: str = 'rectanglelabels', number: str = 'Xy1', **members: object
) -> dict[str, Any]:
    return {
        'id': number, 'type': kind, 'value': value, 'to_name': 'image', 'from_name': 'label',
        **SIZE, **members,
    }  # fmt: skip


def _annotation(*results: object, **members: object) -> dict[str, Any]:
    return {
        'id': 9, 'completed_by': 1, 'result': results, 'was_cancelled': False,
        'created_at': '2026-11-30T12:00:00.5Z', **members,
    }  # fmt: skip


def _task(*annotations: object, number: int = 1, url: str = URL, **members: object) -> Any:
    return {'id': number, 'data': {'image': url}, 'annotations': annotations, **members}


def _read(put: Put, *tasks: object) -> list[ImageLabels]:
    return list(read_labels(put('export.json', json.dumps(tasks))))


def _min_task(*regions: object, number: int = 1, **members: object) -> dict[str, Any]:
    return {
        'image': URL, 'id': number, 'label': regions, 'annotator': 1, 'annotation_id': 9,
        'created_at': '2026-11-30T12:00:00.5Z', 'lead_time': 3.5, **members,
    }  # fmt: skip


def _table(task: dict[str, Any], separator: str) -> str:
    cells = [
        json.dumps(value) if isinstance(value, (list, tuple)) else value for value in task.values()
    ]
    text = io.StringIO()
    csv.writer(text, delimiter=separator).writerows([list(task), cells])
    return text.getvalue()


def _files() -> dict[str, str]:
    """Write the same box as each of the four exports does."""
    task = _min_task({**TURNED, **SHIP, **SIZE})
    return {
        'export.json': json.dumps([_task(_annotation(_result({**TURNED, **SHIP})))]),
        'min.json': json.dumps([task]),
        'export.csv': _table(task, ','),
        'export.tsv': _table(task, '\t'),
        'tabs.csv': _table(task, '\t'),
    }


@pytest.mark.parametrize('name', list(_files()))
def test_a_turned_rectangle_is_read_from_every_export(put: Put, name: str) -> None:
    (labels,) = read_labels(put(name, _files()[name]))
    assert (labels.image, labels.size) == ('5c2f8a1e-P0706.png', (1000, 500))
    assert labels.class_ids == ('ship',)
    np.testing.assert_allclose(labels.boxes().xywhr, [XYWHR])
    assert np.isnan(labels.reference).all()


@pytest.mark.parametrize('rotation', [{}, {'rotation': 0}, {'rotation': None}])
def test_a_rectangle_that_is_not_turned_is_the_reference_box(
    put: Put, rotation: dict[str, Any]
) -> None:
    value = {'x': 30.0, 'y': 40.0, 'width': 20.0, 'height': 4.0, **SHIP, **rotation}
    (labels,) = _read(put, _task(_annotation(_result(value))))
    assert labels.reference.tolist() == [[300, 200, 500, 220]]
    assert labels.corners[0, 0].tolist() == [300, 200]


@given(
    corner=st.tuples(*[st.floats(0, 100)] * 2),
    size=st.tuples(*[st.floats(1, 100)] * 2),
    degrees=st.floats(-360, 360),
)
def test_the_corner_of_a_rectangle_stays_where_it_is_when_it_turns(
    tmp_path_factory: pytest.TempPathFactory,
    corner: tuple[float, float],
    size: tuple[float, float],
    degrees: float,
) -> None:
    names = ('x', 'y', 'width', 'height', 'rotation')
    value = dict(zip(names, (*corner, *size, degrees), strict=True))
    path = tmp_path_factory.mktemp('export') / 'export.json'
    path.write_text(json.dumps([_task(_annotation(_result({**value, **SHIP})))]))
    (labels,) = read_labels(path)
    expected = np.array(corner) * (10, 5)
    along = labels.corners[0, 1] - labels.corners[0, 0]
    np.testing.assert_allclose(labels.corners[0, 0], expected, atol=1e-6)
    turn = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    np.testing.assert_allclose(along, turn * size[0] * 10, atol=1e-6)


def test_a_polygon_is_a_hull(put: Put) -> None:
    value = {'points': [[1, 2], [2, 1], [9, 1], [9, 3], [2, 3]], 'polygonlabels': ['ship']}
    (labels,) = _read(put, _task(_annotation(_result(value, 'polygonlabels'))))
    assert labels.hulls[0] is not None
    assert labels.hulls[0].tolist() == [[10, 10], [20, 5], [90, 5], [90, 15], [20, 15]]


def test_labels_of_their_own_name_the_region_of_the_same_id(put: Put) -> None:
    results = [
        _result(TURNED, 'rectangle', 'a'),
        _result(TURNED, 'rectangle', 'b'),
        _result({'labels': ['tug']}, 'labels', 'b'),
    ]
    (labels,) = _read(put, _task(_annotation(*results)))
    assert labels.class_ids == ('', 'tug')
    assert labels.ids == ('a', 'b')


def test_answers_without_a_place_are_ignored(put: Put) -> None:
    answers = [
        {'type': 'choices', 'value': {'choices': ['harbour']}},
        {'type': 'textarea', 'value': {'text': ['fog']}},
        {'type': 'relation', 'from_id': 'a', 'to_id': 'b'},
    ]
    (labels,) = _read(put, _task(_annotation(*answers, _result({**TURNED, **SHIP}))))
    assert labels.class_ids == ('ship',)


@pytest.mark.parametrize(
    ('url', 'name'),
    [
        (URL, '5c2f8a1e-P0706.png'),
        ('/data/local-files/?d=ships%2Fnorth/P1.png', 'P1.png'),
        ('https://example.org/ships/P1.tif?token=a/b', 'P1.tif'),
        ('s3://bucket/ships/P%201.JPG', 'P 1.JPG'),
        ('C:\\ships\\P1.png', 'P1.png'),
        ('P1', 'P1'),
    ],
)
def test_the_image_is_named_after_its_address(put: Put, url: str, name: str) -> None:
    (labels,) = _read(put, _task(_annotation(), url=url))
    assert labels.image == name
    assert labels.class_ids == ()


def test_the_image_may_be_in_a_member_of_any_name(put: Put) -> None:
    task = _task(_annotation(), data={'text': 'a note', 'scene': URL})
    assert _read(put, task)[0].image == '5c2f8a1e-P0706.png'


@pytest.mark.parametrize('newest_first', [True, False])
def test_of_two_annotations_the_newest_is_read_and_the_other_reported(
    put: Put, newest_first: bool
) -> None:
    old = _annotation(_result({**TURNED, 'rectanglelabels': ['old']}), created_at='2026-01-01')
    new = _annotation(_result({**TURNED, 'rectanglelabels': ['new']}), created_at='2026-02-01')
    versions = [new, old] if newest_first else [old, new]
    errors: list[LabelError] = []
    path = put('export.json', json.dumps([_task(*versions)]))
    (labels,) = read_labels(path, on_error=errors.append)
    assert labels.class_ids == ('new',)
    place = f'tasks[0]: annotations[{versions.index(old)}]: '
    expected = f'{place}not read, as task 1 has a newer annotation'
    assert [error.message for error in errors] == [expected]


def test_cancelled_annotations_are_not_read(put: Put) -> None:
    result = _result({**TURNED, **SHIP})
    tasks = [
        _task(_annotation(result, was_cancelled=True), _annotation(result)),
        _task(_annotation(result, was_cancelled=True), number=2),
    ]
    assert [labels.class_ids for labels in _read(put, *tasks)] == [('ship',), ()]


def test_predictions_are_read_where_no_one_has_annotated(put: Put) -> None:
    prediction = {'result': [_result({**TURNED, **SHIP}, score=0.5)], 'score': 0.1}
    tasks = [
        _task(predictions=[prediction]),
        _task(_annotation(), number=2, predictions=[prediction]),
    ]
    first, second = _read(put, *tasks)
    assert (first.scores.tolist(), second.scores.tolist()) == ([0.5], [])


@pytest.mark.parametrize(
    ('value', 'members', 'message'),
    [
        ({'rle': [1, 2], 'format': 'rle'}, {'type': 'brushlabels'}, "type 'brushlabels' is not"),
        (
            {'x': 1, 'y': 2, 'radiusX': 3, 'radiusY': 4},
            {'type': 'ellipse'},
            "'ellipse' is not read",
        ),
        ({'x': 1, 'y': 2, 'width': 3}, {'type': 'keypointlabels'}, "'keypointlabels' is not read"),
        ({'sequence': []}, {'type': 'videorectangle'}, "'videorectangle' is not read"),
        ({**TURNED, 'width': -1}, {}, 'negative size'),
        ({**TURNED, 'rotation': '30'}, {}, "rotation has '30'"),
        ({**TURNED, 'x': float('nan')}, {}, 'x has a number that is not finite'),
        ({**TURNED, 'rectanglelabels': ['ship', 'tug']}, {}, 'not one label but'),
        ({'points': [[1, 2], [3, 4]]}, {}, 'at least three points'),
        ({'points': [[1, 2], [3, 4], [5]]}, {}, 'a point is not an array of 2 numbers'),
        (TURNED, {'original_width': None}, 'original_width and original_height are not'),
        (TURNED, {'image_rotation': 90}, 'a region of a turned image'),
        (TURNED, {'score': 'high'}, "score has 'high'"),
    ],
)
def test_a_region_that_is_not_read_is_reported_with_its_place(
    put: Put, value: object, members: dict[str, Any], message: str
) -> None:
    results = [_result({**TURNED, **SHIP}), {**_result(value), **members}]
    errors: list[LabelError] = []
    path = put('export.json', json.dumps([_task(_annotation(*results))]))
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.ids) == 1
    (error,) = errors
    assert error.message.startswith('tasks[0]: annotations[0]: region 2: ')
    assert message in error.message


@pytest.mark.parametrize(
    ('task', 'message'),
    [
        ({'data': {}}, "no 'id'"),
        ({'id': 1, 'data': {}}, 'no image name'),
        ({'id': 1, 'data': 5}, "'data' is not a JSON object"),
        (_task(annotations=5), "'annotations' is not an array"),
        (_task(annotations=[{}]), "no 'result'"),
        (_task(annotations=[{'result': 5}]), "'result' is not an array"),
        (_task(_annotation(5)), 'not a JSON object'),
        (5, 'not a JSON object'),
    ],
)
def test_a_malformed_task_is_reported_with_its_number(put: Put, task: object, message: str) -> None:
    errors: list[LabelError] = []
    path = put('export.json', json.dumps([_task(_annotation(), number=2), task]))
    images = list(read_labels(path, 'label_studio', on_error=errors.append))
    assert len(images) == 1
    (error,) = errors
    assert error.message.startswith('tasks[1]: ')
    assert message in error.message


@pytest.mark.parametrize(
    ('cell', 'message'),
    [
        ('"[{""x"": 1"', 'not JSON: '),
        ('"[{""x"": ' + '[' * 100_000 + '"', 'JSON nested too deeply'),
        ('x,y', '5 fields, the header has 4'),
        ('"x', 'not a CSV row'),
    ],
    ids=['cut off', 'nested', 'too many', 'quotes'],
)
def test_a_damaged_row_of_a_table_is_reported_with_its_line(
    put: Put, cell: str, message: str
) -> None:
    path = put('export.csv', f'id,lead_time,annotation_id,label\n1,2,3,{cell}\n')
    errors: list[LabelError] = []
    assert list(read_labels(path, on_error=errors.append)) == []
    assert [error.line for error in errors] == [2]
    assert message in errors[0].message


def test_many_boxes_of_an_image_fit_in_a_row(put: Put) -> None:
    region = {**TURNED, **SHIP, **SIZE}
    (labels,) = read_labels(put('export.csv', _table(_min_task(*[region] * 2000), ',')))
    assert len(labels.ids) == 2000


@pytest.mark.parametrize(('name', 'text'), [('a.json', '{}'), ('a.csv', 'image,x1\n')])
def test_another_file_is_refused(put: Put, name: str, text: str) -> None:
    with pytest.raises(LabelError, match='not a Label Studio export'):
        list(read_labels(put(name, text), 'label_studio'))


def test_the_size_of_the_caller_overrides_that_of_the_file(put: Put) -> None:
    path = put('export.json', _files()['export.json'])
    (labels,) = read_labels(Path(path), image_size=(2000, 1000))
    assert labels.size == (2000, 1000)
    np.testing.assert_allclose(labels.boxes().length, [400])
