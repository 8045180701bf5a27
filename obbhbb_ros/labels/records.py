# SPDX-License-Identifier: Apache-2.0
"""What every label format is read into and written from."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from typing import NoReturn

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

NO_REFERENCE = (float('nan'),) * 4
MIN_HULL_POINTS = 3


class LabelError(ValueError):
    """
    A label file, or one record of it, that cannot be read.

    Not a frozen dataclass, because Python itself sets attributes of an exception in flight.

    Attributes
    ----------
    path : Path
        The file or folder at fault.
    line : int or None
        Line of the record, counted from 1; None where the whole file is meant.
    message : str
        What is wrong, without path and line.
    """

    def __init__(self, path: Path, line: int | None, message: str) -> None:
        """Keep the three parts; ``str()`` joins them as ``path:line: message``."""
        super().__init__(path, line, message)
        self.path = path
        self.line = line
        self.message = message

    def __str__(self) -> str:
        """Return ``path:line: message``, as compilers write it."""
        place = f'{self.path}' if self.line is None else f'{self.path}:{self.line}'
        return f'{place}: {self.message}'


OnError = Callable[[LabelError], None]


def raise_error(error: LabelError) -> NoReturn:
    """Raise the error: what a reader does that was given no `on_error`."""
    # The parser's own ValueError says the same again, so it is not shown as the cause.
    raise error from None


@dataclass(frozen=True, eq=False)
class ImageLabels:
    """
    The labels of one image, in the order of the file.

    Compared by identity, since arrays have no single truth value.

    Attributes
    ----------
    image : str
        Image name without folder and suffix, or as the image column of a table has it.
    corners : FloatArray
        Corners of N oriented boxes in order around each box, shape (N, 4, 2), pixels.
    class_ids : tuple of str
        N classes.
    ids : tuple of str
        N instance ids, '' where the format has none.
    scores : FloatArray
        Shape (N,), 1.0 where the format has none.
    reference : FloatArray
        Reference axis-aligned boxes as xyxy, shape (N, 4), pixels; rows of NaN where none.
    hulls : tuple of (FloatArray or None)
        N hull polygons of shape (K, 2), pixels, or None.
    size : tuple of int or None
        Image width and height in pixels where known.
    source : Path
        The file the labels came from.

    Raises
    ------
    ValueError
        If the fields do not agree on N or an array has another shape.
    """

    image: str
    corners: FloatArray
    class_ids: tuple[str, ...]
    ids: tuple[str, ...]
    scores: FloatArray
    reference: FloatArray
    hulls: tuple[FloatArray | None, ...]
    size: tuple[int, int] | None
    source: Path

    def __post_init__(self) -> None:
        """Check that all fields speak of the same number of boxes."""
        count = len(self.class_ids)
        self._check_shape('corners', self.corners, (count, 4, 2))
        self._check_shape('scores', self.scores, (count,))
        self._check_shape('reference', self.reference, (count, 4))
        for name, values in (('ids', self.ids), ('hulls', self.hulls)):
            if len(values) != count:
                raise ValueError(f'{name} has {len(values)} entries for {count} class_ids')

    @staticmethod
    def _check_shape(name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            raise ValueError(f'{name} has shape {array.shape}, class_ids ask for {shape}')


class Box(NamedTuple):
    """
    One record of a label file: what a format's parser makes of it.

    `corners` holds x1 y1 … x4 y4, `reference` x1 y1 x2 y2, all in pixels.
    """

    corners: Sequence[float]
    class_id: str
    id: str = ''
    score: float = 1.0
    reference: Sequence[float] = NO_REFERENCE
    hull: FloatArray | None = None


def assemble(
    image: str,
    boxes: Sequence[Box],
    size: tuple[int, int] | None,
    source: Path,
) -> ImageLabels:
    """
    Gather the records of one image into arrays.

    Parameters
    ----------
    image : str
        Image name.
    boxes : sequence of Box
        N records in the order of the file, N may be 0.
    size : tuple of int or None
        Image width and height in pixels where known.
    source : Path
        The file the records came from.

    Returns
    -------
    ImageLabels
        With N boxes; the arrays of an image without boxes have a leading dimension of 0.
    """
    return ImageLabels(
        image=image,
        corners=_array([box.corners for box in boxes], (-1, 4, 2)),
        class_ids=tuple(box.class_id for box in boxes),
        ids=tuple(box.id for box in boxes),
        scores=_array([box.score for box in boxes], (-1,)),
        reference=_array([box.reference for box in boxes], (-1, 4)),
        hulls=tuple(box.hull for box in boxes),
        size=size,
        source=source,
    )


def _array(values: Sequence[object], shape: tuple[int, ...]) -> FloatArray:
    return np.array(values, dtype=np.float64).reshape(shape)
