# SPDX-License-Identifier: Apache-2.0
"""Compass search: maximise a function of a few numbers without its derivative."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence

import numpy as np

_FIRST_STEP = 0.08
_LAST_STEP = 5e-4


def compass_search(
    start: Sequence[float],
    value: Callable[[list[float]], tuple[float, ...]],
    low: Sequence[float],
    high: Sequence[float],
) -> list[float]:
    """
    Climb from a point, one coordinate at a time, and halve the step where no move gains.

    It needs no derivative, which medians and shares do not have, and never ends below its start.

    Parameters
    ----------
    start : sequence of float, length K
        Where to begin, within the bounds.
    value : callable
        What to maximise: takes K numbers and returns a tuple; tuples are compared from the front.
    low, high : sequence of float, length K
        Bounds of each coordinate, both included.

    Returns
    -------
    list of float, length K
        The best point.

    Examples
    --------
    >>> best = compass_search([0.0, 0.0], lambda x: (-abs(x[0] - 0.3) - x[1],), [0, 0], [1, 1])
    >>> [round(number, 2) for number in best]
    [0.3, 0.0]
    """
    point = list(start)
    best, step = value(point), _FIRST_STEP
    # Up and down along each coordinate.
    directions = np.kron(np.eye(len(point)), [[1.0], [-1.0]])
    while step >= _LAST_STEP:
        moved = False
        for direction in directions:
            neighbour = np.clip(point + step * direction, low, high).tolist()
            worth = value(neighbour)
            if worth > best:
                point, best, moved = neighbour, worth, True
        if not moved:
            step /= 2.0
    return point
