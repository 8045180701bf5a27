# SPDX-License-Identifier: Apache-2.0
"""
Arrays of oriented boxes, from corners, from centre, size and angle, or from polygons.

Image coordinates: x to the right, y down, pixels, pixel i covering [i, i + 1). Axis-aligned
extents are even in the angle and have period pi, so its sense of rotation matters only where the
angle points to the bow.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field
from enum import IntEnum
from typing import Any
from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import ArrayLike
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]

# Boxes processed at a time, so that the temporaries stay in a core's cache.
BLOCK = 8192

# Products of numbers below _LARGE do not overflow, areas of sides above _SMALL do not underflow.
_LARGE = 1e150
_SMALL = 1e-150

# Beyond this a double no longer resolves a tenth of a pixel, and GEOS fails: from 1e15 on with an
# exception or NaN, from 1e154 on, where squares overflow, with a segmentation fault.
FARTHEST = 1e15

_FLOAT = np.dtype(np.float64)


def blocks(count: int) -> list[slice]:
    """Split `count` rows into slices of at most `BLOCK` rows."""
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


class Defect(IntEnum):
    """
    Why a box cannot be converted; `NONE` if it can.

    `NO_RECTANGLE`: a polygon has coordinates beyond `FARTHEST`, or shapely fails on it.
    """

    NONE = 0
    NOT_FINITE = 1
    NEGATIVE_SIZE = 2
    EMPTY = 3
    TOO_FEW_POINTS = 4
    NO_RECTANGLE = 5
    OUTSIDE_IMAGE = 6


@dataclass(eq=False, repr=False, slots=True)
class OrientedBoxes:
    """
    N oriented boxes, stored as centres and half edges.

    Create them with `from_corners`, `from_xywhr` or `from_polygons`, which accept the long side in
    either place, keep the order of the input, and raise ValueError if it has another shape or
    contains anything but numbers. Boxes that cannot be converted have NaN coordinates and a defect.

    Attributes
    ----------
    center : ndarray, shape (2, N)
        x and y of the centres, pixels.
    first, second : ndarray, shape (2, N)
        Half of two adjacent edges as vectors, pixels.
    defects : ndarray of uint8, shape (N,)
        A `Defect` for each box.
    regular : bool
        True if no box has a defect and no conversion can overflow, so that callers can skip these
        checks.
    bow : ndarray of bool, shape (N,), or None
        Where the bow is known: it is then at ``center + first``. None: nowhere.
    """

    center: FloatArray
    first: FloatArray
    second: FloatArray
    defects: NDArray[np.uint8]
    regular: bool = False
    bow: NDArray[np.bool_] | None = None
    _axes: tuple[FloatArray, FloatArray] | None = field(default=None, init=False)

    @classmethod
    def from_corners(
        cls, corners: ArrayLike, bow: bool | NDArray[np.bool_] = False
    ) -> OrientedBoxes:
        """
        Create boxes from their corners.

        Parameters
        ----------
        corners : array_like, shape (N, 4, 2)
            x and y of the corners in order around each box, pixels; in either direction, from any
            corner. Corners that are not exactly a rectangle, for example after rounding, give
            their mean edges, centred on each axis on the diagonal that is longer along it.
            Crossed corners have no area and are marked as empty; `from_polygons` accepts vertices
            in any order.
        bow : bool or ndarray of bool, shape (N,)
            True if the first two corners are the bow end, for all boxes or for each. Where they
            are a long side the bow is not known.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_corners([[[20, 30], [80, 30], [80, 50], [20, 50]]])
        >>> boxes.length, boxes.width
        (array([60.]), array([20.]))
        """
        boxes = _in_blocks(_as_array(corners, 'corners', (4, 2)), _boxes_of_corners)
        if bow is not False:
            # The second edge leads away from the bow.
            ahead, aside = -boxes.second, boxes.first
            boxes.bow = known = _known_bows(ahead, aside, bow)
            boxes.first = np.where(known, ahead, boxes.first)
            boxes.second = np.where(known, aside, boxes.second)
        return boxes

    @classmethod
    def from_xywhr(cls, xywhr: ArrayLike, bow: bool | NDArray[np.bool_] = False) -> OrientedBoxes:
        """
        Create boxes from centre, size and angle.

        Parameters
        ----------
        xywhr : array_like, shape (N, 5)
            Centre x and y, extent along `theta`, extent across it (pixels), `theta` (radians from
            image +x).
        bow : bool or ndarray of bool, shape (N,)
            True if `theta` points to the bow, full circle, for all boxes or for each. The
            direction is ``(cos(theta), sin(theta))`` in image coordinates, y down: clockwise on
            the screen. Negate angles that are counter-clockwise. Where the extent along `theta`
            is the shorter side the bow is not known.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
        >>> boxes.corners[0].tolist()
        [[20.0, 30.0], [80.0, 30.0], [80.0, 50.0], [20.0, 50.0]]
        >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0], [50, 40, 20, 60, 0]], bow=True)
        >>> boxes.bow
        array([ True, False])
        """
        boxes = _in_blocks(_as_array(xywhr, 'xywhr', (5,)), _boxes_of_xywhr)
        if bow is not False:
            boxes.bow = _known_bows(boxes.first, boxes.second, bow)
        return boxes

    @classmethod
    def from_polygons(cls, polygons: Iterable[ArrayLike]) -> OrientedBoxes:
        """
        Create the minimum rotated rectangle of each polygon.

        Parameters
        ----------
        polygons : iterable of array_like, each of shape (K, 2)
            x and y of the vertices, pixels; any number, in any order, closed or not.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_polygons([
        ...     [[0, 0], [55, 0], [60, 10], [55, 20], [0, 20]],
        ...     [[0, 0], [1, 1]],
        ... ])
        >>> boxes.valid
        array([ True, False])
        >>> Defect(boxes.defects[1]).name
        'TOO_FEW_POINTS'
        """
        rings = [_as_array(polygon, f'polygons[{i}]', (2,)) for i, polygon in enumerate(polygons)]
        defects = np.array([_ring_defect(ring) for ring in rings], np.uint8)
        corners = np.full((len(rings), 4, 2), np.nan)
        usable = defects == Defect.NONE
        if usable.any():
            corners[usable] = _minimum_rotated_rectangles(
                [ring for ring, use in zip(rings, usable, strict=True) if use]
            )
        boxes = cls.from_corners(corners)
        boxes.defects[usable & (boxes.defects == Defect.NOT_FINITE)] = Defect.NO_RECTANGLE
        boxes.defects[~usable] = defects[~usable]
        return boxes

    def __len__(self) -> int:
        """Count the boxes."""
        return self.defects.shape[0]

    def take(self, rows: Any) -> OrientedBoxes:
        """Select boxes by any NumPy index of N rows: a slice, indices or a mask."""
        return OrientedBoxes(
            self.center[:, rows],
            self.first[:, rows],
            self.second[:, rows],
            self.defects[rows],
            self.regular,
            None if self.bow is None else self.bow[rows],
        )

    @property
    def long_axis(self) -> FloatArray:
        """Half the long edge as a vector, pixels, shape (2, N)."""
        return self._sorted_axes()[0]

    @property
    def short_axis(self) -> FloatArray:
        """Half the short edge as a vector, pixels, shape (2, N)."""
        return self._sorted_axes()[1]

    def _sorted_axes(self) -> tuple[FloatArray, FloatArray]:
        """Return long and short axis, sorted on first use."""
        if self._axes is None:
            with np.errstate(over='ignore'):
                self._axes = longer_first(self.first, self.second)
        return self._axes

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which boxes can be converted, shape (N,)."""
        return self.defects == Defect.NONE

    @property
    def length(self) -> FloatArray:
        """Length of the long side, pixels, shape (N,); infinite if it overflows."""
        with np.errstate(over='ignore'):
            return 2.0 * np.hypot(*self.long_axis)

    @property
    def width(self) -> FloatArray:
        """Length of the short side, pixels, shape (N,); infinite if it overflows."""
        with np.errstate(over='ignore'):
            return 2.0 * np.hypot(*self.short_axis)

    @property
    def theta(self) -> FloatArray:
        """Angle of the long axis from image +x, radians in [-pi/2, pi/2), shape (N,)."""
        angle = np.arctan2(self.long_axis[1], self.long_axis[0])
        return np.mod(angle + np.pi / 2, np.pi) - np.pi / 2

    @property
    def corners(self) -> FloatArray:
        """Corners in order around each box, pixels, shape (N, 4, 2)."""
        c, u, v = self.center, self.long_axis, self.short_axis
        with np.errstate(over='ignore', invalid='ignore'):
            stacked = np.stack((c - u - v, c + u - v, c + u + v, c - u + v))
        return np.ascontiguousarray(stacked.transpose(2, 0, 1))


def longer_first(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sort pairs of vectors, (2, N) each, by length; squared lengths must be finite."""
    swap = second[0] * second[0] + second[1] * second[1] > first[0] * first[0] + first[1] * first[1]
    if not swap.any():
        return first, second
    return np.where(swap, second, first), np.where(swap, first, second)


def _known_bows(
    ahead: FloatArray, aside: FloatArray, asked: bool | NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Find where the bow is at the end of half edges `ahead`, (2, N): those not the shorter."""
    with np.errstate(over='ignore', invalid='ignore'):
        length, width = (edge[0] * edge[0] + edge[1] * edge[1] for edge in (ahead, aside))
    # False where a box has a defect, NaN, or its square overflows.
    return (width <= length) & (length < np.inf) & np.broadcast_to(asked, length.shape)


def range_defect(points: FloatArray) -> Defect:
    """Check that no coordinate, (K, 2), is out of range for GEOS."""
    # NaN passes through the maximum and compares as false.
    if np.abs(points).max(initial=0.0) <= FARTHEST:
        return Defect.NONE
    return Defect.NO_RECTANGLE if np.isfinite(points).all() else Defect.NOT_FINITE


def _as_array(values: ArrayLike, name: str, row_shape: tuple[int, ...]) -> FloatArray:
    """Convert `values` to float64 rows of `row_shape`."""
    if type(values) is np.ndarray and values.dtype == _FLOAT and values.shape[1:] == row_shape:
        return values
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f'{name} must be an array of numbers: {error}') from None
    if array.size == 0 and array.ndim <= 1:
        array = array.reshape((0, *row_shape))
    if array.shape[1:] != row_shape or array.ndim != len(row_shape) + 1:
        expected = ', '.join(('N', *map(str, row_shape)))
        raise ValueError(f'{name} must have shape ({expected}), not {array.shape}')
    return array


def _in_blocks(array: FloatArray, boxes_of: Callable[[FloatArray], OrientedBoxes]) -> OrientedBoxes:
    """Create boxes block by block."""
    if len(array) <= BLOCK:
        return boxes_of(array)
    center, first, second = np.empty((3, 2, len(array)))
    boxes = OrientedBoxes(center, first, second, np.empty(len(array), np.uint8), True)
    for rows in blocks(len(array)):
        block = boxes_of(array[rows])
        center[:, rows], first[:, rows], second[:, rows] = block.center, block.first, block.second
        boxes.defects[rows] = block.defects
        boxes.regular &= block.regular
    return boxes


def _boxes_of_corners(corners: FloatArray) -> OrientedBoxes:
    """Create boxes from corners, (n, 4, 2)."""
    # One transposed copy, so that everything below runs along contiguous memory.
    quarters = np.multiply(corners.transpose(1, 2, 0), 0.25, order='C')
    if _all_below_large(quarters):
        boxes = _from_quarters(quarters)
        if np.minimum.reduce(_areas(boxes), initial=np.inf) > _SMALL**2:
            boxes.regular = True
            return boxes
    with np.errstate(invalid='ignore', over='ignore'):
        boxes = _from_quarters(quarters)
        _mark_unusable(boxes)
        return boxes


def _boxes_of_xywhr(xywhr: FloatArray) -> OrientedBoxes:
    """Create boxes from centre, size and angle, (n, 5)."""
    columns = xywhr.T
    sizes = columns[2:4]
    if _all_below_large(columns) and np.minimum.reduce(sizes, axis=None, initial=np.inf) > _SMALL:
        boxes = _from_columns(columns)
        boxes.regular = True
        return boxes
    with np.errstate(invalid='ignore', over='ignore'):
        boxes = _from_columns(columns)
        _mark_unusable(boxes)
    negative = (sizes < 0.0).any(axis=0)
    _mark(boxes, negative & (boxes.defects != Defect.NOT_FINITE), Defect.NEGATIVE_SIZE)
    return boxes


def _all_below_large(numbers: FloatArray) -> bool:
    """Check that all numbers are finite and no product of two can overflow."""
    # NaN passes through the maximum and compares as false.
    return bool(np.maximum.reduce(np.abs(numbers), axis=None, initial=0.0) < _LARGE)


def _from_quarters(quarters: FloatArray) -> OrientedBoxes:
    """Create boxes from corners, scaled by 1/4, (4, 2, n)."""
    diagonals = quarters[2:] - quarters[:2]
    first, second = diagonals[0] - diagonals[1], diagonals[0] + diagonals[1]
    # The middle of the longer diagonal on each axis, not the mean of the corners: `outer` is then
    # their minimum and maximum even if they were rounded to whole pixels. If both edges have the
    # same sign, their sum is the longer diagonal; if not, the other diagonal is. The selection
    # works on the bits, which takes a third of the time of np.where.
    middles = quarters[2:] + quarters[:2]
    signs_differ = np.bitwise_xor(first.view(np.int64), second.view(np.int64))
    signs_differ >>= 63
    middle, other = middles.view(np.int64)
    other ^= middle
    other &= signs_differ
    middle ^= other
    return OrientedBoxes(middles[0] * 2.0, first, second, np.zeros(first.shape[1], np.uint8))


def _from_columns(columns: FloatArray) -> OrientedBoxes:
    """Create boxes from x, y, width, height and theta, (5, n)."""
    half = columns[2:4] * 0.5
    theta = columns[4]
    direction = np.empty((2, len(theta)))
    np.cos(theta, out=direction[0])
    np.sin(theta, out=direction[1])
    first, second = direction * half[0], direction[::-1] * half[1]
    np.negative(second[0], out=second[0])
    return OrientedBoxes(columns[:2].copy(), first, second, np.zeros(half.shape[1], np.uint8))


def _areas(boxes: OrientedBoxes) -> FloatArray:
    """Compute a quarter of the area of each box."""
    products = boxes.first * boxes.second[::-1]
    areas = products[0] - products[1]
    return np.abs(areas, out=areas)


def _mark_unusable(boxes: OrientedBoxes) -> None:
    """Mark the boxes that are not finite or have no area."""
    numbers = np.concatenate((boxes.center, boxes.first, boxes.second))
    finite = np.logical_and.reduce(np.isfinite(numbers))
    empty = finite & (_areas(boxes) == 0.0)
    _mark(boxes, ~finite, Defect.NOT_FINITE)
    _mark(boxes, empty, Defect.EMPTY)


def _mark(boxes: OrientedBoxes, which: NDArray[np.bool_], defect: Defect) -> None:
    """Set the defect of some boxes, and their coordinates to NaN."""
    boxes.defects[which] = defect
    for array in (boxes.center, boxes.first, boxes.second):
        array[:, which] = np.nan


def _ring_defect(ring: FloatArray) -> Defect:
    """Find out why a polygon has no minimum rotated rectangle."""
    defect = range_defect(ring)
    if defect != Defect.NOT_FINITE and len(set(map(tuple, ring.tolist()))) < 3:
        return Defect.TOO_FEW_POINTS
    return defect


def _minimum_rotated_rectangles(rings: Sequence[FloatArray]) -> FloatArray:
    """Compute the corners, (N, 4, 2): zero if there is no area, NaN if shapely fails."""
    owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    # The rectangle depends on the convex hull only, so a crossed or open ring does no harm, and
    # line strings take a third of the time of multipoints.
    envelopes = _oriented_envelopes(shapely.linestrings(np.concatenate(rings), indices=owner))
    corners = np.zeros((len(rings), 4, 2))
    corners[shapely.is_missing(envelopes)] = np.nan
    has_area = shapely.get_type_id(envelopes) == shapely.GeometryType.POLYGON
    if has_area.any():
        coordinates = shapely.get_coordinates(envelopes[has_area])
        corners[has_area] = coordinates.reshape(-1, 5, 2)[:, :4]
    return corners


def _oriented_envelopes(geometries: Any) -> Any:
    """Compute oriented envelopes; None where shapely fails."""
    try:
        with np.errstate(all='ignore'):
            return shapely.oriented_envelope(geometries)
    # Before shapely 2.1 it computes them in Python and divides by the length of an edge.
    except (shapely.errors.GEOSException, ArithmeticError):
        if len(geometries) == 1:
            return np.array([None])
    # The error does not say which geometry failed, so try them one by one.
    return np.concatenate(
        [_oriented_envelopes(geometries[i : i + 1]) for i in range(len(geometries))]
    )
