# SPDX-License-Identifier: Apache-2.0
"""What other tools read in converted labels; the tests of tools that are not installed skip."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from typing import Any

import numpy as np
import pytest

from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.axis_aligned import convert_file

if TYPE_CHECKING:
    from conftest import Put

Image = pytest.importorskip('PIL.Image')

WIDTH, HEIGHT = 160, 120
# The last ship of P1 has its centre outside the image, where Ultralytics drops the whole image.
LABELS = {
    'labels/P1.txt': (
        '20 20 60 30 57.5 40 17.5 30 ship 0\n'
        '90 80 110 60 117 67 97 87 tug 0\n'
        '-35 50 5 60 3 68 -37 58 ship 0\n'
    ),
    'labels/P2.txt': '80 80 20 80 20 66 80 66 ship 0\n',
}


@pytest.fixture
def data_set(put: Put, tmp_path: Path) -> Path:
    """Write a DOTA data set with its images, and return its root."""
    for name, text in LABELS.items():
        put(name, text)
        image = tmp_path / 'images' / f'{Path(name).stem}.png'
        image.parent.mkdir(exist_ok=True)
        Image.new('RGB', (WIDTH, HEIGHT)).save(image)
    return tmp_path


def _converted(data_set: Path, target: str, name: str, **options: Any) -> Path:
    path = data_set / target
    convert_file(data_set / 'labels', path, HullRule(), target_format=name, report=print, **options)
    return path


def _yolo(data_set: Path) -> Path:
    """Convert to a YOLO data set with images, and return its root."""
    root = data_set / 'yolo'
    _converted(data_set, 'yolo/labels', 'yolo')
    (root / 'images').symlink_to(data_set / 'images')
    return root


def _expected(data_set: Path, clipped: bool = False) -> dict[str, np.ndarray]:
    """Return the boxes of the images, sorted by x_min."""
    path = _converted(data_set, 'all.csv', 'csv')
    limits = (0, (WIDTH, HEIGHT) * 2) if clipped else (-np.inf, np.inf)
    return {
        labels.image: _sorted(np.clip(labels.reference, *limits)) for labels in read_labels(path)
    }


def _sorted(xyxy: Any) -> np.ndarray:
    array = np.array(xyxy, np.float64).reshape(-1, 4)
    return array[np.argsort(array[:, 0])]


def _assert_boxes(got: dict[str, Any], expected: dict[str, np.ndarray], atol: float) -> None:
    assert set(got) == set(expected)
    for image, boxes in expected.items():
        np.testing.assert_allclose(_sorted(got[image]), boxes, rtol=0, atol=atol)


def test_pycocotools_evaluates_coco(data_set: Path) -> None:
    coco = pytest.importorskip('pycocotools.coco')
    evaluation = pytest.importorskip('pycocotools.cocoeval')
    truth = coco.COCO(str(_converted(data_set, 'all.json', 'coco')))
    boxes: dict[str, list[Any]] = {}
    for annotation in truth.dataset['annotations']:
        x, y, width, height = annotation['bbox']
        image = truth.loadImgs(annotation['image_id'])[0]['file_name'].removesuffix('.png')
        boxes.setdefault(image, []).append([x, y, x + width, y + height])
    _assert_boxes(boxes, _expected(data_set), 1e-9)
    results = [{**one, 'score': 0.9} for one in truth.dataset['annotations']]
    judge = evaluation.COCOeval(truth, truth.loadRes(results), 'bbox')
    judge.evaluate()
    judge.accumulate()
    judge.summarize()
    assert judge.stats[0] == pytest.approx(1.0)


def test_pycocotools_draws_masks_if_there_is_a_segmentation(data_set: Path) -> None:
    coco = pytest.importorskip('pycocotools.coco')
    truth = coco.COCO(str(_converted(data_set, 'all.json', 'coco', variant='rectangles')))
    for annotation in truth.dataset['annotations']:
        x, y, width, height = annotation['bbox']
        right, bottom = min(x + width, WIDTH), min(y + height, HEIGHT)
        area = (right - max(x, 0)) * (bottom - max(y, 0))
        assert truth.annToMask(annotation).sum() == pytest.approx(area, rel=0.15)


def _read_by_supervision(name: str, **options: Any) -> tuple[list[str], dict[str, Any]]:
    supervision = pytest.importorskip('supervision')
    data = getattr(supervision.DetectionDataset, f'from_{name}')(**options)
    return data.classes, {Path(path).stem: data.annotations[path].xyxy for path in data.annotations}


def test_supervision_reads_coco(data_set: Path) -> None:
    classes, boxes = _read_by_supervision(
        'coco',
        images_directory_path=str(data_set / 'images'),
        annotations_path=str(_converted(data_set, 'all.json', 'coco')),
    )
    assert classes == ['ship', 'tug']
    _assert_boxes(boxes, _expected(data_set), 1e-3)


def test_supervision_reads_voc_that_counts_from_one(data_set: Path) -> None:
    _, boxes = _read_by_supervision(
        'pascal_voc',
        images_directory_path=str(data_set / 'images'),
        annotations_directory_path=str(_converted(data_set, 'voc', 'voc', variant='one-based')),
    )
    _assert_boxes(boxes, _expected(data_set), 1e-3)


def test_supervision_reads_yolo(data_set: Path) -> None:
    root = _yolo(data_set)
    classes, boxes = _read_by_supervision(
        'yolo',
        images_directory_path=str(root / 'images'),
        annotations_directory_path=str(root / 'labels'),
        data_yaml_path=str(root / 'data.yaml'),
    )
    assert classes == ['ship', 'tug']
    _assert_boxes(boxes, _expected(data_set, clipped=True), 1e-3)


@pytest.mark.parametrize('stem', ['P1', 'P2'])
def test_ultralytics_accepts_yolo_labels(data_set: Path, stem: str) -> None:
    utils = pytest.importorskip('ultralytics.data.utils')
    root = _yolo(data_set)
    paths = [str(root / name) for name in (f'images/{stem}.png', f'labels/{stem}.txt')]
    image, rows, _, _, _, missing, _, _, corrupt, message = utils.verify_image_label((
        *paths, '', False, 2, 0, 0, False,
    ))  # fmt: skip
    assert (image, missing, corrupt, message) == (paths[0], 0, 0, '')
    center, side = rows[:, 1:3], rows[:, 3:5]
    xyxy = np.hstack((center - side / 2, center + side / 2)) * ((WIDTH, HEIGHT) * 2)
    _assert_boxes({stem: xyxy}, {stem: _expected(data_set, clipped=True)[stem]}, 1e-3)


def test_ultralytics_finds_images_and_classes_in_data_yaml(data_set: Path) -> None:
    utils = pytest.importorskip('ultralytics.data.utils')
    data = utils.check_det_dataset(str(_yolo(data_set) / 'data.yaml'), autodownload=False)
    assert data['names'] == {0: 'ship', 1: 'tug'}
    assert Path(data['train']).resolve() == (data_set / 'images').resolve()
