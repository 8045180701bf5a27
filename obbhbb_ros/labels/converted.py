# SPDX-License-Identifier: Apache-2.0
"""Axis-aligned boxes on their way to a file."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from obbhbb_ros.converter import Conversion
from obbhbb_ros.labels.records import FloatArray

DIAGNOSTICS = ('length', 'width', 'theta', 't_x', 't_y', 'capped')

Value = float | bool | None


@dataclass(frozen=True, eq=False)
class ConvertedImage:
    """
    The axis-aligned boxes of one image.

    Attributes
    ----------
    image : str
        Image name, as `ImageLabels` has it.
    xyxy : FloatArray
        x_min, y_min, x_max, y_max of N boxes, shape (N, 4), pixels.
    class_ids : tuple of str
        N classes.
    ids : tuple of str
        N instance ids, '' for none.
    scores : FloatArray
        Shape (N,).
    size : tuple of int or None
        Image width and height in pixels where known.
    source : Path
        The file the boxes came from.
    diagnostics : Conversion or None
        How the N boxes came about; its `xyxy` and `valid` are not looked at.

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
    size: tuple[int, int] | None
    source: Path
    diagnostics: Conversion | None = None

    def __post_init__(self) -> None:
        """Check that all fields speak of the same number of boxes, and those are boxes."""
        count = len(self.class_ids)
        given = [len(self.ids), len(self.scores), len(self.xyxy)]
        if self.diagnostics is not None:
            given.append(len(self.diagnostics.length))
        if given != [count] * len(given) or self.xyxy.shape != (count, 4):
            raise ValueError(f'image {self.image!r}: fields do not agree on the number of boxes')
        if not (np.isfinite(self.xyxy).all() and np.isfinite(self.scores).all()):
            raise ValueError(f'image {self.image!r}: a box has a value that is not finite')


class ConvertedBox(NamedTuple):
    """One box in Python numbers; what `diagnostics` does not know is None."""

    xyxy: list[float]
    class_id: str
    id: str
    score: float
    diagnostics: Mapping[str, Value]


def converted_boxes(converted: ConvertedImage) -> Iterator[ConvertedBox]:
    """
    Go through the boxes of an image.

    Parameters
    ----------
    converted : ConvertedImage
        The image.

    Yields
    ------
    ConvertedBox
        With the six diagnostics, or with none.
    """
    columns: dict[str, list[Value]] = {}
    if converted.diagnostics is not None:
        columns = {
            name: [_known(value) for value in getattr(converted.diagnostics, name).tolist()]
            for name in DIAGNOSTICS
        }
    rows = zip(
        converted.xyxy.tolist(), converted.class_ids, converted.ids, converted.scores.tolist(),
        strict=True,
    )
    for index, (xyxy, class_id, instance, score) in enumerate(rows):
        row = {name: values[index] for name, values in columns.items()}
        yield ConvertedBox(xyxy, class_id, instance, score, row)


def _known(value: float | bool) -> Value:
    # Rules that touch no curve have no t_x: NaN, which JSON does not know.
    return None if value != value else value  # noqa: PLR0124
