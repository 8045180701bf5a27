# SPDX-License-Identifier: Apache-2.0
"""Pair boxes with objects, once the motion of the image is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.tracking.sightings import Places
from obbhbb_ros.tracking.sightings import Rows
from obbhbb_ros.tracking.sightings import are_inside
from obbhbb_ros.tracking.sightings import axis_turn
from obbhbb_ros.tracking.sightings import depth

Indices = NDArray[np.intp]

GATE = 4.0
"""A box may be an object within this many standard deviations."""
LOOSE = 3.0
"""Factor on the gate if a box and an object have nothing else within twice that distance."""

# How much two views of one ship may differ: the logarithm of the ratio of their lengths, and the
# angle between their axes. Four standard deviations of a detector with 5 % and 3 degrees.
_LIKE_LENGTH = 0.2
_LIKE_ANGLE = 0.21
# Error of the length of a ship, as a fraction. The middle of a ship at the border is as wrong.
_LENGTH_ERROR = 0.05
# Twice a logarithm of likelihood: an object seen only once may be a false alarm.
_SEEN_ONCE = 2.0
# The search ignores objects further outside the image than this, as a fraction of its sides.
_MARGIN = 0.2
# The search ends at this distance, ship lengths.
_FARTHEST = 8.0
_MAX_PAIRS = 200_000


class Pairs(NamedTuple):
    """
    Boxes and the objects that they show.

    Attributes
    ----------
    boxes, objects : ndarray of int, shape (M,)
        Their rows.
    off : ndarray of complex, shape (M,)
        Distance of the boxes from where the objects were expected, pixels.
    """

    boxes: Indices
    objects: Indices
    off: Places


class _Candidates(NamedTuple):
    """Pairs of box and object that may be one ship; (K,). `spread` is a variance, px²."""

    boxes: Indices
    objects: Indices
    off: Places
    spread: FloatArray
    cost: FloatArray

    def chosen(self, rows: NDArray[np.bool_]) -> _Candidates:
        """Return some of the pairs."""
        return _Candidates(
            self.boxes[rows], self.objects[rows], self.off[rows], self.spread[rows], self.cost[rows]
        )

    def are_alone(self) -> NDArray[np.bool_]:
        """Tell which boxes and objects have only each other."""
        box_counts, object_counts = np.bincount(self.boxes), np.bincount(self.objects)
        alone: NDArray[np.bool_] = (box_counts[self.boxes] == 1) & (
            object_counts[self.objects] == 1
        )
        return alone

    def within(self, deviations: float) -> NDArray[np.bool_]:
        """Tell which boxes are within so many standard deviations of their object."""
        near: NDArray[np.bool_] = np.abs(self.off) < deviations * np.sqrt(self.spread)
        return near


def assigned(objects: Rows, boxes: Rows, size: complex, loose: float = 1.0) -> Pairs:
    """
    Pair boxes with objects within their gates, the likeliest first.

    Parameters
    ----------
    objects, boxes : ndarray
        Rows of objects, moved to where the image is now, and of the boxes in it.
    size : complex
        Width and height of the image, pixels.
    loose : float
        A box and an object with nothing else within this many gates may pair within half as many.

    Returns
    -------
    Pairs
        Each box and each object is in at most one pair.
    """
    rows = np.flatnonzero(are_inside(objects['place'], size, _MARGIN))
    known = objects[rows]
    pairs = _candidates(known, boxes, size, loose * GATE)
    alone = pairs.are_alone() & pairs.within(loose / 2 * GATE)
    like, cost = _likeness(known[pairs.objects], boxes[pairs.boxes])
    tight = pairs.within(GATE)
    pairs = pairs._replace(cost=np.abs(pairs.off) ** 2 / pairs.spread + cost)
    pairs = pairs._replace(cost=pairs.cost + 2 * np.log(pairs.spread))
    near = np.flatnonzero(tight & like)
    best = near[one_to_one(pairs.boxes[near], pairs.objects[near], pairs.cost[near])]
    chosen = np.concatenate((best, np.flatnonzero(alone & like & ~tight)))
    return Pairs(pairs.boxes[chosen], rows[pairs.objects[chosen]], pairs.off[chosen])


def anchors(known: Rows, boxes: Rows) -> Places:
    """
    Return the end at which to compare boxes and objects; 0 to compare their middles.

    If the border cuts a ship, this is the end that is in the image.
    """
    inner: Places = np.where(boxes['whole'], known['inner'], boxes['inner'])
    return inner


def anchored_variance(known: Rows, boxes: Rows, inner: Places) -> FloatArray:
    """Return the variance of the distance between boxes and their objects, px²."""
    length = np.maximum(known['length'], boxes['length'])
    of_length = np.where(inner != 0, _LENGTH_ERROR * length, 0.0)
    variance: FloatArray = known['place_var'] + boxes['place_var'] + of_length**2
    return variance


def _candidates(known: Rows, boxes: Rows, size: complex, deviations: float) -> _Candidates:
    """List pairs of box and object that are within so many standard deviations."""
    i, j = _in_reach(known, boxes, deviations)
    box, one = boxes[i], known[j]
    inner = anchors(one, box)
    off = box['place'] - one['place'] + inner * (box['length'] - one['length']) / 2
    pairs = _Candidates(i, j, off, anchored_variance(one, box, inner), np.zeros(len(i)))
    keep, by_end = pairs.within(deviations), inner != 0
    cut = by_end | ~box['whole']
    if cut.any():
        # A ship that enters is not one that was last seen elsewhere, or that left on its own.
        length = np.maximum(box['length'], one['length'])
        end = one['place'] + inner * one['length'] / 2
        keep &= ~cut | ((np.abs(off) < length) & (~by_end | (depth(end, size) > 0)))
    return pairs.chosen(keep)


def _in_reach(known: Rows, boxes: Rows, deviations: float) -> tuple[Indices, Indices]:
    """List pairs of box and object that may be near enough along x, and along y."""
    lists: list[tuple[Indices, Indices]] = []
    # Boxes at the border form a group of their own: they reach further.
    for is_whole in (True, False):
        group = np.flatnonzero(boxes['whole'] == is_whole)
        group = group[np.argsort(boxes['place'][group].real, kind='stable')]
        x = boxes['place'][group].real
        widest = boxes['place_var'][group].max(initial=0.0)
        by_end = ~known['whole'] if is_whole else np.ones(len(known), np.bool_)
        length = known['length'] * by_end
        reach = deviations * np.sqrt(known['place_var'] + widest + (_LENGTH_ERROR * length) ** 2)
        # Wide gates would pair every box with every object.
        farthest = _FARTHEST * known['length']
        if not is_whole:
            farthest = np.maximum(known['length'], boxes['length'][group].max(initial=0.0))
        reach = np.minimum(reach, farthest) + 0.75 * length
        first, last = (np.searchsorted(x, known['place'].real + side * reach) for side in (-1, 1))
        j, i = index_pairs(first, last, _MAX_PAIRS)
        i = group[i]
        near = np.abs(boxes['place'].imag[i] - known['place'].imag[j]) < reach[j]
        lists.append((i[near], j[near]))
    boxes_of, objects_of = zip(*lists, strict=True)
    return np.concatenate(boxes_of), np.concatenate(objects_of)


def _likeness(known: Rows, boxes: Rows) -> tuple[NDArray[np.bool_], FloatArray]:
    """Tell which pairs may be one ship by their shape, and give twice their -log likelihood."""
    longer = np.log(boxes['length'] / known['length']) / _LIKE_LENGTH
    turned = axis_turn(boxes['angle'] - known['angle']) / _LIKE_ANGLE
    whole = known['whole'] & boxes['whole']
    # The visible part of a ship at the border is not longer than the ship, and grows as it enters.
    like: NDArray[np.bool_] = (
        (np.abs(turned) < np.where(whole, 2.0, 1.2))
        & (longer < np.where(known['whole'], 2.0, 3.0))
        & ((longer > -2.0) | ~whole)
    )
    cost: FloatArray = 8 * turned**2 + np.where(whole, 8 * longer**2, 0.0)
    return like, cost + _SEEN_ONCE * (known['hits'] < 2)


def alike(old: Rows, new: Rows) -> tuple[Indices, Indices]:
    """List the pairs of old and new rows that may be one ship by their shape."""
    order = np.argsort(old['length'], kind='stable')
    lengths = old['length'][order]
    first, last = (
        np.searchsorted(lengths, new['length'] * math.exp(edge))
        for edge in (-_LIKE_LENGTH, _LIKE_LENGTH)
    )
    j, i = index_pairs(first, last, _MAX_PAIRS)
    i = order[i]
    keep = np.abs(axis_turn(new['angle'][j] - old['angle'][i])) < _LIKE_ANGLE
    return i[keep], j[keep]


def index_pairs(first: Indices, last: Indices, max_pairs: int) -> tuple[Indices, Indices]:
    """
    List the pairs (i, j) with first[i] <= j < last[i].

    If there are too many, list those in the middle of the ranges, the same number for every i.

    Examples
    --------
    >>> index_pairs(np.array([0, 4]), np.array([2, 5]), 10)
    (array([0, 0, 1]), array([0, 1, 4]))
    """
    counts = np.maximum(last - first, 0)
    if counts.sum() > max_pairs:
        kept = np.minimum(counts, max(max_pairs // len(counts), 1))
        first, counts = first + (counts - kept) // 2, kept
    i = np.repeat(np.arange(len(first)), counts)
    return i, np.arange(len(i)) - np.repeat(counts.cumsum() - counts, counts) + first[i]


def one_to_one(i: Sequence[int] | Indices, j: Sequence[int] | Indices, cost: FloatArray) -> Indices:
    """
    Choose pairs (i, j), the cheapest first, so that no i and no j is in two of them.

    Examples
    --------
    >>> one_to_one([0, 0, 1], [5, 6, 5], np.array([2.0, 3.0, 1.0])).tolist()
    [2, 1]
    """
    order = np.argsort(cost, kind='stable')
    firsts, seconds = np.asarray(i)[order].tolist(), np.asarray(j)[order].tolist()
    used: tuple[set[int], set[int]] = (set(), set())
    chosen = []
    for row, first, second in zip(order.tolist(), firsts, seconds, strict=True):
        if first not in used[0] and second not in used[1]:
            used[0].add(first)
            used[1].add(second)
            chosen.append(row)
    return np.array(chosen, np.intp)
