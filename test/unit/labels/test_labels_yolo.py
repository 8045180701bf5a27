# SPDX-License-Identifier: Apache-2.0
"""Ultralytics YOLO boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Put

SIZE = (640, 480)


def test_the_documented_example_is_read(put: Put) -> None:
    put('classes.txt', 'head\nship\n')
    path = put('a.txt', '1 0.5 0.25 0.25 0.5\n0 0.1 0.1 0.2 0.2\n')
    (labels,) = read_labels(path, image_size=SIZE)
    assert labels.class_ids == ('ship', 'head')
    assert labels.ids == ('', '')
    assert labels.scores.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(labels.reference[0], [240, 0, 400, 240])
    np.testing.assert_allclose(labels.corners[0], [[240, 0], [400, 0], [400, 240], [240, 240]])


@pytest.mark.parametrize(
    ('end', 'score', 'track'), [('', 1.0, ''), (' 0.75', 0.75, ''), (' 0.75 17', 0.75, '17')]
)
def test_predictions_end_with_confidence_and_track(
    put: Put, end: str, score: float, track: str
) -> None:
    (labels,) = read_labels(put('a.txt', f'0 0.5 0.5 0.2 0.2{end}\n'), image_size=SIZE)
    assert labels.scores.tolist() == [score]
    assert labels.ids == (track,)


def test_the_size_may_come_from_the_image(put: Put) -> None:
    image = pytest.importorskip('PIL.Image')
    picture = put('images/a.png', b'')
    image.new('L', (100, 50)).save(picture)
    (labels,) = read_labels(put('labels/a.txt', '0 0.5 0.5 0.2 0.2\n'))
    assert labels.size == (100, 50)
    np.testing.assert_allclose(labels.reference, [[40, 20, 60, 30]])


@pytest.mark.parametrize(
    ('line', 'message'),
    [
        ('0 0.5 0.5 0.2', '4 fields, expected 5 to 7'),
        ('0 0.5 0.5 0.2 0.2 0.9 1 1', '8 fields'),
        ('ship 0.5 0.5 0.2 0.2', "class index 'ship'"),
        ('0 320 240 20 20', 'not normalised'),
        ('0 0.5 0.5 -0.2 0.2', 'negative size'),
        ('0 0.5 nan 0.2 0.2', 'not a finite number'),
        ('0 0.5 0.5 0.2 0.2 1.5', 'confidence 1.5'),
    ],
)
def test_a_malformed_line_is_reported_with_its_number(put: Put, line: str, message: str) -> None:
    errors: list[LabelError] = []
    path = put('a.txt', f'0 0.5 0.5 0.2 0.2\n{line}\n0 0.5 0.5 0.2 0.2\n')
    (labels,) = read_labels(path, 'yolo', image_size=SIZE, on_error=errors.append)
    assert len(labels.class_ids) == 2
    assert [(error.path, error.line) for error in errors] == [(path, 2)]
    assert message in errors[0].message


@pytest.mark.parametrize(
    ('lines', 'scores', 'tracks'),
    [
        ([' 1', ' 2', ' 17'], [1, 1, 1], ('1', '2', '17')),
        ([' 1'], [1], ('1',)),
        ([' 0.9', ' 1', ' 0.8'], [0.9, 1, 0.8], ('', '', '')),
        ([' 0', ' 0'], [0, 0], ('', '')),
        ([' 0.9 1', ' 0.8 2'], [0.9, 0.8], ('1', '2')),
    ],
)
def test_a_column_of_whole_numbers_is_that_of_track_ids(
    put: Put, lines: list[str], scores: list[float], tracks: tuple[str, ...]
) -> None:
    path = put('a.txt', ''.join(f'0 0.5 0.5 0.2 0.2{end}\n' for end in lines))
    (labels,) = read_labels(path, image_size=SIZE)
    assert labels.scores.tolist() == scores
    assert labels.ids == tracks


@pytest.mark.parametrize(
    ('lines', 'message'),
    [
        (['0.3', '-1.2'], 'rather an angle'),
        (['0.3', '1.57'], 'rather an angle'),
        (['30', '45.5'], 'rather an angle'),
        (['30', '45', '30'], 'whole numbers that repeat'),
    ],
)
def test_an_angle_after_the_size_is_not_taken_for_a_confidence(
    put: Put, lines: list[str], message: str
) -> None:
    path = put('a.txt', ''.join(f'0 0.5 0.5 0.2 0.2 {angle}\n' for angle in lines))
    with pytest.raises(LabelError, match=message):
        list(read_labels(path, image_size=SIZE))


def test_an_angle_in_one_file_is_one_in_all_files_of_the_folder(put: Put, tmp_path: Path) -> None:
    put('a.txt', '0 0.5 0.5 0.2 0.2 0.3\n')
    path = put('b.txt', '0 0.5 0.5 0.2 0.2 -0.3\n')
    with pytest.raises(ValueError, match='rather an angle') as caught:
        read_labels(tmp_path, image_size=SIZE, on_error=print)
    assert str(caught.value).startswith(f'{path}: ')


def test_a_track_id_is_a_whole_number(put: Put) -> None:
    path = put('a.txt', '0 0.5 0.5 0.2 0.2\n0 0.5 0.5 0.2 0.2 0.9 0.42\n')
    with pytest.raises(LabelError, match=r':2: track id 0\.42 is not a whole number'):
        list(read_labels(path, image_size=SIZE))
