# SPDX-License-Identifier: Apache-2.0
"""Axis-aligned labels as other tools read them: numbers of classes, borders, variants."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import ImageBoxes
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_boxes
from obbhbb_ros.labels.axis_aligned import LabelTally
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.axis_aligned import convert_image

if TYPE_CHECKING:
    from conftest import Put

SIZE = (128, 64)
SHIP = '10 20 50 20 50 30 10 30 ship 0\n'
TUG = SHIP.replace('ship', 'tug')
YOLO_OBB = '{} 0.1 0.2 0.3 0.2 0.3 0.4 0.1 0.4\n'


def _convert(source: Path, target: Path, name: str = 'yolo', **options: Any) -> LabelTally:
    return convert_file(
        source, target, HullRule('outer'), target_format=name, image_size=SIZE, report=print,
        **options,
    )  # fmt: skip


def _numbers(path: Path) -> list[str]:
    return [line.split()[0] for line in path.read_text().splitlines()]


def test_yolo_numbers_classes_by_name(put: Put, tmp_path: Path) -> None:
    folder = put('d/P1.txt', TUG + SHIP).parent
    _convert(folder, tmp_path / 'out')
    assert _numbers(tmp_path / 'out/P1.txt') == ['1', '0']


def test_yolo_keeps_the_numbers_of_its_source(put: Put, tmp_path: Path) -> None:
    put('data.yaml', 'names: {0: tug, 2: ship, 3: buoy}\n')
    folder = put('labels/P1.txt', YOLO_OBB.format(2)).parent
    _convert(folder, tmp_path / 'out')
    assert _numbers(tmp_path / 'out/P1.txt') == ['2']
    (labels,) = read_labels(tmp_path / 'out', image_size=SIZE)
    assert labels.class_ids == ('ship',)
    assert labels.extras.label_set.class_names == ('tug', '', 'ship', 'buoy')


def test_yolo_numbers_the_categories_of_coco_by_id_also_unused_ones(
    put: Put, tmp_path: Path
) -> None:
    categories = [{'id': number, 'name': name} for number, name in ((9, 'a'), (3, 'c'), (5, 'b'))]
    box = {'id': 1, 'image_id': 1, 'category_id': 9, 'bbox': [1, 2, 3, 4]}
    document = {
        'images': [{'id': 1, 'file_name': 'P1.png'}], 'categories': categories,
        'annotations': [box],
    }  # fmt: skip
    _convert(put('all.json', json.dumps(document)), tmp_path / 'out')
    assert _numbers(tmp_path / 'out/P1.txt') == ['2']


@pytest.mark.parametrize(
    ('target', 'files', 'train', 'val'),
    [
        ('out', {'P1.txt', 'data.yaml'}, '.', '.'),
        ('out/labels', {'labels/P1.txt', 'data.yaml', 'classes.txt'}, 'images', 'images'),
        (
            'out/labels/val',
            {'labels/val/P1.txt', 'labels/train/P0.txt', 'data.yaml', 'classes.txt'},
            '"images/train"',
            '"images/val"',
        ),
    ],
)
def test_data_yaml_is_where_ultralytics_needs_it(
    put: Put, tmp_path: Path, target: str, files: set[str], train: str, val: str
) -> None:
    folder = put('d/P1.txt', SHIP).parent
    if target.endswith('val'):
        put('out/labels/train/P0.txt', '')
    _convert(folder, tmp_path / target)
    out = tmp_path / 'out'
    assert {str(path.relative_to(out)) for path in out.rglob('*.*')} == files
    lines = (out / 'data.yaml').read_text().splitlines()
    assert lines[1:] == [f'train: {train}', f'val: {val}', 'names:', '  0: "ship"']
    read = list(read_labels(tmp_path / target, image_size=SIZE))
    assert [labels.class_ids for labels in read] == [('ship',)]


def test_classes_keep_their_number_in_another_part(put: Put, tmp_path: Path) -> None:
    first, second = put('a/P1.txt', TUG).parent, put('b/P2.txt', SHIP + TUG).parent
    _convert(first, tmp_path / 'out/labels/train')
    _convert(second, tmp_path / 'out/labels/val')
    assert _numbers(tmp_path / 'out/labels/val/P2.txt') == ['1', '0']
    assert (tmp_path / 'out/classes.txt').read_text() == 'tug\nship\n'
    assert '  0: "tug"\n  1: "ship"\n' in (tmp_path / 'out/data.yaml').read_text()


def test_a_data_yaml_of_somebody_else_stays(put: Put, tmp_path: Path) -> None:
    text = '# mine\nnames: [buoy, ship]\n'
    path = put('out/data.yaml', text)
    _convert(put('a/P1.txt', SHIP).parent, path.parent)
    assert _numbers(path.parent / 'P1.txt') == ['1']
    with pytest.raises(ValueError, match=r"data\.yaml: class 'tug' is missing there"):
        _convert(put('b/P2.txt', TUG).parent, path.parent)
    assert path.read_text() == text
    assert not (path.parent / 'P2.txt').exists()


@given(st.text(min_size=1).filter(lambda name: [name] == name.strip().splitlines()))
def test_any_name_of_a_class_reads_back(
    tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    folder = tmp_path_factory.mktemp('names')
    names = (name, 'a ship')
    boxes = ImageBoxes(
        'P1', np.array([[1.0, 2.0, 3.0, 4.0]] * 2), names, ('', ''), np.ones(2), SIZE, Path('a')
    )
    write_boxes(folder, [boxes], 'yolo')
    (labels,) = read_labels(folder, image_size=SIZE)
    assert labels.class_ids == names


def test_yolo_is_cut_at_the_border_and_that_is_said(put: Put, tmp_path: Path) -> None:
    across, outside = '100 20 150 20 150 30 100 30 ship 0\n', '130 20 150 20 150 30 130 30 ship 0\n'
    tally = _convert(put('d/P1.txt', SHIP + across + outside).parent, tmp_path / 'out')
    assert (tally.boxes, tally.cut, tally.left_out) == (2, 1, {'outside the image': 1})
    assert '1 cut at the border of the image' in str(tally)
    assert not tally.complete
    (labels,) = read_labels(tmp_path / 'out', image_size=SIZE)
    np.testing.assert_allclose(labels.reference, [[10, 20, 50, 30], [100, 20, 128, 30]])


@pytest.mark.parametrize('name', ['voc', 'coco'])
def test_other_formats_are_not_cut(put: Put, tmp_path: Path, name: str) -> None:
    tally = _convert(
        put('d/P1.txt', '100 20 150 20 150 30 100 30 ship 0\n').parent, tmp_path / 'o', name
    )
    assert (tally.boxes, tally.cut) == (1, 0)


def test_nothing_is_written_if_all_boxes_are_outside(put: Put, tmp_path: Path) -> None:
    folder = put('d/P1.txt', '130 20 150 20 150 30 130 30 ship 0\n').parent
    assert not _convert(folder, tmp_path / 'out').readable
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('variant', 'bounds'),
    [
        (None, ['10.25', '20.5', '50.25', '30.0']),
        ('integers', ['10', '20', '51', '30']),
        ('one-based', ['11.25', '21.5', '50.25', '30.0']),
        ('devkit', ['11', '21', '51', '30']),
    ],
)
def test_voc_in_other_pixels(
    put: Put, tmp_path: Path, variant: str | None, bounds: list[str]
) -> None:
    folder = put('d/P1.txt', '10.25 20.5 50.25 20.5 50.25 30 10.25 30 ship 0\n').parent
    _convert(folder, tmp_path / 'out', 'voc', variant=variant)
    (box,) = ElementTree.parse(tmp_path / 'out/P1.xml').getroot().iter('bndbox')
    assert [node.text for node in box] == bounds


def test_coco_with_rectangles_as_segmentation(put: Put, tmp_path: Path) -> None:
    folder, target = put('d/P1.txt', SHIP + TUG).parent, tmp_path / 'out.json'
    _convert(folder, target, 'coco', variant='rectangles')
    first, _ = json.loads(target.read_text())['annotations']
    assert first['segmentation'] == [[10, 20, 50, 20, 50, 30, 10, 30]]
    (labels,) = read_labels(target)
    np.testing.assert_array_equal(labels.reference, [[10, 20, 50, 30]] * 2)
    assert labels.hulls == (None, None)


def test_boxes_are_written_as_a_variant_from_python(put: Put, tmp_path: Path) -> None:
    (labels,) = read_labels(put('P1.txt', SHIP))
    boxes = [convert_image(labels, HullRule('outer')).boxes]
    write_boxes(tmp_path / 'a.json', boxes, 'coco', variant='rectangles')
    (annotation,) = json.loads((tmp_path / 'a.json').read_text())['annotations']
    assert annotation['segmentation'] == [[10, 20, 50, 20, 50, 30, 10, 30]]
    with pytest.raises(ValueError, match="'csv' has no variant 'rectangles': it has none"):
        write_boxes(tmp_path / 'a.csv', boxes, variant='rectangles')


def test_an_unknown_variant_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'voc' has no variant 'rectangles': it has integers, one"):
        _convert(tmp_path / 'missing', tmp_path / 'out', 'voc', variant='rectangles')
