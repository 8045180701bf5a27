# SPDX-License-Identifier: Apache-2.0
"""
COCO detection JSON: one file of many images, in pixels.

::

    {"images": [{"id": 1, "file_name": "P0706.png", "width": 1024, "height": 768}],
     "categories": [{"id": 1, "name": "ship"}],
     "annotations": [{"id": 7, "image_id": 1, "category_id": 1, "bbox": [274, 427, 36, 39],
                      "segmentation": [[284, 466, 274, 456, 300, 427, 310, 439]]}]}

The oriented box is the minimum rotated rectangle of the polygons, which also are the hull unless
four corners say that they are a box; ``bbox`` is the reference box. An annotation without polygons
reads as the upright box of its ``bbox``. Run-length masks are not read and reported one by one.
Images keep the name that the file gives them.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from collections.abc import Hashable
from collections.abc import Iterator
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obbhbb_ros.labels.converted import ConvertedBox
from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.converted import converted_boxes
from obbhbb_ros.labels.documents import checked_text
from obbhbb_ros.labels.documents import image_size_of
from obbhbb_ros.labels.documents import json_member
from obbhbb_ros.labels.documents import json_numbers
from obbhbb_ros.labels.documents import json_score
from obbhbb_ros.labels.documents import plain_text
from obbhbb_ros.labels.documents import read_json
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.format import ImageSize
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.records import assemble
from obbhbb_ros.labels.shapes import Outlined
from obbhbb_ros.labels.shapes import bounds_of_xywh
from obbhbb_ros.labels.shapes import by_image
from obbhbb_ros.labels.shapes import enclose
from obbhbb_ros.labels.shapes import outline
from obbhbb_ros.labels.shapes import upright_corners
from obbhbb_ros.labels.text import is_index
from obbhbb_ros.labels.text import write_lines

MARKS = ('"annotations"', '"images"', '"categories"', '"licenses"')


@dataclass(frozen=True)
class _Image:
    key: str
    name: str
    size: ImageSize | None


def read(path: Path, image_size: ImageSize | None, on_error: OnError) -> Iterator[ImageLabels]:
    """
    Read the images of a COCO file in its order.

    Parameters
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height of every image in pixels; None to take them from the file.
    on_error : callable
        Gets a LabelError for each malformed image, category or annotation, with its place as
        ``annotations[17]``, or one where the file is no COCO JSON.

    Yields
    ------
    ImageLabels
        Named by ``file_name``, also those without annotations.
    """
    try:
        document = read_json(path)
        members = {name: _array(path, document, name) for name in ('images', 'annotations')}
        categories = _array(path, document, 'categories') if 'categories' in document else None
    except LabelError as error:
        on_error(error)
        return
    images = _keyed(path, 'images', members['images'], _image, on_error)
    names = None
    if categories is not None:
        names = _keyed(path, 'categories', categories, _category, on_error)
    records = _annotations(path, members['annotations'], images, names, on_error)
    boxes = by_image(enclose(path, records, on_error))
    for image in images.values():
        yield assemble(image.name, boxes.get(image.key, []), image_size or image.size, path)


def _array(path: Path, document: Any, name: str) -> list[Any]:
    if not isinstance(document, dict) or not isinstance(document.get(name), list):
        raise LabelError(path, None, f'not COCO: no array {name!r}')
    return list(document[name])


def _keyed(
    path: Path,
    name: str,
    records: list[Any],
    parse: Callable[[str, Any], Any],
    on_error: OnError,
) -> dict[Hashable, Any]:
    """Map records by their id, each that cannot be reported with its place."""
    found: dict[Hashable, Any] = {}
    for index, record in enumerate(records):
        try:
            key = _key(record, 'id')
            if key in found:
                raise ValueError(f'id {key!r} is there already')
            found[key] = parse(str(index), record)
        except ValueError as error:
            on_error(LabelError(path, None, f'{name}[{index}]: {error}'))
    return found


def _key(record: object, name: str) -> int | str:
    key = json_member(record, name)
    if isinstance(key, bool) or not isinstance(key, int | str):
        raise ValueError(f'{name!r} is {key!r}, which is no id')
    return key


def _image(key: str, record: dict[str, Any]) -> _Image:
    name = json_member(record, 'file_name')
    if not isinstance(name, str) or not name:
        raise ValueError("'file_name' is no name")
    return _Image(key, checked_text(name), image_size_of(record.get('width'), record.get('height')))


def _category(_: str, record: object) -> str:
    return plain_text(json_member(record, 'name'))


def _annotations(
    path: Path,
    annotations: list[Any],
    images: Mapping[Hashable, _Image],
    names: Mapping[Hashable, str] | None,
    on_error: OnError,
) -> list[Outlined]:
    records = []
    for index, annotation in enumerate(annotations):
        place = f'annotations[{index}]: '
        try:
            image = _look_up(annotation, 'image_id', images)
            box, points = _box(annotation, names)
        except ValueError as error:
            on_error(LabelError(path, None, f'{place}{error}'))
            continue
        records.append(Outlined(image.key, place, None, box, points))
    return records


def _look_up(annotation: object, name: str, known: Mapping[Hashable, Any]) -> Any:
    key = _key(annotation, name)
    if key not in known:
        raise ValueError(f'{name!r} is {key!r}, which is not in the file')
    return known[key]


def _box(
    annotation: dict[str, Any], names: Mapping[Hashable, str] | None
) -> tuple[Box, FloatArray | None]:
    if names is None:
        class_id = plain_text(_key(annotation, 'category_id'))
    else:
        class_id = _look_up(annotation, 'category_id', names)
    box = Box(
        corners=(),
        class_id=class_id,
        id=plain_text(annotation.get('id')),
        score=json_score(annotation.get('score')),
        reference=_reference(annotation.get('bbox')),
    )
    rings = _rings(annotation.get('segmentation'))
    if rings:
        return outline(rings, box)
    if box.reference is NO_REFERENCE:
        raise ValueError("neither 'segmentation' nor 'bbox'")
    return box._replace(corners=upright_corners(box.reference)), None


def _reference(bbox: object) -> tuple[float, ...]:
    if bbox is None:
        return NO_REFERENCE
    return tuple(bounds_of_xywh(*json_numbers(bbox, 4, 'bbox')))


def _rings(segmentation: object) -> list[FloatArray]:
    if isinstance(segmentation, dict):
        raise ValueError('run-length encoded segmentation is not supported, only polygons are')
    if segmentation is None:
        return []
    if not isinstance(segmentation, list):
        raise ValueError('segmentation is not an array of polygons')
    return [_ring(json_numbers(polygon, None, 'segmentation')) for polygon in segmentation]


def _ring(numbers: list[float]) -> FloatArray:
    if len(numbers) < 6 or len(numbers) % 2:
        raise ValueError(f'a polygon of {len(numbers)} numbers: x and y of three points or more')
    return np.array(numbers).reshape(-1, 2)


def write_boxes(path: Path, images: list[ConvertedImage]) -> None:
    """
    Write all images to one COCO file, with scores where one is not 1.

    Ids of boxes stay if all of them are different whole numbers; otherwise they are numbered
    from 1 and keep theirs as ``instance``. Diagnostics are members of their annotation.

    Parameters
    ----------
    path : Path
        The file.
    images : list of ConvertedImage
        The images; ``width`` and ``height`` are there where they are known.
    """
    names = list(dict.fromkeys(name for each in images for name in each.class_ids))
    document = {
        'images': [_image_record(number, each) for number, each in enumerate(images, start=1)],
        'categories': [{'id': number, 'name': name} for number, name in enumerate(names, start=1)],
        'annotations': _annotation_records(images, names),
    }
    write_lines(path, [json.dumps(document, ensure_ascii=False, allow_nan=False)])


def _image_record(number: int, converted: ConvertedImage) -> dict[str, object]:
    record: dict[str, object] = {'id': number, 'file_name': converted.image}
    if converted.size is not None:
        record['width'], record['height'] = converted.size
    return record


def _annotation_records(images: list[ConvertedImage], names: list[str]) -> list[dict[str, Any]]:
    categories = {name: number for number, name in enumerate(names, start=1)}
    scored = any(np.any(converted.scores != 1.0) for converted in images)
    given = [instance for converted in images for instance in converted.ids]
    keep = all(map(is_index, given)) and len(set(map(int, given))) == len(given)
    records: list[dict[str, Any]] = []
    for image_id, converted in enumerate(images, start=1):
        for box in converted_boxes(converted):
            number = int(box.id) if keep else len(records) + 1
            record = _annotation_record(number, image_id, categories[box.class_id], box)
            if scored:
                record['score'] = box.score
            if box.id and not keep:
                record['instance'] = box.id
            records.append(record)
    return records


def _annotation_record(
    number: int, image_id: int, category_id: int, box: ConvertedBox
) -> dict[str, Any]:
    x_min, y_min, x_max, y_max = box.xyxy
    width, height = x_max - x_min, y_max - y_min
    return {
        'id': number,
        'image_id': image_id,
        'category_id': category_id,
        'bbox': [x_min, y_min, width, height],
        'area': width * height,
        'iscrowd': 0,
        **box.diagnostics,
    }


def sniff(head: str) -> bool:
    """Tell whether a member of COCO is there."""
    return any(mark in head for mark in MARKS)


FORMAT = Format(
    name='coco',
    suffixes=('.json',),
    summary='COCO JSON of many images: polygon segmentation, bbox as reference box',
    read=read,
    write=None,
    sniff=sniff,
    write_boxes=write_boxes,
    holds_diagnostics=True,
)
