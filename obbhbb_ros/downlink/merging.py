# SPDX-License-Identifier: Apache-2.0
"""
Merging of crop regions: two become one if the region around both has fewer pixels than the two.

Merging runs in rounds, over regions sorted by x0, y0, x1, y1. Each round has two steps:

1. Every region finds its partner: the region with which it saves the most pixels. Only regions
   that changed in the round before, or whose partner did, search again.
2. Pairs are merged in descending saving, each region with one partner per round. A region inside
   another one is always merged into it.

In crowds, the first rounds search only the nearest regions in x, which cheaply thins them out.
Rounds end when no two regions are left that would save pixels by merging.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

IntArray: TypeAlias = NDArray[np.intp]
Pixels: TypeAlias = NDArray[np.signedinteger]

_BLOCK = 48
_REACH = 64
_NO_PARTNER = -1
# In images of fewer pixels, areas and their sums fit 32 bits, which takes half the memory.
_SMALL_IMAGE = 2**30


@dataclass(frozen=True)
class MergeRules:
    """
    Size limits of merged regions, pixels.

    Attributes
    ----------
    max_side : float
        Maximum side of a merged region. A region inside another one is merged whatever the side.
    step : int
        Sides are rounded up to multiples of this.
    bounds : tuple of int
        Width and height of the image, which rounding does not exceed.
    fit : callable
        Turns corners, (4, N), into those of regions of such sizes, whole numbers of any type.
    """

    max_side: float
    step: int
    bounds: tuple[int, int]
    fit: Callable[[Pixels], NDArray[Any]]


def merge_regions(
    corners: NDArray[np.int64], rules: MergeRules
) -> tuple[NDArray[np.int64], IntArray]:
    """
    Merge regions where that saves pixels.

    `corners` are x0, y0, x1, y1, (4, N), with sizes from `rules.fit`. Returns those of the M
    remaining regions, (4, M), in no particular order, and for each of the N regions the index of
    the merged region that contains it. The grouping does not depend on the order of the input.

    Examples
    --------
    >>> rules = MergeRules(100, step=1, bounds=(640, 480), fit=lambda corners: corners)
    >>> merged, group_of = merge_regions(np.array([[0, 2], [0, 0], [20, 24], [10, 10]]), rules)
    >>> merged.T.tolist(), group_of.tolist()
    ([[0, 0, 24, 10]], [0, 0])
    """
    order = _in_order(corners)
    group_of = np.empty(len(order), np.intp)
    group_of[order] = np.arange(len(order))
    counted = np.int32 if rules.bounds[0] * rules.bounds[1] < _SMALL_IMAGE else np.int64
    regions = _Round(corners[:, order].astype(counted))
    reach, complete = _REACH, True
    while True:
        complete &= _find_partners(regions, rules, reach)
        root = _group(regions)
        if (root != np.arange(len(root))).any():
            regions, new_index = _merge(regions, root, rules)
            group_of = new_index[group_of]
        elif complete:
            return regions.corners.astype(np.int64), group_of
        else:
            reach, complete = len(root), True
            regions.stale[:] = True


def _in_order(corners: Pixels) -> IntArray:
    """Sort by x0, y0, x1, y1, (4, N) to (N,)."""
    low = (corners[0].astype(np.int64) << 32) + corners[1]
    order = np.argsort(low, kind='stable')
    ranked = low[order]
    return np.lexsort(corners[::-1]) if (ranked[1:] == ranked[:-1]).any() else order


class _Round:
    """
    The regions of a round, sorted by x0, y0, x1, y1.

    Attributes
    ----------
    corners : ndarray, shape (4, N)
        x0, y0, x1, y1, pixels.
    area : ndarray, shape (N,)
        Pixels of each region.
    partner : ndarray of int, shape (N,)
        Index of the best partner found so far, or -1.
    saving : ndarray, shape (N,)
        Pixels saved by merging with it.
    stale : ndarray of bool, shape (N,)
        Which regions must search for a partner.
    """

    def __init__(self, corners: Pixels) -> None:
        self.corners = np.ascontiguousarray(corners)
        self.area = (corners[2] - corners[0]) * (corners[3] - corners[1])
        self.partner = np.full(corners.shape[1], _NO_PARTNER)
        self.saving = np.zeros_like(self.area)
        self.stale = np.ones(corners.shape[1], np.bool_)


def _find_partners(regions: _Round, rules: MergeRules, reach: int) -> bool:
    """
    Find the best partner of each stale region, and update the others where it is better for them.

    The search covers about `reach` neighbours on each side. Returns whether that is all overlaps.
    """
    stale = np.flatnonzero(regions.stale)
    complete = True
    lefts = regions.corners[0]
    widest = (regions.corners[2] - lefts).max(initial=0)
    for start in range(0, len(stale), _BLOCK):
        rows = stale[start : start + _BLOCK]
        # Sorted by x0, so all regions that can overlap these rows are in one range.
        first = int(np.searchsorted(lefts, lefts[rows[0]] - widest))
        end = int(np.searchsorted(lefts, regions.corners[2, rows].max()))
        if first < rows[0] - reach or end > rows[-1] + 1 + reach:
            first, end = max(first, rows[0] - reach), min(end, rows[-1] + 1 + reach)
            complete = False
        saving = _savings(regions, rows, slice(first, end), rules)
        saving[np.arange(len(rows)), rows - first] = 0
        _keep_best(regions, rows, np.arange(first, end), saving)
        # Stale regions are searched as rows themselves.
        others = np.flatnonzero(~regions.stale[first:end])
        if others.size:
            saving = np.ascontiguousarray(saving[:, others].T)
            _keep_best(regions, others + first, rows, saving)
    return complete


def _savings(regions: _Round, rows: IntArray, columns: slice, rules: MergeRules) -> Pixels:
    """Compute the pixels saved by merging rows with columns, (R, C); at most 0 if not allowed."""
    sides = []
    fits: NDArray[np.bool_] | None = None
    for axis in (0, 1):
        low, high = regions.corners[axis], regions.corners[axis + 2]
        side = np.maximum(high[rows, None], high[columns])
        side -= np.minimum(low[rows, None], low[columns])
        if rules.step > 1:
            side += rules.step - 1
            side //= rules.step
            side *= rules.step
            np.minimum(side, rules.bounds[axis], out=side)
        if rules.max_side < rules.bounds[axis]:
            short = side <= rules.max_side
            fits = short if fits is None else fits & short
        sides.append(side)
    area = sides[0] * sides[1]
    row_areas, column_areas = regions.area[rows, None], regions.area[columns]
    saving = row_areas + column_areas
    saving -= area
    if fits is not None:
        saving *= fits | (area == np.maximum(row_areas, column_areas))
    return saving


def _keep_best(regions: _Round, rows: IntArray, candidates: IntArray, saving: Pixels) -> None:
    """Take the best candidate for each row where it saves more, (R, C), than the one so far."""
    best = saving.argmax(axis=1)
    saved = saving[np.arange(len(rows)), best]
    better = saved > regions.saving[rows]
    chosen = rows[better]
    regions.partner[chosen] = candidates[best[better]]
    regions.saving[chosen] = saved[better]


def _group(regions: _Round) -> IntArray:
    """Choose what to merge: return, for each region, the first region of its group, (N,)."""
    root = list(range(len(regions.area)))
    paired = np.flatnonzero(regions.partner != _NO_PARTNER)
    paired = paired[np.argsort(-regions.saving[paired], kind='stable')]
    # A region saves at most its own pixels, and only if it is inside another one.
    within = (regions.saving == regions.area).tolist()
    # A region inside another one is merged into it, and is no partner for a third.
    taken = within.copy()
    for one, other in zip(paired.tolist(), regions.partner[paired].tolist(), strict=True):
        if not within[one]:
            if taken[one] or taken[other]:
                continue
            taken[one] = taken[other] = True
        one_root, other_root = _find_root(root, one), _find_root(root, other)
        root[max(one_root, other_root)] = min(one_root, other_root)
    roots = np.array(root, np.intp)
    while (roots[roots] != roots).any():
        roots = roots[roots]
    return roots


def _find_root(root: list[int], region: int) -> int:
    """Find the first region of a group, shortening the path (union-find)."""
    while root[region] != region:
        root[region] = root[root[region]]
        region = root[region]
    return region


def _merge(regions: _Round, root: IntArray, rules: MergeRules) -> tuple[_Round, IntArray]:
    """Merge groups; return the next round, and the new index of each region, (N,)."""
    order = np.argsort(root, kind='stable')
    starts = np.flatnonzero(np.diff(root[order], prepend=-1))
    sizes = np.diff(starts, append=len(root))
    changed = sizes > 1
    low = np.minimum.reduceat(regions.corners[:2, order], starts, axis=1)
    high = np.maximum.reduceat(regions.corners[2:, order], starts, axis=1)
    corners = np.concatenate((low, high))
    corners[:, changed] = rules.fit(corners[:, changed])
    sorting = _in_order(corners)
    new_index = np.empty(len(root), np.intp)
    new_index[order] = np.repeat(np.argsort(sorting), sizes)
    first_of = order[starts][sorting]
    merged = _Round(corners[:, sorting])
    grown = changed[sorting]
    partner = regions.partner[first_of]
    has_partner = partner != _NO_PARTNER
    # A changed partner may have become better or worse.
    moved = has_partner & grown[new_index[partner]]
    merged.stale = grown | moved
    keep = ~merged.stale & has_partner
    merged.partner[keep] = new_index[partner[keep]]
    merged.saving[keep] = regions.saving[first_of][keep]
    return merged, new_index
