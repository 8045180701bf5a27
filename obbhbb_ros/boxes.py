"""
Arrays of oriented boxes, from corners, from centre, size and angle, and from polygons.

Image coordinates: x to the right, y down, pixels, pixel i covering [i, i + 1). Axis-aligned
extents are even in the angle and have period pi, so its sense of rotation does not matter.
"""

from __future__ import annotations

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
BLOCK = 4096


# Of numbers up to here no product overflows; of sides from here on no area vanishes.
_LARGE = 1e150
_SMALL = 1e-150


def blocks(count: int) -> list[slice]:
    """Cut `count` rows into slices that fit a core's cache."""
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


class Defect(IntEnum):
    """Why a box cannot be converted; `NONE` where it can."""

    NONE = 0
    NOT_FINITE = 1
    NEGATIVE_SIZE = 2
    EMPTY = 3
    TOO_FEW_POINTS = 4


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
    tame : bool
        Whether it is known that no box has a defect and that no number is so large or so small
        that a rule could overflow: then nobody needs to look for it.

    Attributes
    ----------
    center, first, second, defects, tame
        As given.
    """

    __slots__ = ('_axes', 'center', 'defects', 'first', 'second', 'tame')

    def __init__(
        self,
        center: FloatArray,
        first: FloatArray,
        second: FloatArray,
        defects: NDArray[np.uint8],
        tame: bool = False,
    ) -> None:
        self.center = center
        self.first = first
        self.second = second
        self.defects = defects
        self.tame = tame
        self._axes: tuple[FloatArray, FloatArray] | None = None

    @classmethod
    def _room_for(cls, count: int) -> OrientedBoxes:
        """Make room for boxes that are yet to be written, and taken for tame until then."""
        center, first, second = np.empty((3, 2, count))
        return cls(center, first, second, np.zeros(count, np.uint8), True)

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
        array = _as_array(corners, 'corners', (4, 2))
        boxes = cls._room_for(len(array))
        for rows in blocks(len(array)):
            # Transposed and quartered at once: all that follows runs along contiguous memory.
            quarters = np.multiply(array[rows].transpose(1, 2, 0), 0.25, order='C')
            if _none_large(quarters):
                boxes._write_corners(quarters, rows)
                if np.minimum.reduce(boxes._areas(rows)) > _SMALL**2:
                    continue
            boxes.tame = False
            with np.errstate(invalid='ignore', over='ignore'):
                boxes._write_corners(quarters, rows)
                boxes._mark_defects(rows)
        return boxes

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
        array = _as_array(xywhr, 'xywhr', (5,))
        boxes = cls._room_for(len(array))
        for rows in blocks(len(array)):
            columns = array[rows].T
            if _none_large(columns) and np.minimum.reduce(columns[2:4], axis=None) > _SMALL:
                boxes._write_columns(columns, rows)
                continue
            boxes.tame = False
            with np.errstate(invalid='ignore', over='ignore'):
                boxes._write_columns(columns, rows)
                boxes._mark_defects(rows)
            negative = (columns[2:4] < 0.0).any(axis=0)
            negative &= boxes.defects[rows] != Defect.NOT_FINITE
            boxes._mark(rows, negative, Defect.NEGATIVE_SIZE)
        return boxes

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
        return boxes

    def _write_corners(self, quarters: FloatArray, rows: slice) -> None:
        """Write the boxes of corners, given as a quarter of each, (4, 2, n), to some rows."""
        diagonal, other = quarters[2:] - quarters[:2]
        first = np.subtract(diagonal, other, out=self.first[:, rows])
        second = np.add(diagonal, other, out=self.second[:, rows])
        # Not the mean of the corners: so `outer` is their minimum and maximum even where they were
        # rounded to whole pixels. Edges of one sign make their sum the longer diagonal.
        middles = quarters[2:] + quarters[:2]
        _take_second_where_signs_differ(middles, first, second)
        np.multiply(middles[0], 2.0, out=self.center[:, rows])

    def _write_columns(self, columns: FloatArray, rows: slice) -> None:
        """Write the boxes of some x, y, width, height and theta, (5, n), to some rows."""
        self.center[:, rows] = columns[:2]
        half_width, half_height = columns[2:4] * 0.5
        direction = np.empty((2, columns.shape[1]))
        np.cos(columns[4], out=direction[0])
        np.sin(columns[4], out=direction[1])
        np.multiply(direction, half_width, out=self.first[:, rows])
        second = np.multiply(direction[::-1], half_height, out=self.second[:, rows])
        np.negative(second[0], out=second[0])

    def _areas(self, rows: slice) -> FloatArray:
        """Compute a quarter of the area of some boxes."""
        products = self.first[:, rows] * self.second[::-1, rows]
        areas = products[0] - products[1]
        return np.abs(areas, out=areas)

    def _mark_defects(self, rows: slice) -> None:
        """Mark those of some boxes that cannot be used."""
        numbers = np.concatenate([each[:, rows] for each in (self.center, self.first, self.second)])
        finite = np.isfinite(numbers).all(axis=0)
        empty = self._areas(rows) == 0.0
        self._mark(rows, ~finite, Defect.NOT_FINITE)
        self._mark(rows, finite & empty, Defect.EMPTY)

    def _mark(self, rows: slice, which: NDArray[np.bool_], defect: Defect) -> None:
        """Mark some of `rows` as defective, and let no number of theirs reach a caller."""
        self.defects[rows][which] = defect
        for array in (self.center, self.first, self.second):
            array[:, rows][:, which] = np.nan

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
            self.tame,
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
                swap = (self.second**2).sum(axis=0) > (self.first**2).sum(axis=0)
            if swap.any():
                first, second = self.first, self.second
                self._axes = np.where(swap, second, first), np.where(swap, first, second)
            else:
                self._axes = self.first, self.second
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


def _as_array(values: ArrayLike, name: str, row_shape: tuple[int, ...]) -> FloatArray:
    """Read `values` as float64 rows of `row_shape`, or say what is wrong with them."""
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
    return bool(np.maximum.reduce(np.abs(numbers), axis=None) < _LARGE)


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


def _ring_defect(ring: FloatArray) -> Defect:
    """Tell why no rectangle can be laid around a polygon's vertices."""
    if not np.isfinite(ring).all():
        return Defect.NOT_FINITE
    if len({(x, y) for x, y in ring.tolist()}) < 3:
        return Defect.TOO_FEW_POINTS
    return Defect.NONE


def _minimum_rotated_rectangles(rings: Sequence[FloatArray]) -> FloatArray:
    """Lay the smallest rectangle around each ring; (N, 4, 2), NaN where it has no area."""
    owner = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    points = shapely.points(np.concatenate(rings))
    # The rectangle depends on the convex hull alone, so a crossed or open ring does no harm.
    envelopes = shapely.oriented_envelope(shapely.multipoints(points, indices=owner))
    corners = np.zeros((len(rings), 4, 2))
    has_area = shapely.get_type_id(envelopes) == shapely.GeometryType.POLYGON
    if has_area.any():
        coordinates = shapely.get_coordinates(envelopes[has_area])
        corners[has_area] = coordinates.reshape(-1, 5, 2)[:, :4]
    return corners
