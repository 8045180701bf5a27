# SPDX-License-Identifier: Apache-2.0
"""
COCO detection JSON: one file of many images, in pixels.

::

    {"images": [{"id": 1, "file_name": "P0706.png", "width": 1024, "height": 768}],
     "categories": [{"id": 1, "name": "ship"}],
     "annotations": [{"id": 7, "image_id": 1, "category_id": 1, "bbox": [274, 427, 36, 39],
                      "segmentation": [[284, 466, 274, 456, 300, 427, 310, 439]]}]}

The oriented box is the minimum rotated rectangle of the polygons, which are also the hull, unless
there is one polygon of four corners; ``bbox`` is the reference box. A run-length mask counts as the
polygon around it. An annotation without a segmentation is read as the box of its ``bbox``: turned
about its centre by ``attributes.rotation``, degrees clockwise as seen, as CVAT and Datumaro write
it; as centre, size and degrees counter-clockwise if it has five numbers, as Detectron2 writes it;
else upright. Angles that could be radians, and members whose meaning is not known, are refused.
Images are named by ``file_name``. Other members of an annotation are its properties.

Ids of boxes are written if all of them are different whole numbers; otherwise boxes are numbered
from 1 and their ids written as ``instance``. Ids of images and categories are written if all images
have different ones and the listed categories do not contradict. Scores are written if one is not 1,
``difficulty`` if it is not 0, and diagnostics and properties as members of their annotation.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from obbhbb_ros.labels import coco_boxes
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.coco_boxes import MEMBERS
from obbhbb_ros.labels.coco_boxes import id_of
from obbhbb_ros.labels.extras import Id
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import Item
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.losses import PARTS

# What begins a file of COCO, one of them at least: Datumaro has an object of categories.
PATHS = {'{images[', '{annotations[{image_id', '{categories[', '{licenses['}


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    _check_lists(file, document)
    images = _by_id(file, 'images', document['images'], _image)
    categories = None
    if 'categories' in document:
        categories = _by_id(file, 'categories', document['categories'], _category)
    annotations = documents.numbered('annotations', document['annotations'])
    parse = partial(
        _annotation, images, categories, coco_boxes.widest_angle(document['annotations'])
    )
    records = file.parse_records(annotations, parse)
    boxes = shapes.enclose(file, records)
    label_set = LabelSet(_ids_by_name(categories or {}))
    for key, (name, size) in images.items():
        rows = boxes.get(repr(key), [])
        yield file.image(name, rows, size, image_id=key, label_set=label_set)


def _check_lists(file: LabelFile, document: Any) -> None:
    if not isinstance(document, dict):
        raise file.error('not COCO: not a JSON object')
    for name in ('images', 'annotations', 'categories'):
        optional = name == 'categories' and name not in document
        if not optional and not isinstance(document.get(name), list):
            raise file.error(f'not COCO: no array {name!r}')


def _by_id(
    file: LabelFile, name: str, records: list[Any], parse: Callable[[dict[str, Any]], Item]
) -> dict[Id, Item]:
    items: dict[Id, Item] = {}

    def parse_new(record: Any) -> tuple[Id, Item]:
        key = id_of(record, 'id')
        if key in items:
            raise ValueError(f'id {key!r} is already used')
        return key, parse(record)

    for _, _, (key, item) in file.parse_records(documents.numbered(name, records), parse_new):
        items[key] = item
    return items


def _id_in(ids: Collection[Id], record: object, name: str) -> Id:
    key = id_of(record, name)
    if key not in ids:
        raise ValueError(f'{name!r} is {key!r}, which is not in the file')
    return key


def _image(record: dict[str, Any]) -> tuple[str, ImageSize | None]:
    name = documents.json_member(record, 'file_name')
    if not isinstance(name, str) or not name:
        raise ValueError("'file_name' is not a name")
    size = documents.image_size_of(record.get('width'), record.get('height'))
    return documents.plain_text(name), size


def _category(record: dict[str, Any]) -> str:
    return documents.plain_text(documents.json_member(record, 'name'))


def _annotation(
    images: Collection[Id],
    categories: Mapping[Id, str] | None,
    widest: float,
    annotation: dict[str, Any],
) -> shapes.Outlined:
    image = repr(_id_in(images, annotation, 'image_id'))
    if categories is None:
        class_id = documents.plain_text(id_of(annotation, 'category_id'))
    else:
        class_id = categories[_id_in(categories, annotation, 'category_id')]
    return coco_boxes.annotated_box(annotation, image, class_id, widest)


def _ids_by_name(categories: Mapping[Id, str]) -> dict[str, Id]:
    """Return the id of each category; the first one if several have the same name."""
    ids: dict[str, Id] = {}
    for key, name in categories.items():
        ids.setdefault(name, key)
    return ids


def _write_boxes(path: Path, images: list[ImageBoxes]) -> None:
    categories, image_ids = _category_ids(images), _image_ids(images)
    document = {
        'images': [_image_record(*pair) for pair in zip(image_ids, images, strict=True)],
        'categories': [{'id': number, 'name': name} for name, number in categories.items()],
        'annotations': _annotation_records(images, image_ids, categories),
    }
    text.write_lines(path, [json.dumps(document, ensure_ascii=False, allow_nan=False)])


def _category_ids(images: Sequence[ImageBoxes]) -> dict[str, Id]:
    """Give the listed categories the ids that they have, and the others the next ones."""
    sets = {id(image.extras.label_set): image.extras.label_set for image in images}
    listed = [entry for one in sets.values() for entry in one.categories.items()]
    ids = dict(listed)
    names = dict.fromkeys([*ids, *(name for image in images for name in image.class_ids)])
    if any(ids[name] != key for name, key in listed) or len(set(ids.values())) != len(ids):
        ids = {}
    last = max((key for key in ids.values() if isinstance(key, int)), default=0)
    new = count(max(last, 0) + 1)
    return {name: ids[name] if name in ids else next(new) for name in names}


def _image_ids(images: Sequence[ImageBoxes]) -> list[Id]:
    ids = [image.extras.image_id for image in images]
    known = [key for key in ids if key is not None]
    return known if len(set(known)) == len(ids) else list(range(1, len(ids) + 1))


def _image_record(number: Id, image: ImageBoxes) -> dict[str, Any]:
    record: dict[str, Any] = {'id': number, 'file_name': image.image}
    if image.size is not None:
        record['width'], record['height'] = image.size
    return record


def _annotation_records(
    images: list[ImageBoxes], image_ids: Sequence[Id], categories: Mapping[str, Id]
) -> list[dict[str, Any]]:
    scored = any(np.any(image.scores != 1.0) for image in images)
    ids = [instance for image in images for instance in image.ids]
    keep_ids = all(map(text.is_index, ids)) and len(set(map(int, ids))) == len(ids)
    records: list[dict[str, Any]] = []
    for image_id, image in zip(image_ids, images, strict=True):
        for box in image.rows(MEMBERS):
            x_min, y_min, x_max, y_max = box.xyxy
            width, height = x_max - x_min, y_max - y_min
            record: dict[str, Any] = {
                'id': int(box.id) if keep_ids else len(records) + 1,
                'image_id': image_id,
                'category_id': categories[box.class_id],
                'bbox': [x_min, y_min, width, height],
                'area': width * height,
                'iscrowd': int(box.crowd),
                **box.diagnostics,
            }
            if scored:
                record['score'] = box.score
            if box.id and not keep_ids:
                record['instance'] = box.id
            if box.difficulty:
                record['difficulty'] = box.difficulty
            records.append({**record, **box.properties})
    return records


def _sniff(head: str) -> bool:
    return not documents.json_paths(head).isdisjoint(PATHS)


FORMAT = Format(
    name='coco',
    suffixes=('.json',),
    summary='COCO JSON of many images: segmentation or bbox, with rotation',
    sniff=_sniff,
    read=_read,
    write_boxes=_write_boxes,
    holds=set(PARTS) - {'file names', 'reference system'},
    reserved=MEMBERS,
)
