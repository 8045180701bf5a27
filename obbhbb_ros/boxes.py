"""
Arrays of oriented boxes, from corners, from centre, size and angle, and from polygons.

Image coordinates: x to the right, y down, pixels, pixel i covering [i, i + 1). Axis-aligned
extents are even in the angle and have period pi, so its sense of rotation does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any
from typing import TypeAlias

import numpy as np
import shapely
from numpy.typing import ArrayLike
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]


class Defect(IntEnum):
    """Why a box cannot be converted; `NONE` where it can."""

    NONE = 0
    NOT_FINITE = 1
    NEGATIVE_SIZE = 2
    EMPTY = 3
    TOO_FEW_POINTS = 4


@dataclass(frozen=True, eq=False)
class OrientedBoxes:
    """
    N oriented boxes, kept as centres and half axes.

    Build one with `from_corners`, `from_xywhr` or `from_polygons`. Which side is the longer one
    never matters there: the half axes are sorted. Boxes that cannot be converted keep their place
    and are marked in `defects`; their numbers are NaN.

    Attributes
    ----------
    center : ndarray, shape (2, N)
        x and y of the centres, pixels.
    long_axis : ndarray, shape (2, N)
        Half the long edge as a vector, pixels: half the length times (cos theta, sin theta).
    short_axis : ndarray, shape (2, N)
        Half the short edge as a vector, pixels.
    defects : ndarray of uint8, shape (N,)
        A `Defect` for each box.
    """

    center: FloatArray
    long_axis: FloatArray
    short_axis: FloatArray
    defects: NDArray[np.uint8]

    @classmethod
    def from_corners(cls, corners: ArrayLike) -> OrientedBoxes:
        """
        Take boxes from their corners.

        Parameters
        ----------
        corners : array_like, shape (N, 4, 2)
            x and y of the corners in order around each box, pixels; either sense, any start.
            Corners that are not quite a rectangle, as rounding leaves them, give their mean edges
            about the middle of their bounds. Crossed corners have no area and are marked empty;
            `from_polygons` takes vertices in any order.

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
        c0, c1, c2, c3 = (array[:, i].T for i in range(4))
        with np.errstate(invalid='ignore', over='ignore'):
            # Not the mean of the corners: so `outer` is their minimum and maximum even where they
            # were rounded to whole pixels.
            low = np.minimum(np.minimum(c0, c1), np.minimum(c2, c3))
            high = np.maximum(np.maximum(c0, c1), np.maximum(c2, c3))
            center = (low + high) * 0.5
            first = (c1 - c0 + c2 - c3) * 0.25
            second = (c2 - c1 + c3 - c0) * 0.25
        return cls._from_half_edges(center, first, second)

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
        center = array[:, :2].T.copy()
        half_size = array[:, 2:4].T * 0.5
        theta = array[:, 4]
        first, second = np.empty_like(center), np.empty_like(center)
        with np.errstate(invalid='ignore', over='ignore'):
            np.cos(theta, out=first[0])
            np.sin(theta, out=first[1])
            np.negative(first[1], out=second[0])
            second[1] = first[0]
            first *= half_size[0]
            second *= half_size[1]
        boxes = cls._from_half_edges(center, first, second)
        if (half_size < 0.0).any():
            boxes._mark_negative((half_size < 0.0).any(axis=0))
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

    @classmethod
    def _from_half_edges(
        cls, center: FloatArray, first: FloatArray, second: FloatArray
    ) -> OrientedBoxes:
        """Sort the half edges into long and short, and mark the boxes that cannot be used."""
        with np.errstate(invalid='ignore', over='ignore'):
            size_first = first[0] * first[0] + first[1] * first[1]
            size_second = second[0] * second[0] + second[1] * second[1]
            product = size_first * size_second * center[0] * center[1]
            swap = size_second > size_first
        if swap.any():
            first, second = np.where(swap, second, first), np.where(swap, first, second)
        boxes = cls(center, first, second, np.zeros(swap.shape, np.uint8))
        # One cheap test for the usual case: everything finite and nothing empty. A centre on an
        # image edge makes the product zero as well, and is then sorted out by the careful one.
        if not (np.isfinite(product) & (product != 0.0)).all():
            boxes._mark_defects()
        return boxes

    def _mark_defects(self) -> None:
        """Find the boxes that are not finite or empty."""
        finite = np.isfinite(self.center).all(axis=0)
        finite &= np.isfinite(self.long_axis).all(axis=0)
        finite &= np.isfinite(self.short_axis).all(axis=0)
        self.defects[~finite] = Defect.NOT_FINITE
        empty = (self.long_axis == 0.0).all(axis=0) | (self.short_axis == 0.0).all(axis=0)
        empty &= finite
        self.defects[empty] = Defect.EMPTY
        self._blank_defective()

    def _mark_negative(self, negative: NDArray[np.bool_]) -> None:
        """Mark boxes of negative size, but for those that are not even finite."""
        self.defects[negative & (self.defects != Defect.NOT_FINITE)] = Defect.NEGATIVE_SIZE
        self._blank_defective()

    def _blank_defective(self) -> None:
        """Let no number of a defective box reach a caller."""
        defective = self.defects != Defect.NONE
        for array in (self.center, self.long_axis, self.short_axis):
            array[:, defective] = np.nan

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
            self.center[:, rows],
            self.long_axis[:, rows],
            self.short_axis[:, rows],
            self.defects[rows],
        )

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which boxes can be converted, shape (N,)."""
        return self.defects == Defect.NONE

    @property
    def length(self) -> FloatArray:
        """Length of the long side, pixels, shape (N,)."""
        return 2.0 * np.hypot(self.long_axis[0], self.long_axis[1])

    @property
    def width(self) -> FloatArray:
        """Length of the short side, pixels, shape (N,)."""
        return 2.0 * np.hypot(self.short_axis[0], self.short_axis[1])

    @property
    def theta(self) -> FloatArray:
        """Angle of the long axis from image +x, radians in [-pi/2, pi/2), shape (N,)."""
        angle = np.arctan2(self.long_axis[1], self.long_axis[0])
        return np.mod(angle + np.pi / 2, np.pi) - np.pi / 2

    @property
    def corners(self) -> FloatArray:
        """Corners in order around each box, pixels, shape (N, 4, 2)."""
        c, u, v = self.center, self.long_axis, self.short_axis
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
