# SPDX-License-Identifier: Apache-2.0
"""Conversion of oriented boxes to axis-aligned boxes by a rule, with caps and diagnostics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import BLOCK
from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.boxes import blocks
from obbhbb_ros.boxes import longer_first
from obbhbb_ros.methods import METHODS
from obbhbb_ros.methods import get_method

Q_RANGE = (1.0, math.inf)
# The lower ends are excluded.
F_RANGE = S_RANGE = (0.0, 2.0)


@dataclass(frozen=True)
class HullRule:
    """
    A conversion rule with its shape parameters; a value out of range raises ValueError.

    Attributes
    ----------
    method : str
        A key of `obbhbb_ros.methods.METHODS`.
    q : float
        Shape exponent in [1, inf].
    f : float
        Fullness in (0, 2]: scales the half-width.
    s : float
        Shrink factor in (0, 2]: scales the half-extents.

    Examples
    --------
    >>> HullRule('superellipse', q=0.5)
    Traceback (most recent call last):
        ...
    ValueError: q must be in [1, inf], not 0.5
    """

    method: str = 'superellipse'
    q: float = 3.0
    f: float = 1.0
    s: float = 1.0

    def __post_init__(self) -> None:
        """Check every value."""
        get_method(self.method)
        if not Q_RANGE[0] <= self.q <= Q_RANGE[1]:
            raise ValueError(f'q must be in [{Q_RANGE[0]:g}, {Q_RANGE[1]:g}], not {self.q}')
        for name, value, (low, high) in (('f', self.f, F_RANGE), ('s', self.s, S_RANGE)):
            if not low < value <= high:
                raise ValueError(f'{name} must be in ({low:g}, {high:g}], not {value}')


PAPER_RULE = HullRule('shape_aware', q=2.2, f=0.9, s=1.0)
"""The published rule with the paper's best-found parameters, "Best mixing parameters"."""


@dataclass(frozen=True)
class Caps:
    """
    The largest plausible ship, `L_max` and `W_max` of Algorithm 1; ValueError if not positive.

    Attributes
    ----------
    max_length, max_width : float or None
        Upper bounds of the longer and the shorter extent of the axis-aligned box, pixels; None
        for no bound.
    """

    max_length: float | None = None
    max_width: float | None = None

    def __post_init__(self) -> None:
        """Check both bounds."""
        for name, value in vars(self).items():
            if value is not None and not value > 0.0:
                raise ValueError(f'{name} must be positive or None, not {value}')

    @property
    def given(self) -> bool:
        """Whether there is any bound."""
        return self.max_length is not None or self.max_width is not None


NO_CAPS = Caps()


@dataclass(frozen=True, eq=False)
class Conversion:
    """
    Axis-aligned boxes with the diagnostics of Algorithm 1.

    Attributes
    ----------
    xyxy : ndarray, shape (N, 4)
        x_min, y_min, x_max, y_max, pixels; NaN rows where the input could not be converted.
    valid : ndarray of bool, shape (N,)
        Which rows are boxes.
    length, width : ndarray, shape (N,)
        Sides of the oriented box, pixels.
    theta : ndarray, shape (N,)
        Angle of its long axis from image +x, radians in [-pi/2, pi/2).
    t_x, t_y : ndarray, shape (N,)
        Where along the hull the box touches it, 0 amidships to 1 at the bow; NaN for rules that
        do not touch a curve.
    capped : ndarray of bool, shape (N,)
        Whether a bound changed the box.
    """

    xyxy: FloatArray
    valid: NDArray[np.bool_]
    length: FloatArray
    width: FloatArray
    theta: FloatArray
    t_x: FloatArray
    t_y: FloatArray
    capped: NDArray[np.bool_]


def convert(
    boxes: OrientedBoxes,
    method: str = HullRule.method,
    q: float = HullRule.q,
    f: float = HullRule.f,
    s: float = HullRule.s,
    max_length: float | None = None,
    max_width: float | None = None,
) -> FloatArray:
    """
    Convert oriented boxes to axis-aligned boxes.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    method : str
        A key of `obbhbb_ros.methods.METHODS`.
    q, f, s : float
        Shape exponent in [1, inf], fullness and shrink factor in (0, 2]; used by the tunable
        methods only.
    max_length, max_width : float, optional
        Upper bounds of the longer and the shorter extent of the result, pixels.

    Returns
    -------
    ndarray of float64, shape (N, 4)
        x_min, y_min, x_max, y_max, pixels; a row is NaN if ``boxes.valid`` is False or the result
        overflows.

    Raises
    ------
    ValueError
        If a parameter is out of range; the message names it.

    Examples
    --------
    >>> from obbhbb_ros import OrientedBoxes, convert
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> convert(boxes)
    array([[20., 30., 80., 50.]])
    """
    uncapped = max_length is None and max_width is None
    caps = NO_CAPS if uncapped else Caps(max_length, max_width)
    return convert_by_rule(boxes, HullRule(method, q, f, s), caps)


def convert_by_rule(boxes: OrientedBoxes, rule: HullRule, caps: Caps = NO_CAPS) -> FloatArray:
    """
    Convert oriented boxes like `convert`, by a rule that is already checked.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> convert_by_rule(boxes, HullRule('outer'), Caps(max_length=50.0))
    array([[25., 30., 75., 50.]])
    """
    if boxes.regular:
        return _all_xyxy(boxes, rule, caps)
    with np.errstate(invalid='ignore', over='ignore'):
        xyxy = _all_xyxy(boxes, rule, caps)
        if not math.isfinite(np.add.reduce(xyxy, axis=None)):
            xyxy[~np.isfinite(xyxy).all(axis=1)] = np.nan
        return xyxy


def half_extents(
    boxes: OrientedBoxes,
    rules: Sequence[HullRule],
    rule_of: NDArray[np.intp] | None = None,
    caps: Caps = NO_CAPS,
) -> FloatArray:
    """
    Compute half-extents along x and y, (2, N), with one rule per class.

    Columns are NaN where the box cannot be converted.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    rules, rule_of : sequence of HullRule, ndarray of int of shape (N,), optional
        The rules, and for each box the index of its rule, by default 0.
    caps : Caps
        Bounds of the result, the same for all.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]] * 2)
    >>> rules = HullRule('outer'), HullRule('superellipse', s=0.5)
    >>> half_extents(boxes, rules, np.array([0, 1])).T
    array([[30., 10.],
           [15.,  5.]])
    """
    if boxes.regular:
        return _all_extents(boxes, rules, rule_of, caps)
    with np.errstate(invalid='ignore', over='ignore'):
        extents = _all_extents(boxes, rules, rule_of, caps)
        # The full size, which messages contain, is the first to overflow.
        farthest = np.abs(boxes.center) + 2.0 * extents
        if not math.isfinite(np.add.reduce(farthest, axis=None)):
            extents[:, ~np.isfinite(farthest).all(axis=0)] = np.nan
    return extents


def convert_with_diagnostics(
    boxes: OrientedBoxes, rule: HullRule, caps: Caps = NO_CAPS
) -> Conversion:
    """
    Convert oriented boxes, with the optional output of Algorithm 1: L, W, theta, t_x, t_y, capped.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> found = convert_with_diagnostics(boxes, HullRule(), Caps(max_length=50.0))
    >>> found.length, found.t_x, found.capped
    (array([60.]), array([1.]), array([ True]))
    """
    xyxy = convert_by_rule(boxes, rule, caps)
    uncapped = convert_by_rule(boxes, rule)
    valid = ~np.isnan(xyxy[:, 0])
    method = METHODS[rule.method]
    along, across = np.abs(boxes.long_axis), np.abs(boxes.short_axis)
    with np.errstate(invalid='ignore', over='ignore'):
        t_x, t_y = method.contact(along, across * (rule.f if method.tunable else 1.0), rule.q)
    return Conversion(
        xyxy=xyxy,
        valid=valid,
        length=boxes.length,
        width=boxes.width,
        theta=boxes.theta,
        t_x=np.where(valid, t_x, np.nan),
        t_y=np.where(valid, t_y, np.nan),
        capped=valid & (xyxy != uncapped).any(axis=1),
    )


def to_xyxy(center: FloatArray, extents: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """
    Combine centres and half-extents, (2, N) each, to boxes: x_min, y_min, x_max, y_max, (N, 4).

    The result is written to `out` if given; if not, each coordinate is contiguous in memory.

    Examples
    --------
    >>> to_xyxy(np.array([[50.0], [40.0]]), np.array([[30.0], [10.0]]))
    array([[20., 30., 80., 50.]])
    """
    xyxy = np.empty((4, center.shape[1])).T if out is None else out
    np.subtract(center, extents, out=xyxy[:, :2].T)
    np.add(center, extents, out=xyxy[:, 2:].T)
    return xyxy


def _all_xyxy(boxes: OrientedBoxes, rule: HullRule, caps: Caps) -> FloatArray:
    """Convert all boxes block by block, (N, 4)."""
    xyxy = np.empty((len(boxes), 4))
    for rows in blocks(len(boxes)):
        to_xyxy(boxes.center[:, rows], _extents(boxes, rule, caps, rows), out=xyxy[rows])
    return xyxy


def _all_extents(
    boxes: OrientedBoxes,
    rules: Sequence[HullRule],
    rule_of: NDArray[np.intp] | None,
    caps: Caps,
) -> FloatArray:
    """Compute the half-extents of all boxes, block by block or rule by rule, (2, N)."""
    if rule_of is None and len(boxes) <= BLOCK:
        return _extents(boxes, rules[0], caps, slice(None))
    extents = np.empty((2, len(boxes)))
    if rule_of is None:
        for rows in blocks(len(boxes)):
            extents[:, rows] = _extents(boxes, rules[0], caps, rows)
    else:
        for index in np.unique(rule_of).tolist():
            mine = np.flatnonzero(rule_of == index)
            extents[:, mine] = _extents(boxes, rules[index], caps, mine)
    return extents


def _extents(
    boxes: OrientedBoxes, rule: HullRule, caps: Caps, rows: slice | NDArray[np.intp]
) -> FloatArray:
    """Compute the half-extents of some rows, (2, n)."""
    method = METHODS[rule.method]
    f = rule.f if method.tunable else 1.0
    along, across = np.abs(boxes.first[:, rows]), np.abs(boxes.second[:, rows])
    if f != 1.0 or not method.symmetric:
        along, across = longer_first(along, across)
    if f != 1.0:
        across = across * f
    extents = method.half_extents(along, across, rule.q)
    if method.tunable and rule.s != 1.0:
        extents *= rule.s
    return _capped(extents, caps) if caps.given else extents


def _capped(extents: FloatArray, caps: Caps) -> FloatArray:
    """Limit the longer extent to the maximum length, the shorter to the maximum width."""
    length, width = caps.max_length or np.inf, caps.max_width or np.inf
    x_is_longer = extents[0] >= extents[1]
    limits = np.where(x_is_longer, [[length], [width]], [[width], [length]])
    return np.minimum(extents, limits / 2.0)
