# SPDX-License-Identifier: Apache-2.0
"""Find the bow of a ship from its hull: the end with less area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.study.metrics import hull_share
from obbhbb_ros.study.metrics import outlines

# An end is this share of the length.
END = 0.3
_FAR = 1e3
# Below this difference, as a share of the hull's area, the ends are alike.
_ALIKE = 1e-9


def bow_sides(boxes: OrientedBoxes, hulls: Sequence[FloatArray | None]) -> NDArray[np.int8]:
    """
    Find on which side of its centre each ship has its bow.

    The bow is the end, the outer 30 % of the length, with less hull area.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    hulls : sequence of (ndarray of shape (K, 2) or None)
        Their hull polygons, pixels.

    Returns
    -------
    ndarray of int, shape (N,)
        1 if the bow is in the direction of ``boxes.long_axis``, -1 if it is in the other; 0 if
        there is no hull or its ends are alike.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> hull = np.array([[20.0, 30.0], [70.0, 30.0], [80.0, 40.0], [70.0, 50.0], [20.0, 50.0]])
    >>> bow_sides(boxes, [hull])
    array([1], dtype=int8)
    """
    axes = np.stack((boxes.long_axis, boxes.short_axis), axis=2)
    squares = (axes**2).sum(axis=1)
    # Along and across the ship, from -1 to 1 in its box.
    local = [
        None if hull is None or not valid else (hull - center) @ turn / squared
        for hull, valid, center, turn, squared in zip(
            hulls, boxes.valid, boxes.center, axes, squares, strict=True
        )
    ]
    polygons, start = outlines(local), 1.0 - 2.0 * END
    ahead, astern = (
        hull_share(np.tile(end, (len(boxes), 1)), polygons)
        for end in ([start, -_FAR, _FAR, _FAR], [-_FAR, -_FAR, -start, _FAR])
    )
    difference = np.nan_to_num(astern - ahead)
    return np.where(np.abs(difference) > _ALIKE, np.sign(difference), 0).astype(np.int8)


def with_bows(boxes: OrientedBoxes, sides: NDArray[np.int8]) -> OrientedBoxes:
    """Return the same boxes with their bows known, from `bow_sides`."""
    along = np.where(sides[:, None] < 0, -boxes.long_axis, boxes.long_axis)
    return replace(boxes, first=along, second=boxes.short_axis, bow=sides != 0)
