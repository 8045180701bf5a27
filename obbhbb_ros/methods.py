# SPDX-License-Identifier: Apache-2.0
"""
The conversion rules: how far a hull reaches along the image axes.

One pure function a rule, and their registry. Every rule works on the same two numbers per
image axis, the reach of the hull's own half axes along it::

                 image x        image y
    along     a * |cos θ|     a * |sin θ|      a = L / 2, half the length
    across    b * |sin θ|     b * |cos θ|      b = f * W / 2, half the width times fullness

with θ the angle of the long axis from image +x. No angle is needed to have them: they are the
absolute components of half the long and half the short edge of the oriented box. A rule returns
the half-extents of the axis-aligned box, in pixels; all are homogeneous of degree one, so a
shrink factor or a ground sample distance passes straight through.

Equation, table and algorithm numbers are those of the paper, "Shape-Aware Oriented Bounding Box
(OBB) to Horizontal Bounding Box (HBB) Conversion".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Rule: TypeAlias = Callable[[FloatArray, FloatArray, float], FloatArray]

# Keeps 0 / 0 from happening where a hull has no extent at all.
_TINY = float(np.finfo(np.float64).tiny)
# From here on the rule is that of the rectangle to the last digit, and products might overflow.
_AS_GOOD_AS_INFINITE = 1e100


def superellipse(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """
    Project the superellipse hull of Eq. 1 exactly.

    The support function of ``|x/a|^q + |y/b|^q = 1`` is the dual norm
    ``(along^p + across^p)^(1/p)`` with ``1/p + 1/q = 1``.

    Parameters
    ----------
    along, across : ndarray, shape (2, N)
        Reach of the half-length and of the half-width along x and y, pixels, not negative.
    q : float
        Shape exponent in [1, inf]: 1 is a rhombus, 2 an ellipse, infinity the rectangle.

    Returns
    -------
    ndarray, shape (2, N)
        Half-extents along x and y, pixels.
    """
    if q == 1.0:
        return np.maximum(along, across)
    if q == 2.0:
        return gaussian(along, across)
    p = q / (q - 1.0) if q < np.inf else 1.0
    if p == 1.0:
        return along + across
    # The larger term is factored out, so that no power overflows whatever p is.
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
    Convert by the published rule (Algorithm 1), in closed form.

    Its curve ``y = b (1 - |x/a|^q)`` lies inside the superellipse, so it undershoots by up to
    15 % per half-extent; where ``along >= q * across`` it ignores the width altogether.

    Parameters
    ----------
    along, across : ndarray, shape (2, N)
        Reach of the half-length and of the half-width along x and y, pixels, not negative.
    q : float
        Shape exponent in [1, inf].

    Returns
    -------
    ndarray, shape (2, N)
        Half-extents along x and y, pixels.
    """
    if q == 1.0:
        return np.maximum(along, across)
    if not q < _AS_GOOD_AS_INFINITE:
        return along + across
    # At the optimum q*b*t^(q-1) = a, hence b*t^q = a*t/q. A bow that touches (t = 1) is b*0.
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
    # A third of the time of np.hypot, which guards against squares that overflow.
    return np.sqrt(along * along + across * across)


def area_equivalent(along: FloatArray, across: FloatArray, q: float = np.inf) -> FloatArray:
    """Scale the outer box about its centre to the area L * W; `q` is ignored."""
    extent = along + across
    # along_x * across_y + along_y * across_x = a * b, a quarter of the oriented box's area.
    area = along[0] * across[1] + along[1] * across[0]
    outer_area = extent[0] * extent[1]
    return extent * np.sqrt(area / np.maximum(outer_area, _TINY))


def gaussian_published(along: FloatArray, across: FloatArray, q: float = 2.0) -> FloatArray:
    """Reproduce the paper's Gaussian baseline, which swaps x and y; `q` is ignored."""
    return gaussian(along, across)[::-1]


def area_equivalent_published(
    along: FloatArray, across: FloatArray, q: float = np.inf
) -> FloatArray:
    """Reproduce the paper's area baseline, which always lays L on x; `q` is ignored."""
    return np.stack((np.hypot(along[0], along[1]), np.hypot(across[0], across[1])))


def shape_aware_contact(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """
    Give t_x and t_y of Algorithm 1 (Eqs. 7 and 8), clipped to [0, 1].

    Parameters
    ----------
    along, across : ndarray, shape (2, N)
        Reach of the half-length and of the half-width along x and y, pixels, not negative.
    q : float
        Shape exponent in [1, inf].

    Returns
    -------
    ndarray, shape (2, N)
        Where along the hull the box touches it: 0 amidships, 1 at bow or stern.
    """
    if q == 1.0:
        return np.where(along >= across, 1.0, 0.0)
    if not q < _AS_GOOD_AS_INFINITE:
        return np.where(along > 0.0, 1.0, 0.0)
    clipped = np.minimum(along, q * across)
    ratio = clipped / np.maximum(q * across, _TINY)
    return np.where(along >= q * across, 1.0, ratio ** (1.0 / (q - 1.0)))


def superellipse_contact(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """
    Give the position along the hull where the box touches the superellipse.

    It is the derivative of the half-extent by `along`, hence 0 amidships and 1 at the bow, like
    the t_x and t_y of Algorithm 1.

    Parameters
    ----------
    along, across : ndarray, shape (2, N)
        Reach of the half-length and of the half-width along x and y, pixels, not negative.
    q : float
        Shape exponent in [1, inf].

    Returns
    -------
    ndarray, shape (2, N)
        Contact position in [0, 1].
    """
    if q == 1.0 or not np.isfinite(q):
        return shape_aware_contact(along, across, q)
    extent = np.maximum(superellipse(along, across, q), _TINY)
    return (along / extent) ** (1.0 / (q - 1.0))


def _contact_at(q: float) -> Rule:
    """Fix the exponent of the superellipse contact for a rule that has none of its own."""
    return lambda along, across, _: superellipse_contact(along, across, q)


def _no_contact(along: FloatArray, across: FloatArray, q: float) -> FloatArray:
    """Say that a rule touches no curve of the hull."""
    return np.full_like(along, np.nan)


@dataclass(frozen=True)
class Method:
    """
    One conversion rule with what a caller has to know of it.

    Attributes
    ----------
    name : str
        Name in parameters, tables and plots.
    half_extents : callable
        ``(along, across, q) -> half_extents``, all (2, N).
    contact : callable
        ``(along, across, q) -> t``, all (2, N); NaN where the rule has no such thing.
    tunable : bool
        Whether `q`, `f` and `s` apply; the others are used with f = s = 1.
    symmetric : bool
        Whether `along` and `across` may change places, so that nobody needs to know which side
        is the longer one.
    onboard : bool
        Whether the node offers it; the others only reproduce the paper's tables.
    summary : str
        One line for tables and help texts.
    """

    name: str
    half_extents: Rule
    contact: Rule
    tunable: bool
    symmetric: bool
    onboard: bool
    summary: str


METHODS: MappingProxyType[str, Method] = MappingProxyType({
    method.name: method
    for method in (
        Method(
            'superellipse', superellipse, superellipse_contact,
            tunable=True, symmetric=True, onboard=True,
            summary='exact projection of the superellipse hull',
        ),
        Method(
            'shape_aware', shape_aware, shape_aware_contact,
            tunable=True, symmetric=False, onboard=True,
            summary='the published rule, Algorithm 1',
        ),
        Method(
            'outer', outer, _contact_at(np.inf),
            tunable=False, symmetric=True, onboard=True,
            summary='minimum and maximum of the corners',
        ),
        Method(
            'midpoint', midpoint, _contact_at(1.0),
            tunable=False, symmetric=True, onboard=True,
            summary='minimum and maximum of the edge midpoints',
        ),
        Method(
            'gaussian', gaussian, _contact_at(2.0),
            tunable=False, symmetric=True, onboard=True,
            summary='Gaussian of the box, marginalised',
        ),
        Method(
            'area_equivalent', area_equivalent, _no_contact,
            tunable=False, symmetric=True, onboard=True,
            summary='outer box scaled to the area of the oriented box',
        ),
        Method(
            'gaussian_published', gaussian_published, _no_contact,
            tunable=False, symmetric=True, onboard=False,
            summary='Gaussian baseline as the paper runs it, x and y swapped',
        ),
        Method(
            'area_equivalent_published', area_equivalent_published, _no_contact,
            tunable=False, symmetric=False, onboard=False,
            summary='area baseline as the paper runs it, length always on x',
        ),
    )
})

ONBOARD_METHODS: tuple[str, ...] = tuple(m.name for m in METHODS.values() if m.onboard)


def get_method(name: str) -> Method:
    """
    Look a rule up by its name.

    Parameters
    ----------
    name : str
        One of the keys of `METHODS`.

    Returns
    -------
    Method
        The rule.

    Raises
    ------
    ValueError
        If there is no such rule; the message lists those there are.
    """
    try:
        return METHODS[name]
    except KeyError:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, not {name!r}") from None
