# SPDX-License-Identifier: Apache-2.0
"""Sizes and file names that labels lack, from the images beside them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any
from xml.etree import ElementTree

import pytest

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels.axis_aligned import convert_file

if TYPE_CHECKING:
    from conftest import Put

Image = pytest.importorskip('PIL.Image')

SHIP = '10 20 50 20 50 30 10 30 ship 0\n'
VOC = '<annotation><filename>{}</filename></annotation>'


def _picture(path: Path, size: tuple[int, int] = (128, 64)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new('L', size).save(path)


def _coco(source: Path, **options: Any) -> tuple[dict[str, Any], list[str]]:
    notes: list[str] = []
    target = source.with_name('out.json')
    convert_file(source, target, HullRule(), target_format='coco', report=notes.append, **options)
    document: dict[str, Any] = json.loads(target.read_text())
    return document, notes


def _voc(source: Path) -> ElementTree.Element:
    target = source.with_name('annotations')
    convert_file(source, target, HullRule(), target_format='voc', report=pytest.fail)
    (path,) = target.iterdir()
    return ElementTree.parse(path).getroot()


@pytest.mark.parametrize(
    ('labels', 'image'), [('d/P1.txt', 'd/P1.png'), ('labels/P1.txt', 'images/P1.JPG')]
)
def test_coco_has_size_and_suffix_of_the_image(
    put: Put, tmp_path: Path, labels: str, image: str
) -> None:
    folder = put(labels, SHIP).parent
    _picture(tmp_path / image)
    document, notes = _coco(folder)
    name = Path(image).name
    assert document['images'] == [{'id': 1, 'file_name': name, 'width': 128, 'height': 64}]
    assert notes == []


def test_voc_has_size_and_suffix_of_the_image(put: Put, tmp_path: Path) -> None:
    folder = put('d/P1.txt', SHIP).parent
    _picture(tmp_path / 'd' / 'P1.png')
    root = _voc(folder)
    size = [root.findtext(f'size/{side}') for side in ('width', 'height')]
    assert (root.findtext('filename'), size) == ('P1.png', ['128', '64'])


def test_a_size_of_the_labels_stays(put: Put, tmp_path: Path) -> None:
    folder = put('d/P1.txt', SHIP).parent
    _picture(tmp_path / 'd' / 'P1.png')
    (image,) = _coco(folder, image_size=(500, 400))[0]['images']
    assert image == {'id': 1, 'file_name': 'P1.png', 'width': 500, 'height': 400}


def test_a_name_in_a_folder_keeps_it(put: Put, tmp_path: Path) -> None:
    header = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\n'
    path = put('all.csv', f'{header}a/P1,0,ship,1,2,9,2,9,4,1,4\n')
    _picture(tmp_path / 'P1.png')
    (image,) = _coco(path)[0]['images']
    assert image['file_name'] == 'a/P1.png'


@pytest.mark.parametrize(
    ('filename', 'written'), [('P1.tif', 'P1.tif'), ('sub/P1.tif', 'sub/P1.tif'), ('b.tif', 'P1')]
)
def test_coco_has_the_file_name_of_voc_if_it_is_that_of_the_image(
    put: Put, filename: str, written: str
) -> None:
    folder = put('d/P1.xml', VOC.format(filename)).parent
    (image,) = _coco(folder, image_size=(9, 9))[0]['images']
    assert image['file_name'] == written


def test_voc_keeps_its_file_name(put: Put, tmp_path: Path) -> None:
    folder = put('d/P1.xml', VOC.format('template.png')).parent
    _picture(tmp_path / 'd' / 'P1.png')
    assert _voc(folder).findtext('filename') == 'template.png'


def test_images_without_a_size_are_said(put: Put, tmp_path: Path) -> None:
    put('d/P1.txt', SHIP)
    put('d/P2.txt', SHIP)
    put('d/P2.png', b'no picture')
    _picture(tmp_path / 'd' / 'P3.png')
    folder = put('d/P3.txt', SHIP).parent
    document, (note,) = _coco(folder)
    assert [set(image) for image in document['images']][:2] == [{'id', 'file_name'}] * 2
    assert note == (
        'coco: 2 of 3 images have no size, which many tools need: '
        "image 'P1': no image beside the labels or in images/ to read the size from"
    )


def test_a_name_that_no_file_can_have_is_no_error(put: Put) -> None:
    header = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\n'
    path = put('all.csv', f'{header}{"n" * 5000},0,ship,1,2,9,2,9,4,1,4\n')
    document, notes = _coco(path)
    assert len(document['images']) == len(notes) == 1


@pytest.mark.parametrize('lines', ['tug,ship', 'ship,tug'])
def test_new_categories_are_numbered_by_name(put: Put, lines: str) -> None:
    header = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\n'
    rows = [f'P1,{row},{name},1,2,9,2,9,4,1,4\n' for row, name in enumerate(lines.split(','))]
    document, _ = _coco(put('all.csv', header + ''.join(rows)))
    assert document['categories'] == [{'id': 1, 'name': 'ship'}, {'id': 2, 'name': 'tug'}]
