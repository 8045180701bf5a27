# SPDX-License-Identifier: Apache-2.0
"""The names of class numbers, beside YOLO labels or above them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Put

SIZE = (100, 100)
LINES = '1 0.5 0.5 0.2 0.2\n0 0.5 0.5 0.2 0.2\n'


def _classes(path: Path) -> tuple[str, ...]:
    (labels,) = read_labels(path, image_size=SIZE)
    return labels.class_ids


@pytest.mark.parametrize(
    ('labels', 'names', 'content'),
    [
        ('labels/a.txt', 'labels/classes.txt', 'tug\nship\n'),
        ('labels/a.txt', 'classes.txt', 'tug\nship\n'),
        ('obj_train_data/a.txt', 'obj.names', 'tug\nship\n'),
        ('labels/a.txt', 'data.yaml', 'names: [tug, ship]\n'),
        ('labels/train/a.txt', 'data.yaml', 'path: .\nnames:\n  0: tug\n  1: ship\nnc: 2\n'),
        ('train/labels/a.txt', 'data.yaml', "names: {'1': ship, 0: 'tug'}\n"),
    ],
)
def test_names_are_read_where_the_tools_write_them(
    put: Put, labels: str, names: str, content: str
) -> None:
    put(names, content)
    assert _classes(put(labels, LINES)) == ('ship', 'tug')


def test_the_nearest_names_are_read(put: Put) -> None:
    put('classes.txt', 'far\nfar\n')
    put('labels/data.yaml', 'names: [tug, ship]')
    assert _classes(put('labels/a.txt', LINES)) == ('ship', 'tug')


def test_names_that_change_are_read_again(put: Put) -> None:
    path = put('labels/a.txt', LINES)
    put('classes.txt', 'tug\nship\n')
    assert _classes(path) == ('ship', 'tug')
    put('classes.txt', 'tugs\nships\n')
    assert _classes(path) == ('ships', 'tugs')


def test_a_name_in_yaml_is_text_whatever_it_looks_like(put: Put) -> None:
    put('data.yaml', 'names: [no, 1e3]')
    assert _classes(put('a.txt', LINES)) == ('1e3', 'no')


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('names: [tug', 'not YAML: '),
        ('names: tug', "'names' is neither a list"),
        ('names: [[tug], [ship]]', "'names' is neither a list"),
        ('names: {ship: 0}', "'ship', which is not the number of a class"),
        ('names: {999999999: ship}', 'not the number of a class'),
        (f'names: {"[" * 5000}', 'nested too deeply'),
        ('names: [' + 'ship, ' * 300_000 + ']', 'too many for a list of class names'),
        (b'names: [\xff]', 'not YAML: '),
        ('a: &a [x, x]\nb: &b [*a, *a]\nnames: [*b, *b]', "'names' is neither a list"),
    ],
    ids=[
        'cut off', 'text', 'nested', 'names to numbers', 'huge number', 'deep',
        'huge', 'not UTF-8', 'aliases',
    ],
)  # fmt: skip
def test_names_that_cannot_be_read_are_an_error_of_that_file(
    put: Put, content: str | bytes, message: str
) -> None:
    path = put('data.yaml', content)
    with pytest.raises(LabelError) as caught:
        _classes(put('labels/a.txt', LINES))
    assert caught.value.path == path
    assert message in caught.value.message


def test_a_number_without_a_name_is_malformed(put: Put) -> None:
    put('data.yaml', 'names: {0: tug, 2: ship}')
    with pytest.raises(LabelError, match=r'a\.txt:1: class 1 has no name in data\.yaml'):
        _classes(put('a.txt', LINES))


@pytest.mark.parametrize('content', ['', 'nc: 2', 'names: []', '- tug'])
def test_without_names_classes_are_numbers(put: Put, content: str) -> None:
    put('data.yaml', content)
    assert _classes(put('a.txt', LINES)) == ('1', '0')
