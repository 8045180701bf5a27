# SPDX-License-Identifier: Apache-2.0
"""The DOTA labelTxt format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.text import is_number

if TYPE_CHECKING:
    from conftest import Make
    from conftest import Put
    from conftest import Same

V1_0 = """\
imagesource:GoogleEarth
gsd:0.146343590398
2753.0 2408.0 2861.0 2385.0 2888.0 2468.0 2805.0 2502.0 ship 0
3445.0 3391.0 3484.0 3409.0 3478.0 3422.0 3437.0 3402.0 large-vehicle 1
"""
V1_5 = """\
imagesource:GoogleEarth
gsd:null
2753 2408 2861 2385 2888 2468 2805 2502 ship 0
3445 3391 3484 3409 3478 3422 3437 3402 large-vehicle 2
"""
V2_0 = """\
acquisition dates:None
imagesource:GF
gsd:None

2753 2408 2861 2385 2888 2468 2805 2502 ship 0
3445 3391 3484 3409 3478 3422 3437 3402 large-vehicle 1
"""
AS_ITS_PAGE_PRINTS_IT = """\
'imagesource':imagesource
'gsd':gsd
2753, 2408, 2861, 2385, 2888, 2468, 2805, 2502, ship, 0
3445, 3391, 3484, 3409, 3478, 3422, 3437, 3402, large-vehicle, 1
"""
BARE = """\
2753 2408 2861 2385 2888 2468 2805 2502 ship
3445\t3391  3484 3409 3478 3422 3437 3402 large-vehicle
"""
BOX = '10 20 50 20 50 30 10 30 ship 0\n'


@pytest.mark.parametrize('text', [V1_0, V1_5, V2_0, AS_ITS_PAGE_PRINTS_IT, BARE])
def test_a_file_is_read_in_pixels(put: Put, text: str) -> None:
    (labels,) = read_labels(put('P0706.txt', text))
    assert labels.image == 'P0706'
    assert labels.class_ids == ('ship', 'large-vehicle')
    assert labels.ids == ('', '')
    assert labels.corners.tolist() == [
        [[2753, 2408], [2861, 2385], [2888, 2468], [2805, 2502]],
        [[3445, 3391], [3484, 3409], [3478, 3422], [3437, 3402]],
    ]
    assert labels.size is None


def test_a_file_with_only_header_lines_is_an_image_without_boxes(put: Put) -> None:
    (labels,) = read_labels(put('P0706.txt', 'imagesource:GoogleEarth\ngsd:null\n'))
    assert labels.corners.shape == (0, 4, 2)


@pytest.mark.parametrize(
    ('line', 'message'),
    [
        ('10 20 50 20 50 30 10 30', '8 fields, expected 9 or 10'),
        ('10 20 50 20 50 30 10 30 storage tank 0', '11 fields'),
        ('10 20 50 20 50 30 10 30 storage tank', "difficulty 'tank' is not a whole number"),
        ('10 20 50 20 50 30 10 30 ship hard', "difficulty 'hard'"),
        ('10 20 x 20 50 30 10 30 ship 0', "'x' is not a number"),
        ('10 20 1_0 20 50 30 10 30 ship 0', "'1_0' is not a number"),
        ('10 20 nan 20 50 30 10 30 ship 0', "'nan' is not a finite number"),
        ('10 20 -inf 20 50 30 10 30 ship 0', "'-inf' is not a finite number"),
        ('10 20 1e999 20 50 30 10 30 ship 0', "'1e999' is not a finite number"),
        ('ship 10 20 50 20 50 30 10 30', "'ship' is not a number"),
    ],
)
def test_a_malformed_line_is_an_error_that_says_why(put: Put, line: str, message: str) -> None:
    path = put('P0706.txt', f'gsd:null\n{BOX}{line}\n{BOX}')
    with pytest.raises(LabelError) as caught:
        list(read_labels(path, 'dota'))
    assert (caught.value.path, caught.value.line) == (path, 3)
    assert message in caught.value.message


@pytest.mark.parametrize(
    ('line', 'message'),
    [
        ('0 0.78 0.74 0.79 0.75 0.77 0.76 0.76 0.75', "category '0.75' is a number"),
        ('0 0.78 0.74 0.79 0.75 0.77 0.76 0.76 1', 'is it yolo_obb'),
        ('0 0.78 0.74 0.79 0.75 0.77 0.76 0.76 1 0.9', 'is it yolo_obb'),
        ('1 1 100 200 50 30 1 1 1', 'not the corners of a box'),
        ('0 303 233 477 333 497 367 323 267', 'not the corners of a box'),
        ('10 20 50 20 50 30 10 30 -1 -1', "category '-1' is a number"),
        ('1e308 1e308 -1e308 1e308 -1e308 1e308 -1e308 1e308 1', 'not the corners of a box'),
        ('4 10 4 50 20 50 20 10 4', 'YOLO-OBB in pixels? They would be dota, too'),
    ],
)
def test_nine_numbers_are_read_only_if_they_are_a_box_and_its_category(
    put: Put, line: str, message: str
) -> None:
    path = put('P0706.txt', f'{BOX}{line}\n')
    with pytest.raises(LabelError, match=r'P0706\.txt:2: ') as caught:
        list(read_labels(path, 'dota'))
    assert message in caught.value.message


@pytest.mark.parametrize(
    'corners',
    ['10 20 50 20 50 30 10 30', '10 20 50 20 10 30 50 30', '0 0 40 1 41 9 1 12', '7 7 7 7 7 7 7 7'],
    ids=['around', 'crossed', 'hand-drawn', 'empty'],
)
def test_a_category_may_be_a_number(put: Put, corners: str) -> None:
    (labels,) = read_labels(put('P0706.txt', f'{corners} 3 0\n'))
    assert labels.class_ids == ('3',)


def test_fractions_of_the_image_are_refused(put: Put) -> None:
    path = put('P0706.txt', '0.1 0.2 0.5 0.2 0.5 0.3 0.1 0.3 ship 0\n' * 2)
    with pytest.raises(LabelError, match='the coordinates are fractions of the image'):
        list(read_labels(path))


def test_a_file_is_written_without_header_lines(make: Make, tmp_path: Path) -> None:
    write_labels(tmp_path, [make('P0706')], 'dota')
    text = (tmp_path / 'P0706.txt').read_text()
    assert text == '10.0 20.0 50.0 20.0 50.0 30.0 10.0 30.0 ship 0\n'


@pytest.mark.parametrize('category', ['', ' ', 'storage tank', 'ship ', 'a,b', 'a\nb', 'a\u2003b'])
def test_a_class_that_is_not_exactly_one_field_cannot_be_written(
    make: Make, tmp_path: Path, category: str
) -> None:
    box = Box((0.0,) * 8, category)
    with pytest.raises(ValueError, match=r"'P0706'.*class"):
        write_labels(tmp_path, [make('good'), make('P0706', box)], 'dota')
    assert list(tmp_path.iterdir()) == []


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
CATEGORIES = st.text(st.characters(exclude_categories=('Cs', 'Z', 'Cc'), exclude_characters=','),
                     min_size=1).filter(lambda name: not is_number(name))  # fmt: skip
CORNERS = st.tuples(*[NUMBERS] * 8).filter(lambda corners: max(map(abs, corners)) > 1)
BOXES = st.tuples(CORNERS, CATEGORIES).map(lambda fields: Box(*fields))
IMAGES = st.lists(
    st.builds(
        LabelFile(Path('made.by')).image,
        st.from_regex(r'[A-Z][a-z0-9_-]{0,20}(\.rf\.[0-9a-f]{4})?', fullmatch=True),
        st.lists(BOXES, max_size=5),
    ),
    min_size=1,
    max_size=4,
    unique_by=lambda labels: labels.image,
)


@given(images=IMAGES)
def test_written_labels_are_read_back_to_the_bit(
    images: list[ImageLabels], assert_same: Same, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp('labelTxt')
    write_labels(folder, images, 'dota')
    read = list(read_labels(folder, 'dota'))
    assert_same(read, sorted(images, key=lambda labels: f'{labels.image}.txt'))
    assert all(not np.isfinite(labels.reference).any() for labels in read)
