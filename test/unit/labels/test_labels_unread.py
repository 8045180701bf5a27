# SPDX-License-Identifier: Apache-2.0
"""Formats of other tools that are not read: the error says what the file is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import detect_format
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.documents import json_paths

if TYPE_CHECKING:
    from conftest import Put

RLE = {'counts': 'X`2', 'size': [800, 1000]}
POLY = [303.4, 232.7, 476.6, 332.7, 496.6, 367.3, 323.4, 267.3]
UCAS = '\t'.join(map(str, [*POLY, 30.0, 300, 280, 200, 40]))


@pytest.mark.parametrize(
    ('name', 'content', 'expected'),
    [
        (
            'sa_1.json',
            {
                'image': {'image_id': 1, 'width': 1000, 'height': 800, 'file_name': 'sa_1.jpg'},
                'annotations': [{'segmentation': RLE, 'bbox': [1, 2, 3, 4], 'id': 7}],
            },
            'SA-1B',
        ),
        (
            '1.json',
            {
                'images': {'file_name': '1.jpg', 'id': 1, 'height': 800, 'width': 1000},
                'categories': [{'id': 3, 'name': 'ship'}],
                'annotations': [{'poly': POLY, 'category_id': 3}],
            },
            'SODA-A',
        ),
        (
            'sem_seg_predictions.json',
            [{'file_name': 'a.png', 'category_id': 1, 'segmentation': RLE}],
            'JSON of semantic segmentation',
        ),
        (
            'predictions.json',
            {'images': [{'id': 1}], 'annotations': [{'image_id': 1, 'segments_info': [{'id': 3}]}]},
            'COCO panoptic JSON',
        ),
        ('instances_predictions.pth', 'PK', 'a pickle of Python'),
        ('results.pkl', '\x80', 'a pickle of Python'),
        (
            'c.json',
            [{'image': 'a.jpg', 'annotations': [{'label': 'x', 'coordinates': {'x': 4}}]}],
            'CreateML',
        ),
        (
            'a.json',
            [{'name': 'ship', 'class': 0, 'confidence': 0.75, 'box': {'x1': 152.1, 'y1': 336.2}}],
            'JSON of Ultralytics results',
        ),
        (
            'a.csv',
            'name,class,confidence,box\nship,0,0.75,"{\'x1\': 152.1}"\n',
            'CSV of Ultralytics results',
        ),
        (
            'via.json',
            {'P1.png1758': {'regions': [{'shape_attributes': {'name': 'rect', 'x': 5}}]}},
            'VGG Image Annotator JSON',
        ),
        ('via.json', {'_via_settings': {}, '_via_img_metadata': {'a': {}}}, 'VGG'),
        ('a.json', {'description': '', 'size': {'height': 8}, 'objects': []}, 'Supervisely'),
        ('a.json', {'filename': '/a.jpg', 'annotations': [{'type': 'box'}]}, 'Dataloop'),
        ('a.json', {'file_name': 'a.jpg', 'predictions': [{'bbox': [1, 2, 3, 4]}]}, 'Lightly'),
        ('a.xml', '<annotation>\n<filename>a.jpg</filename>\n<imagesize>', 'LabelMe XML'),
        ('a.xml', '<annotation><object><polygon><pt><x>1</x>', 'LabelMe XML'),
        ('a.json', {'version': '2.0', 'item': {'name': 'a.jpg'}, 'annotations': []}, 'V7 Darwin'),
        ('a.json', {'metadata': {'name': 'a'}, 'instances': []}, 'SuperAnnotate'),
        ('a.json', {'asset': {'name': 'a'}, 'regions': []}, 'VoTT'),
        ('a.csv', 'ImageID,Source,LabelName,Confidence,XMin,XMax,YMin,YMax\n', 'Open Images'),
        ('a.csv', '#filename,file_size,region_shape_attributes\n', 'VGG Image Annotator CSV'),
        ('a.kml', '<kml>', 'KML'),
        ('a.gml', '<x/>', 'GML'),
        ('a.tab', '!table', 'MapInfo'),
        ('a.feather', 'ARROW1', 'Feather'),
        ('a.ndjson', '{}', 'JSON lines'),
        ('a.xml', '<kml xmlns="http://www.opengis.net/kml/2.2">', 'KML'),
        ('a.txt', 'YOLO_OBB\n0 400 300 200 40 30\n', 'labelImg_OBB'),
        ('gt.txt', '1,-1,300.0,280.0,200.0,40.0,1,1,1.0\n', 'MOT'),
        ('gt.txt', '1,1,912,484,97,109,0,7,1\n2,1,912,484,97,109,0,7,0.5\n', 'MOT'),
        ('det.txt', '1,-1,794,247,71,174,1,-1,-1,-1\n', 'MOT'),
        ('a.txt', 'ship 0.0 0 -1 300 280 500 320 -1 -1 -1 -1 -1 -1 -1 1.0\n', 'KITTI'),
        ('P0001.txt', f'{UCAS}\n', 'UCAS-AOD'),
        ('a.txt', '0 303.4 232.7 476.6 332.7 496.6 367.3 323.4 267.3\n', 'YOLO-OBB in pixels'),
        ('a.txt', '0 303 232 477 332 497 367 324 267 0.9\n', 'YOLO-OBB in pixels'),
        ('a.txt', '14 303 232 477 332 497 367 324 267 0.9 3\n', 'YOLO-OBB in pixels'),
        ('a.txt', '0 0.1 0.2 0.5 0.2 0.5 0.3\n', 'YOLO of three points, or of a box and a key'),
        ('a.txt', '0 0.3 0.2 0.05 0.02 0.31 0.21 0.98\n', 'YOLO of three points'),
    ],
)
def test_an_unread_format_is_refused_by_its_name(
    put: Put, name: str, content: object, expected: str
) -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    path = put(name, text)
    with pytest.raises(ValueError, match=f'{expected}.*, which is not read: ') as caught:
        detect_format(path)
    assert str(caught.value).startswith(f'{path}: ')


@pytest.mark.parametrize(
    ('name', 'text', 'message'),
    [
        ('a.json', '{"b": {"x": [1]}, "a": 2}', 'a JSON object with a, b: use'),
        ('a.json', '{}', 'a JSON object with no members: use'),
        ('a.json', '[{"u": {"x": [1]}, "v": 2}]', 'a JSON array of objects with u, v: use'),
        ('a.json', '[1, [2]]', 'a JSON array: use'),
        (
            'a.xml',
            '<?xml version="1.0"?><!-- a -->\n<html lang="en"><p>',
            'XML with the root <html>',
        ),
        ('a.json', f'{{"{"n" * 999}": 1}}', f'with {"n" * 60}: use'),
    ],
)
def test_a_file_of_an_unknown_format_is_described(
    put: Put, name: str, text: str, message: str
) -> None:
    with pytest.raises(ValueError, match='cannot detect the label format: ') as caught:
        detect_format(put(name, text))
    assert message in str(caught.value)


def test_an_unread_file_beside_label_files_is_not_in_the_way(put: Put, tmp_path: Path) -> None:
    put('a.txt', '2753 2408 2861 2385 2888 2468 2805 2502 ship 0\n')
    put('gt.txt', '1,-1,300.0,280.0,200.0,40.0,1,1,1.0\n')
    put('via.json', '{"_via_img_metadata": {}}')
    assert detect_format(tmp_path) == 'dota'


@pytest.mark.parametrize(
    ('format_name', 'text', 'message'),
    [
        ('coco', '{"_via_img_metadata": {}}', 'VGG Image Annotator JSON, which is not read: '),
        (
            'coco',
            '{"categories": {}, "items": [',
            '(it looks like datumaro)',
        ),
        ('datumaro', '{"images": [], "annotations": []}', "no array 'items' (it looks like coco)"),
        ('coco', '{"images": [], "annotations": {}}', "not COCO: no array 'annotations'"),
    ],
)
def test_a_file_of_another_format_than_the_named_one_is_called_what_it_is(
    put: Put, format_name: str, text: str, message: str
) -> None:
    errors: list[LabelError] = []
    assert list(read_labels(put('a.json', text), format_name, on_error=errors.append)) == []
    assert [message in error.message for error in errors] == [True]


@pytest.mark.parametrize('line', ['10,20,50,20,50,30,10,30,3\n', '0,0,9,0,9,4,0,4,5\n'])
def test_dota_with_commas_is_not_taken_for_mot(put: Put, line: str) -> None:
    assert detect_format(put('a.txt', line)) == 'dota'


def test_json_paths_tell_what_a_document_consists_of() -> None:
    head = '{"info": "a]{\\"b", "images": [{"id": 1, "size": [2, 3]}], "an'
    assert json_paths(head) == {
        '{', '{info', '{images', '{images[', '{images[{', '{images[{id', '{images[{size',
        '{images[{size[', '{an',
    }  # fmt: skip


DOCUMENTS = st.recursive(
    st.none() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
)


@given(DOCUMENTS, st.data())
def test_json_paths_never_fail_and_grow_with_the_head(
    document: object, data: st.DataObject
) -> None:
    text = json.dumps(document, ensure_ascii=False)
    cut = data.draw(st.integers(0, len(text)))
    whole = json_paths(text)
    assert {path for path in json_paths(text[:cut]) if path[-1] in '{['} <= whole | {'{', '['}
    expected = {list: '[', dict: '{'}.get(type(document))
    assert (expected in whole) == (expected is not None)
