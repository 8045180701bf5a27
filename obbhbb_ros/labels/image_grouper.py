# SPDX-License-Identifier: Apache-2.0
"""
Labels of many images in columns: how a file with many records is parsed fast.

A table is an `ImageLabels` without a name whose boxes may belong to several images.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from itertools import count
from typing import Any

import numpy as np
import numpy.typing as npt

from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.image_labels import ImageLabels

ROW_ARRAYS = ('corners', 'scores', 'reference')
ROW_TUPLES = ('class_ids', 'ids', 'hulls')


class ImageGrouper:
    """Collects tables, and gives the labels of each image in the order of first appearance."""

    def __init__(self) -> None:
        self._numbers: defaultdict[str, int] = defaultdict(count().__next__)
        self._rows: list[npt.NDArray[np.int64]] = []
        self._tables: list[ImageLabels] = []

    def add(self, images: Sequence[str], filled: Sequence[bool], table: ImageLabels) -> None:
        """Add a table; `filled` says for each of the images whether a box of the table is its."""
        rows = np.fromiter(map(self._numbers.__getitem__, images), np.int64)
        self._rows.append(rows[np.array(filled, np.bool_)])
        self._tables.append(table)

    def images(self) -> Iterator[ImageLabels]:
        """Return the labels of each image; the boxes stay in their order."""
        if not self._tables:
            return
        rows, table = np.concatenate(self._rows), concatenated(self._tables)
        self._rows, self._tables = [], []
        if np.any(rows[1:] < rows[:-1]):
            order = np.argsort(rows, kind='stable')
            rows, table = rows[order], _reordered(table, order)
        ends = np.searchsorted(rows, np.arange(len(self._numbers)), side='right').tolist()
        start = 0
        for name, end in zip(self._numbers, ends, strict=True):
            yield _part(table, name, slice(start, end))
            start = end


def concatenated(tables: Sequence[ImageLabels]) -> ImageLabels:
    """Join at least one table; name, size and source are those of the first."""
    if len(tables) == 1:
        return tables[0]
    fields: dict[str, Any] = {
        name: np.concatenate([getattr(table, name) for table in tables]) for name in ROW_ARRAYS
    } | {
        name: tuple(chain.from_iterable(getattr(table, name) for table in tables))
        for name in ROW_TUPLES
    }
    lengths = [len(table.class_ids) for table in tables]
    return replace(
        tables[0],
        **fields,
        bow=_joined([table.bow for table in tables], lengths),
        extras=_joined_extras([table.extras for table in tables], lengths),
    )


def _joined(arrays: Sequence[npt.NDArray[Any] | None], lengths: Sequence[int]) -> Any:
    """Join arrays, zeros for those that are None; None if all are."""
    given = [array for array in arrays if array is not None]
    if not given:
        return None
    pairs = zip(arrays, lengths, strict=True)
    parts = [np.zeros(size, given[0].dtype) if array is None else array for array, size in pairs]
    return np.concatenate(parts)


def _joined_extras(extras: Sequence[Extras], lengths: Sequence[int]) -> Extras:
    names = dict.fromkeys(name for part in extras for name in part.properties)
    return replace(
        extras[0],
        crowd=_joined([part.crowd for part in extras], lengths),
        difficulty=_joined([part.difficulty for part in extras], lengths),
        properties={name: _joined_column(name, extras, lengths) for name in names},
    )


def _joined_column(name: str, extras: Sequence[Extras], lengths: Sequence[int]) -> tuple[Any, ...]:
    pairs = zip(extras, lengths, strict=True)
    columns = (part.properties.get(name, (None,) * size) for part, size in pairs)
    return tuple(chain.from_iterable(columns))


def _reordered(table: ImageLabels, order: npt.NDArray[np.intp]) -> ImageLabels:
    """Put the boxes of a table in another order."""
    rows = order.tolist()
    fields: dict[str, Any] = {name: getattr(table, name)[order] for name in ROW_ARRAYS} | {
        name: tuple(map(getattr(table, name).__getitem__, rows)) for name in ROW_TUPLES
    }
    bow = None if table.bow is None else table.bow[order]
    return replace(table, **fields, bow=bow, extras=table.extras.take(order))


def _part(table: ImageLabels, image: str, rows: slice) -> ImageLabels:
    """Cut the labels of an image out of a table."""
    extras = table.extras
    return ImageLabels(
        image,
        table.corners[rows],
        table.class_ids[rows],
        table.ids[rows],
        table.scores[rows],
        table.reference[rows],
        table.hulls[rows],
        table.size,
        table.source,
        None if table.bow is None else table.bow[rows],
        replace(
            extras,
            crowd=None if extras.crowd is None else extras.crowd[rows],
            difficulty=None if extras.difficulty is None else extras.difficulty[rows],
            properties={name: values[rows] for name, values in extras.properties.items()},
        ),
    )
