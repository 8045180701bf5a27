# SPDX-License-Identifier: Apache-2.0
"""
Which regions of an image are better sent as one.

That is where the region around both has fewer pixels than the two together. Regions are merged
in rounds. In each, every region looks for the partner with which it saves most;
then, by falling saving, those join that have not joined another yet, and whatever lies within
another region joins that. A later round looks again only where something changed. In a crowd the
first rounds look only at the nearest in x, which thins it out at little cost. At the end no two
regions are left that would save pixels by merging.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

IntArray: TypeAlias = NDArray[np.intp]
Pixels: TypeAlias = NDArray[np.signedinteger]

Fit: TypeAlias = Callable[[Pixels, Pixels], tuple[Pixels, Pixels]]
"""Lower and upper corners, (2, N) each, of what regions must hold -> corners of the regions."""

_BLOCK = 48
_REACH = 64
_NOBODY = -1
# Of images up to so many pixels, areas and their sums are counted in half the memory.
_SMALL_IMAGE = 2**30


@dataclass(frozen=True)
class MergeRules:
    """
    What a merged region may be.

    Attributes
    ----------
    limit : float
        Longest side that a region may get by merging, pixels. Within another region no limit
        holds, as nothing grows.
    step : int
        Sides are rounded up to multiples of so many pixels.
    bounds : tuple of int
        Width and height of the image, pixels, beyond which nothing is rounded up.
    fit : callable
        Makes the regions, of those sizes, around what was merged.
    """

    limit: float
    step: int
    bounds: tuple[int, int]
    fit: Fit


def merge_regions(
    corners: NDArray[np.int64], rules: MergeRules
) -> tuple[NDArray[np.int64], IntArray]:
    """
    Merge regions where that saves pixels.

    Parameters
    ----------
    corners : ndarray of int, shape (4, N)
        x0, y0, x1, y1 of regions of sizes that `rules.fit` gives.
    rules : MergeRules
        What a merged region may be.

    Returns
    -------
    merged : ndarray of int64, shape (4, M)
        The regions that are left, in no particular order.
    group_of : ndarray of int, shape (N,)
        For each of the N, which of the M holds it. As a grouping of equal regions, neither
        depends on the order of the input.
    """
    order = _in_order(corners)
    group_of = np.empty(len(order), np.intp)
    group_of[order] = np.arange(len(order))
    counted = np.int32 if rules.bounds[0] * rules.bounds[1] < _SMALL_IMAGE else np.int64
    live = _Live(corners[:, order].astype(counted))
    reach, all_seen = _REACH, True
    while True:
        all_seen &= _find_partners(live, rules, reach)
        root = _couple(live)
        if (root != np.arange(len(root))).any():
            live, place = _unite(live, root, rules)
            group_of = place[group_of]
        elif all_seen:
            return live.corners.astype(np.int64), group_of
        else:
            reach, all_seen = len(root), True
            live.stale[:] = True


def _in_order(corners: Pixels) -> IntArray:
    """Sort by x0, y0, x1, y1, (4, N) to (N,)."""
    low = (corners[0].astype(np.int64) << 32) + corners[1]
    order = np.argsort(low, kind='stable')
    ranked = low[order]
    return np.lexsort(corners[::-1]) if (ranked[1:] == ranked[:-1]).any() else order


class _Live:
    """
    The regions of a round, sorted by x0, y0, x1, y1.

    Parameters
    ----------
    corners : ndarray, shape (4, N)
        x0, y0, x1, y1.
    """

    def __init__(self, corners: Pixels) -> None:
        self.corners = np.ascontiguousarray(corners)
        self.area = (corners[2] - corners[0]) * (corners[3] - corners[1])
        self.partner = np.full(corners.shape[1], _NOBODY)
        self.saving = np.zeros_like(self.area)
        self.stale = np.ones(corners.shape[1], np.bool_)


def _find_partners(live: _Live, rules: MergeRules, reach: int) -> bool:
    """
    Look for the best partner of each region that is stale, and of others among the stale.

    None is sought more than about `reach` places away; tell whether that was far enough for all.
    """
    stale = np.flatnonzero(live.stale)
    all_seen = True
    lefts = live.corners[0]
    widest = (live.corners[2] - lefts).max(initial=0)
    for start in range(0, len(stale), _BLOCK):
        rows = stale[start : start + _BLOCK]
        # Sorted by x0, so all that can overlap these rows lie in one stretch.
        first = int(np.searchsorted(lefts, lefts[rows[0]] - widest))
        behind = int(np.searchsorted(lefts, live.corners[2, rows].max()))
        if first < rows[0] - reach or behind > rows[-1] + 1 + reach:
            first, behind = max(first, rows[0] - reach), min(behind, rows[-1] + 1 + reach)
            all_seen = False
        saving = _savings(live, rows, slice(first, behind), rules)
        saving[np.arange(len(rows)), rows - first] = 0
        best = saving.argmax(axis=1)
        _note_best(live, rows, best + first, saving[np.arange(len(rows)), best])
        # Those that are stale themselves have their own turn.
        others = np.flatnonzero(~live.stale[first:behind])
        if others.size:
            saving = np.ascontiguousarray(saving[:, others].T)
            best = saving.argmax(axis=1)
            _note_best(live, others + first, rows[best], saving[np.arange(len(others)), best])
    return all_seen


def _savings(live: _Live, rows: IntArray, columns: slice, rules: MergeRules) -> Pixels:
    """Compute how many pixels each row saves with each column; 0 where they may not merge."""
    sides = []
    fits: NDArray[np.bool_] | None = None
    for axis in (0, 1):
        low, high = live.corners[axis], live.corners[axis + 2]
        side = np.maximum(high[rows, None], high[columns])
        side -= np.minimum(low[rows, None], low[columns])
        if rules.step > 1:
            side += rules.step - 1
            side //= rules.step
            side *= rules.step
            np.minimum(side, rules.bounds[axis], out=side)
        if rules.limit < rules.bounds[axis]:
            short = side <= rules.limit
            fits = short if fits is None else fits & short
        sides.append(side)
    area = sides[0] * sides[1]
    mine, theirs = live.area[rows, None], live.area[columns]
    saving = mine + theirs
    saving -= area
    if fits is not None:
        saving *= fits | (area == np.maximum(mine, theirs))
    return saving


def _note_best(live: _Live, rows: IntArray, partner: IntArray, saving: Pixels) -> None:
    """Keep for some regions the better of the partner known and a new one."""
    better = saving > live.saving[rows]
    chosen = rows[better]
    live.partner[chosen] = partner[better]
    live.saving[chosen] = saving[better]


def _couple(live: _Live) -> IntArray:
    """Let regions join; give for each the one that stands for all it has joined, (N,)."""
    root = list(range(len(live.area)))
    willing = np.flatnonzero(live.partner != _NOBODY)
    willing = willing[np.argsort(-live.saving[willing], kind='stable')]
    # Nothing saves more than its own pixels, and those only within another region.
    within = (live.saving == live.area).tolist()
    # Whatever lies within another goes there, and is no partner for a third.
    taken = within.copy()
    for one, other in zip(willing.tolist(), live.partner[willing].tolist(), strict=True):
        if not within[one]:
            if taken[one] or taken[other]:
                continue
            taken[one] = taken[other] = True
        one_root, other_root = _root(root, one), _root(root, other)
        root[max(one_root, other_root)] = min(one_root, other_root)
    roots = np.array(root, np.intp)
    while (roots[roots] != roots).any():
        roots = roots[roots]
    return roots


def _root(root: list[int], each: int) -> int:
    """Follow who joined whom to the end, and shorten the way there."""
    while root[each] != each:
        root[each] = root[root[each]]
        each = root[each]
    return each


def _unite(live: _Live, root: IntArray, rules: MergeRules) -> tuple[_Live, IntArray]:
    """Make the regions of the next round; also tell where each of this one's went, (N,)."""
    order = np.argsort(root, kind='stable')
    starts = np.flatnonzero(np.diff(root[order], prepend=-1))
    changed = np.diff(starts, append=len(root)) > 1
    low = np.minimum.reduceat(live.corners[:2, order], starts, axis=1)
    high = np.maximum.reduceat(live.corners[2:, order], starts, axis=1)
    low[:, changed], high[:, changed] = rules.fit(low[:, changed], high[:, changed])
    corners = np.concatenate((low, high))
    sorting = _in_order(corners)
    place = np.empty(len(root), np.intp)
    place[order] = np.repeat(np.argsort(sorting), np.diff(starts, append=len(root)))
    heirs = order[starts][sorting]
    united = _Live(corners[:, sorting])
    lost = changed[sorting]
    known = live.partner[heirs]
    # A partner that has changed may have become better or worse.
    moved = (known != _NOBODY) & lost[place[known]]
    united.stale = lost | moved
    keep = ~united.stale & (known != _NOBODY)
    united.partner[keep] = place[known[keep]]
    united.saving[keep] = live.saving[heirs][keep]
    return united, place
