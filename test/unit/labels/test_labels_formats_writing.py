# SPDX-License-Identifier: Apache-2.0
"""Writing files and folders, whatever the format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels

if TYPE_CHECKING:
    from conftest import Make
    from conftest import Put
    from conftest import Same

TEXT_FORMATS = ['dota', 'yolo_obb']


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != 'classes.txt')


@pytest.mark.parametrize('format_name', TEXT_FORMATS)
def test_a_folder_gets_one_file_per_image(
    make: Make, assert_same: Same, tmp_path: Path, format_name: str
) -> None:
    images = [make('b', size=(64, 32)), make('a', size=(64, 32))]
    write_labels(tmp_path / 'new' / 'labels', iter(images), format_name)
    read = read_labels(tmp_path / 'new' / 'labels', format_name, image_size=(64, 32))
    assert_same(list(read), images[::-1])


@pytest.mark.parametrize('format_name', TEXT_FORMATS)
def test_a_single_image_may_go_to_a_file(make: Make, tmp_path: Path, format_name: str) -> None:
    write_labels(tmp_path / 'one.txt', [make(size=(64, 32))], format_name)
    (labels,) = read_labels(tmp_path / 'one.txt', format_name, image_size=(64, 32))
    assert labels.image == 'one'
    assert labels.class_ids == ('ship',)


@pytest.mark.parametrize('count', [0, 2])
def test_a_text_file_holds_exactly_one_image(make: Make, tmp_path: Path, count: int) -> None:
    images = [make(str(index)) for index in range(count)]
    with pytest.raises(ValueError, match=f'one image, not {count}'):
        write_labels(tmp_path / 'one.txt', images, 'dota')
    assert _names(tmp_path) == []


@pytest.mark.parametrize(
    ('image', 'file'),
    [
        ('000002.jpg', '000002.txt'),
        ('P0706.PNG', 'P0706.txt'),
        ('train/tile_4_jpg.rf.8a9a', 'tile_4_jpg.rf.8a9a.txt'),
        ('../../etc/passwd', 'passwd.txt'),
        (r'C:\data\P1.tif', 'P1.txt'),
    ],
)
def test_a_label_file_has_the_bare_name_of_its_image(
    make: Make, tmp_path: Path, image: str, file: str
) -> None:
    write_labels(tmp_path, [make(image)], 'dota')
    assert _names(tmp_path) == [file]


@pytest.mark.parametrize('image', ['', '..', '.jpg', 'a/', '.hidden', 'classes', 'x/classes.png'])
def test_an_image_name_that_would_not_be_read_back_is_refused(
    make: Make, tmp_path: Path, image: str
) -> None:
    with pytest.raises(ValueError, match='no label file can have this name'):
        write_labels(tmp_path, [make('good'), make(image)], 'dota')
    assert _names(tmp_path) == []


def test_images_that_would_share_a_file_are_refused(make: Make, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.txt: both 'train/a' and 'val/a\.png'"):
        write_labels(tmp_path, [make('train/a'), make('val/a.png')], 'dota')
    assert _names(tmp_path) == []


def test_the_format_follows_from_a_suffix_that_only_one_format_has(
    make: Make, tmp_path: Path
) -> None:
    write_labels(str(tmp_path / 'all.csv'), [make('b'), make('a')])
    assert [each.image for each in read_labels(tmp_path / 'all.csv')] == ['b', 'a']


@pytest.mark.parametrize('name', ['a.txt', 'labels', 'a.json'])
def test_the_format_must_be_named_for_any_other_suffix(
    make: Make, tmp_path: Path, name: str
) -> None:
    with pytest.raises(ValueError, match=r'name the label format.*dota.*csv') as caught:
        write_labels(tmp_path / name, [make()])
    assert str(tmp_path / name) in str(caught.value)


def test_an_unknown_format_is_refused(make: Make, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'papyrus'"):
        write_labels(tmp_path, [make()], 'papyrus')


def test_a_format_that_is_only_read_is_refused(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_only = replace(FORMATS['dota'], name='read_only', write=None)
    monkeypatch.setitem(FORMATS, 'read_only', read_only)
    with pytest.raises(ValueError, match=r"cannot write oriented boxes as 'read_only': use dota"):
        write_labels(tmp_path, [make()], 'read_only')


def _with_nan(array: np.ndarray) -> np.ndarray:
    changed = np.array(array, dtype=np.float64)
    changed.flat[0] = np.nan
    return changed


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@pytest.mark.parametrize('format_name', [name for name, each in FORMATS.items() if each.write])
@pytest.mark.parametrize(
    ('field', 'value'),
    [
        ('corners', _with_nan(SQUARE[None])),
        ('corners', SQUARE[None] + np.inf),
        ('scores', np.array([np.nan])),
        ('reference', _with_nan(np.zeros((1, 4)))),
        ('hulls', (_with_nan(SQUARE),)),
        ('hulls', (SQUARE[:2],)),
        ('hulls', (SQUARE.ravel(),)),
    ],
)
def test_values_that_would_not_be_read_back_are_refused_by_every_format(
    make: Make, tmp_path: Path, format_name: str, field: str, value: object
) -> None:
    bad = replace(make('bad', size=(64, 32)), **{field: value})
    with pytest.raises(ValueError, match="'bad'"):
        write_labels(tmp_path / 'out.csv', [make('good', size=(64, 32)), bad], format_name)
    assert _names(tmp_path) == []


def test_a_failure_while_writing_leaves_the_older_file(put: Put, make: Make) -> None:
    path = put('all.csv', 'older\n')

    def images() -> Iterator[ImageLabels]:
        yield make()
        raise OSError('the disk of the images')

    with pytest.raises(OSError, match='the disk of the images'):
        write_labels(path, images())
    assert path.read_text() == 'older\n'


def test_a_file_may_be_written_from_itself(make: Make, assert_same: Same, tmp_path: Path) -> None:
    path = tmp_path / 'all.csv'
    write_labels(path, [make('a'), make('b')])
    write_labels(path, read_labels(path))
    assert_same(list(read_labels(path)), [make('a'), make('b')])


def test_lines_end_in_line_feeds_everywhere(make: Make, tmp_path: Path) -> None:
    write_labels(tmp_path / 'all.csv', [make()])
    data = (tmp_path / 'all.csv').read_bytes()
    assert data.endswith(b'\n')
    assert b'\r' not in data
