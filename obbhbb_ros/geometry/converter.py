# SPDX-License-Identifier: Apache-2.0
"""Conversion of oriented boxes to axis-aligned boxes by a rule, with caps and diagnostics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.boxes import blocks
from obbhbb_ros.geometry.boxes import longer_first
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.geometry.methods import get_method
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import require_number
from obbhbb_ros.limits import setting

__all__ = [
    'NO_CAPS',
    'PAPER_RULE',
    'Caps',
    'Conversion',
    'HullRule',
    'centers_and_extents',
    'convert',
    'convert_by_rule',
    'convert_with_diagnostics',
    'half_extents',
    'to_xyxy',
]

Q_RANGE = Range(1.0, math.inf)
F_RANGE = S_RANGE = Range(0.0, 2.0, above=True)


@dataclass(frozen=True)
class HullRule(CheckedSettings):
    """
    A conversion rule with its shape parameters.

    With a known bow, `f` and `s` scale the hull on each side of the oriented box's centre, and
    `q_bow` and `q_stern`, if they are not None, replace `q` at the two ends. Only `superellipse`
    uses these; the other methods ignore the bow.

    Raises
    ------
    ValueError
        If a value is out of range or there is no such method.
    TypeError
        If a value is no number.

    Examples
    --------
    >>> HullRule('superellipse', q=0.5)
    Traceback (most recent call last):
        ...
    ValueError: q must be 1 to inf, not 0.5
    """

    method: str = setting('superellipse', 'A key of `obbhbb_ros.geometry.methods.METHODS`.')
    q: float = setting(
        3.0,
        'Shape exponent of the hull: 1 is a rhombus, 2 an ellipse, infinity (.inf) a rectangle.',
        Q_RANGE,
    )
    f: float = setting(1.0, 'Fullness: factor on the half-width of the hull.', F_RANGE)
    s: float = setting(1.0, 'Shrink factor on the half-extents of the box.', S_RANGE)
    q_bow: float | None = setting(None, 'Shape exponent of the bow end of the hull.', Q_RANGE)
    q_stern: float | None = setting(None, 'Shape exponent of the stern end of the hull.', Q_RANGE)

    def __post_init__(self) -> None:
        """Check every value."""
        get_method(self.method)
        super().__post_init__()

    @property
    def ends(self) -> tuple[float, float]:
        """Shape exponents at the bow and at the stern."""
        q_bow, q_stern = self.q_bow, self.q_stern
        return self.q if q_bow is None else q_bow, self.q if q_stern is None else q_stern

    @property
    def uses_bow(self) -> bool:
        """Whether a known bow changes the box."""
        if self.q_bow is None and self.q_stern is None:
            return False
        return METHODS[self.method].two_ended and self.ends != (self.q, self.q)


PAPER_RULE = HullRule('shape_aware', q=2.2, f=0.9, s=1.0)
"""The published rule with the paper's best-found parameters, "Best mixing parameters"."""


@dataclass(frozen=True)
class Caps:
    """
    The largest plausible ship, `L_max` and `W_max` of Algorithm 1.

    Attributes
    ----------
    max_length, max_width : float or None
        Upper bounds of the longer and the shorter extent of the axis-aligned box, pixels; None
        for no bound. A box that is too large keeps its centre.

    Raises
    ------
    ValueError
        If a bound is not positive.
    TypeError
        If a bound is no number.
    """

    max_length: float | None = None
    max_width: float | None = None

    def __post_init__(self) -> None:
        """Check both bounds."""
        for name, value in vars(self).items():
            if value is not None and not require_number(name, value) > 0.0:
                raise ValueError(f'{name} must be positive or None, not {value}')


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
        do not touch a curve. Where `q_bow` applies, on the bow's side; otherwise both sides are
        alike.
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
    *,
    method: str = HullRule.method,
    q: float = HullRule.q,
    f: float = HullRule.f,
    s: float = HullRule.s,
    max_length: float | None = None,
    max_width: float | None = None,
    q_bow: float | None = None,
    q_stern: float | None = None,
) -> FloatArray:
    """
    Convert oriented boxes to axis-aligned boxes.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    method : str
        A key of `obbhbb_ros.METHODS`.
    q, f, s : float
        Shape exponent in [1, inf], fullness and shrink factor in (0, 2]. Checked always, but used
        only by the methods that have them, ``METHODS[method].tunable``.
    max_length, max_width : float, optional
        Upper bounds of the longer and the shorter extent of the result, pixels. A box that is too
        large keeps its centre.
    q_bow, q_stern : float, optional
        Shape exponents in [1, inf] of the two ends where ``boxes.bow``; default: q. Such a box is
        not centred on the oriented box. Used only where ``METHODS[method].two_ended``.

    Returns
    -------
    ndarray of float64, shape (N, 4)
        x_min, y_min, x_max, y_max, pixels; a row is NaN if ``boxes.valid`` is False or the result
        overflows.

    Raises
    ------
    TypeError
        If `boxes` are no `OrientedBoxes`, or a parameter is no number.
    ValueError
        If a parameter is out of range; the message names it.

    Examples
    --------
    >>> from obbhbb_ros import OrientedBoxes, convert
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> convert(boxes)
    array([[20., 30., 80., 50.]])
    >>> to_the_right = OrientedBoxes.from_xywhr([[50, 40, 60, 20, np.pi / 4]], bow=True)
    >>> convert(to_the_right, q_bow=1.0, q_stern=np.inf).round(1)
    array([[21.7, 11.7, 71.2, 61.2]])
    """
    rule = HullRule(method, q, f, s, q_bow, q_stern)
    uncapped = max_length is None and max_width is None
    return convert_by_rule(boxes, rule, NO_CAPS if uncapped else Caps(max_length, max_width))


def convert_by_rule(boxes: OrientedBoxes, rule: HullRule, caps: Caps = NO_CAPS) -> FloatArray:
    """
    Convert oriented boxes like `convert`, by a rule that is already checked.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> convert_by_rule(boxes, HullRule('outer'), Caps(max_length=50.0))
    array([[25., 30., 75., 50.]])
    """
    _require_boxes(boxes)
    if boxes.regular:
        return _all_xyxy(boxes, rule, caps)
    with np.errstate(invalid='ignore', over='ignore'):
        xyxy = _all_xyxy(boxes, rule, caps)
        if not math.isfinite(np.add.reduce(xyxy, axis=None)):
            xyxy[~np.isfinite(xyxy).all(axis=1)] = np.nan
        return xyxy


def centers_and_extents(
    boxes: OrientedBoxes,
    rules: Sequence[HullRule],
    rule_of: NDArray[np.intp] | None = None,
    caps: Caps = NO_CAPS,
) -> tuple[FloatArray, FloatArray]:
    """
    Compute axis-aligned boxes as centres and half-extents, with one rule per class.

    Parameters
    ----------
    boxes : OrientedBoxes
        N boxes.
    rules, rule_of : sequence of HullRule, ndarray of int of shape (N,), optional
        The rules, and for each box the index of its rule, by default 0.
    caps : Caps
        Bounds of the result, the same for all.

    Returns
    -------
    center : ndarray, shape (N, 2)
        x and y of the centres, pixels: those of the oriented boxes except where the bow is known
        and its rule has `q_bow` or `q_stern`. Read-only where it is ``boxes.center``.
    half_extents : ndarray, shape (N, 2)
        Half-extents along x and y, pixels; rows are NaN where the box cannot be converted.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, np.pi / 4]] * 2, bow=True)
    >>> rules = HullRule('outer'), HullRule('superellipse', q_bow=1.0, q_stern=np.inf)
    >>> center, half_extents = centers_and_extents(boxes, rules, np.array([0, 1]))
    >>> center.round(1)
    array([[50. , 40. ],
           [46.5, 36.5]])
    >>> half_extents.round(1)
    array([[28.3, 28.3],
           [24.7, 24.7]])
    """
    _require_boxes(boxes)
    if boxes.regular:
        return _all_placed(boxes, rules, rule_of, caps)
    with np.errstate(invalid='ignore', over='ignore'):
        center, extents = _all_placed(boxes, rules, rule_of, caps)
        # The full size, which messages contain, is the first to overflow.
        farthest = np.abs(center) + 2.0 * extents
        if not math.isfinite(np.add.reduce(farthest, axis=None)):
            extents[~np.isfinite(farthest).all(axis=1)] = np.nan
    return center, extents


def half_extents(
    boxes: OrientedBoxes,
    rules: Sequence[HullRule],
    rule_of: NDArray[np.intp] | None = None,
    caps: Caps = NO_CAPS,
) -> FloatArray:
    """
    Compute the half-extents of `centers_and_extents` alone, (N, 2).

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]] * 2)
    >>> rules = HullRule('outer'), HullRule('superellipse', s=0.5)
    >>> half_extents(boxes, rules, np.array([0, 1]))
    array([[30., 10.],
           [15.,  5.]])
    """
    return centers_and_extents(boxes, rules, rule_of, caps)[1]


def convert_with_diagnostics(
    boxes: OrientedBoxes, rule: HullRule, caps: Caps = NO_CAPS
) -> Conversion:
    """
    Convert oriented boxes, with the optional output of Algorithm 1: L, W, theta, t_x, t_y, capped.

    Examples
    --------
    >>> boxes = OrientedBoxes.from_xywhr([[50.0, 40.0, 60.0, 20.0, 0.0]])
    >>> conversion = convert_with_diagnostics(boxes, HullRule(), Caps(max_length=50.0))
    >>> conversion.length, conversion.t_x, conversion.capped
    (array([60.]), array([1.]), array([ True]))
    """
    xyxy = convert_by_rule(boxes, rule, caps)
    uncapped = convert_by_rule(boxes, rule)
    valid = ~np.isnan(xyxy[:, 0])
    method = METHODS[rule.method]
    along, across = np.abs(boxes.long_axis), np.abs(boxes.short_axis)
    with np.errstate(invalid='ignore', over='ignore'):
        across = across * (rule.f if method.tunable else 1.0)
        t = method.contact(along, across, rule.q)
        if rule.uses_bow:
            t = np.where(boxes.bow[:, None], method.contact(along, across, rule.ends[0]), t)
    t_x, t_y = np.where(valid, t.T, np.nan)
    capped = valid & (xyxy != uncapped).any(axis=1)
    return Conversion(xyxy, valid, boxes.length, boxes.width, boxes.theta, t_x, t_y, capped)


def to_xyxy(center: FloatArray, extents: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """
    Combine centres and half-extents, (N, 2) each, to boxes: x_min, y_min, x_max, y_max, (N, 4).

    With `out` the result is written there. Without, each coordinate is contiguous in memory.

    Examples
    --------
    >>> to_xyxy(np.array([[50.0, 40.0]]), np.array([[30.0, 10.0]]))
    array([[20., 30., 80., 50.]])
    """
    xyxy = np.empty((4, len(center))).T if out is None else out
    # Transposed, so that the inner loop runs over the boxes.
    np.subtract(center.T, extents.T, out=xyxy[:, :2].T)
    np.add(center.T, extents.T, out=xyxy[:, 2:].T)
    return xyxy


def _require_boxes(boxes: Any) -> None:
    """Raise TypeError if an argument is not `OrientedBoxes`."""
    if not isinstance(boxes, OrientedBoxes):
        raise TypeError(
            f'boxes must be OrientedBoxes, not {type(boxes).__name__}: make them with '
            'OrientedBoxes.from_xywhr, from_corners or from_polygons'
        )


def _all_xyxy(boxes: OrientedBoxes, rule: HullRule, caps: Caps) -> FloatArray:
    """Convert all boxes block by block, (N, 4)."""
    xyxy = np.empty((len(boxes), 4))
    for rows in blocks(len(boxes)):
        to_xyxy(*_placed(boxes, rule, caps, rows), out=xyxy[rows])
    return xyxy


def _all_placed(
    boxes: OrientedBoxes, rules: Sequence[HullRule], rule_of: NDArray[np.intp] | None, caps: Caps
) -> tuple[FloatArray, FloatArray]:
    """Compute centres and half-extents of all boxes, block by block or rule by rule."""
    if rule_of is None and len(boxes) <= BLOCK:
        return _placed(boxes, rules[0], caps, slice(None))
    center, extents = np.empty((2, 2, len(boxes))).transpose(0, 2, 1)
    if rule_of is None:
        for block in blocks(len(boxes)):
            center[block], extents[block] = _placed(boxes, rules[0], caps, block)
    else:
        for index in np.unique(rule_of).tolist():
            rows = np.flatnonzero(rule_of == index)
            center[rows], extents[rows] = _placed(boxes, rules[index], caps, rows)
    return center, extents


def _placed(
    boxes: OrientedBoxes, rule: HullRule, caps: Caps, rows: slice | NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Compute centres and half-extents of some rows, (n, 2) each."""
    method = METHODS[rule.method]
    f = rule.f if method.tunable else 1.0
    along, across = np.abs(boxes.first[rows]), np.abs(boxes.second[rows])
    if f != 1.0 or not method.symmetric:
        along, across = longer_first(along, across)
    if f != 1.0:
        across = across * f
    center, extents = boxes.center[rows], method.half_extents(along, across, rule.q)
    if rule.uses_bow:
        known = np.flatnonzero(boxes.bow[rows])
        shift, extents[known] = _two_ended(boxes.first[rows][known], across[known], rule)
        center = center.copy(order='K')
        center[known] += shift * rule.s
    if method.tunable and rule.s != 1.0:
        extents *= rule.s
    return center, _capped(extents, caps) if caps.max_length or caps.max_width else extents


def _two_ended(
    bow: FloatArray, across: FloatArray, rule: HullRule
) -> tuple[FloatArray, FloatArray]:
    """
    Project hulls of two half superellipses; `bow` points from the centre to the bow, (n, 2).

    The half at the bow decides how far a hull reaches on the bow's side of the centre, that at the
    stern how far on the other. Returns the shift of the centre and the half-extents, (n, 2) each.
    """
    project, along = METHODS[rule.method].half_extents, np.abs(bow)
    ahead, astern = (0.5 * project(along, across, q) for q in rule.ends)
    return np.sign(bow) * (ahead - astern), ahead + astern


def _capped(extents: FloatArray, caps: Caps) -> FloatArray:
    """Limit the longer extent to the maximum length, the shorter to the maximum width."""
    length, width = caps.max_length or np.inf, caps.max_width or np.inf
    x_is_longer = extents[:, 0] >= extents[:, 1]
    limits = np.where(x_is_longer, [[length], [width]], [[width], [length]]).T
    return np.minimum(extents, limits / 2.0)
