# SPDX-License-Identifier: Apache-2.0
"""
Label files that real tools write; runs in the environment of the tools, see `label_tools.py`.

    python label_writers.py FLEET.json FOLDER

Each writer gets the fleet and a folder, and returns the path that a user would convert. Prints a
JSON array of the samples. A writer that fails is a sample with a `problem`.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any
from typing import NamedTuple

import numpy as np

os.environ.setdefault('YOLO_CONFIG_DIR', '/tmp')
os.environ.setdefault('YOLO_OFFLINE', 'true')
os.environ.setdefault('QT_QPA_PLATFORM', 'offscreen')


class Ship(NamedTuple):
    """An oriented box; theta in radians from +x to +y, clockwise as seen."""

    name: str
    x: float
    y: float
    length: float
    width: float
    theta: float

    @property
    def corners(self) -> list[list[float]]:
        """The four corners, in order around the box."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        along = np.array([cos, sin]) * self.length / 2
        across = np.array([-sin, cos]) * self.width / 2
        center = np.array([self.x, self.y])
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return [(center + i * along + j * across).tolist() for i, j in signs]

    @property
    def flat(self) -> list[float]:
        """The corners as x1 y1 … y4."""
        return [value for corner in self.corners for value in corner]

    @property
    def turned(self) -> tuple[float, float, float, float, float]:
        """The box before it is turned about its centre, x y w h, and the angle in degrees."""
        left, top = self.x - self.length / 2, self.y - self.width / 2
        return left, top, self.length, self.width, math.degrees(self.theta)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The axis-aligned box around the corners."""
        (x1, y1), (x2, y2) = np.min(self.corners, axis=0), np.max(self.corners, axis=0)
        return float(x1), float(y1), float(x2), float(y2)


class Fleet(NamedTuple):
    """Ships by image, and the folder of the images."""

    names: list[str]
    size: tuple[int, int]
    ships: dict[str, list[Ship]]
    pictures: Path


Writer = Callable[[Fleet, Path], Path]


class Sample(NamedTuple):
    """A tool, its format, what it carries (rotation, polygon, mask, box), and its writer."""

    tool: str
    form: str
    carries: str
    write: Writer


SAMPLES: list[Sample] = []


def sample(tool: str, form: str, carries: str) -> Callable[[Writer], Writer]:
    """Add a writer to the samples."""

    def add(write: Writer) -> Writer:
        SAMPLES.append(Sample(tool, form, carries, write))
        return write

    return add


# Datumaro -------------------------------------------------------------------------------------


def _datumaro(fleet: Fleet, kind: str) -> Any:
    import datumaro as dm

    def annotation(ship: Ship, number: int) -> Any:
        label = fleet.names.index(ship.name)
        if kind == 'turned':
            *box, angle = ship.turned
            return dm.Bbox(*box, label=label, id=number, attributes={'rotation': angle})
        if kind == 'rotated':
            from datumaro.components.annotation import RotatedBbox

            box = ship.x, ship.y, ship.length, ship.width, math.degrees(ship.theta)
            return RotatedBbox(*box, label=label, id=number)
        if kind == 'polygon':
            return dm.Polygon(ship.flat, label=label, id=number)
        if kind == 'mask':
            return dm.Mask(_mask(ship, fleet.size), label=label, id=number)
        x1, y1, x2, y2 = ship.bounds
        return dm.Bbox(x1, y1, x2 - x1, y2 - y1, label=label, id=number)

    width, height = fleet.size
    items = [
        dm.DatasetItem(
            id=image,
            subset='train',
            media=dm.Image.from_numpy(np.zeros((height, width, 3), np.uint8)),
            annotations=[annotation(ship, number) for number, ship in enumerate(ships, start=1)],
        )
        for image, ships in fleet.ships.items()
    ]
    # Its CVAT has no attributes but those of the labels.
    attributes = {'rotation'} if kind == 'turned' else set()
    labels = dm.LabelCategories.from_iterable((name, '', attributes) for name in fleet.names)
    return dm.Dataset.from_iterable(items, categories={dm.AnnotationType.label: labels})


def _mask(ship: Ship, size: tuple[int, int]) -> Any:
    import cv2

    mask = np.zeros(size[::-1], np.uint8)
    cv2.fillPoly(mask, [np.round(ship.corners).astype(np.int32)], 1)
    return mask.astype(bool)


def _add_datumaro(form: str, kind: str, carries: str) -> None:
    @sample('datumaro', f'{form}, {kind}', carries)
    def write(fleet: Fleet, folder: Path) -> Path:
        _datumaro(fleet, kind).export(str(folder), form, save_media=True)
        return folder


for _form, _kind, _carries in (
    ('coco_instances', 'turned', 'rotation'),
    ('coco', 'turned', 'rotation'),
    ('voc_detection', 'turned', 'rotation'),
    ('cvat', 'turned', 'rotation'),
    ('datumaro', 'turned', 'rotation'),
    ('dota', 'rotated', 'rotation'),
    ('coco_instances', 'polygon', 'polygon'),
    ('coco', 'polygon', 'polygon'),
    ('cvat', 'polygon', 'polygon'),
    ('datumaro', 'polygon', 'polygon'),
    ('label_me', 'polygon', 'polygon'),
    ('coco_instances', 'mask', 'mask'),
    ('datumaro', 'mask', 'mask'),
    ('coco', 'box', 'box'),
    ('voc_detection', 'box', 'box'),
    ('voc', 'box', 'box'),
    ('yolo', 'box', 'box'),
    ('yolo_ultralytics', 'box', 'box'),
    ('kitti_detection', 'box', 'box'),
    ('mot_seq_gt', 'box', 'box'),
    ('open_images', 'box', 'box'),
    ('segment_anything', 'mask', 'mask'),
):
    _add_datumaro(_form, _kind, _carries)


# supervision ----------------------------------------------------------------------------------


def _supervision(fleet: Fleet, kind: str) -> Any:
    import supervision as sv

    def detections(ships: list[Ship]) -> Any:
        return sv.Detections(
            xyxy=np.array([ship.bounds for ship in ships], np.float32),
            class_id=np.array([fleet.names.index(ship.name) for ship in ships]),
            mask=np.array([_mask(ship, fleet.size) for ship in ships]) if kind == 'mask' else None,
            data={
                'class_name': np.array([ship.name for ship in ships]),
                **(
                    {'xyxyxyxy': np.array([ship.corners for ship in ships], np.float32)}
                    if kind == 'rotated'
                    else {}
                ),
            },
        )

    paths = {image: str(fleet.pictures / f'{image}.png') for image in fleet.ships}
    annotations = {paths[image]: detections(ships) for image, ships in fleet.ships.items()}
    return sv.DetectionDataset(fleet.names, list(paths.values()), annotations)


@sample('supervision', 'COCO, mask', 'mask')
def write_supervision_coco(fleet: Fleet, folder: Path) -> Path:
    """Write COCO with masks."""
    _supervision(fleet, 'mask').as_coco(annotations_path=str(folder / 'all.json'))
    return folder / 'all.json'


def _add_supervision(form: str, kind: str, carries: str) -> None:
    @sample('supervision', f'{form}, {kind}', carries)
    def write(fleet: Fleet, folder: Path) -> Path:
        data = _supervision(fleet, kind)
        if form == 'VOC':
            data.as_pascal_voc(annotations_directory_path=str(folder))
        elif form == 'LabelMe':
            data.as_labelme(annotations_directory_path=str(folder))
        elif form == 'CreateML':
            data.as_createml(annotations_path=str(folder / 'all.json'))
        else:
            data.as_yolo(
                images_directory_path=str(folder / 'images'),
                annotations_directory_path=str(folder / 'labels'),
                data_yaml_path=str(folder / 'data.yaml'),
                is_obb=kind == 'rotated',
            )
        return folder


for _form, _kind, _carries in (
    ('YOLO', 'rotated', 'rotation'),
    ('YOLO', 'mask', 'mask'),
    ('YOLO', 'box', 'box'),
    ('VOC', 'mask', 'mask'),
    ('VOC', 'box', 'box'),
    ('LabelMe', 'mask', 'mask'),
    ('CreateML', 'box', 'box'),
):
    _add_supervision(_form, _kind, _carries)


@sample('supervision', 'CSVSink', 'box')
def write_supervision_csv(fleet: Fleet, folder: Path) -> Path:
    """Write boxes as a table."""
    import supervision as sv

    data = _supervision(fleet, 'box')
    with sv.CSVSink(str(folder / 'all.csv')) as sink:
        for path, detections in data.annotations.items():
            sink.append(detections, {'image': Path(path).stem})
    return folder / 'all.csv'


# pycocotools ----------------------------------------------------------------------------------


@sample('pycocotools', 'COCO, RLE', 'mask')
def write_pycocotools(fleet: Fleet, folder: Path) -> Path:
    """Write COCO with compressed run-length masks."""
    from pycocotools import mask as masks

    width, height = fleet.size
    images = [
        {'id': number, 'file_name': f'{image}.png', 'width': width, 'height': height}
        for number, image in enumerate(fleet.ships, start=1)
    ]
    annotations: list[dict[str, Any]] = []
    for number, ships in enumerate(fleet.ships.values(), start=1):
        for ship in ships:
            code = masks.encode(np.asfortranarray(_mask(ship, fleet.size).astype(np.uint8)))
            annotations.append(
                {
                    'id': len(annotations) + 1,
                    'image_id': number,
                    'category_id': fleet.names.index(ship.name) + 1,
                    'bbox': masks.toBbox(code).tolist(),
                    'area': float(masks.area(code)),
                    'iscrowd': 0,
                    'segmentation': {**code, 'counts': code['counts'].decode()},
                }
            )
    categories = [{'id': number, 'name': name} for number, name in enumerate(fleet.names, start=1)]
    document = {'images': images, 'annotations': annotations, 'categories': categories}
    path = folder / 'all.json'
    path.write_text(json.dumps(document))
    return path


# labelme --------------------------------------------------------------------------------------


def _add_labelme(shape_type: str, carries: str) -> None:
    @sample('labelme', shape_type, carries)
    def write(fleet: Fleet, folder: Path) -> Path:
        from labelme._label_file import LabelFile

        def points(ship: Ship) -> list[list[float]]:
            x1, y1, x2, y2 = ship.bounds
            return [[x1, y1], [x2, y2]] if shape_type == 'rectangle' else ship.corners

        width, height = fleet.size
        for image, ships in fleet.ships.items():
            shapes = [
                {
                    'label': ship.name,
                    'points': points(ship),
                    'shape_type': shape_type,
                    'group_id': None,
                    'description': '',
                    'flags': {},
                    'mask': None,
                }
                for ship in ships
            ]
            LabelFile().save(
                filename=str(folder / f'{image}.json'),
                shapes=shapes,
                image_path=f'{image}.png',
                image_height=height,
                image_width=width,
            )
        return folder


for _kind, _carries in (
    ('polygon', 'polygon'),
    ('oriented_rectangle', 'rotation'),
    ('rectangle', 'box'),
):
    _add_labelme(_kind, _carries)


# Label Studio ---------------------------------------------------------------------------------

LABEL_STUDIO = """<View><Image name="image" value="$image"/>
<{0} name="label" toName="image">{1}</{0}></View>"""


def _tasks(fleet: Fleet, kind: str) -> list[dict[str, Any]]:
    width, height = fleet.size
    scale = np.array([100 / width, 100 / height])

    def result(ship: Ship) -> dict[str, Any]:
        if kind == 'polygon':
            value: dict[str, Any] = {
                'points': (np.array(ship.corners) * scale).tolist(),
                'closed': True,
            }
        else:
            # It is turned about its left upper corner.
            (x, y), sides = np.array(ship.corners[0]) * scale, (ship.length, ship.width) * scale
            value = dict(zip(('x', 'y', 'width', 'height'), (x, y, *sides), strict=True))
            value['rotation'] = math.degrees(ship.theta)
        labels = 'polygonlabels' if kind == 'polygon' else 'rectanglelabels'
        return {
            'from_name': 'label',
            'to_name': 'image',
            'type': labels,
            'original_width': width,
            'original_height': height,
            'image_rotation': 0,
            'value': {**value, labels: [ship.name]},
        }

    return [
        {
            'id': number,
            'data': {'image': f'/data/upload/1/{image}.png'},
            'annotations': [
                {'id': number, 'completed_by': 1, 'result': [result(ship) for ship in ships]}
            ],
        }
        for number, (image, ships) in enumerate(fleet.ships.items(), start=1)
    ]


def _add_label_studio(form: str, kind: str) -> None:
    @sample('label-studio-sdk', f'{form}, {kind}', kind)
    def write(fleet: Fleet, folder: Path) -> Path:
        from label_studio_sdk.converter import Converter

        tag = 'PolygonLabels' if kind == 'polygon' else 'RectangleLabels'
        labels = ''.join(f'<Label value="{name}"/>' for name in fleet.names)
        source = folder.with_name(f'{folder.name}.tasks.json')
        source.write_text(json.dumps(_tasks(fleet, kind)))
        converter = Converter(
            LABEL_STUDIO.format(tag, labels), str(folder), download_resources=False
        )
        converter.convert(str(source), str(folder), form, is_dir=False)
        files = [path for path in folder.iterdir() if path.is_file()]
        return files[0] if len(files) == 1 and len(list(folder.iterdir())) == 1 else folder


for _form, _kind in (
    ('JSON', 'rotation'), ('JSON_MIN', 'rotation'), ('CSV', 'rotation'), ('TSV', 'rotation'),
    ('YOLO_OBB', 'rotation'), ('COCO', 'polygon'), ('JSON', 'polygon'), ('JSON_MIN', 'polygon'),
    ('CSV', 'polygon'),
):  # fmt: skip
    _add_label_studio(_form, _kind)


# Ultralytics ----------------------------------------------------------------------------------


def _results(fleet: Fleet, kind: str) -> dict[str, Any]:
    from ultralytics.engine.results import Results

    names = dict(enumerate(fleet.names))
    track = kind == 'track'

    def rows(ships: list[Ship]) -> Any:
        import torch

        def row(number: int, ship: Ship) -> list[float]:
            ends = [*([float(number)] if track else []), 0.75, float(fleet.names.index(ship.name))]
            if kind in ('rotated', 'track'):
                return [ship.x, ship.y, ship.length, ship.width, ship.theta, *ends]
            return [*ship.bounds, *ends]

        return torch.tensor([row(*pair) for pair in enumerate(ships, start=1)])

    def keypoints(ships: list[Ship]) -> Any:
        import torch

        ends = [np.mean(np.array(ship.corners).reshape(2, 2, 2), axis=1) for ship in ships]
        return torch.tensor(np.array(ends), dtype=torch.float32)

    picture = np.zeros((*fleet.size[::-1], 3), np.uint8)
    done = {}
    for image, ships in fleet.ships.items():
        boxes = {'obb' if kind in ('rotated', 'track') else 'boxes': rows(ships)}
        if kind == 'pose':
            boxes['keypoints'] = keypoints(ships)
        if kind == 'mask':
            import torch

            boxes['masks'] = torch.tensor(np.array([_mask(ship, fleet.size) for ship in ships]))
        done[image] = Results(picture, f'{image}.png', names, **boxes)
    return done


def _add_ultralytics(kind: str, carries: str, confidence: bool) -> None:
    @sample('ultralytics', f'save_txt, {kind}{", conf" if confidence else ""}', carries)
    def write(fleet: Fleet, folder: Path) -> Path:
        for image, results in _results(fleet, kind).items():
            results.save_txt(folder / f'{image}.txt', save_conf=confidence)
        _classes(fleet, folder)
        return folder


def _classes(fleet: Fleet, folder: Path) -> None:
    names = ''.join(f'  {number}: {name}\n' for number, name in enumerate(fleet.names))
    (folder / 'data.yaml').write_text(f'train: .\nval: .\nnames:\n{names}')


for _kind, _carries, _confidence in (
    ('rotated', 'rotation', False),
    ('rotated', 'rotation', True),
    ('track', 'rotation', False),
    ('track', 'rotation', True),
    ('mask', 'mask', False),
    ('pose', 'pose', False),
    ('box', 'box', False),
    ('box', 'box', True),
):
    _add_ultralytics(_kind, _carries, _confidence)


@sample('ultralytics', 'predictions.json, rotated', 'rotation')
def write_predictions(fleet: Fleet, folder: Path) -> Path:
    """Write what the validation of an OBB model saves, beside the names of the classes."""
    from types import SimpleNamespace

    import torch
    from ultralytics.models.yolo.obb import OBBValidator

    results = _results(fleet, 'rotated')
    keeper = SimpleNamespace(jdict=[], names=dict(enumerate(fleet.names)), class_map=[1, 2])
    for image, one in results.items():
        predictions = {'bboxes': one.obb.xywhr, 'conf': one.obb.conf, 'cls': one.obb.cls}
        batch = {'im_file': f'{image}.png', 'ori_shape': fleet.size[::-1]}
        with torch.no_grad():
            OBBValidator.pred_to_json(keeper, predictions, batch)
    path = folder / 'predictions.json'
    path.write_text(json.dumps(keeper.jdict))
    _classes(fleet, folder)
    return path


def _add_results(method: str, suffix: str) -> None:
    @sample('ultralytics', f'{method}, rotated', 'rotation')
    def write(fleet: Fleet, folder: Path) -> Path:
        for image, one in _results(fleet, 'rotated').items():
            (folder / f'{image}{suffix}').write_text(str(getattr(one, method)()))
        return folder


_add_results('to_json', '.json')
_add_results('to_csv', '.csv')


# GeoPandas ------------------------------------------------------------------------------------


def _add_geopandas(form: str, place: str) -> None:
    @sample('geopandas', f'{form}, {place}', 'polygon')
    def write(fleet: Fleet, folder: Path) -> Path:
        import geopandas
        from shapely.geometry import Polygon

        rows = [
            {'image': image, 'class': ship.name, 'geometry': Polygon(_placed(ship, place))}
            for image, ships in fleet.ships.items()
            for ship in ships
        ]
        crs = None if place == 'pixels' else 'EPSG:32633'
        frame = geopandas.GeoDataFrame(rows, crs=crs)
        if place == 'degrees':
            frame = frame.to_crs('EPSG:4326')
        path = folder / f'all.{form}'
        if form == 'csv':
            frame.to_wkt().to_csv(path, index=False)
        elif form == 'parquet':
            frame.to_parquet(path)
        else:
            frame.to_file(path)
        return path


def _placed(ship: Ship, place: str) -> list[list[float]]:
    if place == 'pixels':
        return ship.corners
    return [[500_000 + x, 6_650_000 - y] for x, y in ship.corners]


for _form in ('geojson', 'shp', 'gpkg', 'fgb', 'csv', 'parquet'):
    for _place in ('pixels', 'metres', 'degrees'):
        _add_geopandas(_form, _place)


# X-AnyLabeling --------------------------------------------------------------------------------


def _xanylabeling(fleet: Fleet, folder: Path, kind: str) -> Path:
    """Write the labels of each image as its own JSON; returns their folder."""
    from anylabeling.views.labeling.shape import Shape
    from PyQt6.QtCore import QPointF

    width, height = fleet.size
    for image, ships in fleet.ships.items():
        drawn = []
        for ship in ships:
            shape = Shape(label=ship.name, shape_type=kind, direction=ship.theta)
            x1, y1, x2, y2 = ship.bounds
            upright = [[x1, y1], [x2, y1], [x2, y2], [x1, y2]]
            for point in upright if kind == 'rectangle' else ship.corners:
                shape.add_point(QPointF(*point))
            drawn.append(shape.to_dict())
        document = {
            'version': '4.2.1', 'flags': {}, 'shapes': drawn, 'imagePath': f'{image}.png',
            'imageData': None, 'imageHeight': height, 'imageWidth': width,
        }  # fmt: skip
        (folder / f'{image}.json').write_text(json.dumps(document))
    return folder


def _add_xanylabeling(kind: str, carries: str) -> None:
    @sample('x-anylabeling-cvhub', kind, carries)
    def write(fleet: Fleet, folder: Path) -> Path:
        return _xanylabeling(fleet, folder, kind)


for _kind, _carries in (
    ('rotation', 'rotation'),
    ('quadrilateral', 'polygon'),
    ('polygon', 'polygon'),
    ('rectangle', 'box'),
):
    _add_xanylabeling(_kind, _carries)


def _add_xanylabeling_export(form: str, kind: str, carries: str) -> None:
    @sample('x-anylabeling-cvhub', form, carries)
    def write(fleet: Fleet, folder: Path) -> Path:
        from anylabeling.views.labeling.label_converter import LabelConverter

        source, names = folder.with_suffix('.source'), folder / 'classes.txt'
        source.mkdir()
        _xanylabeling(fleet, source, kind)
        names.write_text('\n'.join(fleet.names))
        converter = LabelConverter(classes_file=str(names))
        method, _, mode = form.partition(', ')
        export = getattr(converter, f'custom_to_{method}')
        pictures = [str(fleet.pictures / f'{image}.png') for image in fleet.ships]
        if method in ('coco', 'odvg'):
            export(pictures, str(source), str(folder), *filter(None, [mode]))
            return folder
        if method in ('mot', 'mots'):
            export(str(source), str(folder))
            return folder / ('gt.txt' if method == 'mot' else 'custom_gt.txt')
        (folder / 'crop_img').mkdir()
        for image, picture in zip(fleet.ships, pictures, strict=True):
            labels = str(source / f'{image}.json')
            if method == 'ppocr':
                export(picture, labels, str(folder), mode)
            elif method == 'voc':
                export(picture, labels, str(folder / f'{image}.xml'), mode)
            else:
                target = str(folder / f'{image}.txt')
                export(labels, target, *filter(None, [mode]))
        return folder / 'Label.txt' if method == 'ppocr' else folder


for _form, _kind, _carries in (
    ('dota', 'rotation', 'rotation'),
    ('yolo, obb', 'rotation', 'rotation'),
    ('yolo, seg', 'polygon', 'polygon'),
    ('yolo, hbb', 'rectangle', 'box'),
    ('voc, polygon', 'polygon', 'polygon'),
    ('voc, rectangle', 'rectangle', 'box'),
    ('coco, polygon', 'polygon', 'polygon'),
    ('mot', 'rectangle', 'box'),
    ('mots', 'polygon', 'mask'),
    ('odvg', 'rectangle', 'box'),
    ('ppocr, rec', 'rotation', 'polygon'),
):
    _add_xanylabeling_export(_form, _kind, _carries)


# globox, pylabel, sahi ------------------------------------------------------------------------


def _globox(fleet: Fleet) -> Any:
    from globox import Annotation
    from globox import AnnotationSet
    from globox import BoundingBox

    return AnnotationSet(
        Annotation(
            f'{image}.png',
            fleet.size,
            [BoundingBox.create(label=ship.name, coords=ship.bounds) for ship in ships],
        )
        for image, ships in fleet.ships.items()
    )


def _add_globox(form: str, name: str) -> None:
    @sample('globox', form, 'box')
    def write(fleet: Fleet, folder: Path) -> Path:
        annotations, path = _globox(fleet), folder / name if name else folder
        if form == 'coco':
            annotations.save_coco(path, auto_ids=True)
        elif form == 'yolo_v5':
            numbers = {name: number for number, name in enumerate(fleet.names)}
            annotations.save_yolo_v5(path, label_to_id=numbers)
            _classes(fleet, folder)
        elif form == 'pascal_voc':
            annotations.save_pascal_voc(path)
        else:
            options = {'image_folder': fleet.pictures} if form == 'via_json' else {}
            getattr(annotations, f'save_{form}')(path, **options)
        return path


for _form, _name in (
    ('coco', 'all.json'), ('yolo_v5', ''), ('pascal_voc', ''), ('labelme', ''),
    ('cvat', 'all.xml'), ('via_json', 'all.json'), ('openimage', 'all.csv'),
):  # fmt: skip
    _add_globox(_form, _name)


@sample('sahi', 'COCO, polygon in whole pixels', 'mask')
def write_sahi(fleet: Fleet, folder: Path) -> Path:
    """Write COCO with polygons."""
    from sahi.utils.coco import Coco
    from sahi.utils.coco import CocoAnnotation
    from sahi.utils.coco import CocoCategory
    from sahi.utils.coco import CocoImage

    coco = Coco()
    for number, name in enumerate(fleet.names):
        coco.add_category(CocoCategory(number, name))
    for image, ships in fleet.ships.items():
        picture = CocoImage(f'{image}.png', *fleet.size[::-1])
        for ship in ships:
            number = fleet.names.index(ship.name)
            picture.add_annotation(
                CocoAnnotation(
                    segmentation=[ship.flat], category_id=number, category_name=ship.name
                )
            )
        coco.add_image(picture)
    path = folder / 'all.json'
    path.write_text(json.dumps(coco.json))
    return path


# ----------------------------------------------------------------------------------------------


def load_fleet(path: Path) -> Fleet:
    """Read the fleet, and draw its images."""
    document = json.loads(path.read_text())
    ships = {image: [Ship(*row) for row in rows] for image, rows in document['ships'].items()}
    return Fleet(document['names'], tuple(document['size']), ships, path.parent / 'pictures')


def main() -> None:
    """Write all samples."""
    fleet, root = load_fleet(Path(sys.argv[1])), Path(sys.argv[2])
    done = []
    for number, one in enumerate(SAMPLES):
        folder = root / f'{number:03}_{one.tool}'
        folder.mkdir(parents=True)
        entry = {'tool': one.tool, 'form': one.form, 'carries': one.carries}
        with contextlib.suppress(metadata.PackageNotFoundError):
            entry['version'] = metadata.version(one.tool)
        try:
            with contextlib.redirect_stdout(sys.stderr):
                entry['path'] = str(one.write(fleet, folder))
        except BaseException as error:
            entry['problem'] = f'{type(error).__name__}: {error}'
        done.append(entry)
    print(json.dumps(done))


if __name__ == '__main__':
    main()
