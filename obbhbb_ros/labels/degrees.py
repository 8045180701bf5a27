# SPDX-License-Identifier: Apache-2.0
"""
Degrees to a plane and back: the Mercator projection of the WGS84 ellipsoid.

Of all projections it alone keeps both angles and the axes: a box that is aligned with them in
the plane is one in degrees, a ship is the same shape anywhere, whatever else is in the file, and
only its scale depends on the latitude. Over a ship of 500 m at 75 degrees the scale changes by
3e-4.

Source: J. P. Snyder, Map Projections, a Working Manual (USGS Professional Paper 1395), equations
7-6, 7-7 and 7-9.
"""

from __future__ import annotations

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray

SEMI_MAJOR = 6378137.0
ECCENTRICITY = 0.0818191908426215
# Beyond it no ship sails.
MAX_LATITUDE = 89.0
MAX_LONGITUDE = 360.0
# Wider polygons are those of ships on both sides of the antimeridian.
MAX_WIDTH = 180.0
# Each step of the inverse is 150 times closer.
STEPS = 8


def to_plane(degrees: FloatArray) -> FloatArray:
    """
    Project longitude and latitude, shape (K, 2), to x and y in metres at the equator.

    Raises ValueError if they are out of range or extend over the antimeridian.
    """
    longitude, latitude = degrees.T
    if not (np.abs(longitude) <= MAX_LONGITUDE).all() or not (np.abs(latitude) <= 90.0).all():
        raise ValueError('a coordinate is no longitude and latitude, though they are in degrees')
    if not (np.abs(latitude) <= MAX_LATITUDE).all():
        raise ValueError(f'a latitude beyond {MAX_LATITUDE:g} degrees is not converted')
    if np.ptp(longitude) > MAX_WIDTH:
        raise ValueError('the polygon extends over the antimeridian, 180 degrees')
    sine = np.sin(np.radians(latitude))
    isometric = np.arctanh(sine) - ECCENTRICITY * np.arctanh(ECCENTRICITY * sine)
    return np.column_stack((SEMI_MAJOR * np.radians(longitude), SEMI_MAJOR * isometric))


def to_degrees(plane: FloatArray) -> FloatArray:
    """Return longitude and latitude of points in the plane, shape (K, 2)."""
    isometric = plane[:, 1] / SEMI_MAJOR
    sine = np.tanh(isometric)
    for _ in range(STEPS):
        sine = np.tanh(isometric + ECCENTRICITY * np.arctanh(ECCENTRICITY * sine))
    longitude = np.degrees(plane[:, 0] / SEMI_MAJOR)
    return np.column_stack((longitude, np.degrees(np.arcsin(sine))))


def ground_scale(y: FloatArray) -> FloatArray:
    """Return the metres on the ground of a metre in the plane at any `y`."""
    latitude = np.radians(to_degrees(np.column_stack((np.zeros_like(y), y)))[:, 1])
    return np.cos(latitude) / np.sqrt(1.0 - (ECCENTRICITY * np.sin(latitude)) ** 2)
