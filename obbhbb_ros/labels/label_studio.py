# SPDX-License-Identifier: Apache-2.0
"""
Label Studio's exports JSON, JSON-MIN and CSV: many images, in percent of the image.

::

    [{"id": 1, "data": {"image": "/data/upload/1/5c2f8a1e-P0706.png"},
      "annotations": [{"result": [
        {"id": "Xy1", "type": "rectanglelabels", "original_width": 1024, "original_height": 768,
         "value": {"x": 26.7, "y": 55.6, "width": 3.8, "height": 2.1, "rotation": 134.0,
                   "rectanglelabels": ["ship"]}}]}]}]

JSON-MIN and CSV have the values of a task, with ``original_width`` and ``original_height``, in one
member or column. ``rotation`` is in degrees, clockwise as seen, about the corner ``x``, ``y``; a
box without it is upright and also the reference box. A polygon is a hull, unless it has four
points. Regions of other kinds (brush, ellipse, key point) are reported and not read; answers that
belong to no region are ignored. Of several annotations of one task the newest is read, the others
are reported. Predictions are read where a task has no annotation.
"""

from __future__ import annotations

import codecs
import json
import math
from collections.abc import Iterable
from collections.abc import Iterator
from functools import partial
from typing import Any
from typing import NamedTuple
from urllib.parse import parse_qs
from urllib.parse import unquote
from urllib.parse import urlsplit

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels import text
from obbhbb_ros.labels.image_labels import MIN_HULL_POINTS
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.image_names import IMAGE_SUFFIXES
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.table_rows import table_rows

JSON_PATHS = ('[{data{', '[{annotation_id', '[{annotations[{result', '[{original_width')
TABLE_COLUMNS = {'annotation_id', 'lead_time'}
# Members of a region that say where it is.
PLACES = ('x', 'points', 'rle', 'sequence', 'vertices')
# Results that belong to a whole image, or say more about a region that is read by itself.
ANSWERS = (
    'choices', 'datetime', 'labels', 'number', 'pairwise', 'rating', 'ranker', 'relation',
    'taxonomy', 'textarea',
)  # fmt: skip


class Annotation(NamedTuple):
    """What one person or model marked in one image; `created` is a time that sorts as text."""

    task: str
    image: str
    created: str
    regions: list[Any]


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    annotations = _newest(file, _annotations(file))
    sizes: dict[str, ImageSize] = {}
    records = file.parse_records(_regions(annotations), partial(_region, file.image_size, sizes))
    boxes = shapes.enclose(file, records)
    for _, _, (task, image, *_) in annotations:
        yield file.image(image, boxes.get(task, []), sizes.get(task))


def _newest(file: LabelFile, annotations: Iterable[Record[Annotation]]) -> list[Record[Annotation]]:
    """Keep the newest annotation of each task, and report the others."""
    newest: dict[str, Record[Annotation]] = {}
    for record in annotations:
        task = record[2].task
        other = newest.setdefault(task, record)
        if other is not record:
            old, newest[task] = sorted((other, record), key=lambda item: item[2].created)
            message = f'{old[1]}not read, as task {task} has a newer annotation'
            file.on_error(LabelError(file.path, old[0], message))
    return list(newest.values())


def _annotations(file: LabelFile) -> Iterator[Record[Annotation]]:
    tasks = _json_tasks(file) if _is_json(file) else _table_rows(file)
    for line, place, versions in file.parse_records(tasks, _annotations_of):
        for name, annotation in versions:
            yield line, f'{place}{name}', annotation


def _is_json(file: LabelFile) -> bool:
    with file.path.open('rb') as stream:
        return stream.read(16).removeprefix(codecs.BOM_UTF8).lstrip()[:1] in b'[{'


def _json_tasks(file: LabelFile) -> Iterator[Record[Any]]:
    document = documents.read_json(file)
    if not isinstance(document, list):
        raise file.error('not a Label Studio export: not a JSON array of tasks')
    return documents.numbered('tasks', document)


def _table_rows(file: LabelFile) -> Iterator[Record[dict[str, Any]]]:
    """Read rows as the members of JSON-MIN; a field that holds a JSON array is one."""
    lines = table_rows(file, lambda header: _columns(header)[0])
    number, _, header = next(lines, (None, '', ''))
    separator, columns = _columns(header)
    if not set(columns) >= TABLE_COLUMNS:
        raise file.error(f'not a Label Studio export: the header is {header[:80]!r}', number)

    def parse(line: str) -> dict[str, Any]:
        fields = text.split_row(line, separator)
        if len(fields) != len(columns):
            raise ValueError(f'{len(fields)} fields, the header has {len(columns)}')
        return {name: _cell(field) for name, field in zip(columns, fields, strict=True)}

    return file.parse_records(lines, parse)


def _columns(header: str) -> tuple[str, list[str]]:
    # A TSV export is called result.csv, too.
    separator = '\t' if '\t' in header else ','
    return separator, header.replace('"', '').split(separator)


def _cell(field: str) -> Any:
    if not field.startswith('[{'):
        return field
    try:
        return json.loads(field)
    except RecursionError:
        raise ValueError('JSON nested too deeply') from None
    except ValueError as error:
        raise ValueError(f'not JSON: {error}') from None


def _annotations_of(task: Any) -> list[tuple[str, Annotation]]:
    """Return the annotations of a task, each with the start of its error messages."""
    number = documents.plain_text(documents.json_member(task, 'id'))
    if 'data' not in task:
        created = documents.plain_text(task.get('created_at'))
        regions = [item for value in task.values() for item in _marked(value)]
        return [('', Annotation(number, _image_name(task), created, regions))]
    image = _image_name(task['data'])
    kind = next((kind for kind in ('annotations', 'completions') if task.get(kind)), 'predictions')
    entries = task.get(kind) or []
    if not isinstance(entries, list):
        raise ValueError(f'{kind!r} is not an array')
    annotations = [
        (f'{kind}[{index}]: ', _annotation(number, image, entry))
        for index, entry in enumerate(entries)
        if not (isinstance(entry, dict) and entry.get('was_cancelled'))
    ]
    return annotations or [('', Annotation(number, image, '', []))]


def _marked(value: Any) -> list[Any]:
    """Return the regions in a member of JSON-MIN: others are answers and names."""
    items = value if isinstance(value, list) else []
    return [item for item in items if isinstance(item, dict) and 'original_width' in item]


def _annotation(number: str, image: str, entry: Any) -> Annotation:
    results = documents.json_member(entry, 'result')
    if not isinstance(results, list):
        raise ValueError("'result' is not an array")
    created = documents.plain_text(entry.get('created_at'))
    return Annotation(number, image, created, _merged(results))


def _merged(results: list[Any]) -> list[dict[str, Any]]:
    """
    Merge each region with its value, as JSON-MIN has it, and with the labels of the same id.

    Answers that are no regions are left out.
    """
    labels: dict[str, Any] = {}
    regions = []
    for result in results:
        kind = documents.json_member(result, 'type')
        value = result.get('value')
        if kind == 'labels' and isinstance(value, dict) and not _has_place(value):
            labels[str(result.get('id'))] = value.get('labels')
        elif kind not in ANSWERS or (isinstance(value, dict) and _has_place(value)):
            regions.append({**result, **(value if isinstance(value, dict) else {})})
    for region in regions:
        region.setdefault('labels', labels.get(str(region.get('id'))))
    return regions


def _has_place(value: dict[str, Any]) -> bool:
    return any(name in value for name in PLACES)


def _image_name(data: Any) -> str:
    """Return the file name in the member of a task that holds an image."""
    if not isinstance(data, dict):
        raise ValueError("'data' is not a JSON object")
    names = [_file_name(value) for value in data.values() if isinstance(value, str)]
    images = [name for name in names if name.lower().endswith(IMAGE_SUFFIXES)]
    if not images and isinstance(value := data.get('image'), str):
        images = [_file_name(value)]
    if not images or not images[0]:
        raise ValueError('no image name')
    return documents.plain_text(images[0])


def _file_name(url: str) -> str:
    try:
        parts = urlsplit(url)
    except ValueError:
        return ''
    # Files of the server's disk: /data/local-files/?d=ships/P0706.png
    path = parse_qs(parts.query).get('d', [parts.path])[0] if 'd=' in parts.query else parts.path
    return unquote(path).replace('\\', '/').rpartition('/')[2]


def _regions(annotations: Iterable[Record[Annotation]]) -> Iterator[Record[tuple[str, Any]]]:
    for line, place, annotation in annotations:
        for index, region in enumerate(annotation.regions):
            yield line, f'{place}region {index + 1}: ', (annotation.task, region)


def _region(
    image_size: ImageSize | None, sizes: dict[str, ImageSize], record: tuple[str, Any]
) -> shapes.Outlined:
    task, region = record
    if region.get('image_rotation'):
        raise ValueError('a region of a turned image (image_rotation) is not read')
    width, height = (region.get(f'original_{side}') for side in ('width', 'height'))
    size = image_size or documents.image_size_of(width, height)
    if size is None:
        raise ValueError('original_width and original_height are not the size of an image')
    sizes[task] = size
    score = region.get('score')
    box = Box(
        corners=(),
        class_id=_class(region),
        id=documents.plain_text(region.get('id')),
        score=1.0 if score is None else documents.json_number(score, 'score'),
    )
    if 'points' in region:
        return shapes.Outlined(task, box, [_polygon(region['points'], size)])
    if not all(name in region for name in ('x', 'y', 'width', 'height')):
        kind = region.get('type') or ', '.join(name for name in region if 'label' in str(name))
        raise ValueError(f'a region of type {kind!r} is not read, only rectangles and polygons are')
    return shapes.Outlined(task, _rectangle(region, box, size))


def _class(region: dict[str, Any]) -> str:
    lists = [value for name, value in region.items() if name.endswith('labels') and value]
    if not lists:
        return ''
    if len(lists) > 1 or not isinstance(lists[0], list) or len(lists[0]) != 1:
        raise ValueError(f'the region has not one label but {json.dumps(lists)[:80]}')
    return documents.plain_text(lists[0][0])


def _polygon(points: Any, size: ImageSize) -> FloatArray:
    if not isinstance(points, list) or len(points) < MIN_HULL_POINTS:
        raise ValueError("'points' is not an array of at least three points")
    percent = [documents.json_numbers(point, 2, 'a point') for point in points]
    # A point that is not finite is reported with the polygon.
    with np.errstate(over='ignore'):
        return np.array(percent, np.float64) * (np.array(size) / 100.0)


def _rectangle(region: dict[str, Any], box: Box, size: ImageSize) -> Box:
    x, y, width, height = (
        documents.json_number(region[name], name) * side / 100.0
        for name, side in zip(('x', 'y', 'width', 'height'), (*size, *size), strict=True)
    )
    degrees = documents.json_number(region.get('rotation') or 0.0, 'rotation')
    if degrees == 0.0:
        bounds = shapes.bounds_of_xywh(x, y, width, height)
        return box._replace(corners=shapes.upright_corners(bounds), reference=bounds)
    angle = math.radians(degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    centre_x = x + (width * cos - height * sin) / 2
    centre_y = y + (width * sin + height * cos) / 2
    return box._replace(corners=shapes.oriented_corners(centre_x, centre_y, width, height, angle))


def _sniff(head: str) -> bool:
    if head.lstrip().startswith('['):
        # The member that holds the regions may have any name.
        return any(path.endswith(JSON_PATHS) for path in documents.json_paths(head))
    first = next((line for line in head.splitlines() if line.strip()), '')
    return set(_columns(first)[1]) >= TABLE_COLUMNS


FORMAT = Format(
    name='label_studio',
    suffixes=('.json', '.csv', '.tsv'),
    summary='Label Studio JSON, JSON-MIN, CSV and TSV of many images: rectangles and polygons',
    sniff=_sniff,
    read=_read,
)
