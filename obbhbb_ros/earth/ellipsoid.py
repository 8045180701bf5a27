# SPDX-License-Identifier: Apache-2.0
"""
The WGS84 ellipsoid: geodetic coordinates, east-north-up, and where rays meet it.

Source of its figures: NGA.STND.0036 (WGS 84), section 3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from obbhbb_ros.geometry.boxes import FloatArray

__all__ = [
    'EQUATOR',
    'POLE',
    'east_north_up',
    'first_hits',
    'is_above',
    'normals',
    'to_ecef',
    'to_geodetic',
]

EQUATOR = 6378137.0
"""Half the axis in the equatorial plane, metres."""
_FLATTENING = 1.0 / 298.257223563
POLE = EQUATOR * (1.0 - _FLATTENING)
"""Half the axis from pole to pole, metres."""

_E2 = _FLATTENING * (2.0 - _FLATTENING)
_SECOND_E2 = _E2 / (1.0 - _E2)

# Near the centre of the Earth a latitude has no meaning: several normals go through a point.
_MIN_RADIUS = 1000e3
# Steps of the formula of Bowring: after two, only a rounding error is left.
_ROUNDS = 2


def to_ecef(latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
    """
    Turn geodetic coordinates into ECEF.

    Parameters
    ----------
    latitude, longitude : array_like, shape (...)
        Degrees.
    height : array_like, shape (...)
        Metres above the ellipsoid.

    Returns
    -------
    ndarray, shape (..., 3)
        Metres. NaN where the latitude is beyond a pole or a number is not finite.

    Examples
    --------
    >>> to_ecef(0.0, 90.0, 1000.0).round(3).tolist()
    [0.0, 6379137.0, 0.0]
    """
    with np.errstate(invalid='ignore', over='ignore'):
        phi, lam = np.radians(latitude), np.radians(longitude)
        above = np.asarray(height, np.float64)
        phi = np.where(np.abs(phi) <= np.pi / 2, phi, np.nan)
        sin, cos = np.sin(phi), np.cos(phi)
        across = EQUATOR / np.sqrt(1.0 - _E2 * sin * sin)
        from_axis = (across + above) * cos
        points = (
            from_axis * np.cos(lam),
            from_axis * np.sin(lam),
            (across * (1 - _E2) + above) * sin,
        )
        return _joined(*points)


def to_geodetic(points: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Turn ECEF into geodetic coordinates.

    Source: Bowring, "The accuracy of geodetic latitude and height equations", Survey Review 28
    (1985), applied twice.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        Metres.

    Returns
    -------
    latitude, longitude : ndarray, shape (...)
        Degrees; the longitude in [-180, 180]. NaN within 1000 km of the centre of the Earth.
    height : ndarray, shape (...)
        Metres above the ellipsoid.

    Examples
    --------
    >>> [float(value) for value in to_geodetic([0.0, 0.0, -POLE - 50.0])]
    [-90.0, 0.0, 50.0]
    """
    x, y, z = _components(points)
    with np.errstate(invalid='ignore', over='ignore', divide='ignore'):
        from_axis = np.hypot(x, y)
        radius = np.hypot(from_axis, z)
        from_axis = np.where(radius > _MIN_RADIUS, from_axis, np.nan)
        # Sine and cosine of the reduced latitude, up to a common factor.
        sin, cos = POLE * z * (1.0 + _SECOND_E2 * POLE / radius), EQUATOR * from_axis
        for _ in range(_ROUNDS):
            scale = np.hypot(sin, cos)
            sin, cos = sin / scale, cos / scale
            up = z + _SECOND_E2 * POLE * (sin * sin * sin)
            out = from_axis - _E2 * EQUATOR * (cos * cos * cos)
            sin, cos = up * (1.0 - _FLATTENING), out
        scale = np.hypot(up, out)
        sin, cos = up / scale, out / scale
        height = from_axis * cos + z * sin - EQUATOR * np.sqrt(1.0 - _E2 * sin * sin)
        longitude = np.where(np.isnan(height), np.nan, np.degrees(np.arctan2(y, x)))
        return np.degrees(np.arctan2(up, out)), longitude, height


def east_north_up(latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
    """
    Give the axes east, north and up of places, in ECEF.

    Parameters
    ----------
    latitude, longitude : array_like, shape (...)
        Degrees.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        The rows are unit vectors east, north and up: ``axes @ vector`` turns a vector of ECEF into
        east-north-up, ``axes.T @ vector`` the other way.

    Examples
    --------
    >>> (east_north_up(0.0, 90.0) @ [-1.0, 2.0, 3.0]).round(9).tolist()
    [1.0, 3.0, 2.0]
    """
    with np.errstate(invalid='ignore'):
        phi, lam = np.radians(latitude), np.radians(longitude)
        sin_phi, cos_phi, sin_lam, cos_lam = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    rows = (
        (-sin_lam, cos_lam, np.zeros_like(sin_phi * sin_lam)),
        (-sin_phi * cos_lam, -sin_phi * sin_lam, cos_phi),
        (cos_phi * cos_lam, cos_phi * sin_lam, sin_phi),
    )
    components = [np.broadcast_arrays(*row) for row in rows]
    return np.moveaxis(np.array(components), (0, 1), (-2, -1))


def first_hits(origins: ArrayLike, rays: ArrayLike, height: float = 0.0) -> FloatArray:
    """
    Find where rays from outside first meet the surface at a height above the ellipsoid.

    The surface is modelled as the ellipsoid with axes longer by the height, which is off by at most
    0.14 mm at a height of 100 m and 4 mm at 3 km. The distance is that of the point of the ray
    nearest to the centre, in coordinates in which the ellipsoid is a sphere, less half the chord.

    Parameters
    ----------
    origins : array_like, shape (..., 3)
        Where the rays begin, ECEF, metres; broadcast against `rays`.
    rays : array_like, shape (..., 3)
        Directions in ECEF, of any length.
    height : float
        Height of the surface, metres; above -6000 km.

    Returns
    -------
    ndarray, shape (..., 3)
        ECEF, metres. NaN where a ray passes the Earth or looks away from it, or begins below the
        surface.

    Examples
    --------
    >>> first_hits([8e6, 0.0, 0.0], [[-2.0, 0.0, 0.0], [1.0, 0.0, 0.0]]).round(6).tolist()
    [[6378137.0, 0.0, 0.0], [nan, nan, nan]]
    """
    origin, ray = _components(origins), _components(rays)
    scales = _scales(height)
    with np.errstate(all='ignore'):
        begin = [value * scale for value, scale in zip(origin, scales, strict=True)]
        along = [value * scale for value, scale in zip(ray, scales, strict=True)]
        squared = _dot(along, along)
        nearest = -_dot(begin, along) / squared
        foot = [o + nearest * d for o, d in zip(begin, along, strict=True)]
        chord = np.sqrt((1.0 - _dot(foot, foot)) / squared)
        distance = np.where((nearest > 0.0) & (_dot(begin, begin) > 1.0), nearest - chord, np.nan)
        return _joined(*(o + distance * d for o, d in zip(origin, ray, strict=True)))


def normals(points: ArrayLike, height: float = 0.0) -> FloatArray:
    """
    Give the unit vectors up at points of the surface at a height, ECEF.

    Parameters
    ----------
    points : array_like, shape (..., 3)
        ECEF, metres.
    height : float
        Height of the surface, metres.

    Returns
    -------
    ndarray, shape (..., 3)

    Examples
    --------
    >>> normals([0.0, 0.0, POLE]).tolist()
    [0.0, 0.0, 1.0]
    """
    with np.errstate(all='ignore'):
        parts = [p * s * s for p, s in zip(_components(points), _scales(height), strict=True)]
        length = np.sqrt(_dot(parts, parts))
        return _joined(*(part / length for part in parts))


def is_above(point: ArrayLike, height: float = 0.0) -> bool:
    """
    Tell whether a point, shape (3,), ECEF, lies above the surface at a height.

    Examples
    --------
    >>> is_above([0.0, 0.0, POLE + 5.0], 4.0), is_above([0.0, 0.0, POLE + 5.0], 6.0)
    (True, False)
    """
    with np.errstate(all='ignore'):
        scaled = [p * s for p, s in zip(_components(point), _scales(height), strict=True)]
        return bool(_dot(scaled, scaled) > 1.0)


def _scales(height: float) -> tuple[float, float, float]:
    """Give the factors per axis that make the surface at a height a sphere of radius 1."""
    across = 1.0 / (EQUATOR + height)
    return across, across, 1.0 / (POLE + height)


def _components(points: ArrayLike) -> FloatArray:
    """Split (..., 3) into x, y and z, as a view (3, ...)."""
    return np.moveaxis(np.asarray(points, np.float64), -1, 0)


def _joined(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Join x, y and z to (..., 3)."""
    return np.moveaxis(np.array((x, y, z)), 0, -1)


def _dot(left: FloatArray | list[FloatArray], right: FloatArray | list[FloatArray]) -> FloatArray:
    """Compute the inner products of vectors, given as x, y and z."""
    product: FloatArray = left[0] * right[0] + left[1] * right[1] + left[2] * right[2]
    return product
