# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb convert`."""

from __future__ import annotations

import csv
import gc
import subprocess
import sys
from collections.abc import Iterable
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.cli import main
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.axis_aligned import convert_image
from obbhbb_ros.labels.axis_aligned import convert_labels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile

TARGETS = [
    ('yolo', 'out'), ('coco', 'out.json'), ('voc', 'out'), ('geojson', 'out.geojson'),
    ('csv', 'out.csv'), ('shapefile', 'out.shp'), ('geopackage', 'out.gpkg'),
    ('flatgeobuf', 'out.fgb'),
]  # fmt: skip
SHIP = '10 20 50 40 46 48 6 28 ship 0\n'
EMPTY = '10 20 10 20 10 20 10 20 ship 0\n'
OTHER = '100 100 100 160 88 160 88 100 tug 0\n'


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / 'labelTxt'
    folder.mkdir()
    (folder / 'P1.txt').write_text(SHIP + OTHER)
    (folder / 'P2.txt').write_text(OTHER)
    return folder


def _expected(source: Path, **parameters: float) -> list[np.ndarray]:
    return [
        convert(OrientedBoxes.from_corners(labels.corners), **parameters)
        for labels in read_labels(source)
    ]


def _run(*arguments: object) -> int:
    return main(['convert', *map(str, arguments)])


@pytest.mark.parametrize(('format_name', 'target'), TARGETS)
def test_every_format_comes_out_with_the_boxes_of_the_converter(
    source: Path, tmp_path: Path, format_name: str, target: str, capsys: pytest.CaptureFixture
) -> None:
    if format_name in {'shapefile', 'geopackage', 'flatgeobuf'}:
        pytest.importorskip('geopandas')
    path = tmp_path / target
    assert _run(source, path, '--to', format_name, '--image-size', 640, 480) == 0
    read = list(read_labels(path, format_name, image_size=(640, 480)))
    for labels, xyxy in zip(read, _expected(source), strict=True):
        np.testing.assert_allclose(labels.reference, xyxy, rtol=0, atol=1e-9)
    assert [each.class_ids for each in read] == [('ship', 'tug'), ('tug',)]
    assert capsys.readouterr().out == (
        '2 images, 3 boxes converted, 0 left out, 0 malformed records skipped\n'
    )


@pytest.mark.parametrize(
    ('name', 'text', 'size'),
    [
        ('a.txt', '0 0.1 0.2 0.5 0.2 0.5 0.3 0.1 0.3\n', (640, 480)),
        ('a.txt', '0 0.3 0.25 0.4 0.1\n', (640, 480)),
        ('a.csv', 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\na,0,s,1,2,9,2,9,4,1,4\n', None),
        ('a.csv', 'image,wkt\na,"POLYGON ((1 2, 9 2, 9 4, 1 4, 1 2))"\n', None),
        (
            'a.xml',
            '<annotation><object><name>s</name><bndbox><xmin>1</xmin><ymin>2</ymin>'
            '<xmax>9</xmax><ymax>4</ymax></bndbox></object></annotation>',
            None,
        ),
        (
            'a.xml',
            '<HRSC_Image><HRSC_Objects><HRSC_Object><mbox_cx>5</mbox_cx><mbox_cy>3</mbox_cy>'
            '<mbox_w>8</mbox_w><mbox_h>2</mbox_h><mbox_ang>0</mbox_ang></HRSC_Object>'
            '</HRSC_Objects></HRSC_Image>',
            None,
        ),
        (
            'a.json',
            '{"images": [{"id": 1, "file_name": "a"}], "annotations": [{"id": 1, "image_id": 1, '
            '"category_id": 1, "bbox": [1, 2, 8, 2]}]}',
            None,
        ),
        (
            'a.json',
            '{"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", '
            '"coordinates": [[[1, 2], [9, 2], [9, 4], [1, 4], [1, 2]]]}}',
            None,
        ),
    ],
    ids=['yolo_obb', 'yolo', 'csv', 'wkt', 'voc', 'hrsc', 'coco', 'geojson'],
)
def test_every_format_goes_in(
    tmp_path: Path, name: str, text: str, size: tuple[int, int] | None
) -> None:
    (tmp_path / name).write_text(text)
    size_options = [] if size is None else ['--image-size', *size]
    assert _run(tmp_path / name, tmp_path / 'out.csv', *size_options) == 0
    (labels,) = read_labels(tmp_path / 'out.csv')
    assert (labels.image, len(labels.class_ids)) == ('a', 1)
    expected = [[64, 96, 320, 144]] if size else [[1, 2, 9, 4]]
    np.testing.assert_allclose(labels.reference, expected, atol=1e-9)


def test_every_parameter_of_the_conversion_counts(source: Path, tmp_path: Path) -> None:
    # The caps bind this one only.
    (source / 'P3.txt').write_text('0 0 100 0 100 30 0 30 ship 0\n')
    path = tmp_path / 'out.csv'
    parameters = {
        'method': 'shape_aware', 'q': 4.0, 'f': 0.9, 's': 1.1, 'max_length': 80, 'max_width': 25,
    }  # fmt: skip
    options = [
        text
        for name, value in parameters.items()
        for text in (f'--{name.replace("_", "-")}', value)
    ]
    assert _run(source, path, *options) == 0
    expected = _expected(source, **parameters)
    for labels, xyxy in zip(read_labels(path), expected, strict=True):
        np.testing.assert_array_equal(labels.reference, xyxy)
    for name in parameters:
        without = _expected(source, **{k: v for k, v in parameters.items() if k != name})
        assert (np.vstack(without) != np.vstack(expected)).any(), name


def test_diagnostics_are_columns(source: Path, tmp_path: Path) -> None:
    path = tmp_path / 'out.csv'
    assert _run(source, path, '--diagnostics', '--max-length', 50) == 0
    with path.open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert [row['capped'] for row in rows] == ['0', '1', '1']
    assert [float(row['length']) for row in rows[1:]] == [60.0, 60.0]
    assert [float(row['width']) for row in rows[1:]] == [12.0, 12.0]
    assert abs(float(rows[1]['theta'])) == pytest.approx(np.pi / 2)
    assert all(0.0 <= float(row[name]) <= 1.0 for row in rows for name in ('t_x', 't_y'))


def test_bad_records_and_boxes_are_reported_counted_and_left_out(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (source / 'P1.txt').write_text(f'{SHIP}1 2 3\n{EMPTY}{OTHER}')
    path = tmp_path / 'out.csv'
    assert _run(source, path) == 0
    printed = capsys.readouterr()
    assert printed.out == (
        '2 images, 3 boxes converted, 1 left out (1 empty), 1 malformed records skipped\n'
    )
    malformed, left_out = printed.err.splitlines()
    assert malformed.startswith(f'{source / "P1.txt"}:2: 3 fields')
    assert left_out == f"{source / 'P1.txt'}: image 'P1': box 2 left out: empty"
    assert _run(source, path, '--strict') == 1
    assert [len(each.class_ids) for each in read_labels(path)] == [2, 1]


def test_nothing_is_written_if_nothing_can_be_read(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    for path in source.iterdir():
        path.write_text('1 2 3\n')
    assert _run(source, tmp_path / 'out.csv', '--from', 'dota') == 1
    assert not (tmp_path / 'out.csv').exists()
    printed = capsys.readouterr()
    assert '0 boxes converted, 0 left out, 2 malformed' in printed.out
    assert 'nothing to convert' in printed.err


def test_images_without_ships_are_valid(source: Path, tmp_path: Path) -> None:
    for path in source.iterdir():
        path.write_text('')
    assert _run(source, tmp_path / 'out.csv', '--strict') == 0
    assert [each.image for each in read_labels(tmp_path / 'out.csv')] == ['P1', 'P2']


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--to', 'dota'], "cannot write axis-aligned boxes as 'dota': use yolo"),
        (['--to', 'yolo', '--diagnostics'], 'cannot hold diagnostics'),
        (['--to', 'yolo'], "image 'P1': yolo needs its size"),
        (['--from', 'papyrus', '--to', 'csv'], "unknown label format 'papyrus'"),
        ([], 'name the label format to write'),
        (['--to', 'csv', '--q', '0.5'], 'q must be 1 to inf'),
        (['--to', 'csv', '--method', 'magic'], 'magic'),
        (['--to', 'csv', '--max-length', '-1'], 'max_length must be positive'),
        (['--to', 'csv', '--image-size', '0', '5'], 'image_size'),
    ],
)
def test_a_wrong_option_prints_one_line_and_writes_no_file(
    source: Path, tmp_path: Path, options: list[str], message: str, capsys: pytest.CaptureFixture
) -> None:
    assert _run(source, tmp_path / 'out', *options) == 1
    printed = capsys.readouterr().err
    assert printed.startswith('obbhbb: ')
    assert message in printed
    assert printed.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_yolo_takes_the_size_from_the_images(source: Path, tmp_path: Path) -> None:
    image = pytest.importorskip('PIL.Image')
    for name in ('P1', 'P2'):
        image.new('L', (200, 200)).save(source / f'{name}.png')
    assert _run(source, tmp_path / 'out', '--to', 'yolo') == 0
    (labels,) = read_labels(tmp_path / 'out' / 'P2.txt', image_size=(200, 200))
    np.testing.assert_allclose(labels.reference, _expected(source)[1])


def test_labels_may_be_converted_in_place(tmp_path: Path) -> None:
    path = tmp_path / 'all.csv'
    path.write_text('image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\na,0,s,1,2,9,2,9,4,1,4\n')
    assert _run(path, path) == 0
    (labels,) = read_labels(path)
    np.testing.assert_allclose(labels.reference, [[1, 2, 9, 4]])


def test_the_command_runs_as_a_program_and_is_quiet_in_a_pipe(source: Path, tmp_path: Path) -> None:
    command = [sys.executable, '-m', 'obbhbb_ros.cli', 'convert', source, tmp_path / 'out.csv']
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ''
    assert done.stdout.startswith('2 images, 3 boxes converted')


def test_a_box_that_overflows_is_left_out_with_the_reason() -> None:
    huge = Box((-1e308, 0, 1e308, 0, 1e308, 1e308, -1e308, 1e308), 'ship')
    labels = LabelFile(Path('x')).image('P1', [huge, Box((0, 0, 4, 0, 4, 2, 0, 2), 'ship', 'b')])
    converted = convert_image(labels, HullRule(s=2.0), diagnostics=True)
    assert converted.boxes.ids == ('b',)
    assert converted.boxes.diagnostics is not None
    assert converted.boxes.diagnostics.length.tolist() == [4.0]
    assert converted.left_out == {0: 'overflow'}


def test_defects_are_counted_by_reason() -> None:
    nan, empty = Box((np.nan,) * 8, 'ship'), Box((1.0,) * 8, 'ship')
    labels = LabelFile(Path('x')).image('P1', [nan, empty, empty])
    lines: list[str] = []
    _, tally = convert_labels([labels], partial(convert_image, rule=HullRule()), lines.append)
    assert tally.left_out == {'not finite': 1, 'empty': 2}
    assert len(lines) == 3


@pytest.mark.parametrize(('part', 'total'), [('', 2), ('P1.txt', None)])
def test_progress_gets_the_images_and_the_number_of_files_of_a_folder(
    source: Path, tmp_path: Path, part: str, total: int | None
) -> None:
    seen: list[object] = []

    def progress(images: Iterable[ImageLabels], count: int | None) -> Iterator[ImageLabels]:
        seen.append(count)
        for image in images:
            seen.append(image.image)
            yield image

    convert_file(
        source / part, tmp_path / 'out.csv', HullRule(), report=seen.append, progress=progress
    )
    assert seen == [total, 'P1', 'P2'][: 3 if total else 2]


def test_a_folder_is_listed_once(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed: list[Path] = []
    iterdir = Path.iterdir

    def listing(folder: Path) -> Iterator[Path]:
        listed.append(folder)
        return iterdir(folder)

    monkeypatch.setattr(Path, 'iterdir', listing)
    assert _run(source, tmp_path / 'out.csv') == 0
    assert listed == [source]


def test_the_bow_may_be_at_the_first_edge_of_every_box(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    # The bow of the first ship is up and to the left; the first edge of the other is a long side.
    path = tmp_path / 'P1.txt'
    path.write_text('0 14 14 0 64 50 50 64 ship 0\n50 20 10 20 10 10 50 10 ship 0\n')
    ends = ('--q-bow', 1, '--q-stern', 'inf')
    assert _run(path, tmp_path / 'out.csv', '--bow', 'first-edge', *ends) == 0
    assert '2 boxes converted (1 with a known bow), 0 left out' in capsys.readouterr().out
    (labels,) = read_labels(tmp_path / 'out.csv')
    np.testing.assert_allclose(labels.reference, [[7, 7, 64, 64], [10, 10, 50, 20]])


def test_the_bow_is_that_of_the_labels(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    ship = '<HRSC_Object>{}<header_x>{}</header_x><header_y>{}</header_y></HRSC_Object>'
    box = ''.join(
        f'<mbox_{name}>{value}</mbox_{name}>'
        for name, value in {'cx': 99, 'cy': 99, 'w': 60, 'h': 20, 'ang': np.pi / 4}.items()
    )
    ships = ship.format(box, 120, 120) + ship.format(box, 78, 78) + ship.format(box, 0, 0)
    path = tmp_path / 'a.xml'
    path.write_text(f'<HRSC_Image><HRSC_Objects>{ships}</HRSC_Objects></HRSC_Image>')
    ends = ('--q', 2, '--q-bow', 1, '--q-stern', 'inf')
    assert _run(path, tmp_path / 'out.csv', '--bow', 'labels', *ends) == 0
    assert '(2 with a known bow)' in capsys.readouterr().out
    (labels,) = read_labels(tmp_path / 'out.csv')
    bow, stern, neither = 30 * 0.5**0.5, 40 * 0.5**0.5, 500**0.5
    expected = [[-stern] * 2 + [bow] * 2, [-bow] * 2 + [stern] * 2, [-neither] * 2 + [neither] * 2]
    np.testing.assert_allclose(labels.reference, 99 + np.array(expected))


def test_ends_without_a_bow_have_no_effect_and_a_warning_says_so(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert _run(source, tmp_path / 'one.csv') == 0
    assert _run(source, tmp_path / 'other.csv', '--q-bow', 1, '--q-stern', 4) == 0
    assert 'no effect without --bow' in capsys.readouterr().err
    assert (tmp_path / 'one.csv').read_text() == (tmp_path / 'other.csv').read_text()


def test_a_conversion_that_fails_leaves_garbage_collection_on(tmp_path: Path) -> None:
    assert _run(tmp_path / 'nowhere.csv', tmp_path / 'out.csv') == 1
    assert gc.isenabled()


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--max-length', '400m', '--max-width', '60'], 'both --max-length and --max-width'),
        (['--max-length', '400 km'], 'a number or metres'),
        (['--max-length', '400m'], 'no reference system'),
    ],
)
def test_caps_that_cannot_be_meant_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    source = tmp_path / 'a.txt'
    source.write_text('10 20 50 20 50 30 10 30 ship 0')
    assert main(['convert', str(source), str(tmp_path / 'a.csv'), *options]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ('names', 'unread'),
    [
        (('a.txt', 'train/b.txt', 'val/deep/c.txt'), ('train', 'val')),
        (('a.txt', 'notes/b.md', '.hidden/b.txt', 'images/b.txt'), ()),
        (('train/b.txt', 'val/c.txt'), ()),
    ],
)
def test_folders_that_are_not_read_beside_labels_are_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    names: tuple[str, ...],
    unread: tuple[str, ...],
) -> None:
    for name in names:
        path = tmp_path / 'in' / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('10 20 50 20 50 30 10 30 ship 0')
    assert main(['convert', str(tmp_path / 'in'), str(tmp_path / 'out.csv')]) == 0
    err = capsys.readouterr().err
    assert err.count('not read') == len(unread)
    assert all(f'{tmp_path / "in" / name}: label files lie beside it' in err for name in unread)
