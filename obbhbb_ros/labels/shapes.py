# SPDX-License-Identifier: Apache-2.0
"""Corners of boxes from what formats give instead: bounds, centre and angle, polygons."""

from __future__ import annotations

import math
from collections.abc import Iterator
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely

from obbhbb_ros.boxes import BLOCK
from obbhbb_ros.boxes import FARTHEST
from obbhbb_ros.boxes import Defect
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.boxes import range_defect
from obbhbb_ros.labels.records import NO_REFERENCE
from obbhbb_ros.labels.records import Box
from obbhbb_ros.labels.records import FloatArray
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError

Corners = tuple[float, float, float, float, float, float, float, float]

BOX_CORNERS = 4
PROBLEMS = {
    Defect.NOT_FINITE: 'the polygon has a coordinate that is not finite',
    Defect.EMPTY: 'the polygon has no area',
    Defect.TOO_FEW_POINTS: 'the polygon has fewer than three distinct points',
    Defect.NO_RECTANGLE: (
        f'no rectangle can be laid around the polygon: a coordinate beyond {FARTHEST:g}, or points '
        'too close to tell apart'
    ),
}


def upright_corners(xyxy: Sequence[float]) -> Corners:
    """
    Give the corners of an axis-aligned box.

    Parameters
    ----------
    xyxy : sequence of float
        x_min, y_min, x_max, y_max, pixels.

    Returns
    -------
    tuple of float
        x1 y1 … x4 y4, around the box.

    Raises
    ------
    ValueError
        If a maximum is less than its minimum.
    """
    x_min, y_min, x_max, y_max = xyxy
    if x_max < x_min or y_max < y_min:
        raise ValueError(f'the box is inside out: {x_min} {y_min} to {x_max} {y_max}')
    return (x_min, y_min, x_max, y_min, x_max, y_max, x_min, y_max)


def bounds_of_xywh(x: float, y: float, width: float, height: float) -> list[float]:
    """
    Turn a corner and a size into x_min, y_min, x_max, y_max.

    Raises
    ------
    ValueError
        If a size is negative.
    """
    _check_size(width, height)
    return [x, y, x + width, y + height]


def oriented_corners(x: float, y: float, width: float, height: float, angle: float) -> Corners:
    """
    Give the corners of a box that is turned about its centre.

    Parameters
    ----------
    x, y : float
        Centre, pixels.
    width, height : float
        Extent along `angle` and across it, pixels.
    angle : float
        Radians from image +x towards +y.

    Returns
    -------
    tuple of float
        x1 y1 … x4 y4, around the box.

    Raises
    ------
    ValueError
        If a size is negative.
    """
    _check_size(width, height)
    ux, uy = math.cos(angle) * width / 2, math.sin(angle) * width / 2
    vx, vy = -math.sin(angle) * height / 2, math.cos(angle) * height / 2
    return (
        x - ux - vx, y - uy - vy, x + ux - vx, y + uy - vy,
        x + ux + vx, y + uy + vy, x - ux + vx, y - uy + vy,
    )  # fmt: skip


def _check_size(width: float, height: float) -> None:
    if width < 0.0 or height < 0.0:
        raise ValueError(f'the box has a negative size: {width} x {height}')


class Outlined(NamedTuple):
    """
    A record whose box is known or, where it has `points`, still to be laid around them.

    `place` is put before what is wrong with it, `line` is its line where known; `image` is what
    tells its image from the others of the file.
    """

    image: str
    place: str
    line: int | None
    box: Box
    points: FloatArray | None = None


def ring_of(values: object) -> FloatArray:
    """
    Turn nested lists of positions into an array.

    Parameters
    ----------
    values : sequence of sequences of float
        K positions; what follows x and y in each is ignored.

    Returns
    -------
    ndarray of float64, shape (K, 2)
        The positions.

    Raises
    ------
    ValueError
        If they are anything else.
    """
    try:
        ring = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError('a ring is not a list of positions') from None
    if ring.ndim != 2 or ring.shape[1] < 2:
        raise ValueError('a ring is not a list of positions')
    return ring if ring.shape[1] == 2 else np.ascontiguousarray(ring[:, :2])


def check_coordinates(points: FloatArray) -> None:
    """
    Check that polygons can be computed with.

    Raises
    ------
    ValueError
        If a coordinate is not finite, or so large that GEOS crashes on it or never ends.
    """
    defect = range_defect(points)
    if defect != Defect.NONE:
        raise ValueError(PROBLEMS[defect])


def outline(rings: Sequence[FloatArray], box: Box) -> tuple[Box, FloatArray]:
    """
    Add the hull that the outer rings of a ship's polygons show.

    Several parts are one ship, cut by what hides it: the hull is the convex hull of them all. A
    ring of four corners is somebody's box and no hull. Where it is an upright rectangle it is the
    reference box too, unless there is one.

    Parameters
    ----------
    rings : sequence of ndarray, each of shape (K, 2)
        The outer ring of each part, at least one; closed or not. Holes are part of the ship.
    box : Box
        The record; its corners are not looked at.

    Returns
    -------
    Box, ndarray of shape (K, 2)
        The record with the hull, and the points that its corners are to be laid around.

    Raises
    ------
    ValueError
        If there is no ring, or a value is not finite or too large.
    """
    if not rings:
        raise ValueError('the polygon is empty')
    points = rings[0] if len(rings) == 1 else np.concatenate(rings)
    check_coordinates(points)
    ring = _without_closing(rings[0])
    if len(rings) > 1:
        ring = _convex_ring(points)
    if len(rings) > 1 or len(ring) != BOX_CORNERS:
        return box._replace(hull=ring if len(ring) >= 3 else None), points
    if box.reference is NO_REFERENCE and _is_upright(ring):
        reference = [*ring.min(axis=0).tolist(), *ring.max(axis=0).tolist()]
        return box._replace(reference=reference), points
    return box, points


def _without_closing(ring: FloatArray) -> FloatArray:
    closed = len(ring) > 1 and bool((ring[0] == ring[-1]).all())
    return ring[:-1] if closed else ring


def _convex_ring(points: FloatArray) -> FloatArray:
    hull = shapely.convex_hull(shapely.multipoints(points))
    return np.asarray(_without_closing(shapely.get_coordinates(hull)))


def _is_upright(ring: FloatArray) -> bool:
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = ring.tolist()
    return x0 != x2 and y0 != y2 and (
        (y0, x1, y2, x3) == (y1, x2, y3, x0) or (x0, y1, x2, y3) == (x1, y2, x3, y0)
    )


def enclose(path: Path, records: list[Outlined], on_error: OnError) -> list[Outlined]:
    """
    Lay the minimum rotated rectangle around every outline of a file.

    Parameters
    ----------
    path : Path
        The file they came from.
    records : list of Outlined
        The records; those without points stay as they are. The list is emptied on the way: of a
        large file there would be every outline beside its box.
    on_error : callable
        Gets a LabelError for each outline that no rectangle lies around; it is left out.

    Returns
    -------
    list of Outlined
        Every record with its corners, in the same order.
    """
    complete: list[Outlined] = []
    records.reverse()
    while records:
        block = records[: -BLOCK - 1 : -1]
        del records[-BLOCK:]
        complete += _enclosed(path, block, on_error)
    return complete


def _enclosed(path: Path, records: Sequence[Outlined], on_error: OnError) -> Iterator[Outlined]:
    """Lay rectangles around some outlines."""
    outlines = [record.points for record in records if record.points is not None]
    with np.errstate(over='ignore', invalid='ignore'):
        boxes = OrientedBoxes.from_polygons(outlines)
    found = zip(boxes.defects.tolist(), boxes.corners.reshape(-1, 8).tolist(), strict=True)
    for record in records:
        if record.points is None:
            yield record
            continue
        defect, corners = next(found)
        if defect == Defect.NONE:
            box = record.box._replace(corners=corners)
            yield Outlined(record.image, record.place, record.line, box)
        else:
            message = f'{record.place}{PROBLEMS[Defect(defect)]}'
            on_error(LabelError(path, record.line, message))


def by_image(records: Sequence[Outlined]) -> dict[str, list[Box]]:
    """Group the boxes of records by image, in the order of their first appearance."""
    images: dict[str, list[Box]] = {}
    for record in records:
        images.setdefault(record.image, []).append(record.box)
    return images
