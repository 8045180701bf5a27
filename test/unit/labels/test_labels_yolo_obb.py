# SPDX-License-Identifier: Apache-2.0
"""The YOLO-OBB format of Ultralytics, and the image sizes it needs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.geometry.boxes import OrientedBoxes
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
    [
        ('', 1.0, ''),
        (' 1', 1.0, '1'),
        (' 0', 0.0, ''),
        (' 1.0', 1.0, ''),
        (' 0.875 17', 0.875, '17'),
    ],
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
        ('2 0.1 0.2 0.5 0.2 0.5 0.3 0.1', '8 fields do not fit this file, where nothing follows'),
        ('2 0.1 0.2 0.5 0.2 0.5 0.3', '7 fields'),
        (f'{BOX} 0.5', '10 fields'),
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
        (f'{BOX[:-1]}x', "'0.x' is not a number"),
    ],
)
def test_a_malformed_line_is_an_error_that_says_why(put: Put, line: str, message: str) -> None:
    path = put('a.txt', f'{BOX}\n{line}\n')
    with pytest.raises(LabelError) as caught:
        list(read_labels(path, 'yolo_obb', image_size=SIZE))
    assert (caught.value.path, caught.value.line) == (path, 2)
    assert message in caught.value.message


@pytest.mark.parametrize(
    ('end', 'message'),
    [
        (' 1.001', 'confidence 1.001 is not within 0..1'),
        (' -0.001', 'confidence -0.001 is not within 0..1'),
        (' 17', 'confidence 17 is not within 0..1'),
        (' x', "'x' is not a number"),
        ('', '9 fields do not fit this file, where confidence follows the points'),
        (' 0.5 17', '11 fields'),
    ],
)
def test_a_confidence_is_within_0_and_1(put: Put, end: str, message: str) -> None:
    path = put('a.txt', f'{BOX} 0.5\n{BOX}{end}\n{BOX} 0.6\n{BOX} 0.7\n')
    errors: list[LabelError] = []
    (labels,) = read_labels(path, image_size=SIZE, on_error=errors.append)
    assert labels.scores.tolist() == [0.5, 0.6, 0.7]
    assert [error.line for error in errors] == [2]
    assert message in errors[0].message


# What `yolo track save_txt=True` writes: no confidence, unless save_conf is True.
@pytest.mark.parametrize(
    ('lines', 'scores', 'tracks'),
    [
        ([f'{BOX} 1', f'{BOX} 2', f'{BOX} 269'], [1, 1, 1], ('1', '2', '269')),
        ([f'{BOX} 0.9 1', f'{BOX} 0.8 2'], [0.9, 0.8], ('1', '2')),
        ([f'{BOX} 0.9 1'], [0.9], ('1',)),
        ([f'{BOX} 0.9', f'{BOX} 1'], [0.9, 1], ('', '')),
    ],
)
def test_a_column_of_whole_numbers_is_that_of_track_ids(
    put: Put, lines: list[str], scores: list[float], tracks: tuple[str, ...]
) -> None:
    (labels,) = read_labels(put('a.txt', '\n'.join(lines)), image_size=SIZE)
    assert labels.corners.tolist() == IN_PIXELS * len(lines)
    assert labels.scores.tolist() == scores
    assert labels.ids == tracks


HULL = '0 0.1 0.25 0.2 0.2 0.6 0.2 0.6 0.3 0.2 0.3'


@pytest.mark.parametrize(
    ('lines', 'scores', 'tracks'),
    [
        ([HULL], [1], ('',)),
        ([f'{HULL} 0.1 0.25'], [1], ('',)),
        ([f'{HULL} 0.9', f'{BOX} 0.8'], [0.9, 0.8], ('', '')),
        ([f'{HULL} 4', f'{BOX} 7'], [1, 1], ('4', '7')),
        ([f'{HULL} 0.9 4', f'{BOX} 0.8 7'], [0.9, 0.8], ('4', '7')),
        ([HULL, BOX, BOX], [1, 1, 1], ('', '', '')),
    ],
    ids=['bare', 'closed', 'confidence', 'track', 'both', 'beside boxes'],
)
def test_more_than_four_points_are_a_hull(
    put: Put, lines: list[str], scores: list[float], tracks: tuple[str, ...]
) -> None:
    (labels,) = read_labels(put('a.txt', '\n'.join(lines)), image_size=(100, 100))
    assert labels.hulls[0] is not None
    np.testing.assert_allclose(labels.hulls[0], [[10, 25], [20, 20], [60, 20], [60, 30], [20, 30]])
    np.testing.assert_allclose(labels.boxes().xywhr[0], [35, 25, 50, 10, 0], atol=1e-9)
    assert labels.scores.tolist() == scores
    assert labels.ids == tracks


def test_a_first_corner_that_is_repeated_at_the_end_is_ignored(put: Put) -> None:
    # The first y is 1: as a confidence and a track id, the end would be 0.125 and 1.
    closed = '2 0.125 1 0.5 1 0.5 0.5 0.125 0.5 0.125 1'
    (labels,) = read_labels(put('a.txt', f'{closed}\n{closed}\n'), image_size=SIZE)
    assert labels.hulls == (None, None)
    assert labels.scores.tolist() == [1, 1]
    assert labels.ids == ('', '')


def test_an_end_that_may_be_a_point_or_a_track_is_refused(put: Put) -> None:
    path = put('a.txt', '0 0.1 0.9 0.2 0.7 0.6 0.8 0.7 0.9 0.4 1')
    with pytest.raises(LabelError, match='a point at the border, or a confidence and a track id'):
        list(read_labels(path, image_size=SIZE))


@pytest.mark.parametrize('points', [2, 3, 4, 17])
@pytest.mark.parametrize('visibility', ['', ' 2', ' 0.98'], ids=['none', 'label', 'prediction'])
def test_poses_are_refused(put: Put, points: int, visibility: str) -> None:
    random = np.random.default_rng(points)
    lines = []
    for _ in range(12):
        x, y, width, height = random.uniform((0.2, 0.2, 0.05, 0.05), (0.8, 0.8, 0.1, 0.1))
        places = random.uniform(-0.5, 0.5, (points, 2))
        places[:2] = (-0.45, -0.4), (0.45, 0.4)
        key_points = ''.join(
            f' {x + dx * width:.6g} {y + dy * height:.6g}{visibility}' for dx, dy in places
        )
        lines.append(f'0 {x:.6g} {y:.6g} {width:.6g} {height:.6g}{key_points}')
    with pytest.raises(LabelError, match='look like poses'):
        list(read_labels(put('a.txt', '\n'.join(lines)), 'yolo_obb', image_size=SIZE))


@pytest.mark.parametrize('end', ['', ' 0.75'])
def test_poses_of_two_points_amidships_are_refused(put: Put, end: str) -> None:
    # Ultralytics' save_txt: a box, and the middles of both sides of a ship.
    line = f'0 0.316406 0.34375 0.387542 0.393077 0.347461 0.271432 0.285351 0.416068{end}\n'
    with pytest.raises(LabelError, match='look like poses'):
        list(read_labels(put('a.txt', line), image_size=SIZE))


@given(
    boxes=st.lists(
        st.tuples(*[st.floats(0.1, 0.9)] * 2, *[st.floats(0.01, 0.5)] * 2, st.floats(0, 3.2)),
        min_size=1,
        max_size=5,
    ),
    ends=st.sampled_from(['', ' 0.9', ' {}', ' 0.9 {}']),
)
def test_oriented_boxes_of_every_place_and_size_are_told_from_poses(
    tmp_path_factory: pytest.TempPathFactory, boxes: list[tuple[float, ...]], ends: str
) -> None:
    corners = OrientedBoxes.from_xywhr(boxes).corners.clip(-1, 2).reshape(-1, 8)
    lines = [
        f'0 {" ".join(f"{value:.6g}" for value in row)}{ends.format(number)}'
        for number, row in enumerate(corners.tolist(), start=1)
    ]
    path = tmp_path_factory.mktemp('labels') / 'a.txt'
    path.write_text('\n'.join(lines))
    (labels,) = read_labels(path, image_size=(1, 1))
    np.testing.assert_allclose(labels.corners.reshape(-1, 8), corners, atol=1e-5)
    assert labels.scores.tolist() == [0.9 if '0.9' in ends else 1.0] * len(boxes)
    tracks = [str(number) if '{' in ends else '' for number in range(1, len(boxes) + 1)]
    assert list(labels.ids) == tracks


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


def test_names_are_numbered_by_data_yaml(make: Make, tmp_path: Path) -> None:
    images = [
        make('a', IN_BOX._replace(class_id='ship'), size=SIZE),
        make('b', IN_BOX._replace(class_id='7'), IN_BOX._replace(class_id='ship'), size=SIZE),
    ]
    write_labels(tmp_path, images, 'yolo_obb')
    assert '  0: "7"\n  1: "ship"\n' in (tmp_path / 'data.yaml').read_text()
    assert not (tmp_path / 'classes.txt').exists()
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
