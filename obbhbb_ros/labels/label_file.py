# SPDX-License-Identifier: Apache-2.0
"""What the parser of a format works with: a label file, its records and their errors."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from typing import NamedTuple
from typing import NoReturn
from typing import TypeAlias
from typing import TypeVar

import numpy as np

from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.labels.extras import NO_EXTRAS
from obbhbb_ros.labels.extras import NO_PROPERTIES
from obbhbb_ros.labels.extras import NO_SET
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.extras import Id
from obbhbb_ros.labels.extras import LabelSet
from obbhbb_ros.labels.extras import columns_of
from obbhbb_ros.labels.extras import only_if_any
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize

NO_REFERENCE = (float('nan'),) * 4

Item = TypeVar('Item')

Record: TypeAlias = tuple[int | None, str, Item]
"""The line of a record, where there is one, the start of its error messages, and the record."""


class LabelError(ObbhbbError, ValueError):
    """
    A label file, or one record of it, that cannot be read.

    Attributes
    ----------
    path : Path
        The file or folder at fault.
    line : int or None
        Line of the record, counted from 1; None for the whole file.
    message : str
        What is wrong, without path and line.
    """

    def __init__(self, path: Path, line: int | None, message: str) -> None:
        super().__init__(path, line, message)
        self.path = path
        self.line = line
        self.message = message

    def __str__(self) -> str:
        """Return ``path:line: message``, as compilers write it."""
        place = f'{self.path}' if self.line is None else f'{self.path}:{self.line}'
        return f'{place}: {self.message}'


class FileError(LabelError):
    """A label file that cannot be used as a whole."""


OnError = Callable[[LabelError], None]


def raise_error(error: LabelError) -> NoReturn:
    """Raise the error; the default of `on_error`."""
    # Without the ValueError of the parser as its cause, which has the same message.
    raise error from None


class Box(NamedTuple):
    """
    One record of a label file, as a format's parser returns it.

    `corners` holds x1 y1 … x4 y4, `reference` x1 y1 x2 y2, all in pixels. With `bow`, the first
    two corners are the bow end. `crowd`, `difficulty` and `properties`, what else the record says,
    are as in `Extras`.
    """

    corners: Sequence[float]
    class_id: str
    id: str = ''
    score: float = 1.0
    reference: Sequence[float] = NO_REFERENCE
    hull: FloatArray | None = None
    bow: bool = False
    crowd: bool = False
    difficulty: int = 0
    properties: Mapping[str, Any] = NO_PROPERTIES


@dataclass(frozen=True)
class LabelFile:
    """
    A label file that is being read.

    Attributes
    ----------
    path : Path
        The file.
    image_size : tuple of int or None
        Width and height of every image in pixels, if the caller passes them.
    on_error : callable
        Gets a LabelError for each malformed record, which is left out; by default, the error is
        raised.
    """

    path: Path
    image_size: ImageSize | None = None
    on_error: OnError = raise_error

    def error(self, message: str, line: int | None = None) -> FileError:
        """Return the error to raise if the file as a whole cannot be used."""
        return FileError(self.path, line, message)

    def parse_records(
        self, records: Iterable[Record[Any]], parse: Callable[[Any], Item]
    ) -> Iterator[Record[Item]]:
        """Parse records one by one; report and skip those for which `parse` raises ValueError."""
        for line, place, record in records:
            try:
                item = parse(record)
            except ValueError as error:
                self.on_error(LabelError(self.path, line, f'{place}{error}'))
            else:
                yield line, place, item

    def parse_blocks(
        self,
        blocks: Iterable[tuple[Sequence[int], Sequence[Any]]],
        parse: Callable[[Sequence[Any]], Item],
        place: Callable[[int], tuple[int | None, str]] = lambda line: (line, ''),
    ) -> Iterator[Item]:
        """
        Parse records block by block; report and skip those for which `parse` raises ValueError.

        A block with such a record is halved until it is alone, so that the rules are those of
        `parse` alone, and errors are the same as if the records were parsed one by one.

        Parameters
        ----------
        blocks : iterable of pairs
            The numbers of N records, and the records.
        parse : callable
            Turns N records into an item.
        place : callable, optional
            The line of a number, where there is one, and the start of an error message; by default
            numbers are lines.
        """
        for numbers, records in blocks:
            waiting = [(0, len(records))] if records else []
            while waiting:
                start, stop = waiting.pop()
                try:
                    item = parse(records[start:stop])
                except ValueError as error:
                    if stop - start == 1:
                        line, before = place(numbers[start])
                        self.on_error(LabelError(self.path, line, f'{before}{error}'))
                    else:
                        middle = (start + stop) // 2
                        waiting += [(middle, stop), (start, middle)]
                else:
                    yield item

    def image(
        self,
        name: str,
        boxes: Sequence[Box],
        size: ImageSize | None = None,
        *,
        image_id: Id | None = None,
        file_name: str = '',
        label_set: LabelSet = NO_SET,
    ) -> ImageLabels:
        """
        Collect the N boxes of an image, which may be none, in arrays of N rows.

        `size` is that of the image if `image_size` is None; the others are as in `Extras`.
        """
        return ImageLabels(
            image=name,
            corners=np.array([box.corners for box in boxes], np.float64).reshape(-1, 4, 2),
            class_ids=tuple(box.class_id for box in boxes),
            ids=tuple(box.id for box in boxes),
            scores=np.array([box.score for box in boxes], np.float64),
            reference=np.array([box.reference for box in boxes], np.float64).reshape(-1, 4),
            hulls=tuple(box.hull for box in boxes),
            size=self.image_size or size,
            source=self.path,
            bow=only_if_any((box.bow for box in boxes), np.bool_),
            extras=Extras(
                crowd=only_if_any((box.crowd for box in boxes), np.bool_),
                difficulty=only_if_any((box.difficulty for box in boxes), np.int64),
                properties=columns_of([box.properties for box in boxes]),
                image_id=image_id,
                file_name=file_name,
                label_set=label_set,
            ),
        )

    def table(
        self,
        name: str,
        corners: FloatArray,
        class_ids: Sequence[str],
        *,
        ids: Sequence[str] | None = None,
        scores: FloatArray | None = None,
        reference: FloatArray | None = None,
        size: ImageSize | None = None,
        extras: Extras = NO_EXTRAS,
    ) -> ImageLabels:
        """Collect N boxes that are columns already: corners, (N, 4, 2), and what else is known."""
        count = len(class_ids)
        return ImageLabels(
            image=name,
            corners=corners,
            class_ids=tuple(class_ids),
            ids=('',) * count if ids is None else tuple(ids),
            scores=np.ones(count) if scores is None else scores,
            reference=np.full((count, 4), np.nan) if reference is None else reference,
            hulls=(None,) * count,
            size=self.image_size or size,
            source=self.path,
            extras=extras,
        )

    def images(
        self, boxes: Mapping[str, Sequence[Box]], label_set: LabelSet = NO_SET
    ) -> Iterator[ImageLabels]:
        """Collect the boxes of images by name."""
        return (self.image(name, rows, label_set=label_set) for name, rows in boxes.items())
