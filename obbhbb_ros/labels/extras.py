# SPDX-License-Identifier: Apache-2.0
"""What label files say beyond the boxes, so that it can be written again."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

Id = int | str

NO_PROPERTIES: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class LabelSet:
    """
    What all images of a file have in common.

    Attributes
    ----------
    categories : mapping of str to (int or str)
        The id of each class that the file lists, used or not, in the order of the file.
    crs : str
        Reference system of the coordinates, as GIS libraries take it: ``EPSG:32633`` or WKT;
        '' for pixels.
    in_degrees : bool
        Whether `crs` is in degrees, and the coordinates of `ImageLabels` are in the plane of
        `obbhbb_ros.labels.degrees`.
    placed : bool
        Whether the labels were in a map, and were placed in the pixels of the image beside them,
        whose size they have.
    class_names : tuple of str
        The names of class numbers, '' for a number without one, where the format has numbers.
    others : tuple of str
        Names of what the file says besides, and which no format holds.
    """

    categories: Mapping[str, Id] = field(default_factory=dict)
    crs: str = ''
    in_degrees: bool = False
    placed: bool = False
    class_names: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


NO_SET = LabelSet()


@dataclass(frozen=True, eq=False)
class Extras:
    """
    What the source says of an image and its N boxes beyond the boxes.

    Attributes
    ----------
    crowd : ndarray of bool or None
        Which boxes are groups of ships (``iscrowd``), shape (N,); None if no box is.
    difficulty : ndarray of int or None
        How difficult the boxes are, 0 for easy ones, shape (N,); None if no box is difficult.
    properties : mapping of str to sequence
        Further columns by name, each of N values, in the order of the file; None where a box has
        no value.
    image_id : int, str or None
        The id of the image in the file.
    file_name : str
        The name of the image file, where it is not `image`.
    label_set : LabelSet
        What all images of the file have in common.
    """

    crowd: npt.NDArray[np.bool_] | None = None
    difficulty: npt.NDArray[np.int64] | None = None
    properties: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    image_id: Id | None = None
    file_name: str = ''
    label_set: LabelSet = NO_SET

    def check(self, image: str, count: int) -> None:
        """Raise ValueError, which names the image, if a field does not have `count` rows."""
        columns = {'crowd': self.crowd, 'difficulty': self.difficulty, **self.properties}
        for name, values in columns.items():
            if values is not None and len(values) != count:
                raise ValueError(
                    f'image {image!r}: {name} has {len(values)} entries for {count} class_ids'
                )

    def take(self, rows: npt.NDArray[np.intp]) -> Extras:
        """Select boxes by their row numbers."""
        return replace(
            self,
            crowd=None if self.crowd is None else self.crowd[rows],
            difficulty=None if self.difficulty is None else self.difficulty[rows],
            properties={
                name: tuple(values[row] for row in rows.tolist())
                for name, values in self.properties.items()
            },
        )


NO_EXTRAS = Extras()


def columns_of(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Sequence[Any]]:
    """Turn N mappings into columns of N values, in the order in which the names appear."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: tuple(row.get(name) for row in rows) for name in names}


def only_if_any(values: Iterable[int], dtype: npt.DTypeLike) -> npt.NDArray[Any] | None:
    """Return the values as an array, or None if all of them are 0."""
    array = np.array(list(values), dtype)
    return array if array.any() else None
