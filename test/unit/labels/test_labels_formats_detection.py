# SPDX-License-Identifier: Apache-2.0
"""Telling the format of a path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import detect_format

if TYPE_CHECKING:
    from conftest import Put

DOTA = '2753 2408 2861 2385 2888 2468 2805 2502 ship 0\n'
YOLO = '0 0.780811 0.743961 0.782371 0.74686 0.777691 0.752174 0.776131 0.749758\n'
CSV = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\n'


def test_the_registry_has_every_format_under_its_own_name() -> None:
    assert list(FORMATS) == [
        'dota', 'yolo_obb', 'yolo', 'csv', 'wkt', 'hrsc', 'voc', 'cvat', 'fair1m', 'coco',
        'coco_results', 'datumaro', 'geojson', 'labelme', 'label_studio', 'ultralytics',
        'shapefile',
    ]  # fmt: skip
    for name, entry in FORMATS.items():
        assert entry.name == name
        assert entry.summary
        assert all(suffix == suffix.lower() and suffix[0] == '.' for suffix in entry.suffixes)


@pytest.mark.parametrize(
    ('name', 'text', 'expected'),
    [
        ('a.txt', DOTA, 'dota'),
        ('a.txt', DOTA.replace(' 0\n', '\n'), 'dota'),
        ('a.txt', DOTA.replace(' ', ', '), 'dota'),
        ('a.txt', f'imagesource:GoogleEarth\ngsd:0.146343590398\n{DOTA}', 'dota'),
        ('a.txt', 'gsd:null\n', 'dota'),
        ('a.txt', '0.1 0.2 0.5 0.2 0.5 0.3 0.1 0.3 ship 0\n', 'dota'),
        ('a.txt', DOTA.replace('ship', '3'), 'dota'),
        ('a.txt', '0 0 9 0 9 4 0 4 5 0\n', 'dota'),
        ('a.txt', '0 2 0 -1 1 1 1 1 2\n', 'yolo_obb'),
        ('a.txt', YOLO, 'yolo_obb'),
        ('a.txt', YOLO.replace('\n', ' 0.93\n'), 'yolo_obb'),
        ('a.txt', YOLO.replace('\n', ' 0.93 17\n'), 'yolo_obb'),
        ('a.txt', '14 -0.05 0 1 0 1 1 -0.05 1\n', 'yolo_obb'),
        ('a.TXT', f'\n\n  \n{YOLO}', 'yolo_obb'),
        ('a.txt', f'\ufeff{YOLO}', 'yolo_obb'),
        ('a.csv', CSV, 'csv'),
        ('a.CSV', f'\ufeff\n{CSV}', 'csv'),
        ('a.csv', 'image,instance,class,score,x_min,y_min,x_max,y_max\n', 'csv'),
        ('a.csv', '"Geometry",class\n', 'wkt'),
        ('a.txt', '0 0.5 0.5 0.1 0.1\n', 'yolo'),
        ('a.txt', '0 0.5 0.5 0.1 0.1 0.93 4\n', 'yolo'),
        ('a.xml', '<?xml version="1.0"?>\n<HRSC_Image>\n', 'hrsc'),
        ('a.xml', '<annotation verified="no">\n', 'voc'),
        ('a.xml', '<annotations>\n<version>1.1</version>', 'cvat'),
        ('a.xml', '<annotation><source/><objects><object>', 'fair1m'),
        ('a.json', '{"info": {}, "licenses": [], "images": [', 'coco'),
        ('a.json', '{"annotations": [{"image_id": 1', 'coco'),
        ('a.json', '[{"image_id": 1, "category_id": 1, "bbox": [', 'coco_results'),
        ('a.json', '{"infos": {}, "categories": {"label": {}}, "items": [', 'datumaro'),
        ('a.json', '{"type": "FeatureCollection", "features": [', 'geojson'),
        ('a.geojson', '{}', 'geojson'),
        ('a.json', '{"version": "6.3.1", "flags": {}, "shapes": [', 'labelme'),
        ('a.json', '[{"id": 1, "annotations": [{"result": [', 'label_studio'),
        ('a.json', '[{"id": 1, "image": "a.png", "annotation_id": 1,', 'label_studio'),
        ('a.json', '[{"poly": [{"points": [], "original_width": 9}], "id": 1,', 'label_studio'),
        ('a.json', '[{"image": "a.png", "label": [{"x": 1, "original_width": 9}', 'label_studio'),
        ('a.csv', '"annotation_id",annotator,id,image,label,lead_time\n', 'label_studio'),
        ('a.tsv', 'annotation_id\tannotator\tid\timage\tlabel\tlead_time\n', 'label_studio'),
        ('a.json', '[{"image_id": "a", "score": 0.9, "rbox": [', 'ultralytics'),
        ('a.shp', '\x00\x00\x27\x0a', 'shapefile'),
        ('a.csv', '', 'csv'),
    ],
)
def test_a_format_is_detected_by_suffix_and_content(
    put: Put, name: str, text: str, expected: str
) -> None:
    assert detect_format(put(name, text)) == expected


def test_a_blank_file_has_the_first_format_of_its_suffix(put: Put) -> None:
    assert detect_format(put('a.txt', '\n')) == 'dota'


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('a.txt', 'ship\n'),
        ('a.txt', '0 0.5 0.5 0.1\n'),
        ('a.txt', f'{DOTA}{YOLO}'),
        ('a.csv', 'image,what\n'),
        ('a.xml', '<html>'),
        ('a.json', '{}'),
        ('labels', DOTA),
    ],
    ids=['words', 'too few numbers', 'both', 'other table', 'other XML', 'other JSON', 'no suffix'],
)
def test_an_undetectable_format_is_an_error_with_the_path_and_all_formats(
    put: Put, name: str, text: str
) -> None:
    path = put(name, text)
    with pytest.raises(ValueError, match=r'cannot detect.*dota \(\.txt\).*yolo_obb.*csv') as caught:
        detect_format(path)
    assert str(path) in str(caught.value)


def test_the_first_file_with_a_detectable_format_decides_for_a_folder(
    put: Put, tmp_path: Path
) -> None:
    put('a.txt', '')
    put('b.txt', 'train/a.png\n')
    put('c.txt', YOLO)
    put('classes.txt', 'ship\n')
    put('results.csv', 'epoch,loss\n')
    assert detect_format(str(tmp_path)) == 'yolo_obb'


def test_a_folder_of_blank_files_and_classes_txt_has_a_format(put: Put, tmp_path: Path) -> None:
    put('a.txt', '')
    put('classes.txt', 'ship\n')
    assert detect_format(tmp_path) == 'dota'


def test_a_folder_of_several_formats_needs_a_name(put: Put, tmp_path: Path) -> None:
    put('a.txt', DOTA)
    put('all.csv', CSV)
    with pytest.raises(ValueError, match='more than one label format') as caught:
        detect_format(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_a_folder_of_unknown_text_is_refused(put: Put, tmp_path: Path) -> None:
    put('a.txt', 'hello\n')
    put('b.txt', '')
    with pytest.raises(ValueError, match='cannot detect'):
        detect_format(tmp_path)


def test_a_folder_without_label_files_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LabelError, match='no label file'):
        detect_format(tmp_path)


def test_a_missing_path_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match='nowhere'):
        detect_format(tmp_path / 'nowhere')
