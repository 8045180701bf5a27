# SPDX-License-Identifier: Apache-2.0
"""
From four corners in any order to the box that they mean.

Corners are scaled by 1/4 ("quarters") and of shape (4, 2, n): all x of a corner, then all y, which
makes the arithmetic fast. Every four points have two mean half edges u and v, a middle m and a skew
w: they are m - u - v + w, m + u - v - w, m + u + v + w, m - u + v - w. In another order of the
points u, v and w change places and signs, no more.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]

# Products of four numbers below LARGE do not overflow, squared areas of sides above SMALL do not
# underflow.
LARGE = 1e70
SMALL = 1e-70

# The share of their minimum rectangle that corners fill at least if they are meant as a box. Below,
# they outline a hull.
BOX_FILL = 0.85

# Limits of |u · v| / (u² + v²) and of |w| √(u² + v²) / |u × v|. Within both, the points are in
# order, and the rectangle around them along the longer edge has less than 1.1 · 1.05 times their
# area, so that they fill more than BOX_FILL.
_OBLIQUE = 1 / 40
_SKEWED = 1 / 20

# First and second of the six pairs of four points.
_PAIRS = np.array(((0, 0, 0, 1, 1, 2), (1, 2, 3, 2, 3, 3)))


def quarters_of(corners: FloatArray) -> FloatArray:
    """Scale corners, (n, 4, 2), by 1/4, which never overflows, to shape (4, 2, n)."""
    # One transposed copy, so that the arithmetic runs along contiguous memory. A signalling NaN,
    # which a message may hold, would warn.
    with np.errstate(invalid='ignore'):
        return np.multiply(corners.transpose(1, 2, 0), 0.25, order='C')


def areas_of(first: FloatArray, second: FloatArray) -> FloatArray:
    """Compute a quarter of the area of each box, (n,), from its half edges, (2, n) each."""
    products = first * second[::-1]
    areas = products[0] - products[1]
    return np.abs(areas, out=areas)


def mean_edges(quarters: FloatArray) -> FloatArray:
    """Compute u, v and w, (3, 2, n), from corners scaled by 1/4."""
    diagonals, sums = quarters[2:] - quarters[:2], quarters[2:] + quarters[:2]
    edges = np.empty((3, *sums.shape[1:]))
    np.subtract(diagonals[0], diagonals[1], out=edges[0])
    np.add(diagonals[0], diagonals[1], out=edges[1])
    np.subtract(sums[0], sums[1], out=edges[2])
    return edges


def middles_of(quarters: FloatArray) -> FloatArray:
    """
    Compute the middles of the extents, (2, n), from corners scaled by 1/4.

    Not their means: so `outer` is their minimum and maximum even if they were rounded to whole
    pixels.
    """
    middles: FloatArray = np.maximum.reduce(quarters)
    middles += np.minimum.reduce(quarters)
    middles *= 2.0
    return middles


def are_nearly_rectangles(edges: FloatArray) -> NDArray[np.bool_]:
    """Tell which points, by u, v and w, are in order and surely fill their rectangle, (n,)."""
    first, second, _ = edges
    products, squares = first * second, edges * edges
    lengths = squares[:, 0] + squares[:, 1]
    sizes = lengths[0] + lengths[1]
    areas = areas_of(first, second)
    nearly: NDArray[np.bool_] = np.abs(products[0] + products[1]) <= _OBLIQUE * sizes
    # Not where the squared area underflows.
    nearly &= lengths[2] * sizes < _SKEWED**2 * areas * areas
    return nearly


def are_crossed(quarters: FloatArray) -> NDArray[np.bool_]:
    """Tell which corners, scaled by 1/4, are not in order around their box, (n,)."""
    first, second, skew = mean_edges(quarters)
    others = np.stack((areas_of(second, skew), areas_of(skew, first)))
    # With two corners in one place both sides are equal but for rounding.
    in_order = (1.0 + 1e-9) * (areas_of(first, second) + others.min(axis=0))
    crossed: NDArray[np.bool_] = others.max(axis=0) > in_order
    return crossed


def boxes_from_quarters(quarters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute centres and half edges, (2, n) each, from corners of any kind, scaled by 1/4."""
    edges, center = mean_edges(quarters), middles_of(quarters)
    first, second, _ = edges
    nearly = are_nearly_rectangles(edges) & (np.abs(quarters).max(axis=(0, 1)) < LARGE)
    rows = np.flatnonzero(~nearly & np.isfinite(quarters).all(axis=(0, 1)))
    center[:, rows], first[:, rows], second[:, rows] = _boxes_of_any_points(
        quarters[:, :, rows], second[:, rows]
    )
    return center, first, second


def _boxes_of_any_points(
    quarters: FloatArray, given: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Compute centres and half edges, (2, m) each, from corners that may have any order and shape.

    Parameters
    ----------
    quarters : ndarray, shape (4, 2, m)
        Corners scaled by 1/4, finite.
    given : ndarray, shape (2, m)
        v of the corners as they are. The second half edge of the box is the one along it.
    """
    # Sorted by x, then y: the order of the corners makes no difference, not even in rounding.
    ordered = np.sort(quarters[:, 0] + 1j * quarters[:, 1], axis=0)
    points = np.stack((ordered.real, ordered.imag), axis=1)
    origin = points[0].copy()
    points -= origin
    # By a power of two, which rounds nothing, so that no product overflows.
    _, exponents = np.frexp(np.abs(points).max(axis=(0, 1)))
    points = np.ldexp(points, -exponents)
    first, second, areas = _widest_pair(mean_edges(points))
    boxes = middles_of(points), first, second
    rectangles = _minimum_rectangles(4.0 * points)
    is_hull = (areas > 0.0) & (areas < BOX_FILL * areas_of(*rectangles[1:]))
    center, first, second = (
        np.where(is_hull, *parts) for parts in zip(rectangles, boxes, strict=True)
    )
    first, second = _second_along(np.ldexp(given, -exponents), first, second)
    center, first, second = (np.ldexp(part, exponents) for part in (center, first, second))
    return center + 4.0 * origin, first, second


def _widest_pair(edges: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Choose two of u, v and w, (2, m) each, that span the most; also return the areas, (m,)."""
    spans = np.stack([areas_of(edges[i], edges[i - 2]) for i in range(3)])
    widest, rows = spans.argmax(axis=0), np.arange(edges.shape[2])
    return edges[widest, :, rows].T, edges[widest - 2, :, rows].T, spans[widest, rows]


def _minimum_rectangles(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute centres and half edges, (2, m) each, of the least rectangles of points, (4, 2, m)."""
    # One of their edges lies on two of the points.
    start, end = _PAIRS
    lines = points[end] - points[start]
    lengths = np.hypot(lines[:, 0], lines[:, 1])
    ux, uy = lines[:, 0] / lengths, lines[:, 1] / lengths
    x, y = points[:, None, 0], points[:, None, 1]
    along, across = x * ux + y * uy, y * ux - x * uy
    spans = np.ptp(along, axis=0), np.ptp(across, axis=0)
    # Two points in one place have no direction.
    areas = np.where(lengths > 0.0, spans[0] * spans[1], np.inf)
    best = areas.argmin(axis=0), np.arange(points.shape[2])
    rows, columns = best
    along, across = along[:, rows, columns], across[:, rows, columns]
    ahead = np.stack((ux[best], uy[best]))
    aside = np.stack((-ahead[1], ahead[0]))
    center = ahead * _middle(along) + aside * _middle(across)
    return center, ahead * (np.ptp(along, axis=0) / 2.0), aside * (np.ptp(across, axis=0) / 2.0)


def _middle(values: FloatArray) -> FloatArray:
    """Compute the middles of columns."""
    middle: FloatArray = (values.max(axis=0) + values.min(axis=0)) / 2.0
    return middle


def _second_along(
    direction: FloatArray, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Exchange and turn half edges, (2, m), so that the second is the one along `direction`."""
    turns = [np.sum(edge * direction, axis=0) for edge in (first, second)]
    sizes = [np.hypot(*edge) for edge in (first, second)]
    exchange = np.abs(turns[0]) * sizes[1] > np.abs(turns[1]) * sizes[0]
    turn = np.where(np.where(exchange, *turns) < 0.0, -1.0, 1.0)
    return np.where(exchange, second, first), turn * np.where(exchange, first, second)
