# SPDX-License-Identifier: Apache-2.0
"""Detections for Task 1 of DOTA, one file per class."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import detect_format
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

BOX = '303.4 232.7 476.6 332.7 496.6 367.3 323.4 267.3'


def test_image_score_and_corners_are_read_and_the_class_from_the_name(put: Put) -> None:
    path = put('Task1_large-vehicle.txt', f'P1 0.91 {BOX}\nP2 1.0 {BOX}\nP1 0.25 {BOX}\n')
    first, second = read_labels(path)
    assert (first.image, second.image) == ('P1', 'P2')
    assert first.class_ids == ('large-vehicle', 'large-vehicle')
    assert first.scores.tolist() == [0.91, 0.25]
    assert first.corners[0].ravel().tolist() == list(map(float, BOX.split()))


def test_the_boxes_of_an_image_are_gathered_from_the_files_of_all_classes(
    put: Put, tmp_path: Path
) -> None:
    put('Task1_plane.txt', f'P2 0.5 {BOX}\n')
    put('Task1_ship.txt', f'P1 0.9 {BOX}\nP2 0.8 {BOX}\n')
    put('Task1_tug.txt', '')
    images = list(read_labels(tmp_path))
    assert [(labels.image, labels.class_ids) for labels in images] == [
        ('P2', ('plane', 'ship')),
        ('P1', ('ship',)),
    ]


@pytest.mark.parametrize(
    'line',
    [
        f'P0706__1024__0___0 0.9 {BOX}',
        f'100000001 0.9 {BOX}',
        f'17 1 {BOX}',
        '100000001 0.9 303 233 477 333 497 367 323 267',
    ],
)
def test_an_image_may_be_called_by_a_number(put: Put, line: str) -> None:
    path = put('Task1_ship.txt', f'{line}\n')
    assert detect_format(path) == 'dota_results'
    (labels,) = read_labels(path)
    assert labels.image == line.split(maxsplit=1)[0]


@pytest.mark.parametrize(
    ('line', 'message'),
    [
        (f'P1 {BOX}', '9 fields, expected 10: image score x1'),
        (f'P1 0.5 {BOX} 1', '11 fields'),
        (f'P1 1.5 {BOX}', 'score 1.5 is not within 0..1'),
        (f'P1 nan {BOX}', "'nan' is not a finite number"),
        (f'P1 high {BOX}', "'high' is not a number"),
        (f'P1 0.5 {BOX[:-5]}1e999', "'1e999' is not a finite number"),
    ],
)
def test_a_malformed_line_is_reported_with_its_number(put: Put, line: str, message: str) -> None:
    errors: list[LabelError] = []
    path = put('Task1_ship.txt', f'P1 0.5 {BOX}\n{line}\n')
    (labels,) = read_labels(path, 'dota_results', on_error=errors.append)
    assert len(labels.ids) == 1
    assert [error.line for error in errors] == [2]
    assert message in errors[0].message
