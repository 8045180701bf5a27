# SPDX-License-Identifier: Apache-2.0
"""Reading files and folders, whatever the format."""

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

DOTA = '10 20 50 20 50 30 10 30 ship 0\n'
YOLO = '0 0.1 0.2 0.5 0.2 0.5 0.3 0.1 0.3\n'
HEADER = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\n'
CSV = f'{HEADER}P1,0,ship,10,20,50,20,50,30,10,30\n'
CORNERS = [[[10.0, 20.0], [50.0, 20.0], [50.0, 30.0], [10.0, 30.0]]]


@pytest.mark.parametrize(
    ('name', 'text', 'format_name'),
    [('P1.txt', DOTA, 'dota'), ('P1.txt', YOLO, 'yolo_obb'), ('all.csv', CSV, 'csv')],
)
@pytest.mark.parametrize('told', [True, False], ids=['told', 'detected'])
def test_every_format_reads_the_same_box(
    put: Put, name: str, text: str, format_name: str, told: bool
) -> None:
    path = put(name, text)
    (labels,) = read_labels(path, format_name if told else None, image_size=(100, 100))
    assert labels.image == 'P1'
    assert labels.size == (100, 100)
    assert labels.source == path
    assert labels.corners.dtype == np.float64
    np.testing.assert_allclose(labels.corners, CORNERS, rtol=0, atol=1e-12)
    assert np.isnan(labels.reference).all()
    assert labels.scores.tolist() == [1.0]
    assert labels.hulls == (None,)


def test_a_path_may_be_a_string(put: Put) -> None:
    (labels,) = read_labels(str(put('P1.txt', DOTA)))
    assert labels.image == 'P1'


def test_a_folder_is_read_in_the_order_of_its_names(put: Put, tmp_path: Path) -> None:
    for name in ('b.txt', 'a10.txt', 'a1.TXT', 'c.rf.1f2e.txt'):
        put(name, DOTA)
    assert [each.image for each in read_labels(tmp_path)] == ['a1', 'a10', 'b', 'c.rf.1f2e']


def test_a_folder_of_tables_is_read_table_by_table(put: Put, tmp_path: Path) -> None:
    row = ',0,ship,10,20,50,20,50,30,10,30\n'
    put('2.csv', f'{HEADER}x{row}w{row}')
    put('1.csv', f'{HEADER}z{row}y{row}z{row}')
    images = list(read_labels(tmp_path))
    assert [(each.image, len(each.ids)) for each in images] == [
        ('z', 2), ('y', 1), ('x', 1), ('w', 1),
    ]  # fmt: skip
    assert [each.source.name for each in images] == ['1.csv', '1.csv', '2.csv', '2.csv']


@pytest.mark.parametrize(
    'stranger', ['classes.txt', '.a.txt', '._a.txt', 'a.png', 'readme.md', 'deeper/a.txt']
)
def test_only_label_files_directly_in_the_folder_are_read(
    put: Put, tmp_path: Path, stranger: str
) -> None:
    put(stranger, 'ship\n')
    put('P1.txt', DOTA)
    assert [each.image for each in read_labels(tmp_path)] == ['P1']


def test_files_are_read_one_by_one(put: Put, tmp_path: Path) -> None:
    put('a.txt', DOTA)
    put('b.txt', DOTA)
    images = read_labels(tmp_path)
    assert next(images).image == 'a'
    put('b.txt', DOTA * 3)
    assert len(next(images).ids) == 3


@pytest.mark.parametrize('format_name', [None, 'dota', 'yolo_obb', 'csv'])
def test_a_missing_path_is_an_error_of_the_call(tmp_path: Path, format_name: str | None) -> None:
    with pytest.raises(FileNotFoundError, match='nowhere'):
        read_labels(tmp_path / 'nowhere', format_name)


@pytest.mark.parametrize('format_name', [None, 'dota', 'yolo_obb', 'csv'])
def test_a_folder_without_label_files_is_an_error_even_with_on_error(
    put: Put, tmp_path: Path, format_name: str | None
) -> None:
    put('classes.txt', 'ship\n')
    put('P1.png', b'')
    with pytest.raises(LabelError, match='no label file') as caught:
        read_labels(tmp_path, format_name, on_error=print)
    assert (caught.value.path, caught.value.line) == (tmp_path, None)


def test_an_unknown_format_is_an_error_that_lists_all_formats(put: Put) -> None:
    with pytest.raises(ValueError, match=r"'papyrus'.*dota.*yolo_obb.*csv"):
        read_labels(put('P1.txt', DOTA), 'papyrus')


@pytest.mark.parametrize('size', [(640,), (640, 480, 3), (0, 480), (640, 0), (640.0, 480), 640])
def test_an_image_size_is_two_positive_integers(put: Put, size: object) -> None:
    with pytest.raises(ValueError, match='image_size'):
        read_labels(put('P1.txt', DOTA), image_size=size)


def test_an_image_size_may_come_from_numpy(put: Put) -> None:
    size = np.array([640, 1])
    (labels,) = read_labels(put('P1.txt', DOTA), image_size=size)
    assert labels.size == (640, 1)


@pytest.mark.parametrize('text', ['', '\n', ' \r\n\r\n', '\ufeff'])
@pytest.mark.parametrize('format_name', [None, 'dota', 'yolo_obb'])
def test_a_blank_text_file_is_an_image_without_boxes(
    put: Put, text: str, format_name: str | None
) -> None:
    (labels,) = read_labels(put('P1.txt', text), format_name)
    assert labels.image == 'P1'
    assert labels.corners.shape == (0, 4, 2)
    assert labels.size is None


@pytest.mark.parametrize('end', ['\n', '\r\n', '\r'], ids=['LF', 'CRLF', 'CR'])
@pytest.mark.parametrize('bom', ['', '\ufeff'], ids=['plain', 'BOM'])
@pytest.mark.parametrize(
    ('name', 'text'),
    [('P1.txt', DOTA * 2), ('P1.txt', YOLO * 2), ('all.csv', CSV + CSV.splitlines()[1])],
    ids=['dota', 'yolo_obb', 'csv'],
)
def test_line_ends_and_byte_order_marks_do_not_matter(
    put: Put, name: str, text: str, bom: str, end: str
) -> None:
    path = put(name, bom + text.replace('\n', end))
    (labels,) = read_labels(path, image_size=(100, 100))
    assert (labels.image, len(labels.class_ids)) == ('P1', 2)


FORMATS_WITH_A_BAD_LINE_3 = [
    ('P1.txt', 'dota', f'{DOTA}\n{{bad}}{DOTA}'),
    ('P1.txt', 'yolo_obb', f'{YOLO}\n{{bad}}{YOLO}'),
    ('all.csv', 'csv', f'{CSV}{{bad}}{CSV.splitlines()[1]}\n'),
]


@pytest.mark.parametrize(('name', 'format_name', 'text'), FORMATS_WITH_A_BAD_LINE_3)
@pytest.mark.parametrize('bad', ['oops\n', b'\xff\xfe 1 2\n'], ids=['malformed', 'not UTF-8'])
class TestABadRecord:
    """A line that cannot be read, between two that can."""

    @staticmethod
    def _put(put: Put, name: str, text: str, bad: str | bytes) -> Path:
        raw = bad.encode() if isinstance(bad, str) else bad
        return put(name, text.encode().replace(b'{bad}', raw))

    def test_is_raised_with_its_line(
        self, put: Put, name: str, format_name: str, text: str, bad: str | bytes
    ) -> None:
        path = self._put(put, name, text, bad)
        with pytest.raises(LabelError) as caught:
            list(read_labels(path, format_name, image_size=(100, 100)))
        assert (caught.value.path, caught.value.line) == (path, 3)
        assert str(caught.value).startswith(f'{path}:3: ')

    def test_is_reported_once_and_skipped_with_on_error(
        self, put: Put, name: str, format_name: str, text: str, bad: str | bytes
    ) -> None:
        path = self._put(put, name, text, bad)
        errors: list[LabelError] = []
        (labels,) = read_labels(path, format_name, image_size=(100, 100), on_error=errors.append)
        assert [error.line for error in errors] == [3]
        assert len(labels.class_ids) == 2

    def test_does_not_hide_the_format(
        self, put: Put, name: str, format_name: str, text: str, bad: str | bytes
    ) -> None:
        path = self._put(put, name, text, bad)
        errors: list[LabelError] = []
        list(read_labels(path, image_size=(100, 100), on_error=errors.append))
        assert [error.line for error in errors] == [3], format_name


def test_bytes_that_are_not_utf_8_are_named(put: Put) -> None:
    path = put('P1.txt', DOTA.encode() + b'10 20 50 20 50 30 10 30 sh\xefp 0\n')
    with pytest.raises(LabelError, match=r':2: not UTF-8 text: byte 0xef at position 27$'):
        list(read_labels(path))


def test_bad_records_are_counted_over_all_files_of_a_folder(put: Put, tmp_path: Path) -> None:
    put('a.txt', f'{DOTA}1 2 3\n')
    put('b.txt', DOTA)
    put('c.txt', f'x\n{DOTA}\ny\n')
    errors: list[LabelError] = []
    images = list(read_labels(tmp_path, on_error=errors.append))
    assert [len(each.ids) for each in images] == [1, 1, 1]
    assert [(error.path.name, error.line) for error in errors] == [
        ('a.txt', 2), ('c.txt', 1), ('c.txt', 4),
    ]  # fmt: skip


def test_without_on_error_the_images_before_the_bad_record_are_read(
    put: Put, tmp_path: Path
) -> None:
    put('a.txt', DOTA)
    put('b.txt', 'oops\n')
    images = read_labels(tmp_path)
    assert next(images).image == 'a'
    with pytest.raises(LabelError, match=r'b\.txt:1: '):
        next(images)


def test_an_exception_from_on_error_ends_the_reading(put: Put) -> None:
    def give_up(error: LabelError) -> None:
        raise RuntimeError(str(error))

    with pytest.raises(RuntimeError, match=r'P1\.txt:1: '):
        list(read_labels(put('P1.txt', 'oops\n'), 'dota', on_error=give_up))


@pytest.mark.parametrize(
    ('name', 'text', 'format_name'),
    [
        ('P1.txt', 'oops\n', 'dota'),
        ('all.csv', 'image,x1\n', 'csv'),
        ('P1.xml', '<html/>', 'voc'),
        ('all.json', '{}', 'coco'),
        ('P1.txt', YOLO, 'yolo_obb'),
    ],
    ids=['record', 'header', 'root', 'members', 'size'],
)
def test_an_error_that_on_error_raises_again_is_reported_once(
    put: Put, name: str, text: str, format_name: str
) -> None:
    errors: list[LabelError] = []

    def keep_and_raise(error: LabelError) -> None:
        errors.append(error)
        raise error

    with pytest.raises(LabelError) as caught:
        list(read_labels(put(name, text), format_name, on_error=keep_and_raise))
    assert errors == [caught.value]


COCO_OF_TWO_IMAGES = json.dumps(
    {
        'images': [{'id': 1, 'file_name': 'a.png'}, {'id': 2, 'file_name': 'b.png'}],
        'categories': [{'id': 1, 'name': 'ship'}],
        'annotations': [{'id': 1, 'image_id': 1, 'category_id': 1, 'bbox': [1, 2, 3, 4]}],
    }
)


@pytest.mark.parametrize('other', ['stuff', 'person_keypoints', 'image_info'])
def test_coco_files_of_the_same_images_are_read_once(put: Put, tmp_path: Path, other: str) -> None:
    put('annotations/instances_train.json', COCO_OF_TWO_IMAGES)
    put(f'annotations/{other}_train.json', COCO_OF_TWO_IMAGES)
    assert [labels.image for labels in read_labels(tmp_path)] == ['a.png', 'b.png']


def test_coco_files_without_instances_of_the_same_part_are_read(put: Put, tmp_path: Path) -> None:
    put('annotations/instances_train.json', COCO_OF_TWO_IMAGES)
    put('annotations/stuff_val.json', COCO_OF_TWO_IMAGES)
    assert len(list(read_labels(tmp_path))) == 4
