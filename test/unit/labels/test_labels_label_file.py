# SPDX-License-Identifier: Apache-2.0
"""The labels of an image, and the errors of label files."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile

FILE = LabelFile(Path('P0706.txt'))
FIELDS = {
    'image': 'P0706',
    'corners': np.zeros((2, 4, 2)),
    'class_ids': ('ship', 'ship'),
    'ids': ('', ''),
    'scores': np.ones(2),
    'reference': np.full((2, 4), np.nan),
    'hulls': (None, None),
    'size': None,
    'source': Path('P0706.txt'),
}


def test_fields_that_agree_are_accepted() -> None:
    labels = ImageLabels(**FIELDS)
    assert labels.corners is FIELDS['corners']


@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('corners', np.zeros((2, 8))),
        ('corners', np.zeros((3, 4, 2))),
        ('scores', np.ones((2, 1))),
        ('reference', np.zeros((1, 4))),
        ('ids', ('',)),
        ('hulls', ()),
        ('class_ids', ('ship',)),
        ('bow', np.zeros(3, bool)),
    ],
)
def test_fields_that_disagree_are_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match='class_ids'):
        ImageLabels(**{**FIELDS, field: value})


def test_the_bow_is_where_the_labels_say_or_at_every_first_edge_or_unknown() -> None:
    upright = (0, 0, 4, 0, 4, 9, 0, 9)
    boxes = [Box(upright, 'ship', bow=True), Box(upright, 'ship'), Box((*upright[2:], 0, 0), '')]
    labels = FILE.image('P0706', boxes)
    assert not labels.boxes().bow.any()
    assert labels.boxes('labels').bow.tolist() == [True, False, False]
    # The first edge of the third box is a long side.
    assert labels.boxes('first-edge').bow.tolist() == [True, True, False]
    assert FILE.image('P0706', boxes[1:]).boxes('labels').bow.tolist() == [False, False]
    with pytest.raises(ValueError, match=r'bow must be one of none, labels, first-edge'):
        labels.boxes('theta')


def test_an_image_without_boxes_keeps_the_shapes() -> None:
    labels = FILE.image('P0706', [], (640, 480))
    assert labels.corners.shape == (0, 4, 2)
    assert labels.scores.shape == (0,)
    assert labels.reference.shape == (0, 4)
    assert labels.class_ids == labels.ids == labels.hulls == ()
    assert labels.size == (640, 480)


@pytest.mark.parametrize(
    ('line', 'text'),
    [(7, 'labels/a.txt:7: 3 fields'), (None, 'labels/a.txt: 3 fields')],
)
def test_an_error_reads_as_path_line_message(line: int | None, text: str) -> None:
    error = LabelError(Path('labels/a.txt'), line, '3 fields')
    assert isinstance(error, ValueError)
    assert str(error) == text
    assert (error.path, error.line, error.message) == (Path('labels/a.txt'), line, '3 fields')


def test_an_error_can_be_pickled() -> None:
    error = pickle.loads(pickle.dumps(LabelError(Path('a.txt'), 3, 'no')))
    assert str(error) == 'a.txt:3: no'


def test_what_a_record_says_beyond_its_box_becomes_columns() -> None:
    upright = (0, 0, 4, 0, 4, 9, 0, 9)
    boxes = [
        Box(upright, 'ship', properties={'mmsi': 219000001, 'flag': 'DK'}),
        Box(upright, 'ship', crowd=True, difficulty=2, properties={'flag': None, 'time': '12:00'}),
    ]
    label_set = LabelSet({'ship': 3, 'tug': 8}, 'EPSG:32633')
    labels = FILE.image('P1', boxes, image_id=17, file_name='P1.png', label_set=label_set)
    extras = labels.extras
    assert extras.properties == {
        'mmsi': (219000001, None),
        'flag': ('DK', None),
        'time': (None, '12:00'),
    }
    assert extras.crowd is not None
    assert extras.difficulty is not None
    assert extras.crowd.tolist() == [False, True]
    assert extras.difficulty.tolist() == [0, 2]
    assert (extras.image_id, extras.file_name) == (17, 'P1.png')
    assert extras.label_set is label_set
    last = extras.take(np.array([1]))
    assert last.properties == {'mmsi': (None,), 'flag': (None,), 'time': ('12:00',)}
    assert last.crowd is not None
    assert last.crowd.tolist() == [True]


def test_plain_labels_have_no_columns_beyond_the_box() -> None:
    extras = FILE.image('P1', [Box((0,) * 8, 'ship')]).extras
    assert (extras.crowd, extras.difficulty, dict(extras.properties)) == (None, None, {})


@pytest.mark.parametrize(
    'extras',
    [
        Extras(crowd=np.zeros(3, bool)),
        Extras(difficulty=np.zeros(1, int)),
        Extras(properties={'mmsi': (1,)}),
    ],
)
def test_extras_of_another_number_of_boxes_are_refused(extras: Extras) -> None:
    with pytest.raises(ValueError, match=r"image 'P0706': .* entries for 2 class_ids"):
        ImageLabels(**FIELDS, extras=extras)
