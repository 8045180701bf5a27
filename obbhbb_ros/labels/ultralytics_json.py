# SPDX-License-Identifier: Apache-2.0
"""
The predictions of Ultralytics' OBB models, ``predictions.json``: many images, in pixels.

::

    [{"image_id": "P0706", "file_name": "P0706.png", "category_id": 1, "score": 0.91,
      "rbox": [292.0, 447.1, 38.6, 16.2, 2.31],
      "poly": [284.1, 466.0, 274.2, 456.3, 300.0, 427.1, 310.2, 439.4]}]

``poly`` has the corners; without it, ``rbox`` has centre, size and angle, in radians from image +x
towards +y, along the first size. Images without predictions are not in the file.

The file has no names of classes: they stay numbers, unless a file beside it names them, see
`class_names`. The first class is 1, or 0 in files that lack ``file_name``, those of versions before
8.3.49 (source: ultralytics/ultralytics #18140); where the numbers of such a file do not tell, it is
refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from functools import partial
from typing import Any
from typing import NamedTuple

from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.class_names import ClassNames
from obbhbb_ros.labels.class_names import find_class_names
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import Box
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_file import Record
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.text import is_index

PATHS = {'[{image_id', '[{score'}
BOX_PATHS = {'[{rbox[', '[{poly['}
MAX_DIGITS = 6


class Prediction(NamedTuple):
    """A box whose class is a number, its image, and whether its version names the file."""

    image: str
    box: Box
    has_file_name: bool


def _read(file: LabelFile) -> Iterator[ImageLabels]:
    document = documents.read_json(file)
    if not isinstance(document, list):
        raise file.error('not predictions of Ultralytics: not a JSON array')
    predictions = list(file.parse_records(documents.numbered('', document), _prediction))
    names = find_class_names(file.path.parent)
    if names.path is not None:
        rename = partial(_named, names, _first_class(file, predictions, names))
        predictions = list(file.parse_records(predictions, rename))
    images: dict[str, list[Box]] = {}
    for _, _, prediction in predictions:
        images.setdefault(prediction.image, []).append(prediction.box)
    return file.images(images, LabelSet(class_names=names.names))


def _first_class(
    file: LabelFile, predictions: Sequence[Record[Prediction]], names: ClassNames
) -> int:
    """Return the number of the first class, 0 or 1; raise FileError if it is not known."""
    numbers = {prediction.box.class_id for _, _, prediction in predictions}
    if '0' in numbers:
        return 0
    has_file_names = any(prediction.has_file_name for _, _, prediction in predictions)
    if has_file_names or not numbers or str(len(names.names)) in numbers:
        return 1
    where = names.path.name if names.path else ''
    raise file.error(
        f'its class numbers may begin with 0 or with 1, so the names in {where} do not fit for '
        'certain: write it with a newer version, or move the names away to keep numbers'
    )


def _named(names: ClassNames, first: int, prediction: Prediction) -> Prediction:
    number = prediction.box.class_id
    if not is_index(number) or len(number) > MAX_DIGITS or int(number) < first:
        raise ValueError(f'category_id {number!r} is not the number of a class')
    name = names.name(str(int(number) - first))
    return prediction._replace(box=prediction.box._replace(class_id=name))


def _prediction(record: Any) -> Prediction:
    documents.json_member(record, 'image_id')
    image = documents.plain_text(record.get('file_name') or record['image_id'])
    if not image:
        raise ValueError('no image name')
    box = Box(
        corners=_corners(record),
        class_id=documents.plain_text(documents.json_member(record, 'category_id')),
        score=documents.json_number(documents.json_member(record, 'score'), 'score'),
    )
    return Prediction(image, box, 'file_name' in record)


def _corners(record: dict[str, Any]) -> list[float] | shapes.Corners:
    if 'poly' in record:
        return documents.json_numbers(record['poly'], 8, 'poly')
    if 'rbox' not in record:
        raise ValueError("neither 'poly' nor 'rbox'")
    return shapes.oriented_corners(*documents.json_numbers(record['rbox'], 5, 'rbox'))


def _sniff(head: str) -> bool:
    paths = documents.json_paths(head)
    return paths >= PATHS and not paths.isdisjoint(BOX_PATHS)


FORMAT = Format(
    name='ultralytics',
    suffixes=('.json',),
    summary='predictions.json of Ultralytics OBB models: rbox and poly of many images',
    sniff=_sniff,
    read=_read,
)
