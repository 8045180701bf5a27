# SPDX-License-Identifier: Apache-2.0
"""What real tools load from our output; runs in the environment of the tools."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from typing import NamedTuple

import numpy as np

os.environ.setdefault('YOLO_OFFLINE', 'true')

Boxes = dict[str, list[tuple[str, float, float, float, float]]]


class Loader(NamedTuple):
    """A tool, one of our outputs, and how the tool loads it: class and x1 y1 x2 y2 by image."""

    tool: str
    form: str
    load: Callable[[Path], Boxes]


LOADERS: list[Loader] = []


def loader(tool: str, *forms: str) -> Callable[[Callable[[Path], Boxes]], Callable[[Path], Boxes]]:
    """Add a loader for these outputs."""

    def add(load: Callable[[Path], Boxes]) -> Callable[[Path], Boxes]:
        LOADERS.extend(Loader(tool, form, load) for form in forms)
        return load

    return add


def _xywh(name: str, box: Any) -> tuple[str, float, float, float, float]:
    x, y, width, height = map(float, box)
    return name, x, y, x + width, y + height


def _of_supervision(data: Any) -> Boxes:
    return {
        Path(path).stem: [
            (data.classes[number], *map(float, box))
            for number, box in zip(one.class_id, one.xyxy, strict=True)
        ]
        for path, one in data.annotations.items()
    }


@loader('pycocotools', 'COCO', 'COCO, rectangles')
def load_pycocotools(path: Path) -> Boxes:
    """Load with the API of COCO."""
    from pycocotools.coco import COCO

    coco, boxes = COCO(str(path)), {}
    for image in coco.loadImgs(coco.getImgIds()):
        boxes[Path(image['file_name']).stem] = [
            _xywh(coco.loadCats(one['category_id'])[0]['name'], one['bbox'])
            for one in coco.loadAnns(coco.getAnnIds(imgIds=[image['id']]))
        ]
    return boxes


@loader('pycocotools, masks', 'COCO', 'COCO, rectangles')
def load_masks(path: Path) -> Boxes:
    """Draw each annotation, which must have pixels."""
    from pycocotools.coco import COCO

    coco = COCO(str(path))
    for annotation in coco.dataset['annotations']:
        assert coco.annToMask(annotation).any()
    return load_pycocotools(path)


@loader('supervision', 'COCO', 'COCO, rectangles')
def load_supervision_coco(path: Path) -> Boxes:
    """Load a data set of COCO."""
    import supervision as sv

    pictures = str(path.parent / 'pictures')
    return _of_supervision(sv.DetectionDataset.from_coco(pictures, str(path)))


@loader('supervision', 'VOC', 'VOC, one-based', 'VOC, devkit')
def load_supervision_voc(path: Path) -> Boxes:
    """Load a data set of VOC."""
    import supervision as sv

    pictures = str(path.parent / 'pictures')
    return _of_supervision(sv.DetectionDataset.from_pascal_voc(pictures, str(path)))


@loader('supervision', 'YOLO')
def load_supervision_yolo(path: Path) -> Boxes:
    """Load a data set of YOLO by its data.yaml."""
    import supervision as sv

    parts = str(path / 'images'), str(path / 'labels'), str(path / 'data.yaml')
    return _of_supervision(sv.DetectionDataset.from_yolo(*parts))


def _of_datumaro(path: Path, form: str) -> Boxes:
    import datumaro as dm

    if path.suffix == '.json':
        # It asks for folders of these names.
        folder = path.parent / 'annotations'
        folder.mkdir(exist_ok=True)
        (path.parent / 'images').mkdir(exist_ok=True)
        path = Path(shutil.copy(path, folder))
    data = dm.Dataset.import_from(str(path), form)
    names = [category.name for category in data.categories()[dm.AnnotationType.label]]
    return {
        Path(item.id).name: [
            _xywh(names[one.label], (one.x, one.y, one.w, one.h))
            for one in item.annotations
            if one.type == dm.AnnotationType.bbox
        ]
        for item in data
    }


@loader('datumaro', 'COCO', 'COCO, rectangles')
def load_datumaro_coco(path: Path) -> Boxes:
    """Load a file of COCO instances."""
    return _of_datumaro(path, 'coco_instances')


@loader('datumaro', 'YOLO')
def load_datumaro_yolo(path: Path) -> Boxes:
    """Load a data set of Ultralytics."""
    return _of_datumaro(path, 'yolo')


def _of_globox(annotations: Any, names: list[str] | None = None) -> Boxes:
    def name(label: str) -> str:
        return label if names is None else names[int(label)]

    return {
        Path(one.image_id).stem: [(name(box.label), *box.ltrb) for box in one.boxes]
        for one in annotations
    }


@loader('globox', 'COCO', 'COCO, rectangles')
def load_globox_coco(path: Path) -> Boxes:
    """Load a file of COCO."""
    from globox import AnnotationSet

    return _of_globox(AnnotationSet.from_coco(path))


@loader('globox', 'VOC', 'VOC, integers')
def load_globox_voc(path: Path) -> Boxes:
    """Load a folder of VOC."""
    from globox import AnnotationSet

    return _of_globox(AnnotationSet.from_pascal_voc(path))


@loader('globox', 'YOLO')
def load_globox_yolo(path: Path) -> Boxes:
    """Load a folder of YOLO labels."""
    from globox import AnnotationSet

    labels, images = path / 'labels', path / 'images'
    annotations = AnnotationSet.from_yolo_v5(labels, image_folder=images, image_extension='.png')
    return _of_globox(annotations, ['ship', 'tug'])


def _of_pylabel(data: Any) -> Boxes:
    boxes: Boxes = {}
    columns = ['img_filename', 'cat_name', 'ann_bbox_xmin', 'ann_bbox_ymin', 'ann_bbox_xmax']
    for image, name, *bounds in data.df[[*columns, 'ann_bbox_ymax']].values.tolist():
        boxes.setdefault(Path(image).stem, []).append((str(name), *map(float, bounds)))
    return boxes


@loader('pylabel', 'COCO', 'COCO, rectangles')
def load_pylabel_coco(path: Path) -> Boxes:
    """Load a file of COCO."""
    from pylabel.importer import ImportCoco

    return _of_pylabel(ImportCoco(str(path)))


@loader('pylabel', 'VOC', 'VOC, integers')
def load_pylabel_voc(path: Path) -> Boxes:
    """Load a folder of VOC."""
    from pylabel.importer import ImportVOC

    return _of_pylabel(ImportVOC(str(path)))


@loader('pylabel', 'YOLO')
def load_pylabel_yolo(path: Path) -> Boxes:
    """Load a folder of YOLO labels."""
    from pylabel.importer import ImportYoloV5

    labels = str(path / 'labels')
    data = ImportYoloV5(
        labels, img_ext='png', cat_names=['ship', 'tug'], path_to_images='../images'
    )
    return _of_pylabel(data)


@loader('sahi', 'COCO', 'COCO, rectangles')
def load_sahi(path: Path) -> Boxes:
    """Load a file of COCO."""
    from sahi.utils.coco import Coco

    coco = Coco.from_coco_dict_or_path(str(path))
    return {
        Path(image.file_name).stem: [
            _xywh(one.category_name, one.bbox) for one in image.annotations
        ]
        for image in coco.images
    }


@loader('ultralytics, check', 'YOLO')
def load_ultralytics(path: Path) -> Boxes:
    """Check and load each image as the training of Ultralytics does."""
    from PIL import Image
    from ultralytics.data.utils import check_det_dataset
    from ultralytics.data.utils import verify_image_label

    names = check_det_dataset(str(path / 'data.yaml'), autodownload=False)['names']
    boxes: Boxes = {}
    for image in sorted((path / 'images').iterdir()):
        label = path / 'labels' / f'{image.stem}.txt'
        answer = verify_image_label((str(image), str(label), '', False, len(names), 0, 0, False))
        assert answer[0] is not None, answer[-1]
        size = np.tile(Image.open(image).size, 2)
        center, side = answer[1][:, 1:3], answer[1][:, 3:5]
        xyxy = np.hstack((center - side / 2, center + side / 2)) * size
        classes = [names[int(number)] for number in answer[1][:, 0]]
        boxes[image.stem] = [(c, *b) for c, b in zip(classes, xyxy.tolist(), strict=True)]
    return boxes


@loader('ultralytics, convert_coco', 'COCO', 'COCO, rectangles')
def load_convert_coco(path: Path) -> Boxes:
    """Convert COCO to YOLO with Ultralytics; its class is the category's id less one."""
    import json
    import tempfile

    from PIL import Image
    from ultralytics.data.converter import convert_coco

    names = {one['id'] - 1: one['name'] for one in json.loads(path.read_text())['categories']}
    boxes: Boxes = {}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / 'in').mkdir()
        (Path(folder) / 'in' / path.name).write_bytes(path.read_bytes())
        convert_coco(f'{folder}/in', f'{folder}/out', cls91to80=False)
        for file in Path(folder, 'out').rglob('*.txt'):
            size = Image.open(path.parent / 'pictures' / f'{file.stem}.png').size
            rows = [line.split() for line in file.read_text().splitlines()]
            boxes[file.stem] = []
            for number, *values in rows:
                x, y, w, h = np.array(values, np.float64) * np.tile(size, 2)
                boxes[file.stem].append(_xywh(names[int(number)], (x - w / 2, y - h / 2, w, h)))
    return boxes


def _of_frame(path: Path, read: str) -> Boxes:
    import geopandas

    frame = getattr(geopandas, read)(path)
    boxes: Boxes = {}
    rows = zip(frame['image'], frame['class'], frame.geometry.bounds.to_numpy(), strict=True)
    for image, name, bounds in rows:
        boxes.setdefault(str(image), []).append((str(name), *map(float, bounds)))
    return boxes


@loader('geopandas', 'GeoJSON', 'GeoPackage', 'shapefile')
def load_geopandas(path: Path) -> Boxes:
    """Load a file of polygons."""
    return _of_frame(path, 'read_file')


@loader('pandas', 'CSV')
def load_pandas(path: Path) -> Boxes:
    """Load a table."""
    import pandas

    boxes: Boxes = {}
    columns = ['image', 'class', 'x_min', 'y_min', 'x_max', 'y_max']
    for image, name, *bounds in pandas.read_csv(path)[columns].values.tolist():
        boxes.setdefault(str(image), []).append((str(name), *bounds))
    return boxes
