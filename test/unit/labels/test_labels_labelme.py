# SPDX-License-Identifier: Apache-2.0
"""The JSON files of LabelMe and X-AnyLabeling."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING
from typing import Any

import numpy as np
import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

CORNERS = [[284.0, 466.0], [274.0, 456.0], [300.0, 430.0], [310.0, 440.0]]
UPRIGHT = [[10.0, 20.0], [90.0, 20.0], [90.0, 50.0], [10.0, 50.0]]


def _document(*shapes: object, **members: object) -> str:
    return json.dumps({
        'version': '6.3.1', 'flags': {}, 'shapes': shapes, 'imagePath': 'P0706.png',
        'imageData': None, 'imageHeight': 768, 'imageWidth': 1024, **members,
    })  # fmt: skip


def _shape(kind: str | None, points: object, **members: object) -> dict[str, Any]:
    return {
        'label': 'ship', 'points': points, 'group_id': None, 'description': '',
        'shape_type': kind, 'flags': {}, 'mask': None, **members,
    }  # fmt: skip


@pytest.mark.parametrize('kind', ['oriented_rectangle', 'rotation', 'quadrilateral', 'polygon'])
def test_four_corners_are_an_oriented_box(put: Put, kind: str) -> None:
    (labels,) = read_labels(put('a.json', _document(_shape(kind, CORNERS))))
    assert (labels.image, labels.size) == ('P0706', (1024, 768))
    assert labels.class_ids == ('ship',)
    boxes = labels.boxes()
    np.testing.assert_allclose(boxes.center, [[292, 448]], atol=1e-9)
    np.testing.assert_allclose(boxes.length, [26 * 2**0.5])
    np.testing.assert_allclose(boxes.width, [10 * 2**0.5])
    assert np.isnan(labels.reference).all()
    assert labels.hulls == (None,)


def test_what_x_anylabeling_says_of_a_shape_is_kept(put: Put) -> None:
    shape = _shape(
        'rotation', CORNERS, difficult=True, direction=2.3, attributes={'flag': 'NL'},
        description='moored', kie_linking=[], score=None,
    )  # fmt: skip
    path = put('a.json', _document(shape, _shape('polygon', CORNERS), checked=True, image_tags=[]))
    (labels,) = read_labels(path)
    assert labels.difficulties == [1, 0]
    assert labels.extras.properties == {
        'attributes': ({'flag': 'NL'}, None), 'description': ('moored', None),
    }  # fmt: skip
    assert labels.extras.label_set.others == ('checked',)


@pytest.mark.parametrize('points', [[[10, 50], [90, 20]], [[90, 20], [10, 50]], UPRIGHT])
def test_a_rectangle_is_upright_and_the_reference_box(put: Put, points: object) -> None:
    (labels,) = read_labels(put('a.json', _document(_shape('rectangle', points))))
    assert sorted(labels.corners[0].tolist()) == sorted(UPRIGHT)
    assert labels.reference.tolist() == [[10, 20, 90, 50]]


@pytest.mark.parametrize('kind', ['polygon', None], ids=['typed', 'before LabelMe 3.11'])
def test_a_polygon_is_a_hull(put: Put, kind: str | None) -> None:
    hull = [[0, 5], [10, 0], [60, 0], [60, 10], [10, 10]]
    (labels,) = read_labels(put('a.json', _document(_shape(kind, hull))))
    assert labels.hulls[0] is not None
    assert labels.hulls[0].tolist() == hull
    np.testing.assert_allclose(labels.boxes().length, [60])


def test_group_and_score_of_a_shape_are_id_and_score(put: Put) -> None:
    shapes = [_shape('rotation', CORNERS, group_id=7, score=0.5), _shape('rotation', CORNERS)]
    (labels,) = read_labels(put('a.json', _document(*shapes)))
    assert labels.ids == ('7', '')
    assert labels.scores.tolist() == [0.5, 1.0]


@pytest.mark.parametrize(
    ('path', 'name'),
    [
        ('..\\images\\P1.png', 'P1'),
        ('/data/P1.rf.1.tif', 'P1.rf.1'),
        ('', 'a'),
        (None, 'a'),
        (5, 'a'),
    ],
)
def test_the_image_is_named_after_its_path_or_the_file(put: Put, path: object, name: str) -> None:
    (labels,) = read_labels(put('a.json', _document(imagePath=path)))
    assert labels.image == name
    assert labels.corners.shape == (0, 4, 2)


@pytest.mark.parametrize(
    ('shape', 'message'),
    [
        (_shape('circle', [[1, 2], [3, 4]]), "a shape of type 'circle' is not read, only polygon"),
        (_shape('mask', [[1, 2], [3, 4]]), "type 'mask' is not read"),
        (_shape('linestrip', CORNERS), "type 'linestrip' is not read"),
        (_shape('rotation', CORNERS[:3]), 'an oriented box of 3 points, expected 4'),
        (_shape('rectangle', CORNERS[:3]), 'an oriented box of 3 points, expected 4'),
        (_shape('polygon', CORNERS[:2]), 'a polygon of 2 points'),
        (_shape('polygon', [[1, 2], [3, 4], [5, 6]]), 'the polygon has no area'),
        (_shape('polygon', [[1, 2], [3, 4], [5, 1e300]]), 'no minimum rotated rectangle'),
        (_shape('polygon', [[1, 2], [3, 4], [5]]), 'a point is not an array of 2 numbers'),
        (_shape('polygon', [[1, 2], [3, 4], [5, '6']]), "'6', which is not a number"),
        (_shape('polygon', [[1, 2], [3, 4], [5, float('inf')]]), 'not finite'),
        (_shape('polygon', {}), 'points is not an array'),
        (_shape(5, CORNERS), 'a shape of type 5'),
        (_shape([], CORNERS), 'type'),
        (_shape('polygon', CORNERS, score='high'), "score has 'high'"),
        ({'points': CORNERS}, "no 'label'"),
        ({'label': 'ship'}, "no 'points'"),
        ('ship', 'not a JSON object'),
    ],
)
def test_a_shape_that_is_not_read_is_reported_with_its_number(
    put: Put, shape: object, message: str
) -> None:
    errors: list[LabelError] = []
    path = put('a.json', _document(_shape('rotation', CORNERS), shape))
    (labels,) = read_labels(path, 'labelme', on_error=errors.append)
    assert len(labels.ids) == 1
    (error,) = errors
    assert error.message.startswith('shapes[1]: ')
    assert message in error.message


@pytest.mark.parametrize('document', ['[]', '{}', '{"shapes": 5}', '{"shapes": {}}', '5'])
def test_another_document_is_refused(put: Put, document: str) -> None:
    with pytest.raises(LabelError, match="not LabelMe: no array 'shapes'"):
        list(read_labels(put('a.json', document), 'labelme'))
