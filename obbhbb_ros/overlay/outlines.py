# SPDX-License-Identifier: Apache-2.0
"""Outlines of boxes on a Pillow canvas: solid or dashed, with a rim that makes them stand out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray

Color: TypeAlias = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)
# Length of a dash in line widths, about.
_WIDTHS_PER_DASH = 4.0


@dataclass(frozen=True)
class Pen:
    """
    What boxes are outlined with.

    Attributes
    ----------
    color : Color
        Colour of the line. Its rim is black or white, see `ink_on`.
    width : int
        Width of the line, pixels.
    dashed : bool
        Whether the line is dashed; then the rim is on both sides of it, else outside the box.
    """

    color: Color
    width: int
    dashed: bool = False

    @property
    def rim(self) -> int:
        """Width of the rim, pixels."""
        return max(1, self.width // 3)

    def strokes(self, corners: FloatArray) -> list[tuple[Color, int, FloatArray]]:
        """List colour, width and lines, (M, 2, 2), of rims and outlines of boxes, (N, 4, 2)."""
        width, rim, ink = self.width, self.rim, ink_on(self.color)
        if self.dashed:
            # A line twice, so that the dashes of the rim are those of the line.
            edges = _edges(corners, 0.0, 1)
            return [(ink, width + 2 * rim, edges), (self.color, width, edges)]
        outside = _edges(corners, (width + rim) / 2.0, rim)
        return [(ink, rim, outside), (self.color, width, _edges(corners, 0.0, width))]


def visible_strokes(
    corners: FloatArray, pen: Pen, size: tuple[int, int]
) -> list[tuple[Color, int, FloatArray]]:
    """List colour, width and lines, (M, 2, 2), of what shows of boxes, (N, 4, 2), in a picture."""
    strokes = []
    for color, width, edges in pen.strokes(corners[finite(corners)]):
        margin = np.full(2, float(width))
        within = clipped(edges, -margin, np.array(size) + margin)
        if pen.dashed:
            within = dashes(within, _WIDTHS_PER_DASH * pen.width)
        strokes.append((color, width, within))
    return strokes


def outline(canvas: Any, corners: FloatArray, pen: Pen) -> None:
    """Draw the edges of boxes, (N, 4, 2), in pixels of the picture, with a rim around each box."""
    # First all rims: that of one box must not cover the line of another.
    for ink, thickness, edges in visible_strokes(corners, pen, canvas.im.size):
        for x0, y0, x1, y1 in np.floor(edges).reshape(-1, 4).tolist():
            canvas.line((x0, y0, x1, y1), ink, thickness)


def finite(points: FloatArray) -> NDArray[np.bool_]:
    """Return which rows of points, (N, K, 2), are finite."""
    return np.logical_and.reduce(np.isfinite(points), axis=(1, 2))


def _edges(corners: FloatArray, distance: float, width: int) -> FloatArray:
    """List the edges, (4 N, 2, 2), of boxes grown by a distance, for lines of some width."""
    along = np.roll(corners, -1, axis=1) - corners
    # An edge of zero length has no direction.
    with np.errstate(divide='ignore', invalid='ignore'):
        unit = np.nan_to_num(along / np.hypot(along[..., 0], along[..., 1])[..., None])
    starts = corners + distance * (np.roll(unit, 1, axis=1) - unit)
    # Long enough for corners without notches.
    longer = (width - 1) / 2.0 * unit
    ends = np.roll(starts, -1, axis=1) + longer
    return np.stack((starts - longer, ends), axis=2).reshape(-1, 2, 2)


def clipped(segments: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """
    Cut line segments to a rectangle.

    Parameters
    ----------
    segments : ndarray, shape (M, 2, 2)
        x and y of the two ends.
    low, high : ndarray, shape (2,)
        Corners of the rectangle.

    Returns
    -------
    ndarray, shape (K, 2, 2)
        What lies inside of those that are finite.

    Examples
    --------
    >>> lines = np.array([[[-10.0, 5.0], [30.0, 5.0]], [[-9.0, 0.0], [-9.0, 9.0]]])
    >>> clipped(lines, np.array([0.0, 0.0]), np.array([20.0, 20.0])).tolist()
    [[[0.0, 5.0], [20.0, 5.0]]]
    """
    segments = segments[finite(segments)]
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    with np.errstate(divide='ignore', invalid='ignore'):
        crossings = np.sort(np.stack(((low - start) / step, (high - start) / step)), axis=0)
    first = np.fmax(crossings[0].max(axis=1), 0.0)
    last = np.fmin(crossings[1].min(axis=1), 1.0)
    kept = first <= last
    start, step = start[kept], step[kept]
    return np.stack((start + first[kept, None] * step, start + last[kept, None] * step), axis=1)


def dashes(segments: FloatArray, length: float) -> FloatArray:
    """
    Cut line segments into dashes, with gaps as long as they are.

    Parameters
    ----------
    segments : ndarray, shape (M, 2, 2)
        x and y of the two ends, finite.
    length : float
        Length of a dash, about: a segment begins and ends with a whole one.

    Returns
    -------
    ndarray, shape (K, 2, 2)
        The dashes, in the order of the segments.

    Examples
    --------
    >>> dashes(np.array([[[0.0, 0.0], [3.0, 0.0]]]), 1.1)[..., 0].tolist()
    [[0.0, 1.0], [2.0, 3.0]]
    """
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    count = 1 + np.round((np.hypot(*step.T) / length - 1.0) / 2.0).clip(0.0).astype(int)
    row = np.repeat(np.arange(len(segments)), count)
    number = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    # Dashes and gaps are equal parts of a segment.
    begin = 2.0 * number / (2.0 * count[row] - 1.0)
    end = begin + 1.0 / (2.0 * count[row] - 1.0)
    share = np.stack((begin, end), axis=1)[..., None]
    return start[row, None] + share * step[row, None]


def ink_on(color: Color) -> Color:
    """Choose black or white to stand out from a colour, by its brightness."""
    red, green, blue = color
    return _BLACK if 0.299 * red + 0.587 * green + 0.114 * blue > 140.0 else _WHITE


def rgb(color: str) -> Color:
    """Parse '#rrggbb', once instead of for every line as Pillow would."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue
