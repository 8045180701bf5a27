# SPDX-License-Identifier: Apache-2.0
"""The YOLO-OBB format of Ultralytics, and the image sizes it needs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import image_files
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile

if TYPE_CHECKING:
    from conftest import Make
    from conftest import Put

# The example of docs.ultralytics.com/datasets/obb.
DOCUMENTED = '0 0.780811 0.743961 0.782371 0.74686 0.777691 0.752174 0.776131 0.749758\n'
BOX = '2 0.125 0.25 0.5 0.25 0.5 0.5 0.125 0.5'
SIZE = (640, 480)
IN_PIXELS = [[[80, 120], [320, 120], [320, 240], [80, 240]]]


def _put_image(path: Path, size: tuple[int, int], **options: object) -> None:
    image = pytest.importorskip('PIL.Image')
    path.parent.mkdir(parents=True, exist_ok=True)
    image.new('RGB', size).save(path, **options)


def test_the_documented_example_is_read_in_pixels(put: Put) -> None:
    (labels,) = read_labels(put('a.txt', DOCUMENTED), 'yolo_obb', image_size=(1000, 2000))
    expected = [[[780.811, 1487.922], [782.371, 1493.72], [777.691, 1504.348], [776.131, 1499.516]]]
    np.testing.assert_allclose(labels.corners, expected, rtol=0, atol=1e-9)
    assert labels.class_ids == ('0',)
    assert labels.ids == ('',)
    assert labels.scores.tolist() == [1.0]
    assert labels.size == (1000, 2000)


@pytest.mark.parametrize(
    ('end', 'score', 'track'),
    [('', 1.0, ''), (' 1', 1.0, ''), (' 0', 0.0, ''), (' 0.875 17', 0.875, '17')],
)
def test_predictions_end_with_confidence_and_track(
    put: Put, end: str, score: float, track: str
) -> None:
    (labels,) = read_labels(put('a.txt', f'{BOX}{end}\n'), image_size=SIZE)
    assert labels.corners.tolist() == IN_PIXELS
    assert labels.scores.tolist() == [score]
    assert labels.ids == (track,)


def test_boxes_may_extend_beyond_the_image(put: Put) -> None:
    (labels,) = read_labels(put('a.txt', '0 -1 0 2 0 2 1 -1 1'), image_size=(100, 100))
    assert labels.corners[0, :, 0].tolist() == [-100, 200, 200, -100]


@pytest.mark.parametrize(
    ('line', 'message'),
    [
        ('2 0.1 0.2 0.5 0.2 0.5 0.3 0.1', '8 fields, expected 9 to 11'),
        (f'{BOX} 0.5 17 1', '12 fields'),
        ('2 0.5 0.5 0.1 0.1', '5 fields'),
        (BOX.replace('0.125', 'x', 1), "'x' is not a number"),
        (BOX.replace('0.125', 'nan', 1), "'nan' is not a finite number"),
        (BOX.replace('0.125', '80', 1), 'not normalised'),
        (BOX.replace('0.125', '2.001', 1), 'not normalised'),
        (BOX.replace('0.125', '-1.001', 1), 'not normalised'),
        (f'ship{BOX[1:]}', "class index 'ship'"),
        (f'-1{BOX[1:]}', "class index '-1'"),
        (f'2.0{BOX[1:]}', "class index '2.0'"),
        (f'{BOX} 1.001', 'confidence 1.001 is not within 0..1'),
        (f'{BOX} -0.001', 'confidence -0.001 is not within 0..1'),
        (f'{BOX} 17', 'confidence 17 is not within 0..1'),
        (f'{BOX} x', "'x' is not a number"),
    ],
)
def test_a_malformed_line_is_an_error_that_says_why(put: Put, line: str, message: str) -> None:
    path = put('a.txt', f'{BOX}\n{line}\n')
    with pytest.raises(LabelError) as caught:
        list(read_labels(path, 'yolo_obb', image_size=SIZE))
    assert (caught.value.path, caught.value.line) == (path, 2)
    assert message in caught.value.message


def test_classes_txt_names_the_indices(put: Put) -> None:
    put('classes.txt', '\ufeffplane\r\nstorage tank\r\n ship \r\n')
    (labels,) = read_labels(put('a.txt', BOX), image_size=SIZE)
    assert labels.class_ids == ('ship',)


@pytest.mark.parametrize('names', ['plane\nship\n', 'plane\nship\n\ncar\n'])
def test_an_index_without_a_name_is_malformed(put: Put, names: str) -> None:
    put('classes.txt', names)
    with pytest.raises(LabelError, match=r'a\.txt:1: class 2 has no name in classes\.txt'):
        list(read_labels(put('a.txt', BOX), image_size=SIZE))


def test_a_classes_txt_that_is_not_text_is_an_error_in_that_file(put: Put, tmp_path: Path) -> None:
    put('classes.txt', b'plane\nsh\xefp\n')
    put('a.txt', BOX)
    put('b.txt', BOX)
    with pytest.raises(LabelError, match=r'classes\.txt:2: not UTF-8'):
        list(read_labels(tmp_path, image_size=SIZE))
    errors: list[LabelError] = []
    assert list(read_labels(tmp_path, image_size=SIZE, on_error=errors.append)) == []
    assert [error.path.name for error in errors] == ['classes.txt', 'classes.txt']


@pytest.mark.parametrize(
    ('labels', 'image'),
    [
        ('a.txt', 'a.png'),
        ('a.txt', 'a.jpg'),
        ('a.txt', 'a.TIF'),
        ('tile.rf.8a9a.txt', 'tile.rf.8a9a.bmp'),
        ('labels/a.txt', 'images/a.png'),
        ('labels/train/a.txt', 'images/train/a.png'),
        ('train/labels/a.txt', 'train/images/a.png'),
        ('labels/labels/a.txt', 'labels/images/a.png'),
    ],
)
def test_the_size_is_taken_from_the_image(
    put: Put, tmp_path: Path, labels: str, image: str
) -> None:
    _put_image(tmp_path / image, SIZE)
    (read,) = read_labels(put(labels, BOX))
    assert read.size == SIZE
    assert read.corners.tolist() == IN_PIXELS


def test_the_size_is_found_from_a_relative_path(
    put: Put, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put_image(tmp_path / 'images' / 'a.png', SIZE)
    put('labels/a.txt', BOX)
    monkeypatch.chdir(tmp_path / 'labels')
    (read,) = read_labels('a.txt')
    assert read.size == SIZE


@pytest.mark.parametrize('orientation', range(1, 9))
def test_the_size_is_that_of_the_image_as_displayed(
    put: Put, tmp_path: Path, orientation: int
) -> None:
    image = pytest.importorskip('PIL.Image')
    exif = image.Exif()
    exif[0x0112] = orientation
    _put_image(tmp_path / 'a.jpg', (48, 32), exif=exif)
    (read,) = read_labels(put('a.txt', BOX))
    with image.open(tmp_path / 'a.jpg') as stored:
        shown = pytest.importorskip('PIL.ImageOps').exif_transpose(stored)
        assert read.size == shown.size


@pytest.mark.filterwarnings('error')
def test_the_size_of_an_image_that_pillow_warns_about_is_read(
    put: Put, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put_image(tmp_path / 'a.png', SIZE)
    limit = SIZE[0] * SIZE[1] - 1
    monkeypatch.setattr(pytest.importorskip('PIL.Image'), 'MAX_IMAGE_PIXELS', limit)
    (read,) = read_labels(put('a.txt', BOX))
    assert read.size == SIZE


def test_an_image_that_is_too_large_needs_an_image_size(
    put: Put, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put_image(tmp_path / 'a.png', SIZE)
    monkeypatch.setattr(image_files, 'MAX_PIXELS', SIZE[0] * SIZE[1] - 1)
    path = put('a.txt', BOX)
    with pytest.raises(LabelError, match='image_size'):
        list(read_labels(path))
    (read,) = read_labels(path, image_size=SIZE)
    assert read.size == SIZE


def test_the_image_size_of_the_caller_overrides_the_image(put: Put, tmp_path: Path) -> None:
    _put_image(tmp_path / 'a.png', (10, 10))
    (read,) = read_labels(put('a.txt', BOX), image_size=SIZE)
    assert read.size == SIZE


def test_without_an_image_the_error_says_what_to_pass(put: Put) -> None:
    path = put('labels/a.txt', BOX)
    with pytest.raises(LabelError, match=r'no image .*image_size=\(width, height\)') as caught:
        list(read_labels(path))
    assert (caught.value.path, caught.value.line) == (path, None)


def test_an_image_that_cannot_be_read_is_named(put: Put) -> None:
    pytest.importorskip('PIL')
    image = put('a.png', 'not a PNG')
    with pytest.raises(LabelError, match='image_size') as caught:
        list(read_labels(put('a.txt', BOX)))
    assert f'cannot read {image}' in caught.value.message


def test_without_pillow_the_error_says_what_to_pass(
    put: Put, monkeypatch: pytest.MonkeyPatch
) -> None:
    put('a.png', b'')
    monkeypatch.setitem(sys.modules, 'PIL', None)
    with pytest.raises(LabelError, match=r'Pillow, which is not installed: pass image_size'):
        list(read_labels(put('a.txt', BOX)))


def test_with_on_error_files_of_unknown_size_are_left_out(put: Put, tmp_path: Path) -> None:
    _put_image(tmp_path / 'b.png', SIZE)
    for name in ('a.txt', 'b.txt', 'c.txt'):
        put(name, BOX)
    errors: list[LabelError] = []
    assert [each.image for each in read_labels(tmp_path, on_error=errors.append)] == ['b']
    assert [error.path.name for error in errors] == ['a.txt', 'c.txt']


def test_a_blank_file_takes_the_size_of_its_image(put: Put, tmp_path: Path) -> None:
    _put_image(tmp_path / 'a.png', SIZE)
    (read,) = read_labels(put('a.txt', ''), 'yolo_obb')
    assert (read.size, read.corners.shape) == (SIZE, (0, 4, 2))


IN_BOX = Box((80.0, 120.0, 320.0, 120.0, 320.0, 240.0, 80.0, 240.0), '2')


def test_a_file_is_written_normalised(make: Make, tmp_path: Path) -> None:
    write_labels(tmp_path, [make('a', IN_BOX, size=SIZE)], 'yolo_obb')
    assert (tmp_path / 'a.txt').read_text() == f'{BOX}\n'
    assert not (tmp_path / 'classes.txt').exists()


def test_an_image_without_boxes_needs_no_size(tmp_path: Path) -> None:
    write_labels(tmp_path, [LabelFile(Path('made.by')).image('a', [])], 'yolo_obb')
    assert (tmp_path / 'a.txt').read_text() == ''


def test_scores_are_written_if_one_is_not_1(make: Make, tmp_path: Path) -> None:
    image = make('a', IN_BOX, IN_BOX._replace(score=0.5, id='17'), size=SIZE)
    write_labels(tmp_path, [image], 'yolo_obb')
    assert (tmp_path / 'a.txt').read_text() == f'{BOX} 1.0\n{BOX} 0.5\n'


def test_names_are_numbered_by_classes_txt(make: Make, tmp_path: Path) -> None:
    images = [
        make('a', IN_BOX._replace(class_id='ship'), size=SIZE),
        make('b', IN_BOX._replace(class_id='7'), IN_BOX._replace(class_id='ship'), size=SIZE),
    ]
    write_labels(tmp_path, images, 'yolo_obb')
    assert (tmp_path / 'classes.txt').read_text() == 'ship\n7\n'
    read = read_labels(tmp_path, 'yolo_obb', image_size=SIZE)
    assert [each.class_ids for each in read] == [('ship',), ('7', 'ship')]


def test_names_in_classes_txt_keep_their_number(put: Put, make: Make, tmp_path: Path) -> None:
    put('classes.txt', 'plane\nship\n')
    boxes = [IN_BOX._replace(class_id=name) for name in ('buoy', 'ship')]
    write_labels(tmp_path, [make('a', *boxes, size=SIZE)], 'yolo_obb')
    assert (tmp_path / 'classes.txt').read_text() == 'plane\nship\nbuoy\n'
    (read,) = read_labels(tmp_path, image_size=SIZE)
    assert read.class_ids == ('buoy', 'ship')


@pytest.mark.parametrize(
    ('box', 'size', 'message'),
    [
        (IN_BOX, None, 'YOLO needs its size'),
        (IN_BOX, (32, 24), 'far outside its size'),
        (IN_BOX._replace(score=1.5), SIZE, 'scores are not within'),
        (IN_BOX._replace(class_id=''), SIZE, 'cannot be a line'),
        (IN_BOX._replace(class_id=' ship'), SIZE, 'cannot be a line'),
        (IN_BOX._replace(class_id='a\nb'), SIZE, 'cannot be a line'),
    ],
)
def test_values_that_would_not_be_read_back_are_refused(
    make: Make, tmp_path: Path, box: Box, size: tuple[int, int] | None, message: str
) -> None:
    images = [make('a', IN_BOX, size=SIZE), make('b', box, size=size)]
    with pytest.raises(ValueError, match=message):
        write_labels(tmp_path, images, 'yolo_obb')
    assert list(tmp_path.iterdir()) == []


def test_written_labels_are_read_back_within_rounding(make: Make, tmp_path: Path) -> None:
    corners = np.random.default_rng(0).uniform(-50, 700, (100, 8))
    boxes = [IN_BOX._replace(corners=row, score=index / 100) for index, row in enumerate(corners)]
    write_labels(tmp_path, [make('a', *boxes, size=(653, 481))], 'yolo_obb')
    (read,) = read_labels(tmp_path, image_size=(653, 481))
    np.testing.assert_allclose(read.corners.reshape(-1, 8), corners, rtol=0, atol=1e-12 * 700)
    assert read.scores.tolist() == [box.score for box in boxes]
