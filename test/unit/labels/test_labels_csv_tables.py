# SPDX-License-Identifier: Apache-2.0
"""The CSV table of many images."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_boxes
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.axis_aligned import convert_image
from obbhbb_ros.labels.label_file import NO_REFERENCE
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile

if TYPE_CHECKING:
    from conftest import Make
    from conftest import Put
    from conftest import Same

HEADER = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,hx1,hy1,hx2,hy2,mask'
CORNER_COLUMNS = 'x1,y1,x2,y2,x3,y3,x4,y4'
BOX = '10,20,50,20,50,30,10,30'
CORNERS = [[10, 20], [50, 20], [50, 30], [10, 30]]
FULL = f'b.jpg,7,ship,{BOX},11,21,49,29,11 25;30 21;49.5 25;30 29'
BARE = f'b.jpg,,,{BOX},,,,,'


def _table(*rows: str) -> str:
    return ''.join(f'{row}\n' for row in rows)


def test_a_full_row_is_read(put: Put) -> None:
    (labels,) = read_labels(put('all.csv', _table(HEADER, FULL)))
    assert labels.image == 'b.jpg'
    assert labels.ids == ('7',)
    assert labels.class_ids == ('ship',)
    assert labels.corners.tolist() == [CORNERS]
    assert labels.reference.tolist() == [[11, 21, 49, 29]]
    assert labels.hulls[0] is not None
    assert labels.hulls[0].tolist() == [[11, 25], [30, 21], [49.5, 25], [30, 29]]
    assert labels.scores.tolist() == [1.0]


def test_a_row_without_reference_and_mask_is_read(put: Put) -> None:
    (labels,) = read_labels(put('all.csv', _table(HEADER, FULL, BARE)))
    assert labels.ids == ('7', '')
    assert np.isnan(labels.reference).tolist() == [[False] * 4, [True] * 4]
    assert labels.hulls[1] is None


def test_columns_may_be_absent_unknown_and_in_any_order(put: Put) -> None:
    header = 'note,y4,x4,y3,x3,y2,x2,y1,x1,score, class ,instance,image'
    row = 'whatever,30,10,30,50,20,50,20,10,0.25,ship,7,b.jpg'
    (labels,) = read_labels(put('all.csv', _table(header, row)))
    assert (labels.image, labels.ids, labels.class_ids) == ('b.jpg', ('7',), ('ship',))
    assert labels.corners.tolist() == [CORNERS]
    assert labels.scores.tolist() == [0.25]
    assert np.isnan(labels.reference).all()
    assert labels.hulls == (None,)


@pytest.mark.parametrize('score', ['', 'nan', 'NaN'])
def test_an_empty_score_counts_as_1(put: Put, score: str) -> None:
    rows = f'{FULL},{score}', f'{FULL},0.5'
    (labels,) = read_labels(put('all.csv', _table(f'{HEADER},score', *rows)))
    assert labels.scores.tolist() == [1.0, 0.5]


@pytest.mark.parametrize(
    ('header', 'row'),
    [
        (
            f'Image,CLASS,{",".join(["X1", "Y1", "X2", "Y2", "X3", "Y3", "X4", "Y4"])},Score',
            f'a,ship,{BOX},0.5',
        ),
        (f',file_name,class_name,{CORNER_COLUMNS},conf', f'0,a,ship,{BOX},0.5'),
        (
            'label,filename,xyxyxyxy,confidence',
            'ship,a,"[[10, 20], [50, 20], [50, 30], [10, 30]]",.5',
        ),
        ('image,class,cx,cy,w,h,angle_deg,score', 'a,ship,30,25,40,10,0,0.5'),
        ('image,class,cx,cy,w,h,degrees,score', 'a,ship,30,25,10,40,-90,0.5'),
        (
            'image,class,x_center,y_center,width,height,rotation_rad,score',
            'a,ship,30,25,40,10,0,.5',
        ),
    ],
    ids=['upper case', 'pandas', 'list', 'centred', 'cv2.minAreaRect', 'radians'],
)
def test_columns_of_other_tools_are_read(put: Put, header: str, row: str) -> None:
    (labels,) = read_labels(put('all.csv', _table(header, row)))
    assert (labels.image, labels.class_ids) == ('a', ('ship',))
    assert labels.scores.tolist() == [0.5]
    np.testing.assert_allclose(sorted(labels.corners[0].tolist()), sorted(CORNERS), atol=1e-9)


@pytest.mark.parametrize(('name', 'angle'), [('angle_deg', 30.0), ('theta_radians', np.pi / 6)])
def test_an_angle_runs_from_x_towards_y_along_the_first_size(
    put: Put, name: str, angle: float
) -> None:
    text = _table(f'image,class,cx,cy,w,h,{name}', f'a,ship,30,25,40,10,{angle}')
    (labels,) = read_labels(put('all.csv', text))
    np.testing.assert_allclose(labels.boxes().xywhr, [[30, 25, 40, 10, np.pi / 6]])


def test_detections_that_supervision_writes_are_those_of_one_image(put: Put) -> None:
    header = 'x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,class_name,note'
    (labels,) = read_labels(put('sink.csv', _table(header, '10,20,50,30,0,0.9,3,ship,x')))
    assert (labels.image, labels.class_ids, labels.ids) == ('sink', ('ship',), ('3',))
    assert labels.scores.tolist() == [0.9]
    assert labels.reference.tolist() == [[10, 20, 50, 30]]


def test_frames_that_supervision_writes_are_told_apart(put: Put) -> None:
    header = 'x_min,y_min,x_max,y_max,class_id,confidence,tracker_id,frame,xyxyxyxy'
    row = '10,20,50,30,0,0.9,3,{},"[[10, 20], [50, 25], [49, 30], [9, 25]]"'
    images = list(read_labels(put('sink.csv', _table(header, row.format(1), row.format(2)))))
    assert [labels.image for labels in images] == ['1', '2']
    assert images[0].corners[0, 1].tolist() == [50, 25]


def test_an_image_without_boxes_may_have_a_row_number(put: Put) -> None:
    header = f',image,class,{CORNER_COLUMNS}'
    empty, full = read_labels(put('all.csv', _table(header, f'0,a{"," * 9}', f'1,b,ship,{BOX}')))
    assert (empty.image, len(empty.ids)) == ('a', 0)
    assert (full.image, len(full.ids)) == ('b', 1)


@pytest.mark.parametrize(
    ('header', 'row', 'message'),
    [
        ('image,class,cx,cy,w,h,angle_deg', 'a,ship,0.5,0.5,0.1,0.2,30', 'fractions of the image?'),
        ('image,class,cx,cy,w,h,angle_deg', 'a,ship,30,25,-4,10,30', 'negative size'),
        ('image,class,cx,cy,w,h,angle_deg', 'a,ship,30,25,4,10,nan', 'not a finite number'),
        ('image,class,xyxyxyxy', 'a,ship,[1 2 3 4]', 'xyxyxyxy has 4 numbers, expected 8'),
        ('image,class,xyxyxyxy', 'a,ship,[[[[x', "'x' is not a number"),
    ],
)
def test_a_malformed_box_of_other_columns_is_reported(
    put: Put, header: str, row: str, message: str
) -> None:
    path = put('all.csv', _table(header, row))
    with pytest.raises(LabelError) as caught:
        list(read_labels(path))
    assert (caught.value.path, caught.value.line) == (path, 2)
    assert message in caught.value.message


def test_rows_are_grouped_by_image_in_order_of_first_appearance(put: Put) -> None:
    rows = [f'{image},{index},ship,{BOX},,,,,' for index, image in enumerate('cabacc')]
    images = read_labels(put('all.csv', _table(HEADER, *rows)))
    assert [(each.image, ''.join(each.ids)) for each in images] == [
        ('c', '045'), ('a', '13'), ('b', '2'),
    ]  # fmt: skip


def test_quoted_fields_are_unquoted(put: Put) -> None:
    row = f'"P0706@0,0=a ""b""",0,"ship, large",{BOX},,,,,'
    (labels,) = read_labels(put('all.csv', _table(HEADER, row)))
    assert labels.image == 'P0706@0,0=a "b"'
    assert labels.class_ids == ('ship, large',)


def test_a_row_with_only_an_image_name_is_an_image_without_boxes(put: Put) -> None:
    empty, full = read_labels(put('all.csv', _table(HEADER, f'a.jpg{"," * 15}', FULL)))
    assert (empty.image, empty.corners.shape) == ('a.jpg', (0, 4, 2))
    assert (full.image, full.corners.shape) == ('b.jpg', (1, 4, 2))


def test_a_table_with_only_a_header_has_no_images(put: Put) -> None:
    assert list(read_labels(put('all.csv', _table(HEADER)))) == []


@pytest.mark.parametrize(
    ('header', 'message'),
    [
        (HEADER.replace('class,', '').replace('x3,', ''), 'missing columns: class, x3 '),
        (HEADER.replace('image', 'file'), 'missing columns: image '),
        (HEADER.replace('hy1,', ''), 'missing columns: hy1 '),
        (HEADER.replace(',', ';'), 'separated by semicolons: separate the columns by commas'),
        (HEADER.replace(',', '\t'), 'separated by tabs: separate the columns by commas'),
        (f'{HEADER},X1', 'columns named more than once: x1'),
        ('image,class,cx,cy,w,h,angle', "column 'angle' does not say its unit: call it angle_deg"),
        ('image,class,cx,cy,w,h,Theta', "column 'theta' does not say its unit"),
        ('image,class,cx,cy,w,h', 'need one column angle_deg or angle_rad'),
        ('image,class,cx,cy,w,h,angle_deg,rad', 'need one column angle_deg or angle_rad'),
        ('x_min,y_min,x_max,y_max,class_name', 'missing columns: image '),
        (f'{HEADER},x1', 'columns named more than once: x1'),
        (f'{HEADER},"x', 'not a CSV row'),
    ],
)
def test_an_unusable_header_is_an_error(put: Put, header: str, message: str) -> None:
    path = put('all.csv', _table('', header, FULL))
    with pytest.raises(LabelError) as caught:
        list(read_labels(path, 'csv'))
    assert (caught.value.path, caught.value.line) == (path, 2)
    assert message in caught.value.message


def test_a_table_without_a_header_is_an_error_that_names_the_columns(put: Put) -> None:
    with pytest.raises(LabelError, match=r'all\.csv: missing columns: image, class, x1'):
        list(read_labels(put('all.csv', '')))


def test_with_on_error_the_other_tables_of_a_folder_are_read(put: Put, tmp_path: Path) -> None:
    put('1.csv', _table('image,x1', 'a,1', 'a,2'))
    put('2.csv', _table(HEADER, FULL))
    errors: list[LabelError] = []
    assert [each.image for each in read_labels(tmp_path, on_error=errors.append)] == ['b.jpg']
    assert [(error.path.name, error.line) for error in errors] == [('1.csv', 1)]


@pytest.mark.parametrize(
    ('row', 'message'),
    [
        (f'b.jpg,7,ship,{BOX}', '11 fields, the header has 16'),
        (f'{FULL},', '17 fields, the header has 16'),
        (FULL.replace('b.jpg', ''), 'no image name'),
        (FULL.replace('50,20', '50,'), "'' is not a number"),
        (f'b.jpg,7{"," * 14}', "'' is not a number"),
        (f'b.jpg{"," * 15}x', "'' is not a number"),
        (FULL.replace('50,20', '50,x'), "'x' is not a number"),
        (FULL.replace('50,20', '50,nan'), "'nan' is not a finite number"),
        (FULL.replace('49,29', '49,'), "'' is not a number"),
        (FULL.replace('49,29', 'inf,29'), "'inf' is not a finite number"),
        (FULL.replace('49.5 25', '49.5'), 'mask is not a polygon'),
        (FULL.replace('49.5 25', '49.5 25 30 21'), 'mask is not a polygon'),
        (FULL.replace('49.5 25', 'x 25'), "'x' is not a number"),
        (f'b.jpg,7,ship,{BOX},,,,,1 2;3 4', 'mask is not a polygon'),
        (f'"{FULL}', 'not a CSV row'),
        (f'"b"c,7,ship,{BOX},,,,,', 'not a CSV row'),
    ],
)
def test_a_malformed_row_is_an_error_and_only_this_row_is_lost(
    put: Put, row: str, message: str
) -> None:
    path = put('all.csv', _table(HEADER, FULL, '', row, FULL))
    errors: list[LabelError] = []
    (labels,) = read_labels(path, on_error=errors.append)
    assert len(labels.ids) == 2
    assert [(error.path, error.line) for error in errors] == [(path, 4)]
    assert message in errors[0].message


@pytest.mark.parametrize('score', ['x', 'inf'])
def test_a_score_has_to_be_a_finite_number(put: Put, score: str) -> None:
    path = put('all.csv', _table(f'{HEADER},score', f'{FULL},{score}'))
    with pytest.raises(LabelError, match=rf":2: '{score}' is not a"):
        list(read_labels(path))


def test_a_hull_may_exceed_the_field_limit_of_the_csv_module(make: Make, tmp_path: Path) -> None:
    hull = np.random.default_rng(0).random((8000, 2))
    box = Box((0.0,) * 8, 'ship', hull=hull)
    write_labels(tmp_path / 'all.csv', [make('a', box)])
    assert (tmp_path / 'all.csv').stat().st_size > csv.field_size_limit()
    (labels,) = read_labels(tmp_path / 'all.csv')
    np.testing.assert_array_equal(labels.hulls[0], hull)


def test_a_table_is_written_with_the_columns_that_are_read(make: Make, tmp_path: Path) -> None:
    hull = np.array([[0.1, 0.0], [1.0, 0.0], [1.0, 1.5]])
    box = Box((10, 20, 50, 20, 50, 30, 10, 30), 'ship', '7', 1.0, (11, 21, 49, 29), hull)
    write_labels(tmp_path / 'all.csv', [make('a,b', box), make('c')])
    assert (tmp_path / 'all.csv').read_text() == _table(
        HEADER,
        '"a,b",7,ship,10.0,20.0,50.0,20.0,50.0,30.0,10.0,30.0,11.0,21.0,49.0,29.0,'
        '0.1 0.0;1.0 0.0;1.0 1.5',
        'c,,ship,10.0,20.0,50.0,20.0,50.0,30.0,10.0,30.0,,,,,',
    )


def test_scores_are_written_if_one_is_not_1(make: Make, tmp_path: Path) -> None:
    write_labels(tmp_path / 'all.csv', [make('a'), make('b', Box((0.0,) * 8, 'ship', score=0.5))])
    lines = (tmp_path / 'all.csv').read_text().splitlines()
    assert [line.rpartition(',')[2] for line in lines] == ['score', '1.0', '0.5']


def test_an_image_without_a_name_cannot_be_written(make: Make, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match='without a name'):
        write_labels(tmp_path / 'all.csv', [make('good'), make('', Box((0.0,) * 8, 'ship'))])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('text', ['a\nb', '\n', '\n\na "b",\n', 'a\u2028\x0bb'])
def test_line_breaks_in_fields_are_written_and_read(make: Make, tmp_path: Path, text: str) -> None:
    corners = (10.0, 20.0, 50.0, 20.0, 50.0, 30.0, 10.0, 30.0)
    box = Box(corners, text, text, properties={'note': text, 'no\nte': 'x'})
    images = [make(f'{text}1', box, box), make('2', box)]
    write_boxes(tmp_path / 'all.csv', [convert_image(image, HullRule()).boxes for image in images])
    first, second = read_labels(tmp_path / 'all.csv')
    assert (first.image, second.image) == (f'{text}1', '2')
    for labels, count in ((first, 2), (second, 1)):
        assert labels.ids == labels.class_ids == (text,) * count
        assert labels.extras.properties == {'note': (text,) * count, 'no\nte': ('x',) * count}


@pytest.mark.parametrize('end', ['\r', '\r\n', '\n'])
def test_every_line_break_in_a_field_is_read_as_lf(put: Put, end: str) -> None:
    table = end.join([HEADER, f'a,0,"ship{end}{end}tug",{BOX},,,,,', FULL, ''])
    (first, second) = read_labels(put('all.csv', table))
    assert (first.class_ids, second.image) == (('ship\n\ntug',), 'b.jpg')


@pytest.mark.parametrize('rows', [1, 2, 3])
def test_stray_quotes_damage_their_rows_alone(put: Put, rows: int) -> None:
    stray = [f'a,{row},"ship,{BOX},,,,,' for row in range(rows)]
    table = _table(HEADER, *(line for row in stray for line in (row, FULL)), FULL)
    errors: list[LabelError] = []
    (labels,) = read_labels(put('all.csv', table), on_error=errors.append)
    assert len(labels.ids) == rows + 1
    assert [error.line for error in errors] == [2 * row + 2 for row in range(rows)]


def test_a_field_of_many_lines_goes_over_blocks(put: Put) -> None:
    text = '\n'.join(['x' * 1000] * 900)
    (labels,) = read_labels(
        put('all.csv', _table(HEADER, f'a,0,"{text}",{BOX},,,,,', f'a,1,s,{BOX},,,,,'))
    )
    assert labels.class_ids == (text, 's')


def test_a_quote_that_does_not_end_costs_one_row(put: Put) -> None:
    rows = [f'a,0,"ship,{BOX},,,,,', *[f'a,1,s,{BOX},,,,,'] * 5000]
    errors: list[LabelError] = []
    (labels,) = read_labels(put('all.csv', _table(HEADER, *rows)), on_error=errors.append)
    assert (len(labels.ids), [error.line for error in errors]) == (5000, [2])


# What GEOS can compute with.
NEAR = st.floats(-1e15, 1e15)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
POINTS = st.lists(st.tuples(NEAR, NEAR), min_size=3, max_size=6)
TEXT = st.text(st.characters(exclude_categories=('Cs', 'Cc'), include_characters='\n'), max_size=10)
BOXES = st.builds(
    Box,
    corners=st.tuples(*[NUMBERS] * 8),
    class_id=TEXT,
    id=TEXT,
    score=st.just(1.0) | NUMBERS,
    reference=st.just(NO_REFERENCE) | st.tuples(*[NUMBERS] * 4),
    hull=st.none() | POINTS.map(lambda points: np.array(points, dtype=np.float64)),
    # Hypothesis takes all fields of a named tuple for required ones.
    bow=st.just(False),
    crowd=st.just(False),
    difficulty=st.just(0),
    properties=st.just({}),
)
IMAGES = st.lists(
    st.builds(
        LabelFile(Path('made.by')).image,
        TEXT.filter(bool),
        st.lists(BOXES, max_size=4),
    ),
    max_size=4,
    unique_by=lambda labels: labels.image,
)


@given(images=IMAGES)
def test_written_labels_are_read_back_to_the_bit(
    images: list[ImageLabels], assert_same: Same, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp('table') / 'all.csv'
    write_labels(path, images)
    assert_same(list(read_labels(path)), images)


MALFORMED = (
    'b.jpg,7,ship',
    FULL.replace('50,20', '50,x'),
    FULL.replace('50,20', '50,2_0'),
    FULL.replace('50,20', '50,1e999'),
    f'"{FULL}',
    f',7,ship,{BOX},,,,,',
)


@given(
    rows=st.lists(st.sampled_from(('', f'c.jpg{"," * 15}', BARE, FULL, *MALFORMED)), max_size=60)
)
def test_errors_are_those_of_each_row_alone(
    rows: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp('table') / 'all.csv'
    path.write_text(_table(HEADER, *rows))
    errors: list[LabelError] = []
    images = list(read_labels(path, on_error=errors.append))
    lines = [number for number, row in enumerate(rows, start=2) if row in MALFORMED]
    assert [error.line for error in errors] == lines
    for error in errors:
        path.write_text(_table(HEADER, rows[(error.line or 0) - 2]))
        with pytest.raises(LabelError) as alone:
            list(read_labels(path))
        assert alone.value.message == error.message
    boxes = [row for row in rows if row in {BARE, FULL}]
    assert [label for labels in images for label in labels.ids] == [
        '7' if row == FULL else '' for row in boxes
    ]


@pytest.mark.parametrize('end', ['\n', '\r\n', '\r'])
def test_a_long_table_keeps_its_rows_and_the_lines_of_its_errors(put: Put, end: str) -> None:
    rows = [f'{row % 3}.jpg,{row},ship,{BOX},,,,,'.encode() for row in range(20_000)]
    rows[7_000], rows[7_001], rows[19_999] = b'\xff', b'', rows[0].replace(b'50', b'x')
    path = put('all.csv', '')
    path.write_bytes(b'\xef\xbb\xbf' + end.encode().join([HEADER.encode(), *rows]))
    errors: list[LabelError] = []
    images = list(read_labels(path, on_error=errors.append))
    expected = [list(range(first, 19_999, 3)) for first in range(3)]
    for skipped in (7_000, 7_001):
        expected[skipped % 3].remove(skipped)
    assert [list(map(int, labels.ids)) for labels in images] == expected
    assert [error.line for error in errors] == [7_002, 20_001]
