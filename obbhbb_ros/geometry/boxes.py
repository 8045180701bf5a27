# SPDX-License-Identifier: Apache-2.0
"""
Arrays of oriented boxes, from corners, from centre, size and angle, or from polygons.

Image coordinates: x to the right, y down, pixels; pixel i covers [i, i + 1). Axis-aligned extents
are even in the angle and have period pi, so the sense of rotation matters only where the angle
points to the bow.

Arrays of points and vectors have shape (N, 2). In memory all x come first, then all y, which is
what makes the arithmetic fast.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from enum import IntEnum
from functools import cached_property
from typing import Any
from typing import NoReturn

import numpy as np
import shapely
from numpy.typing import ArrayLike
from numpy.typing import NDArray

from obbhbb_ros.geometry.corners import LARGE
from obbhbb_ros.geometry.corners import SMALL
from obbhbb_ros.geometry.corners import FloatArray
from obbhbb_ros.geometry.corners import are_crossed
from obbhbb_ros.geometry.corners import are_nearly_rectangles
from obbhbb_ros.geometry.corners import areas_of
from obbhbb_ros.geometry.corners import boxes_from_quarters
from obbhbb_ros.geometry.corners import mean_edges
from obbhbb_ros.geometry.corners import middles_of
from obbhbb_ros.geometry.corners import quarters_of

__all__ = ['FARTHEST', 'Defect', 'FloatArray', 'OrientedBoxes']

# The number of boxes that are processed at a time, so that the temporaries stay in a core's cache.
BLOCK = 8192

# The largest coordinate of a polygon. Beyond it a double no longer resolves a tenth of a pixel, and
# GEOS fails: from 1e15 on with an exception or NaN, from 1e154 on, where squares overflow, with a
# segmentation fault.
FARTHEST = 1e15

_FLOAT = np.dtype(np.float64)

# The number of boxes that `repr` shows.
_SHOWN = 3


def blocks(count: int) -> list[slice]:
    """Split `count` rows into slices of at most `BLOCK` rows."""
    return [slice(start, start + BLOCK) for start in range(0, count, BLOCK)]


class Defect(IntEnum):
    """
    Why a box cannot be converted.

    Attributes
    ----------
    NONE
        It can be converted.
    NOT_FINITE
        A coordinate, size or angle is NaN or infinite.
    NEGATIVE_SIZE
        A size is negative.
    EMPTY
        The box has no area.
    TOO_FEW_POINTS
        The polygon has fewer than three different vertices.
    NO_RECTANGLE
        The polygon has coordinates beyond `FARTHEST`, or shapely fails on it.
    OUTSIDE_IMAGE
        No part of the box lies in the image; only where boxes are clipped to it.
    """

    NONE = 0
    NOT_FINITE = 1
    NEGATIVE_SIZE = 2
    EMPTY = 3
    TOO_FEW_POINTS = 4
    NO_RECTANGLE = 5
    OUTSIDE_IMAGE = 6


@dataclass(frozen=True, eq=False, repr=False)
class OrientedBoxes:
    """
    N oriented boxes.

    Create them with `from_corners`, `from_xywhr` or `from_polygons`, which accept the long side in
    either place, keep the order of the input, and raise ValueError if it has another shape or
    contains anything but numbers. A box that cannot be converted keeps its row, with NaN
    coordinates and a defect.

    The boxes cannot be changed: all arrays are read-only, and so become arrays that are passed to
    the constructor. `boxes[rows]` selects boxes by any NumPy index; an integer and iteration give
    `OrientedBoxes` of length 1. `==` is True or False: whether all arrays are equal to the last
    bit, NaN being equal to NaN. Compare `corners` to allow for rounding.

    Attributes
    ----------
    center : ndarray, shape (N, 2)
        x and y of the centres, pixels.
    first, second : ndarray, shape (N, 2)
        Half of two adjacent edges as vectors, pixels.
    defects : ndarray of uint8, shape (N,)
        A `Defect` for each box.
    bow : ndarray of bool, shape (N,)
        Where the bow is known; it is then at ``center + first``.
    regular : bool
        True if no box has a defect and no conversion can overflow, so that callers can skip these
        checks.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0], [9, 9, 4, 2, 1], [0, 0, 0, 2, 0]])
    >>> boxes
    <OrientedBoxes: 3 boxes, 1 invalid, xywhr:
    [[50. 40. 60. 20.  0.]
     [ 9.  9.  4.  2.  1.]
     [nan nan nan nan nan]]>
    >>> boxes[boxes.valid].length
    array([60.,  4.])
    >>> boxes[1] == boxes[1:2]
    True
    """

    center: FloatArray
    first: FloatArray
    second: FloatArray
    defects: NDArray[np.uint8]
    bow: NDArray[np.bool_]
    regular: bool = False

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in self._arrays:
            # By name, the argument doubles the time.
            array.setflags(False)  # type: ignore[call-arg]

    @classmethod
    def from_corners(
        cls, corners: ArrayLike, *, bow: bool | NDArray[np.bool_] = False
    ) -> OrientedBoxes:
        """
        Create boxes from their corners.

        Parameters
        ----------
        corners : array_like, shape (N, 4, 2) or (N, 8)
            x and y of the corners of each box, pixels, in any order. Corners that are not exactly
            a rectangle, for example after rounding, give their mean edges, centred on the
            axis-aligned box around them. If they fill less than 85 % of their minimum rotated
            rectangle, they outline a hull and give that rectangle.
        bow : bool or ndarray of bool, shape (N,)
            True if the first two corners are the bow end, for all boxes or for each. Where they
            are a long side, or corners are `crossed`, the bow is not known.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_corners([[20, 30, 80, 30, 80, 50, 20, 50]])
        >>> boxes.length, boxes.width
        (array([60.]), array([20.]))
        """
        rows = _as_array(corners, 'corners', (4, 2))
        boxes = _in_blocks(rows, _boxes_of_corners)
        if bow is False:
            return boxes
        # The second edge leads away from the bow.
        ahead, aside = -boxes.second, boxes.first
        known = _known_bows(ahead, aside, bow) & ~crossed(rows)
        return replace(
            boxes,
            first=np.where(known[:, None], ahead, boxes.first),
            second=np.where(known[:, None], aside, boxes.second),
            bow=known,
        )

    @classmethod
    def from_xywhr(
        cls, xywhr: ArrayLike, *, bow: bool | NDArray[np.bool_] = False, degrees: bool = False
    ) -> OrientedBoxes:
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
        degrees : bool
            Whether `theta` is in degrees.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 90]], degrees=True)
        >>> boxes.corners[0].round(9).tolist()
        [[60.0, 10.0], [60.0, 70.0], [40.0, 70.0], [40.0, 10.0]]
        >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0], [50, 40, 20, 60, 0]], bow=True)
        >>> boxes.bow
        array([ True, False])
        """
        rows = _as_array(xywhr, 'xywhr', (5,))
        if degrees:
            with np.errstate(invalid='ignore'):
                rows = rows * (1.0, 1.0, 1.0, 1.0, np.pi / 180.0)
        boxes = _in_blocks(rows, _boxes_of_xywhr)
        if bow is False:
            return boxes
        return replace(boxes, bow=_known_bows(boxes.first, boxes.second, bow))

    @classmethod
    def from_polygons(cls, polygons: Iterable[ArrayLike | shapely.Geometry]) -> OrientedBoxes:
        """
        Create the minimum rotated rectangle of each polygon; of four corners, `from_corners`.

        Parameters
        ----------
        polygons : iterable of array_like, each of shape (K, 2), or of shapely geometries
            x and y of the vertices, pixels; any number, in any order, closed or not.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_polygons([
        ...     [[0, 0], [55, 0], [60, 10], [55, 20], [0, 20]],
        ...     shapely.box(0, 0, 60, 20),
        ...     [[0, 0], [1, 1]],
        ... ])
        >>> boxes.valid
        array([ True,  True, False])
        >>> Defect(boxes.defects[2]).name
        'TOO_FEW_POINTS'
        """
        rings = [_vertices(polygon, f'polygons[{i}]') for i, polygon in enumerate(polygons)]
        quads = [row for row, ring in enumerate(rings) if is_quadrilateral(ring)]
        if len(quads) == len(rings):
            return _boxes_of_quadrilaterals(rings)
        others = sorted(set(range(len(rings))).difference(quads))
        parts = (
            _boxes_of_quadrilaterals([rings[row] for row in quads]),
            _enclosing_boxes([rings[row] for row in others]),
        )
        return cls.concatenate(parts)[np.argsort(quads + others)]

    @classmethod
    def concatenate(cls, parts: Iterable[OrientedBoxes]) -> OrientedBoxes:
        """
        Join boxes, in the order of the parts.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0], [9, 9, 4, 2, 1]])
        >>> OrientedBoxes.concatenate([boxes[1], boxes]).length
        array([ 4., 60.,  4.])
        """
        parts = list(parts) or [cls.from_xywhr([])]
        arrays = zip(*(part._arrays for part in parts), strict=True)
        center, first, second, defects, bow = map(np.concatenate, arrays)
        regular = all(part.regular for part in parts)
        return cls(center, first, second, defects, bow, regular)

    def __len__(self) -> int:
        """Count the boxes."""
        return self.defects.shape[0]

    def __getitem__(self, rows: Any) -> OrientedBoxes:
        """Select boxes by a NumPy index of N rows: an integer, a slice, integers or a mask."""
        if isinstance(rows, (int, np.integer)):
            row = range(len(self))[rows]
            rows = slice(row, row + 1)
        center, first, second, defects, bow = (array[rows] for array in self._arrays)
        return OrientedBoxes(center, first, second, defects, bow, self.regular)

    def __iter__(self) -> Iterator[OrientedBoxes]:
        """Iterate over the boxes, as `OrientedBoxes` of length 1."""
        return (self[row] for row in range(len(self)))

    def __eq__(self, other: object) -> bool:
        """Return whether all boxes are equal to the last bit, with the same defects and bows."""
        if not isinstance(other, OrientedBoxes):
            return NotImplemented
        return all(
            np.array_equal(left, right, equal_nan=True)
            for left, right in zip(self._arrays, other._arrays, strict=True)
        )

    __hash__ = None  # type: ignore[assignment]

    def __array__(self, *_: Any, **__: Any) -> NoReturn:
        """Refuse to become an array, as there is more than one that it could be."""
        raise TypeError('OrientedBoxes are no array: take .xywhr, (N, 5), or .corners, (N, 4, 2)')

    def __repr__(self) -> str:
        """Show the number of boxes and the first rows."""
        invalid = np.count_nonzero(self.defects)
        rows = np.array2string(self[:_SHOWN].xywhr, precision=3, suppress_small=True)
        return (
            f'<OrientedBoxes: {len(self)} box{"" if len(self) == 1 else "es"}'
            f'{f", {invalid} invalid" if invalid else ""}, xywhr:\n'
            f'{rows}{" ..." if len(self) > _SHOWN else ""}>'
        )

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        """All arrays, in the order in which the constructor takes them."""
        return self.center, self.first, self.second, self.defects, self.bow

    @cached_property
    def _axes(self) -> tuple[FloatArray, FloatArray]:
        """Half the long and half the short edge."""
        with np.errstate(over='ignore'):
            axes = longer_first(self.first, self.second)
        for axis in axes:
            axis.setflags(write=False)
        return axes

    @property
    def long_axis(self) -> FloatArray:
        """Half the long edge as a vector, pixels, shape (N, 2)."""
        return self._axes[0]

    @property
    def short_axis(self) -> FloatArray:
        """Half the short edge as a vector, pixels, shape (N, 2)."""
        return self._axes[1]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which boxes can be converted, shape (N,)."""
        return self.defects == Defect.NONE

    @property
    def length(self) -> FloatArray:
        """Length of the long side, pixels, shape (N,); infinite if it overflows."""
        return _full_length(self.long_axis)

    @property
    def width(self) -> FloatArray:
        """Length of the short side, pixels, shape (N,); infinite if it overflows."""
        return _full_length(self.short_axis)

    @property
    def theta(self) -> FloatArray:
        """Angle of the long axis from image +x, radians in [-pi/2, pi/2), shape (N,)."""
        x, y = self.long_axis.T
        return np.mod(np.arctan2(y, x) + np.pi / 2, np.pi) - np.pi / 2

    @property
    def xywhr(self) -> FloatArray:
        """
        Centre x and y, length, width (pixels) and angle (radians), shape (N, 5).

        The angle is `theta`, or, where the bow is known, the direction of the bow in [-pi, pi].
        ``from_xywhr(boxes.xywhr, bow=boxes.bow)`` gives the same boxes, but for rounding.
        """
        x, y = self.first.T
        angle = np.where(self.bow, np.arctan2(y, x), self.theta)
        return np.column_stack((self.center, self.length, self.width, angle))

    @property
    def corners(self) -> FloatArray:
        """
        Corners in order around each box, pixels, shape (N, 4, 2).

        The first edge is a long side. The order does not depend on the bow.
        """
        return corners_of(self.center, self.long_axis, self.short_axis)

    def to_polygons(self) -> NDArray[np.object_]:
        """
        Create shapely polygons, shape (N,); None where a box is not valid.

        Examples
        --------
        >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0], [0, 0, 0, 2, 0]])
        >>> boxes.to_polygons().tolist()
        [<POLYGON ((20 30, 80 30, 80 50, 20 50, 20 30))>, None]
        """
        polygons = np.full(len(self), None)
        polygons[self.valid] = shapely.polygons(self.corners[self.valid])
        return polygons


def corners_of(center: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Compute the corners around boxes, (N, 4, 2), from centres and half edges, (N, 2) each."""
    c, u, v = center, first, second
    with np.errstate(over='ignore', invalid='ignore'):
        corners = np.stack((c - u - v, c + u - v, c + u + v, c - u + v), axis=1)
    return np.ascontiguousarray(corners)


def _full_length(half_edges: FloatArray) -> FloatArray:
    """Compute the lengths of edges from half of them as vectors, (N, 2)."""
    with np.errstate(over='ignore'):
        return 2.0 * np.hypot(*half_edges.T)


def longer_first(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sort pairs of vectors, (N, 2) each, by length; squared lengths must be finite."""
    swap = _squared(second) > _squared(first)
    if not swap.any():
        return first, second
    swap = swap[:, None]
    return np.where(swap, second, first), np.where(swap, first, second)


def _squared(vectors: FloatArray) -> FloatArray:
    """Compute the squared lengths of vectors, (N, 2)."""
    x, y = vectors.T
    squared: FloatArray = x * x + y * y
    return squared


def _known_bows(
    ahead: FloatArray, aside: FloatArray, claimed: bool | NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Decide where the bow is at the end of `ahead`: where claimed, if that is not the shorter."""
    with np.errstate(over='ignore', invalid='ignore'):
        length, width = _squared(ahead), _squared(aside)
    # False where a box has a defect, NaN, or its square overflows.
    known: NDArray[np.bool_] = (width <= length) & (length < np.inf)
    if np.shape(claimed) not in ((), known.shape):
        raise ValueError(f'bow must be a bool or have shape {known.shape}, not {np.shape(claimed)}')
    return known & np.asarray(claimed, np.bool_)


def range_defect(points: FloatArray) -> Defect:
    """Check that no coordinate, (K, 2), is out of range for GEOS."""
    # NaN passes through the maximum and compares as false.
    if np.abs(points).max(initial=0.0) <= FARTHEST:
        return Defect.NONE
    return Defect.NO_RECTANGLE if np.isfinite(points).all() else Defect.NOT_FINITE


def _as_array(values: ArrayLike, name: str, row_shape: tuple[int, ...]) -> FloatArray:
    """Convert `values` to float64 rows of `row_shape`; a row may also be flat."""
    if type(values) is np.ndarray and values.dtype == _FLOAT and values.shape[1:] == row_shape:
        return values
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f'{name} must be an array of numbers: {error}') from None
    size = math.prod(row_shape)
    if array.shape == (0,) or array.shape[1:] == (size,):
        array = array.reshape(-1, *row_shape)
    if array.shape[1:] != row_shape or array.ndim != len(row_shape) + 1:
        expected = ', '.join(('N', *map(str, row_shape)))
        also = f' or (N, {size})' if len(row_shape) > 1 else ''
        raise ValueError(f'{name} must have shape ({expected}){also}, not {array.shape}')
    return array


def _vertices(polygon: ArrayLike | shapely.Geometry, name: str) -> FloatArray:
    """Return the vertices of a polygon, (K, 2)."""
    if isinstance(polygon, shapely.Geometry):
        return np.asarray(shapely.get_coordinates(polygon))
    return _as_array(polygon, name, (2,))


def _in_blocks(array: FloatArray, boxes_of: Callable[[FloatArray], OrientedBoxes]) -> OrientedBoxes:
    """Create boxes block by block."""
    if len(array) <= BLOCK:
        return boxes_of(array)
    # Into arrays of the full size: `OrientedBoxes.concatenate` takes half as long again.
    count, regular = len(array), True
    center, first, second = np.empty((3, 2, count)).transpose(0, 2, 1)
    defects = np.empty(count, np.uint8)
    for rows in blocks(count):
        block = boxes_of(array[rows])
        center[rows], first[rows], second[rows] = block.center, block.first, block.second
        defects[rows] = block.defects
        regular &= block.regular
    return OrientedBoxes(center, first, second, defects, np.zeros(count, np.bool_), regular)


def _boxes_of_corners(corners: FloatArray) -> OrientedBoxes:
    """Create boxes from corners, (n, 4, 2)."""
    quarters = quarters_of(corners)
    below_large = _all_below_large(quarters)
    if below_large:
        edges = mean_edges(quarters)
        if are_nearly_rectangles(edges).all():
            return _regular_boxes(middles_of(quarters), edges[0], edges[1])
    with np.errstate(invalid='ignore', over='ignore', divide='ignore'):
        center, first, second = boxes_from_quarters(quarters)
        if below_large and np.minimum.reduce(areas_of(first, second)) > SMALL**2:
            return _regular_boxes(center, first, second)
        return _checked_boxes(center, first, second)


def _boxes_of_xywhr(xywhr: FloatArray) -> OrientedBoxes:
    """Create boxes from centre, size and angle, (n, 5)."""
    columns = xywhr.T
    sizes = columns[2:4]
    if _all_below_large(columns) and np.minimum.reduce(sizes, axis=None, initial=np.inf) > SMALL:
        return _regular_boxes(*_from_columns(columns))
    with np.errstate(invalid='ignore', over='ignore'):
        return _checked_boxes(*_from_columns(columns), negative=(sizes < 0.0).any(axis=0))


def _all_below_large(numbers: FloatArray) -> bool:
    """Check that all numbers are finite and no product of two can overflow."""
    # NaN passes through the maximum and compares as false.
    return bool(np.maximum.reduce(np.abs(numbers), axis=None, initial=0.0) < LARGE)


def _from_columns(columns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute centres and half edges, (2, n) each, from x, y, width, height and theta, (5, n)."""
    half = columns[2:4] * 0.5
    theta = columns[4]
    direction = np.empty((2, len(theta)))
    np.cos(theta, out=direction[0])
    np.sin(theta, out=direction[1])
    first, second = direction * half[0], direction[::-1] * half[1]
    np.negative(second[0], out=second[0])
    return columns[:2].copy(), first, second


def _regular_boxes(center: FloatArray, first: FloatArray, second: FloatArray) -> OrientedBoxes:
    """Create boxes without defects from arrays of shape (2, n)."""
    count = center.shape[1]
    nowhere = np.zeros(count, np.bool_)
    return OrientedBoxes(center.T, first.T, second.T, np.zeros(count, np.uint8), nowhere, True)


def _checked_boxes(
    center: FloatArray,
    first: FloatArray,
    second: FloatArray,
    negative: bool | NDArray[np.bool_] = False,
) -> OrientedBoxes:
    """Create boxes from arrays of shape (2, n), and mark those that cannot be converted."""
    numbers = np.concatenate((center, first, second))
    finite = np.logical_and.reduce(np.isfinite(numbers))
    defects = np.zeros(len(finite), np.uint8)
    defects[areas_of(first, second) == 0.0] = Defect.EMPTY
    defects[negative] = Defect.NEGATIVE_SIZE
    defects[~finite] = Defect.NOT_FINITE
    numbers[:, defects != Defect.NONE] = np.nan
    center, first, second = np.split(numbers, 3)
    return OrientedBoxes(center.T, first.T, second.T, defects, np.zeros(len(finite), np.bool_))


def crossed(corners: ArrayLike) -> NDArray[np.bool_]:
    """
    Tell which corners, (N, 4, 2), are not in order around their box, (N,).

    Examples
    --------
    >>> crossed([[[0, 0], [6, 0], [6, 2], [0, 2]], [[0, 0], [6, 0], [0, 2], [6, 2]]])
    array([False,  True])
    """
    quarters = quarters_of(_as_array(corners, 'corners', (4, 2)))
    with np.errstate(invalid='ignore', over='ignore'):
        return are_crossed(quarters)


def count_crossed(polygons: Iterable[FloatArray]) -> int:
    """Count the polygons, (K, 2), that are four corners not in order around their box."""
    corners = [ring[:4] for ring in polygons if is_quadrilateral(ring)]
    return int(np.count_nonzero(crossed(np.array(corners)))) if corners else 0


def is_quadrilateral(ring: FloatArray) -> bool:
    """Tell whether a ring, (K, 2), has four corners, closed or not."""
    return len(ring) == 4 or (len(ring) == 5 and ring[0].tolist() == ring[4].tolist())


def _boxes_of_quadrilaterals(rings: Sequence[FloatArray]) -> OrientedBoxes:
    """Create boxes of four corners, closed or not, within `FARTHEST`."""
    corners = np.array([ring[:4] for ring in rings]).reshape(-1, 4, 2)
    beyond = np.abs(corners).max(axis=(1, 2), initial=0.0) > FARTHEST
    if beyond.any():
        corners[beyond] = np.nan
    boxes = OrientedBoxes.from_corners(corners)
    if boxes.regular:
        return boxes
    defects = boxes.defects.copy()
    for row in np.flatnonzero(defects):
        defects[row] = _ring_defect(rings[int(row)]) or defects[row]
    return replace(boxes, defects=defects)


def _enclosing_boxes(rings: Sequence[FloatArray]) -> OrientedBoxes:
    """Create the minimum rotated rectangles of rings of any number of points."""
    defects = np.array([_ring_defect(ring) for ring in rings], np.uint8)
    corners, origins = np.full((len(rings), 4, 2), np.nan), np.zeros((len(rings), 2))
    usable = defects == Defect.NONE
    if usable.any():
        polygons = [ring for ring, use in zip(rings, usable, strict=True) if use]
        origins[usable] = [ring[0] for ring in polygons]
        # Map coordinates would cost shapely most of its digits.
        corners[usable] = _minimum_rotated_rectangles([ring - ring[0] for ring in polygons])
    boxes = OrientedBoxes.from_corners(corners)
    defects[usable] = boxes.defects[usable]
    defects[usable & (defects == Defect.NOT_FINITE)] = Defect.NO_RECTANGLE
    return replace(boxes, center=boxes.center + origins, defects=defects)


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
