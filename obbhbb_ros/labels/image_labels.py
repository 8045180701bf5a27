# SPDX-License-Identifier: Apache-2.0
"""The labels of an image as they are read, and its axis-aligned boxes as they are written."""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from pathlib import Path
from typing import Any
from typing import Literal
from typing import NamedTuple
from typing import TypeAlias
from typing import TypeVar
from typing import get_args

import numpy as np
import numpy.typing as npt

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import Conversion
from obbhbb_ros.labels.extras import NO_EXTRAS
from obbhbb_ros.labels.extras import NO_PROPERTIES
from obbhbb_ros.labels.extras import Extras
from obbhbb_ros.labels.image_names import bare_name

ImageSize = tuple[int, int]

MIN_HULL_POINTS = 3
DIAGNOSTICS = ('length', 'width', 'theta', 't_x', 't_y', 'capped')

BowSource: TypeAlias = Literal['none', 'labels', 'first-edge']
BOW_SOURCES: tuple[BowSource, ...] = get_args(BowSource)

Value = float | bool | None


@dataclass(frozen=True, eq=False)
class ImageLabels:
    """
    The labels of one image, in the order of the file.

    Attributes
    ----------
    image : str
        Image name without folder and suffix, or as the image column of a table has it.
    corners : FloatArray
        Corners of N oriented boxes, in any order, shape (N, 4, 2), pixels.
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
    bow : ndarray of bool or None
        Which labels say where the bow is, shape (N,): there the first two corners are the bow end.
        None if no label does.
    extras : Extras
        What the file says beyond this.

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
    size: ImageSize | None
    source: Path
    bow: npt.NDArray[np.bool_] | None = None
    extras: Extras = NO_EXTRAS

    def __post_init__(self) -> None:
        """Check that all fields have the same number of boxes."""
        count = len(self.class_ids)
        arrays = {'corners': (4, 2), 'scores': (), 'reference': (4,)}
        if self.bow is not None:
            arrays['bow'] = ()
        for name, row_shape in arrays.items():
            actual, shape = getattr(self, name).shape, (count, *row_shape)
            if actual != shape:
                raise ValueError(f'{name} has shape {actual}, not {shape} for {count} class_ids')
        for name in ('ids', 'hulls'):
            if (entries := len(getattr(self, name))) != count:
                raise ValueError(f'{name} has {entries} entries for {count} class_ids')
        self.extras.check(self.image, count)

    def take(self, rows: npt.NDArray[np.intp]) -> ImageLabels:
        """Select labels by their row numbers."""
        return replace(
            self,
            corners=self.corners[rows],
            class_ids=tuple(self.class_ids[row] for row in rows),
            ids=tuple(self.ids[row] for row in rows),
            scores=self.scores[rows],
            reference=self.reference[rows],
            hulls=tuple(self.hulls[row] for row in rows),
            bow=None if self.bow is None else self.bow[rows],
            extras=self.extras.take(rows),
        )

    @property
    def difficulties(self) -> list[int]:
        """How difficult the N boxes are, 0 for easy ones."""
        values = self.extras.difficulty
        return [0] * len(self.class_ids) if values is None else values.tolist()

    def boxes(self, bow: BowSource = 'none') -> OrientedBoxes:
        """
        Return the oriented boxes.

        `bow` says where the bow is known: where the labels say so (`labels`), at the first two
        corners of every box (`first-edge`), or nowhere (`none`). It is also unknown where the first
        two corners are a long side.
        """
        if bow not in BOW_SOURCES:
            raise ValueError(f'bow must be one of {", ".join(BOW_SOURCES)}, not {bow!r}')
        if bow == 'labels' and self.bow is not None:
            return OrientedBoxes.from_corners(self.corners, bow=self.bow)
        return OrientedBoxes.from_corners(self.corners, bow=bow == 'first-edge')


class BoxRow(NamedTuple):
    """One axis-aligned box in Python numbers; an unknown diagnostic or property is None."""

    xyxy: list[float]
    class_id: str
    id: str
    score: float
    diagnostics: Mapping[str, Value]
    crowd: bool = False
    difficulty: int = 0
    properties: Mapping[str, Any] = NO_PROPERTIES


@dataclass(frozen=True, eq=False)
class ImageBoxes:
    """
    The axis-aligned boxes of one image, to be written.

    Attributes
    ----------
    xyxy : FloatArray
        x_min, y_min, x_max, y_max of N boxes, shape (N, 4), pixels.
    diagnostics : Conversion or None
        How the N boxes were computed; its `xyxy` and `valid` are not used.
    image, class_ids, ids, scores, size, source, extras
        As in `ImageLabels`.

    Raises
    ------
    ValueError
        If the fields do not agree on N, or a box is not finite.
    """

    image: str
    xyxy: FloatArray
    class_ids: tuple[str, ...]
    ids: tuple[str, ...]
    scores: FloatArray
    size: ImageSize | None
    source: Path
    diagnostics: Conversion | None = None
    extras: Extras = NO_EXTRAS

    def __post_init__(self) -> None:
        """Check that all fields have the same number of boxes, and that these are finite."""
        count = len(self.class_ids)
        lengths = {len(self.ids), len(self.scores)}
        if self.diagnostics is not None:
            lengths.add(len(self.diagnostics.length))
        if lengths != {count} or self.xyxy.shape != (count, 4):
            raise ValueError(f'image {self.image!r}: fields do not agree on the number of boxes')
        if not (np.isfinite(self.xyxy).all() and np.isfinite(self.scores).all()):
            raise ValueError(f'image {self.image!r}: a box has a value that is not finite')
        self.extras.check(self.image, count)

    @property
    def file_name(self) -> str:
        """The name of the image, with folder and suffix of its file where that has this name."""
        name = self.extras.file_name
        return name if name and bare_name(name) == bare_name(self.image) else self.image

    def rows(self, reserved: Collection[str] = ()) -> Iterator[BoxRow]:
        """
        Iterate over the boxes, with the six diagnostics or with none.

        Properties named like a diagnostic or like one of the `reserved` names, which are in lower
        case, are left out.
        """
        names = () if self.diagnostics is None else DIAGNOSTICS
        columns = {name: getattr(self.diagnostics, name).tolist() for name in names}
        crowd, difficulty = self.extras.crowd, self.extras.difficulty
        properties = self._properties_besides({*names, *reserved})
        rows = zip(self.xyxy.tolist(), self.class_ids, self.ids, self.scores.tolist(), strict=True)
        for index, row in enumerate(rows):
            yield BoxRow(
                *row,
                {name: _none_if_nan(values[index]) for name, values in columns.items()},
                crowd is not None and bool(crowd[index]),
                0 if difficulty is None else int(difficulty[index]),
                {name: values[index] for name, values in properties.items()},
            )

    def _properties_besides(self, taken: Collection[str]) -> Mapping[str, Sequence[Any]]:
        properties = self.extras.properties
        return {name: properties[name] for name in properties if name.lower() not in taken}


def _none_if_nan(value: Value) -> Value:
    # Methods without a curve have t_x NaN, which JSON cannot hold.
    return None if value != value else value  # noqa: PLR0124


AnyImage = TypeVar('AnyImage', ImageLabels, ImageBoxes)
