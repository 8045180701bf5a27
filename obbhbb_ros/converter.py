# SPDX-License-Identifier: Apache-2.0
"""Oriented boxes and a rule in, axis-aligned boxes out, with flags and diagnostics."""

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
    A conversion rule with its shape parameters.

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

    Raises
    ------
    ValueError
        If one of them is out of range; the message names it.
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
        for name, (low, high) in (('f', F_RANGE), ('s', S_RANGE)):
            value = getattr(self, name)
            if not low < value <= high:
                raise ValueError(f'{name} must be in ({low:g}, {high:g}], not {value}')


PAPER_RULE = HullRule('shape_aware', q=2.2, f=0.9, s=1.0)
"""The published rule with the paper's best-found parameters, "Best mixing parameters"."""


@dataclass(frozen=True)
class Caps:
    """
    The largest ship that is believed, `L_max` and `W_max` of Algorithm 1.

    Attributes
    ----------
    max_length, max_width : float or None
        Upper bounds of the longer and the shorter extent of the axis-aligned box, pixels; None
        where there is none.

    Raises
    ------
    ValueError
        If one of them is not positive; the message names it.
    """

    max_length: float | None = None
    max_width: float | None = None

    def __post_init__(self) -> None:
        """Check both bounds."""
        for name in ('max_length', 'max_width'):
            value = getattr(self, name)
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
        touch no curve.
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
    Convert oriented boxes to axis-aligned ones.

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
        Bounds of the longer and the shorter extent of the result, pixels.

    Returns
    -------
    ndarray of float64, shape (N, 4)
        x_min, y_min, x_max, y_max, pixels; a row is NaN where ``boxes.valid`` is False, or where
        the result overflows.

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
    Convert oriented boxes under a rule that is already checked.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    rule : HullRule
        The rule.
    caps : Caps
        Bounds of the result.

    Returns
    -------
    ndarray of float64, shape (N, 4)
        As `convert`.
    """
    if boxes.regular:
        return _all_xyxy(boxes, rule, caps)
    with np.errstate(invalid='ignore', over='ignore'):
        return _without_overflown(_all_xyxy(boxes, rule, caps))


def half_extents(
    boxes: OrientedBoxes,
    rules: Sequence[HullRule],
    rule_of: NDArray[np.intp] | None = None,
    caps: Caps = NO_CAPS,
) -> FloatArray:
    """
    Compute half-extents along x and y, each box under the rule of its class.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    rules : sequence of HullRule
        The rules in use.
    rule_of : ndarray of int, shape (N,), optional
        For each box, the index of its rule; without it the first rule is for all.
    caps : Caps
        Bounds of the result, the same for all.

    Returns
    -------
    ndarray of float64, shape (2, N)
        Half-extents, pixels; NaN columns where the box cannot be converted.
    """
    if boxes.regular:
        return _all_extents(boxes, rules, rule_of, caps)
    with np.errstate(invalid='ignore', over='ignore'):
        extents = _all_extents(boxes, rules, rule_of, caps)
        # The whole size, which messages state, is the first to overflow.
        farthest = np.abs(boxes.center) + 2.0 * extents
        if not math.isfinite(np.add.reduce(farthest, axis=None)):
            extents[:, ~np.isfinite(farthest).all(axis=0)] = np.nan
    return extents


def convert_with_diagnostics(
    boxes: OrientedBoxes, rule: HullRule, caps: Caps = NO_CAPS
) -> Conversion:
    """
    Convert oriented boxes and tell how, the optional output of Algorithm 1.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    rule : HullRule
        The rule.
    caps : Caps
        Bounds of the result.

    Returns
    -------
    Conversion
        The boxes, and L, W, theta, t_x, t_y and the cap flag of each.
    """
    xyxy = convert_by_rule(boxes, rule, caps)
    uncapped = convert_by_rule(boxes, rule)
    valid = ~np.isnan(xyxy[:, 0])
    f = rule.f if METHODS[rule.method].tunable else 1.0
    along, across = np.abs(boxes.long_axis), np.abs(boxes.short_axis) * f
    with np.errstate(invalid='ignore', over='ignore'):
        t_x, t_y = METHODS[rule.method].contact(along, across, rule.q)
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


def to_xyxy(center: FloatArray, extents: FloatArray) -> FloatArray:
    """
    Lay half-extents around centres.

    Parameters
    ----------
    center : ndarray, shape (2, N)
        Centres, pixels.
    extents : ndarray, shape (2, N)
        Half-extents as `half_extents` gives them, pixels.

    Returns
    -------
    ndarray of float64, shape (N, 4)
        x_min, y_min, x_max, y_max; NaN rows where the extents are NaN. In memory, each coordinate
        of all boxes comes after another.
    """
    corners = np.empty((4, center.shape[1]))
    np.subtract(center, extents, out=corners[:2])
    np.add(center, extents, out=corners[2:])
    return corners.T


def _all_xyxy(boxes: OrientedBoxes, rule: HullRule, caps: Caps) -> FloatArray:
    """Convert all boxes, (N, 4)."""
    xyxy = np.empty((len(boxes), 4))
    for rows in blocks(len(boxes)):
        extents = _block_extents(boxes, rule, caps, rows)
        _lay_around(boxes.center[:, rows], extents, xyxy[rows])
    return xyxy


def _all_extents(
    boxes: OrientedBoxes,
    rules: Sequence[HullRule],
    rule_of: NDArray[np.intp] | None,
    caps: Caps,
) -> FloatArray:
    """Compute the half-extents of all boxes, (2, N)."""
    if rule_of is None and len(boxes) <= BLOCK:
        return _block_extents(boxes, rules[0], caps, slice(None))
    extents = np.empty((2, len(boxes)))
    if rule_of is None:
        for rows in blocks(len(boxes)):
            extents[:, rows] = _block_extents(boxes, rules[0], caps, rows)
        return extents
    for index in np.unique(rule_of).tolist():
        mine = np.flatnonzero(rule_of == index)
        extents[:, mine] = _block_extents(boxes.take(mine), rules[index], caps, slice(None))
    return extents


def _block_extents(
    boxes: OrientedBoxes, rule: HullRule, caps: Caps, rows: slice
) -> FloatArray:
    """Compute the half-extents of some rows, (2, n)."""
    method = METHODS[rule.method]
    along, across = _reaches(boxes, rule, rows)
    extents = method.half_extents(along, across, rule.q)
    if method.tunable and rule.s != 1.0:
        extents *= rule.s
    return _capped(extents, caps) if caps.given else extents


def _reaches(
    boxes: OrientedBoxes, rule: HullRule, rows: slice
) -> tuple[FloatArray, FloatArray]:
    """Project the hull's half axes, the half-width scaled by the fullness."""
    method = METHODS[rule.method]
    f = rule.f if method.tunable else 1.0
    along, across = np.abs(boxes.first[:, rows]), np.abs(boxes.second[:, rows])
    if method.symmetric and f == 1.0:
        return along, across
    along, across = longer_first(along, across)
    return along, (across if f == 1.0 else across * f)


def _capped(extents: FloatArray, caps: Caps) -> FloatArray:
    """Bound the longer half-extent by half the length, the other by half the width."""
    longer = np.inf if caps.max_length is None else caps.max_length / 2.0
    shorter = np.inf if caps.max_width is None else caps.max_width / 2.0
    lies_on_x = extents[0] >= extents[1]
    limits = np.stack(
        (np.where(lies_on_x, longer, shorter), np.where(lies_on_x, shorter, longer))
    )
    return np.minimum(extents, limits)


def _lay_around(center: FloatArray, extents: FloatArray, xyxy: FloatArray) -> None:
    """Write the boxes of half-extents around centres to `xyxy`, (n, 4)."""
    np.subtract(center, extents, out=xyxy[:, :2].T)
    np.add(center, extents, out=xyxy[:, 2:].T)


def _without_overflown(xyxy: FloatArray) -> FloatArray:
    """Make the rows that are not finite NaN."""
    if not math.isfinite(np.add.reduce(xyxy, axis=None)):
        xyxy[~np.isfinite(xyxy).all(axis=1)] = np.nan
    return xyxy
