# SPDX-License-Identifier: Apache-2.0
"""
The conversion rules: half-extents of a hull along the image axes.

Each rule is a pure function of two numbers per image axis, the projections of half the hull's
length and of half its width on that axis::

                 image x        image y
    along     a * |cos θ|     a * |sin θ|      a = L / 2, half the length
    across    b * |sin θ|     b * |cos θ|      b = f * W / 2, half the width times fullness

with θ the angle of the long axis from image +x. They are the absolute components of half the long
and half the short edge of the oriented box, so no angle is computed. The functions take them as
arrays of shape (N, 2), pixels, not negative, with the shape exponent q in [1, inf], and return the
half-extents of the axis-aligned box, shape (N, 2), pixels. All are homogeneous of degree one: a
shrink factor or a ground sample distance can be applied before or after.

Where the bow is known, `superellipse` is called once for each end with an exponent of its own. All
other rules ignore the bow.

Equation, table and algorithm numbers are those of the paper, "Shape-Aware Oriented Bounding Box
(OBB) to Horizontal Bounding Box (HBB) Conversion".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['METHODS', 'ONBOARD_METHODS', 'Method', 'get_method']

Rule: TypeAlias = Callable[[FloatArray, FloatArray, float], FloatArray]

# Prevents 0 / 0 if a hull has no extent at all.
_TINY = float(np.finfo(np.float64).tiny)
# From here on the rule equals that of the rectangle in double precision, and products might
# overflow.
_EFFECTIVELY_INFINITE = 1e100


def superellipse(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """
    Project the superellipse hull of Eq. 1 exactly.

    The support function of ``|x/a|^q + |y/b|^q = 1`` is the dual norm
    ``(along^p + across^p)^(1/p)`` with ``1/p + 1/q = 1``.

    Parameters
    ----------
    along, across : ndarray, shape (N, 2)
        Projections of the half-length and of the half-width on x and y, pixels, not negative.
    q : float
        Shape exponent in [1, inf]: 1 is a rhombus, 2 an ellipse, infinity the rectangle.

    Returns
    -------
    ndarray, shape (N, 2)
        Half-extents along x and y, pixels.

    Examples
    --------
    >>> along, across = np.array([[4.0, 0.0]]), np.array([[3.0, 10.0]])
    >>> superellipse(along, across, q=2.0)
    array([[ 5., 10.]])
    >>> superellipse(along, across, q=np.inf)
    array([[ 7., 10.]])
    """
    if q == 1.0:
        return np.maximum(along, across)
    if q == 2.0:
        return gaussian(along, across)
    p = q / (q - 1.0) if q < np.inf else 1.0
    if p == 1.0:
        return along + across
    # The larger term is factored out, so that no power overflows for any p.
    larger = np.maximum(along, across)
    ratio = np.minimum(along, across)
    ratio /= larger + _TINY
    ratio **= p
    ratio += 1.0
    ratio **= 1.0 / p
    ratio *= larger
    return ratio


def shape_aware(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """
    Apply the published rule (Algorithm 1) in closed form; parameters as for `superellipse`.

    Its curve ``y = b (1 - |x/a|^q)`` lies inside the superellipse, so its half-extents are up to
    15 % smaller; where ``along >= q * across`` the width has no effect.

    Examples
    --------
    >>> shape_aware(np.array([[4.0, 30.0]]), np.array([[4.0, 10.0]]), q=2.0)
    array([[ 5., 30.]])
    """
    if q == 1.0:
        return np.maximum(along, across)
    if not q < _EFFECTIVELY_INFINITE:
        return along + across
    # At the optimum q*b*t^(q-1) = a, hence b*t^q = a*t/q. At t = 1 the bow touches, where y = 0.
    limit = q * across
    t = np.minimum(along, limit)
    t /= np.maximum(limit, _TINY)
    t **= 1.0 / (q - 1.0)
    t *= along
    t *= 1.0 - 1.0 / q
    t += across
    return np.where(along < limit, t, along)


def outer(along: FloatArray, across: FloatArray, q: float = np.inf) -> FloatArray:
    """Enclose the four corners, ``along + across``; `q` is ignored."""
    return along + across


def midpoint(along: FloatArray, across: FloatArray, q: float = 1.0) -> FloatArray:
    """Enclose the four edge midpoints, ``max(along, across)`` (Table 1, "M"); `q` is ignored."""
    return np.maximum(along, across)


def gaussian(along: FloatArray, across: FloatArray, q: float = 2.0) -> FloatArray:
    """Marginalise the box's Gaussian on each axis: the ellipse's extent; `q` is ignored."""
    # A third of the time of np.hypot, which also handles squares that overflow.
    return np.sqrt(along * along + across * across)


def area_equivalent(along: FloatArray, across: FloatArray, q: float = np.inf) -> FloatArray:
    """Scale the outer box about its centre to the area L * W; `q` is ignored."""
    extent = along + across
    # along_x * across_y + along_y * across_x = a * b, a quarter of the oriented box's area.
    area = along[:, 0] * across[:, 1] + along[:, 1] * across[:, 0]
    outer_area = extent[:, 0] * extent[:, 1]
    return extent * np.sqrt(area / np.maximum(outer_area, _TINY))[:, None]


def gaussian_published(along: FloatArray, across: FloatArray, q: float = 2.0) -> FloatArray:
    """Reproduce the paper's Gaussian baseline, which swaps x and y; `q` is ignored."""
    return gaussian(along, across)[:, ::-1]


def area_equivalent_published(
    along: FloatArray, across: FloatArray, q: float = np.inf
) -> FloatArray:
    """Reproduce the paper's area baseline, which always puts L on x; `q` is ignored."""
    return np.stack((np.hypot(*along.T), np.hypot(*across.T))).T


def shape_aware_contact(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """Compute t_x and t_y of Algorithm 1 (Eqs. 7 and 8), 0 amidships to 1 at bow or stern."""
    if q == 1.0:
        return np.where(along >= across, 1.0, 0.0)
    if not q < _EFFECTIVELY_INFINITE:
        return np.where(along > 0.0, 1.0, 0.0)
    limit = q * across
    ratio = np.minimum(along, limit) / np.maximum(limit, _TINY)
    return np.where(along >= limit, 1.0, ratio ** (1.0 / (q - 1.0)))


def superellipse_contact(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """
    Compute where along the hull the box touches the superellipse, 0 amidships to 1 at the bow.

    This is the derivative of the half-extent with respect to `along`, comparable to the t_x and
    t_y of Algorithm 1.
    """
    if q == 1.0 or not np.isfinite(q):
        return shape_aware_contact(along, across, q)
    extent = np.maximum(superellipse(along, across, q), _TINY)
    return (along / extent) ** (1.0 / (q - 1.0))


def _contact_at(q: float) -> Rule:
    """Return the superellipse contact with a fixed exponent."""
    return lambda along, across, _: superellipse_contact(along, across, q)


def _no_contact(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """Return NaN, for rules that do not touch a curve."""
    return np.full_like(along, np.nan)


@dataclass(frozen=True)
class Method:
    """
    A conversion rule and its properties.

    Attributes
    ----------
    name : str
        Name in parameters, tables and plots.
    half_extents : callable
        ``(along, across, q) -> half_extents``, all (N, 2).
    contact : callable
        ``(along, across, q) -> t``, all (N, 2); NaN if the rule does not touch a curve.
    summary : str
        One line for tables and help texts.
    tunable : bool
        Whether `q`, `f` and `s` apply; if not, f = s = 1.
    symmetric : bool
        Whether `along` and `across` can be swapped, so that the sides need no sorting.
    onboard : bool
        Whether the node offers the rule; the others only reproduce the paper's tables.
    two_ended : bool
        Whether `q_bow` and `q_stern` apply where the bow is known; if not, it is ignored.
    """

    name: str
    half_extents: Rule
    contact: Rule
    summary: str
    tunable: bool = False
    symmetric: bool = True
    onboard: bool = True
    two_ended: bool = False


_METHODS = (
    Method(
        'superellipse',
        superellipse,
        superellipse_contact,
        'exact projection of the superellipse hull',
        tunable=True,
        two_ended=True,
    ),
    Method(
        'shape_aware',
        shape_aware,
        shape_aware_contact,
        'the published rule, Algorithm 1',
        tunable=True,
        symmetric=False,
    ),
    Method('outer', outer, _contact_at(np.inf), 'minimum and maximum of the corners of the box'),
    Method('midpoint', midpoint, _contact_at(1.0), 'minimum and maximum of the edge midpoints'),
    Method('gaussian', gaussian, _contact_at(2.0), 'Gaussian of the box, marginalised'),
    Method(
        'area_equivalent',
        area_equivalent,
        _no_contact,
        'outer box scaled to the area of the oriented box',
    ),
    Method(
        'gaussian_published',
        gaussian_published,
        _no_contact,
        'Gaussian baseline as the paper runs it, x and y swapped',
        onboard=False,
    ),
    Method(
        'area_equivalent_published',
        area_equivalent_published,
        _no_contact,
        'area baseline as the paper runs it, length always on x',
        symmetric=False,
        onboard=False,
    ),
)
METHODS = MappingProxyType({method.name: method for method in _METHODS})

ONBOARD_METHODS: tuple[str, ...] = tuple(m.name for m in METHODS.values() if m.onboard)


def get_method(name: str) -> Method:
    """
    Look up a rule in `METHODS`; ValueError with the names of all if there is none.

    Examples
    --------
    >>> get_method('outer').summary
    'minimum and maximum of the corners of the box'
    """
    try:
        return METHODS[name]
    except KeyError:
        raise ValueError(f'method must be one of {", ".join(METHODS)}, not {name!r}') from None
