# SPDX-License-Identifier: Apache-2.0
"""What labels say beyond the boxes: written again, or counted as lost."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import Put

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.axis_aligned import convert_file

convert = partial(convert_file, rule=HullRule(), report=print)

COCO: dict[str, Any] = {
    'images': [
        {'id': 42, 'file_name': 'b.png', 'width': 64, 'height': 48},
        {'id': 17, 'file_name': 'a.png', 'width': 64, 'height': 48},
    ],
    'categories': [{'id': 8, 'name': 'tug'}, {'id': 3, 'name': 'ship'}, {'id': 9, 'name': 'buoy'}],
    'annotations': [
        {
            'id': 101, 'image_id': 42, 'category_id': 8, 'bbox': [10, 10, 20, 20], 'iscrowd': 1,
            'mmsi': 219000001, 'attributes': {'occluded': True}, 'score': 0.5,
        },
        {'id': 7, 'image_id': 17, 'category_id': 3, 'bbox': [10, 10, 9, 9], 'time': '12:00'},
    ],
}  # fmt: skip


def _without_losses(path: Path, target: Path) -> dict[str, Any]:
    tally = convert(path, target, target_format='coco')
    assert (tally.boxes, tally.losses) == (2, '')
    document: dict[str, Any] = json.loads(target.read_text())
    return document


def test_coco_keeps_ids_unused_categories_crowds_and_other_members(put: Put) -> None:
    path = put('in.json', json.dumps(COCO))
    written = _without_losses(path, path.with_name('out.json'))
    assert written['images'] == COCO['images']
    assert written['categories'] == COCO['categories']
    kept = ('id', 'image_id', 'category_id', 'mmsi', 'attributes', 'time')
    for before, after in zip(COCO['annotations'], written['annotations'], strict=True):
        assert {key: after[key] for key in kept if key in after} == {
            key: before[key] for key in kept if key in before
        }
        assert after['iscrowd'] == before.get('iscrowd', 0)


def test_a_class_that_coco_does_not_list_gets_a_free_id(put: Put) -> None:
    path = put('in.csv', 'image,class,instance,x_min,y_min,x_max,y_max\na,ship,1,2,3,4,5\n')
    convert(path, path.with_name('out.json'), target_format='coco')
    written = json.loads(path.with_name('out.json').read_text())
    assert written['categories'] == [{'id': 1, 'name': 'ship'}]


def test_ids_that_contradict_are_numbered_anew_and_counted(put: Put) -> None:
    put('in/a.json', json.dumps(COCO))
    other = json.loads(json.dumps(COCO).replace('"id": 3', '"id": 4').replace('_id": 3', '_id": 4'))
    folder = put('in/b.json', json.dumps(other)).parent
    tally = convert(folder, folder.with_name('out.json'), target_format='coco')
    written = json.loads(folder.with_name('out.json').read_text())
    assert [image['id'] for image in written['images']] == [1, 2, 3, 4]
    assert [entry['id'] for entry in written['categories']] == [1, 2, 3]
    assert 'image ids' in tally.losses
    assert 'category ids' in tally.losses


@pytest.mark.parametrize(
    ('target', 'losses'),
    [
        (
            'yolo',
            '2 ids, 1 crowd mark, 2 image sizes, 2 image ids, '
            '3 properties (mmsi, attributes, time), 3 category ids (tug, ship, buoy)',
        ),
        (
            'voc',
            '1 score, 2 ids, 1 crowd mark, 2 image ids, '
            '3 properties (mmsi, attributes, time), 3 category ids (tug, ship, buoy)',
        ),
    ],
)
def test_what_a_format_cannot_hold_is_counted(put: Put, target: str, losses: str) -> None:
    path = put('in.json', json.dumps(COCO))
    tally = convert(path, path.with_name('out'), target_format=target)
    assert tally.losses == f'{target}: {losses}'
    assert str(tally).splitlines()[1] == f'not held by {target}: {losses}'


@pytest.mark.parametrize('member', ['mmsi', 'iscrowd', 'difficulty'])
def test_members_that_cannot_be_understood_are_reported(put: Put, member: str) -> None:
    nested: Any = 7.5
    for _ in range(40):
        nested = [nested]
    annotation = COCO['annotations'][1] | {member: nested}
    path = put('in.json', json.dumps(COCO | {'annotations': [annotation]}))
    with pytest.raises(ValueError, match=rf'annotations\[0\]: .*{member}'):
        list(read_labels(path))


@pytest.mark.parametrize('difficulty', ['0', '1', '2'])
def test_the_difficulty_of_dota_is_kept(put: Put, difficulty: str) -> None:
    path = put('a.txt', f'10 20 50 20 50 30 10 30 ship {difficulty}\n')
    write_labels(path.with_name('out'), read_labels(path), 'dota')
    written = path.with_name('out') / 'a.txt'
    assert written.read_text().split()[-1] == difficulty
    convert(path, path.with_name('voc'), target_format='voc')
    assert f'<difficult>{difficulty}</difficult>' in (path.with_name('voc') / 'a.xml').read_text()


def test_voc_keeps_difficult_and_the_name_of_the_image_file(put: Put) -> None:
    path = put(
        'a.xml',
        '<annotation><filename>a.jpg</filename><object><name>ship</name><difficult>1</difficult>'
        '<bndbox><xmin>1</xmin><ymin>2</ymin><xmax>3</xmax><ymax>4</ymax></bndbox></object>'
        '</annotation>',
    )
    tally = convert(path, path.with_name('voc'), target_format='voc')
    assert tally.losses == ''
    written = (path.with_name('voc') / 'a.xml').read_text()
    assert '<filename>a.jpg</filename>' in written
    assert '<difficult>1</difficult>' in written


def test_the_difficulty_of_hrsc_is_read(put: Put) -> None:
    path = put(
        'a.xml',
        '<HRSC_Image><HRSC_Objects><HRSC_Object><difficult>1</difficult><box_xmin>1</box_xmin>'
        '<box_ymin>2</box_ymin><box_xmax>3</box_xmax><box_ymax>4</box_ymax></HRSC_Object>'
        '</HRSC_Objects></HRSC_Image>',
    )
    (labels,) = read_labels(path)
    assert labels.difficulties == [1]


def test_what_coco_says_besides_is_counted(put: Put) -> None:
    document = {
        'info': {'year': 2026},
        'licenses': [],
        'images': [{'id': 1, 'file_name': 'a.png', 'license': 2, 'coco_url': ''}],
        'categories': [{'id': 1, 'name': 'ship', 'supercategory': 'vessel'}],
        'annotations': [{'id': 1, 'image_id': 1, 'category_id': 1, 'bbox': [1, 2, 3, 4]}],
    }
    path = put('in.json', json.dumps(document))
    tally = convert(path, path.with_name('out.json'), target_format='coco')
    assert tally.losses == (
        'coco: 3 other members (info, images.license, categories.supercategory)'
    )


@pytest.mark.parametrize(
    ('pose', 'properties'), [('Left', {'pose': ('Left',)}), ('Unspecified', {})]
)
def test_the_pose_of_voc_is_a_property_unless_it_is_unspecified(
    put: Put, pose: str, properties: dict[str, tuple[str]]
) -> None:
    bounds = '<bndbox><xmin>1</xmin><ymin>2</ymin><xmax>3</xmax><ymax>4</ymax></bndbox>'
    ship = f'<name>ship</name><pose>{pose}</pose><truncated>0</truncated>{bounds}'
    path = put('a.xml', f'<annotation><object>{ship}</object></annotation>')
    (labels,) = read_labels(path)
    assert labels.extras.properties == properties
    tally = convert(path, path.with_name('out'), target_format='voc')
    assert tally.losses == ('voc: 1 property (pose)' if properties else '')
