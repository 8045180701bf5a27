# SPDX-License-Identifier: Apache-2.0
"""Telling the format of a path."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import detect_format
from obbhbb_ros.labels import read_labels

if TYPE_CHECKING:
    from conftest import Put

DOTA = '2753 2408 2861 2385 2888 2468 2805 2502 ship 0\n'
YOLO = '0 0.780811 0.743961 0.782371 0.74686 0.777691 0.752174 0.776131 0.749758\n'
CSV = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\n'


def test_the_registry_has_every_format_under_its_own_name() -> None:
    assert list(FORMATS) == [
        'dota', 'dota_results', 'yolo_obb', 'yolo', 'csv', 'wkt', 'hrsc', 'voc', 'cvat', 'fair1m',
        'coco', 'coco_results', 'datumaro', 'geojson', 'labelme', 'label_studio', 'ultralytics',
        'shapefile', 'geopackage', 'flatgeobuf', 'parquet',
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
    ('name', 'text', 'problem'),
    [
        ('a.txt', 'ship\n', "the first line is 'ship'"),
        ('a.txt', '0 0.5 0.5 0.1\n', "the first line is '0 0.5 0.5 0.1'"),
        (
            'a.txt',
            '\n10 20 50 20 50 30 10 30 ground track field 0\n',
            "the first line is '10 20 50 20",
        ),
        ('a.txt', f'{DOTA}{YOLO}', r'it fits dota \(.txt\), yolo_obb \(.txt\), name one of them'),
        ('a.csv', 'image,what\n', "the first line is 'image,what'"),
        ('a.csv', CSV.replace(',', ';'), 'separated by semicolons: separate the columns by commas'),
        ('a.csv', CSV.replace(',', '\t'), 'separated by tabs: separate the columns by commas'),
        ('a.csv', CSV.encode('utf-16'), 'UTF-16 text: save it as UTF-8'),
        ('a.csv', gzip.compress(CSV.encode(), mtime=0), 'gzip-compressed: unpack it'),
        ('a.txt', b'PK\x03\x04', 'a ZIP archive: unpack it'),
        ('a.xml', '<html>', 'XML with the root <html>'),
        ('a.json', '{}', 'a JSON object with no members'),
        ('labels', DOTA, "the first line is '2753"),
    ],
)
def test_an_undetectable_format_is_an_error_that_says_what_the_file_is(
    put: Put, name: str, text: str | bytes, problem: str
) -> None:
    path = put(name, text)
    expected = rf'cannot detect the label format: {problem}.*: use dota \(\.txt\).*yolo_obb.*csv'
    with pytest.raises(ValueError, match=expected) as caught:
        detect_format(path)
    assert str(caught.value).startswith(f'{path}: ')


@pytest.mark.parametrize('name', ['a.csv', 'a.txt', 'a.json', 'a.geojson'])
@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (gzip.compress(b'x' * 1000, mtime=0), 'gzip-compressed'),
        (CSV.encode('utf-16-le').join((b'\xff\xfe', b'')), 'UTF-16 text'),
    ],
)
def test_a_packed_file_is_refused_by_every_reader(
    put: Put, name: str, content: bytes, message: str
) -> None:
    path = put(name, content)
    for format_name, entry in FORMATS.items():
        if path.suffix in entry.suffixes:
            errors: list[LabelError] = []
            assert list(read_labels(path, format_name, on_error=errors.append)) == []
            (error,) = errors
            assert (error.path, error.line) == (path, None)
            assert message in error.message


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


YOLO_IMAGE = '0 0.5 0.5 0.1 0.1\n'
VOC = '<annotation><object><name>ship</name></object></annotation>'


@pytest.mark.parametrize(
    ('files', 'expected', 'format_name'),
    [
        (
            {'labels/train/b.txt': YOLO, 'labels/val/a.txt': YOLO, 'train.txt': './images/b.png\n',
             'data.yaml': '', 'images/train/b.txt': 'ship'},
            ['labels/train/b.txt', 'labels/val/a.txt'], 'yolo_obb',
        ),
        (
            {'obj_train_data/b.txt': YOLO_IMAGE, 'train.txt': 'data/obj_train_data/a.PNG\n',
             'obj_val_data/a.txt': YOLO_IMAGE, 'obj.names': 'ship', 'obj.data': ''},
            ['obj_train_data/b.txt', 'obj_val_data/a.txt'], 'yolo',
        ),
        (
            {'labels/a.txt': YOLO, 'classes.txt': 'ship', 'notes.json': '{"categories": []}'},
            ['labels/a.txt'], 'yolo_obb',
        ),
        (
            {'Annotations/a.xml': VOC, 'ImageSets/Main/train.txt': 'a\n', 'labelmap.txt': '# x'},
            ['Annotations/a.xml'], 'voc',
        ),
        ({'labelTxt/a.txt': DOTA, 'images/a.txt': ''}, ['labelTxt/a.txt'], 'dota'),
        ({'train/labelTxt-v1.5/a.txt': DOTA}, ['train/labelTxt-v1.5/a.txt'], 'dota'),
        (
            {'train/labels/a.txt': YOLO, 'valid/labels/b.txt': YOLO, 'README.roboflow.txt': 'x y'},
            ['train/labels/a.txt', 'valid/labels/b.txt'], 'yolo_obb',
        ),
        (
            {'a.txt': DOTA, 'README.txt': 'x', 'license.txt': 'x', 'deep/b.txt': DOTA},
            ['a.txt'], 'dota',
        ),
    ],
    ids=[
        'Ultralytics', 'Darknet', 'Label Studio', 'Pascal VOC', 'DOTA', 'DOTA parts', 'Roboflow',
        'labels',
    ],
)  # fmt: skip
def test_the_root_that_a_tool_exports_is_read_as_it_is(
    put: Put, tmp_path: Path, files: dict[str, str], expected: list[str], format_name: str
) -> None:
    for name, content in files.items():
        put(name, content)
    assert detect_format(tmp_path) == format_name
    images = read_labels(tmp_path, image_size=(9, 9), on_error=lambda _: None)
    assert [image.source for image in images] == [tmp_path / name for name in expected]


def test_a_root_with_two_folders_of_labels_needs_one_of_them_named(
    put: Put, tmp_path: Path
) -> None:
    put('labelTxt-v1.0/a.txt', DOTA)
    put('labelTxt-v1.5/a.txt', DOTA)
    with pytest.raises(LabelError, match=r'labelTxt-v1\.0 and labelTxt-v1\.5: name one of them'):
        detect_format(tmp_path)


def test_labels_are_not_searched_for_too_deep(put: Put, tmp_path: Path) -> None:
    put('a/b/c/d/a.txt', DOTA)
    with pytest.raises(LabelError, match='no label file in this folder or below'):
        detect_format(tmp_path)
