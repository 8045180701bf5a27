# SPDX-License-Identifier: Apache-2.0
"""The annotations of a COCO file: plain ones by columns, all others one by one."""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import FARTHEST
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.labels import documents
from obbhbb_ros.labels import shapes
from obbhbb_ros.labels.coco_boxes import annotated_box
from obbhbb_ros.labels.coco_boxes import id_of
from obbhbb_ros.labels.coco_boxes import widest_angle
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import Id
from obbhbb_ros.labels.extras import only_if_any
from obbhbb_ros.labels.image_grouper import ImageGrouper
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile

# An annotation with these members, one polygon of four corners and a bbox of four numbers is plain.
PLAIN = {'id', 'image_id', 'category_id', 'segmentation', 'bbox', 'area', 'iscrowd'}


class AnnotationReader:
    """
    Reads the annotations of a file.

    Parameters
    ----------
    file : LabelFile
        The file.
    images : collection of Id
        The images, in their order.
    categories : mapping of Id to str or None
        The names of the categories; None if the file lists none.
    annotations : list
        The annotations; forgotten as they are read, so that a large file is in memory only once.
    """

    def __init__(
        self,
        file: LabelFile,
        images: Collection[Id],
        categories: Mapping[Id, str] | None,
        annotations: list[Any],
    ) -> None:
        self._file, self._images, self._categories = file, images, categories
        self._annotations = annotations
        # A number and its text are different ids.
        self._keys = dict.fromkeys(map(repr, images))

    def images(self) -> Iterator[ImageLabels]:
        """Return the labels of every image, in the order of the images."""
        grouper = ImageGrouper()
        grouper.add(list(self._keys), [False] * len(self._keys), self._file.image('', []))
        widest = widest_angle(self._annotations)
        for start in range(0, len(self._annotations), BLOCK):
            block = self._annotations[start : start + BLOCK]
            self._annotations[start : start + BLOCK] = [None] * len(block)
            with suppress(ValueError):
                images, table = self._plain(block)
                grouper.add(images, [True] * len(images), table)
                continue
            self._add_others(grouper, start, block, widest)
        return grouper.images()

    def _plain(self, annotations: Sequence[Any]) -> tuple[list[str], ImageLabels]:
        """
        Turn annotations into columns.

        Raises ValueError, without a reason, if one is not plain or not sound.
        """
        if {*map(type, annotations)} != {dict} or not PLAIN.issuperset(
            chain.from_iterable(annotations)
        ):
            raise ValueError
        columns = {name: [record.get(name) for record in annotations] for name in PLAIN}
        _check_types(columns['image_id'], int, str)
        _check_types(columns['category_id'], int, str)
        _check_types(columns['id'], int, str, type(None))
        _check_types(columns['iscrowd'], int, type(None))
        if not {None, 0, 1}.issuperset(columns['iscrowd']):
            raise ValueError
        polygons = columns['segmentation']
        _check_types(polygons, list)
        if {*map(len, polygons)} != {1}:
            raise ValueError
        corners = _rows([polygon[0] for polygon in polygons], 8).reshape(-1, 4, 2)
        bbox = _rows(columns['bbox'], 4)
        closed = (corners[:, 0] == corners[:, 3]).all(axis=1)
        sound = OrientedBoxes.from_corners(corners).valid & ~closed & (bbox[:, 2:] >= 0).all(axis=1)
        if not sound.all():
            raise ValueError
        images = list(map(repr, columns['image_id']))
        if not self._keys.keys() >= {*images}:
            raise ValueError
        table = ImageLabels(
            image='',
            corners=corners,
            class_ids=tuple(map(self._class_of, columns['category_id'])),
            ids=tuple(map(documents.plain_text, columns['id'])),
            scores=np.ones(len(images)),
            reference=np.hstack((bbox[:, :2], bbox[:, :2] + bbox[:, 2:])),
            hulls=(None,) * len(images),
            size=None,
            source=self._file.path,
            extras=Extras(crowd=only_if_any(map(bool, columns['iscrowd']), np.bool_)),
        )
        return images, table

    def _class_of(self, key: Id) -> str:
        """Return the name of a category; raise ValueError if it is not in the file."""
        if self._categories is None:
            return documents.plain_text(key)
        if key not in self._categories:
            raise ValueError(f"'category_id' is {key!r}, which is not in the file")
        return self._categories[key]

    def _add_others(
        self, grouper: ImageGrouper, first: int, annotations: Sequence[Any], widest: float
    ) -> None:
        """Parse annotations one by one; report and skip those that are no box."""
        records = (
            (None, f'annotations[{number}]: ', record)
            for number, record in enumerate(annotations, first)
        )
        parsed = self._file.parse_records(records, partial(self._record, widest))
        for image, boxes in shapes.enclose(self._file, parsed).items():
            grouper.add([image] * len(boxes), [True] * len(boxes), self._file.image('', boxes))

    def _record(self, widest: float, annotation: Any) -> shapes.Outlined:
        image = id_of(annotation, 'image_id')
        if image not in self._images:
            raise ValueError(f"'image_id' is {image!r}, which is not in the file")
        class_id = self._class_of(id_of(annotation, 'category_id'))
        return annotated_box(annotation, repr(image), class_id, widest)


def _check_types(values: Sequence[Any], *kinds: type) -> None:
    if not {*map(type, values)} <= {*kinds}:
        raise ValueError


def _rows(lists: Sequence[Any], size: int) -> FloatArray:
    """Turn N lists of `size` numbers into an array that GEOS can compute with."""
    _check_types(lists, list)
    if {*map(len, lists)} != {size}:
        raise ValueError
    numbers = list(chain.from_iterable(lists))
    _check_types(numbers, int, float)
    try:
        rows = np.array(numbers, np.float64).reshape(-1, size)
    except OverflowError:
        raise ValueError from None
    # Not true of NaN either.
    if not (np.abs(rows) <= FARTHEST).all():
        raise ValueError
    return rows
