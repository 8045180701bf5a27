# SPDX-License-Identifier: Apache-2.0
"""
Arrays of oriented boxes, from corners, from centre, size and angle, and from polygons.

Image coordinates: x to the right, y down, pixels, pixel i covering [i, i + 1). Axis-aligned
extents are even in the angle and have period pi, so its sense of rotation does not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Sequence
from enum import IntEnum
from typing import Any
from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import ArrayLike
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]


# Boxes worked on at a time: the temporaries of so many stay in a core's own cache.
BLOCK = 8192


# Of numbers up to here no product overflows; of sides from here on no area vanishes.
LARGE = 1e150
_FLOAT = np.dtype(np.float64)
SMALL = 1e-150

# Farther out a double no longer resolves a tenth of a pixel, and GEOS fails: from 1e15 on with an
# exception or NaN, from 1e154 on, where squares overflow, with a segmentation fault.
FARTHEST = 1e15


def blocks(count: int) -> list[slice]:
    """Cut `count` rows into slices that fit a core's cache."""
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


class Defect(IntEnum):
    """
    Why a box cannot be converted; `NONE` where it can.

    `NO_RECTANGLE`: a polygon has coordinates beyond `FARTHEST`, or shapely fails on it.
    """

    NONE = 0
    NOT_FINITE = 1
    NEGATIVE_SIZE = 2
    EMPTY = 3
    TOO_FEW_POINTS = 4
    NO_RECTANGLE = 5


class OrientedBoxes:
    """
    N oriented boxes, kept as centres and half edges.

    Build one with `from_corners`, `from_xywhr` or `from_polygons`. Which side is the longer one
    never matters there. Boxes that cannot be converted keep their place and are marked in
    `defects`; their numbers are NaN.

    Parameters
    ----------
    center : ndarray, shape (2, N)
        x and y of the centres, pixels.
    first, second : ndarray, shape (2, N)
        Half of two adjacent edges as vectors, pixels.
    defects : ndarray of uint8, shape (N,)
        A `Defect` for each box.
    regular : bool
        Whether it is known that no box has a defect and that no number is so large or so small
        that a rule could overflow: then nobody needs to look for it.

    Attributes
    ----------
    center, first, second, defects, regular
        As given.
    """

    __slots__ = ('_axes', 'center', 'defects', 'first', 'regular', 'second')

    def __init__(
        self,
        center: FloatArray,
        first: FloatArray,
        second: FloatArray,
        defects: NDArray[np.uint8],
        regular: bool = False,
    ) -> None:
        self.center = center
        self.first = first
        self.second = second
        self.defects = defects
        self.regular = regular
        self._axes: tuple[FloatArray, FloatArray] | None = None

    @classmethod
    def from_corners(cls, corners: ArrayLike) -> OrientedBoxes:
        """
        Take boxes from their corners.

        Parameters
        ----------
        corners : array_like, shape (N, 4, 2)
            x and y of the corners in order around each box, pixels; either sense, any start.
            Corners that are not quite a rectangle, as rounding leaves them, give their mean edges
            about the middle of the diagonal that is the longer one on each axis. Crossed corners
            have no area and are marked empty; `from_polygons` takes vertices in any order.

        Returns
        -------
        OrientedBoxes
            The boxes, in the same order.

        Raises
        ------
        ValueError
            If `corners` does not have that shape or holds anything but numbers.
        """
        return _in_blocks(_as_array(corners, 'corners', (4, 2)), _boxes_of_corners)

    @classmethod
    def from_xywhr(cls, xywhr: ArrayLike) -> OrientedBoxes:
        """
        Take boxes from centre, size and angle.

        Parameters
        ----------
        xywhr : array_like, shape (N, 5)
            Centre x and y, extent along `theta`, extent across it (pixels), `theta` (radians from
            image +x).

        Returns
        -------
        OrientedBoxes
            The boxes, in the same order.

        Raises
        ------
        ValueError
            If `xywhr` does not have that shape or holds anything but numbers.
        """
        return _in_blocks(_as_array(xywhr, 'xywhr', (5,)), _boxes_of_xywhr)

    @classmethod
    def from_polygons(cls, polygons: Iterable[ArrayLike]) -> OrientedBoxes:
        """
        Take the minimum rotated rectangle of each polygon.

        Parameters
        ----------
        polygons : iterable of array_like, each of shape (K, 2)
            x and y of the vertices, pixels; any number, any order, closed or not.

        Returns
        -------
        OrientedBoxes
            The boxes, in the same order.

        Raises
        ------
        ValueError
            If a polygon does not have that shape or holds anything but numbers; the message says
            which.
        """
        rings = [
            _as_array(polygon, f'polygons[{i}]', (2,)) for i, polygon in enumerate(polygons)
        ]
        defects = np.array([_ring_defect(ring) for ring in rings], np.uint8)
        corners = np.full((len(rings), 4, 2), np.nan)
        usable = np.flatnonzero(defects == Defect.NONE)
        if usable.size:
            corners[usable] = _minimum_rotated_rectangles([rings[i] for i in usable])
        boxes = cls.from_corners(corners)
        known = defects != Defect.NONE
        boxes.defects[known] = defects[known]
        boxes.defects[~known & (boxes.defects == Defect.NOT_FINITE)] = Defect.NO_RECTANGLE
        return boxes

    def mark(self, which: NDArray[np.bool_], defect: Defect) -> None:
        """
        Mark boxes as defective, and let no number of theirs reach a caller.

        Parameters
        ----------
        which : ndarray of bool, shape (N,)
            The boxes.
        defect : Defect
            What is wrong with them.
        """
        self.defects[which] = defect
        for array in (self.center, self.first, self.second):
            array[:, which] = np.nan

    def __len__(self) -> int:
        """Count the boxes."""
        return self.defects.shape[0]

    def take(self, rows: Any) -> OrientedBoxes:
        """
        Select boxes.

        Parameters
        ----------
        rows : slice, ndarray of int or ndarray of bool
            What NumPy takes as an index of N rows.

        Returns
        -------
        OrientedBoxes
            Those boxes, in that order.
        """
        return OrientedBoxes(
            self.center[:, rows], self.first[:, rows], self.second[:, rows], self.defects[rows],
            self.regular,
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
        """Sort the half edges by length, once."""
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
        """Length of the long side, pixels, shape (N,)."""
        return _whole(self.long_axis)

    @property
    def width(self) -> FloatArray:
        """Length of the short side, pixels, shape (N,)."""
        return _whole(self.short_axis)

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
    """
    Sort pairs of vectors by length.

    Parameters
    ----------
    first, second : ndarray, shape (2, N)
        The vectors of each pair; the squares of their lengths must be finite.

    Returns
    -------
    longer, shorter : ndarray, shape (2, N)
        The first ones where both are of one length.
    """
    swap = second[0] * second[0] + second[1] * second[1] > first[0] * first[0] + first[1] * first[1]
    if not swap.any():
        return first, second
    return np.where(swap, second, first), np.where(swap, first, second)


def _in_blocks(
    array: FloatArray, boxes_of: Callable[[FloatArray], OrientedBoxes]
) -> OrientedBoxes:
    """Make boxes of some rows at a time."""
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
    """Make boxes of corners, (n, 4, 2)."""
    # Transposed and quartered at once: all that follows runs along contiguous memory.
    quarters = np.multiply(corners.transpose(1, 2, 0), 0.25, order='C')
    if _none_large(quarters):
        boxes = _lay_corners(quarters)
        if np.minimum.reduce(_areas(boxes), initial=np.inf) > SMALL**2:
            boxes.regular = True
            return boxes
    with np.errstate(invalid='ignore', over='ignore'):
        boxes = _lay_corners(quarters)
        _mark_unusable(boxes)
        return boxes


def _boxes_of_xywhr(xywhr: FloatArray) -> OrientedBoxes:
    """Make boxes of centre, size and angle, (n, 5)."""
    columns = xywhr.T
    sizes = columns[2:4]
    if _none_large(columns) and np.minimum.reduce(sizes, axis=None, initial=np.inf) > SMALL:
        boxes = _lay_columns(columns)
        boxes.regular = True
        return boxes
    with np.errstate(invalid='ignore', over='ignore'):
        boxes = _lay_columns(columns)
        _mark_unusable(boxes)
    negative = (sizes < 0.0).any(axis=0)
    boxes.mark(negative & (boxes.defects != Defect.NOT_FINITE), Defect.NEGATIVE_SIZE)
    return boxes


def _lay_corners(quarters: FloatArray) -> OrientedBoxes:
    """Lay boxes through corners, given as a quarter of each, (4, 2, n)."""
    diagonals = quarters[2:] - quarters[:2]
    first, second = diagonals[0] - diagonals[1], diagonals[0] + diagonals[1]
    # Not the mean of the corners: so `outer` is their minimum and maximum even where they were
    # rounded to whole pixels. Edges of one sign make their sum the longer diagonal.
    middles = quarters[2:] + quarters[:2]
    _take_second_where_signs_differ(middles, first, second)
    return OrientedBoxes(middles[0] * 2.0, first, second, np.zeros(first.shape[1], np.uint8))


def _lay_columns(columns: FloatArray) -> OrientedBoxes:
    """Lay boxes of x, y, width, height and theta, (5, n)."""
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
    boxes.mark(~finite, Defect.NOT_FINITE)
    boxes.mark(empty, Defect.EMPTY)


def _as_array(values: ArrayLike, name: str, row_shape: tuple[int, ...]) -> FloatArray:
    """Read `values` as float64 rows of `row_shape`, or say what is wrong with them."""
    if type(values) is np.ndarray and values.dtype == _FLOAT and values.shape[1:] == row_shape:
        return values
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f'{name} must be an array of numbers: {error}') from None
    if array.size == 0 and array.ndim <= 1:
        array = array.reshape((0, *row_shape))
    if array.shape[1:] != row_shape or array.ndim != len(row_shape) + 1:
        wanted = ', '.join(('N', *map(str, row_shape)))
        raise ValueError(f'{name} must have shape ({wanted}), not {array.shape}')
    return array


def _none_large(numbers: FloatArray) -> bool:
    """Tell whether all numbers are finite and so small that no product of two overflows."""
    # NaN passes through the maximum, and compares as false.
    return bool(np.maximum.reduce(np.abs(numbers), axis=None, initial=0.0) < LARGE)


def _take_second_where_signs_differ(
    pair: FloatArray, first: FloatArray, second: FloatArray
) -> None:
    """Write `pair[1]` to `pair[0]` where `first` and `second` differ in sign; uses `pair[1]` up."""
    # On the bits, which takes a third of the time of np.where.
    differ = np.bitwise_xor(first.view(np.int64), second.view(np.int64))
    differ >>= 63
    chosen, other = pair.view(np.int64)
    other ^= chosen
    other &= differ
    chosen ^= other


def _whole(half: FloatArray) -> FloatArray:
    """Give twice the length of half edges; infinite where that overflows."""
    with np.errstate(over='ignore'):
        return 2.0 * np.hypot(half[0], half[1])


def range_defect(points: FloatArray) -> Defect:
    """Tell whether there is a coordinate, (K, 2), that GEOS must not see."""
    # NaN passes through the maximum, and compares as false.
    if np.abs(points).max(initial=0.0) <= FARTHEST:
        return Defect.NONE
    return Defect.NO_RECTANGLE if np.isfinite(points).all() else Defect.NOT_FINITE


def _ring_defect(ring: FloatArray) -> Defect:
    """Tell why no rectangle can be laid around a polygon's vertices."""
    defect = range_defect(ring)
    if defect != Defect.NOT_FINITE and len(set(map(tuple, ring.tolist()))) < 3:
        return Defect.TOO_FEW_POINTS
    return defect


def _minimum_rotated_rectangles(rings: Sequence[FloatArray]) -> FloatArray:
    """
    Lay the smallest rectangle around each ring.

    Returns
    -------
    ndarray, shape (N, 4, 2)
        Corners; all zero where the rectangle has no area, NaN where shapely fails.
    """
    owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    # The rectangle depends on the convex hull alone, so a crossed or open ring does no harm, and a
    # line is made in a third of the time that points take.
    envelopes = _oriented_envelopes(shapely.linestrings(np.concatenate(rings), indices=owner))
    corners = np.zeros((len(rings), 4, 2))
    corners[shapely.is_missing(envelopes)] = np.nan
    has_area = shapely.get_type_id(envelopes) == shapely.GeometryType.POLYGON
    if has_area.any():
        coordinates = shapely.get_coordinates(envelopes[has_area])
        corners[has_area] = coordinates.reshape(-1, 5, 2)[:, :4]
    return corners


def _oriented_envelopes(geometries: Any) -> Any:
    """Lay oriented envelopes around geometries; None for those that GEOS fails on."""
    try:
        with np.errstate(all='ignore'):
            return shapely.oriented_envelope(geometries)
    except shapely.errors.GEOSException:
        if len(geometries) == 1:
            return np.array([None])
    # It does not tell which of them it was.
    return np.concatenate([_oriented_envelopes(geometries[i : i + 1])
                           for i in range(len(geometries))])
