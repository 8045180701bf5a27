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
have different ones and the listed categories do not contradict; new categories follow by name.
``file_name`` has the suffix of the image if it is known. Scores are written if one is not 1,
``difficulty`` if it is not 0, and diagnostics and properties as members of their annotation.

There is no ``segmentation``: supervision would draw a mask for each box, 45 MB in an image of
4096 x 4096. The variant ``rectangles`` has the corners of the box there.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from itertools import count
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from obbhbb_ros.files import write_pieces
from obbhbb_ros.labels import coco_annotations
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.class_order import ordered_classes
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

LISTS = ('images', 'annotations', 'categories')
# Members that are read; those of annotations are all kept.
KNOWN = {'images': ('id', 'file_name', 'width', 'height'), 'categories': ('id', 'name')}
# What begins a file of COCO, one of them at least: Datumaro has an object of categories.
PATHS = {'{images[', '{annotations[{image_id', '{categories[', '{licenses['}


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    _check_lists(file, document)
    images = _by_id(file, 'images', document['images'], _image)
    categories = None
    if 'categories' in document:
        categories = _by_id(file, 'categories', document['categories'], _category)
    reader = coco_annotations.AnnotationReader(file, images, categories, document['annotations'])
    label_set = LabelSet(_ids_by_name(categories or {}), others=_others(document))
    for (key, (name, size)), labels in zip(images.items(), reader.images(), strict=True):
        yield replace(
            labels,
            image=name,
            size=file.image_size or size,
            extras=replace(labels.extras, image_id=key, label_set=label_set),
        )


def _check_lists(file: LabelFile, document: Any) -> None:
    if not isinstance(document, dict):
        raise file.error('not COCO: not a JSON object')
    for name in LISTS:
        optional = name == 'categories' and name not in document
        if not optional and not isinstance(document.get(name), list):
            raise file.error(f'not COCO: no array {name!r}')


def _others(document: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of members that are not read and not empty."""
    names = [name for name, value in document.items() if value and name not in LISTS]
    for part, known in KNOWN.items():
        records = (record for record in document.get(part, ()) if isinstance(record, dict))
        members = (item for record in records for item in record.items())
        lost = dict.fromkeys(name for name, value in members if value and name not in known)
        names += [f'{part}.{name}' for name in lost]
    return tuple(names)


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


def _image(record: dict[str, Any]) -> tuple[str, ImageSize | None]:
    name = documents.json_member(record, 'file_name')
    if not isinstance(name, str) or not name:
        raise ValueError("'file_name' is not a name")
    size = documents.image_size_of(record.get('width'), record.get('height'))
    return documents.plain_text(name), size


def _category(record: dict[str, Any]) -> str:
    return documents.plain_text(documents.json_member(record, 'name'))


def _ids_by_name(categories: Mapping[Id, str]) -> dict[str, Id]:
    """Return the id of each category; the first one if several have the same name."""
    ids: dict[str, Id] = {}
    for key, name in categories.items():
        ids.setdefault(name, key)
    return ids


def _write_boxes(path: Path, images: list[ImageBoxes], rectangles: bool = False) -> None:
    categories, image_ids = _category_ids(images), _image_ids(images)
    dump = json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
    pictures = [_image_record(*pair) for pair in zip(image_ids, images, strict=True)]
    listed = [{'id': number, 'name': name} for name, number in categories.items()]
    head = f'{{"images": {dump(pictures)}, "categories": {dump(listed)}, "annotations": ['
    # Image by image, as their records take ten times the memory of the columns.
    records = _annotations(images, image_ids, categories)
    if rectangles:
        records = map(_with_rectangles, records)
    parts = (dump(part)[1:-1] for part in records if part)
    annotations = (f'{", " if number else ""}{part}' for number, part in enumerate(parts))
    write_pieces(path, chain([head], annotations, [']}\n']))


def _category_ids(images: Sequence[ImageBoxes]) -> dict[str, Id]:
    """Give the listed categories the ids that they have, and the others the next ones."""
    sets = {id(image.extras.label_set): image.extras.label_set for image in images}
    listed = [entry for one in sets.values() for entry in one.categories.items()]
    ids = dict(listed)
    names = dict.fromkeys([*ids, *ordered_classes(images)])
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
    record: dict[str, Any] = {'id': number, 'file_name': image.file_name}
    if image.size is not None:
        record['width'], record['height'] = image.size
    return record


def _annotations(
    images: list[ImageBoxes], image_ids: Sequence[Id], categories: Mapping[str, Id]
) -> Iterator[list[dict[str, Any]]]:
    """Return the records of each image."""
    scored = any(np.any(image.scores != 1.0) for image in images)
    ids = [instance for image in images for instance in image.ids]
    keep_ids = all(map(text.is_index, ids)) and len(set(map(int, ids))) == len(ids)
    numbers: Iterator[int] = map(int, ids) if keep_ids else count(1)
    for image_id, image in zip(image_ids, images, strict=True):
        own = list(islice(numbers, len(image.ids)))
        records = _annotation_records(image, image_id, own, categories)
        added = list(_further_members(image, scored, keep_ids))
        yield [{**record, **more} for record, more in zip(records, added, strict=True)]


def _with_rectangles(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    boxes = (shapes.bounds_of_xywh(*record['bbox']) for record in records)
    corners = map(list, map(shapes.upright_corners, boxes))
    return [
        {**record, 'segmentation': [ring]} for record, ring in zip(records, corners, strict=True)
    ]


def _annotation_records(
    image: ImageBoxes, image_id: Id, numbers: Sequence[int], categories: Mapping[str, Id]
) -> list[dict[str, Any]]:
    """Return the members that every annotation has."""
    low, sides = image.xyxy[:, :2], image.xyxy[:, 2:] - image.xyxy[:, :2]
    bbox, areas = np.hstack((low, sides)).tolist(), sides.prod(axis=1).tolist()
    crowd = np.zeros(len(areas)) if image.extras.crowd is None else image.extras.crowd
    columns = numbers, image.class_ids, bbox, areas, crowd.astype(np.int64).tolist()
    return [
        {
            'id': number,
            'image_id': image_id,
            'category_id': categories[name],
            'bbox': box,
            'area': area,
            'iscrowd': is_crowd,
        }
        for number, name, box, area, is_crowd in zip(*columns, strict=True)
    ]


def _further_members(
    image: ImageBoxes, scored: bool, keep_ids: bool
) -> Iterator[Mapping[str, Any]]:
    """Return the members that only some annotations have."""
    extras = image.extras
    if image.diagnostics is None and not extras.properties and extras.difficulty is None:
        for score, instance in zip(image.scores.tolist(), image.ids, strict=True):
            yield _scored(score if scored else None, '' if keep_ids else instance)
        return
    for box in image.rows(MEMBERS):
        named = _scored(box.score if scored else None, '' if keep_ids else box.id)
        difficulty = {'difficulty': box.difficulty} if box.difficulty else {}
        known = {name: value for name, value in box.properties.items() if value is not None}
        yield {**box.diagnostics, **named, **difficulty, **known}


def _scored(score: float | None, instance: str) -> dict[str, Any]:
    members: dict[str, Any] = {} if score is None else {'score': score}
    return {**members, 'instance': instance} if instance else members


def _sniff(head: str) -> bool:
    return not documents.json_paths(head).isdisjoint(PATHS)


FORMAT = Format(
    name='coco',
    suffixes=('.json',),
    summary='COCO JSON of many images: segmentation or bbox, with rotation',
    sniff=_sniff,
    read=_read,
    write_boxes=_write_boxes,
    variants={'rectangles': partial(_write_boxes, rectangles=True)},
    holds=set(PARTS) - {'file names', 'reference system'},
    reserved=MEMBERS,
    in_pixels=True,
)
