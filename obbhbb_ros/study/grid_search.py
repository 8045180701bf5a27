# SPDX-License-Identifier: Apache-2.0
"""
The paper's grid search for q, f and s (Algorithm 2).

`Bench` prepares ships so that trying a setting is fast: the half-extents are computed once per q
and f, and the shrink factor scales them.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import S_RANGE
from obbhbb_ros.geometry.methods import Method
from obbhbb_ros.geometry.methods import get_method
from obbhbb_ros.study.metrics import Overlap
from obbhbb_ros.study.metrics import area
from obbhbb_ros.study.ships import Ships

_HALVINGS = 40


@dataclass(frozen=True)
class Grid:
    """Candidate values of q, f and s; a search tries all combinations."""

    q: tuple[float, ...]
    f: tuple[float, ...]
    s: tuple[float, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of values of q, f and s."""
        return len(self.q), len(self.f), len(self.s)


GRIDS: MappingProxyType[str, Grid] = MappingProxyType(
    {
        # The paper's search space, 120 settings.
        'paper': Grid(
            q=(1.5, 1.8, 2.0, 2.2, 2.4, 2.6), f=(0.7, 0.8, 0.9, 1.0, 1.1), s=(0.95, 1.0, 1.05, 1.1)
        ),
        # The best settings for real ships lie outside the paper's search space.
        'wide': Grid(
            q=(1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0),
            f=(0.8, 0.9, 1.0, 1.1, 1.2),
            s=(0.9, 0.95, 1.0, 1.05, 1.1),
        ),
    }
)


def tunable(name: str) -> Method:
    """Return a method that has q, f and s; raise ValueError if it has none."""
    method = get_method(name)
    if not method.tunable:
        raise ValueError(f'{name} has no parameters to calibrate')
    return method


class Bench:
    """
    N ships with reference boxes, prepared for trying many settings of one method.

    Raises ValueError if a ship has no reference box, or the method has no parameters.
    """

    def __init__(self, ships: Ships, method: str = 'superellipse') -> None:
        if not ships.with_reference.all():
            raise ValueError('calibration needs a reference box for every ship')
        self._method = tunable(method)
        # Each coordinate on its own, (2, N), is faster.
        boxes, turned = ships.boxes, np.ascontiguousarray
        self._along, self._across = (
            np.abs(turned(axis.T)) for axis in (boxes.long_axis, boxes.short_axis)
        )
        self._low, self._high = turned(ships.reference.T).reshape(2, 2, -1) - turned(boxes.center.T)
        self._reference_area = area(ships.reference)
        self._outer_area = 4.0 * np.prod(self._along + self._across, axis=0)

    def extents(self, q: float, f: float) -> FloatArray:
        """Compute half-extents before shrinking, pixels, shape (2, N)."""
        return self._method.half_extents(self._along, self._across * f, q)

    def overlap(self, extents: FloatArray) -> Overlap:
        """Compare the boxes of half-extents, (2, N), with the references."""
        return Overlap(self._shared(extents), 4.0 * extents[0] * extents[1], self._reference_area)

    def relative_area(self, extents: FloatArray) -> FloatArray:
        """Compute areas relative to those of the outer boxes, shape (N,)."""
        return 4.0 * extents[0] * extents[1] / self._outer_area

    def needed_shrink(self, extents: FloatArray, keep: float) -> FloatArray:
        """
        Find the smallest s of each ship that keeps enough of its reference box, shape (N,).

        The part that is kept never falls as s grows, so bisection finds it, to within 1e-11; s is
        infinite where even the largest does not keep enough. `extents`, (2, N), are half-extents
        at s = 1, pixels; `keep` is a share of the reference's area, in (0, 1].
        """
        enough = keep * self._reference_area * (1.0 - 1e-12)
        low, high = np.zeros(extents.shape[1]), np.full(extents.shape[1], S_RANGE.high)
        reachable = self._shared(extents * high) >= enough
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            kept = self._shared(extents * middle) >= enough
            high = np.where(kept, middle, high)
            low = np.where(kept, low, middle)
        return np.where(reachable, high, np.inf)

    def _shared(self, extents: FloatArray) -> FloatArray:
        """Compute the area shared with the references, (N,)."""
        sides = np.minimum(self._high, extents) - np.maximum(self._low, -extents)
        np.maximum(sides, 0.0, out=sides)
        return sides[0] * sides[1]


@dataclass(frozen=True, eq=False)
class Surface:
    """Result of a grid search: mean IoU and relative error (Eq. relerr), (Q, F, S)."""

    grid: Grid
    mean_iou: FloatArray
    relative_error: FloatArray

    def best(self) -> tuple[float, float, float]:
        """Return q, f and s of the largest mean IoU, the first of equals, as Algorithm 2 does."""
        i, j, k = np.unravel_index(int(np.argmax(self.mean_iou)), self.mean_iou.shape)
        return self.grid.q[i], self.grid.f[j], self.grid.s[k]


def search(bench: Bench, grid: Grid) -> Surface:
    """
    Try every setting of a grid (Algorithm 2).

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import synthetic_ships
    >>> ships = synthetic_ships(aspects=2, angles=9, seed=None)
    >>> round(float(search(Bench(ships), GRIDS['paper']).mean_iou.max()), 2)
    0.9
    """
    surface = Surface(grid, *(np.empty(grid.shape) for _ in range(2)))
    for i, q in enumerate(grid.q):
        for j, f in enumerate(grid.f):
            extents = bench.extents(q, f)
            for k, s in enumerate(grid.s):
                overlap = bench.overlap(extents * s)
                surface.mean_iou[i, j, k] = overlap.iou.mean()
                surface.relative_error[i, j, k] = overlap.relative_error.mean()
    return surface
