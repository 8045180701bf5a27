# SPDX-License-Identifier: Apache-2.0
"""
Distortion of lenses: the models of `sensor_msgs/CameraInfo`, and their inverses.

Source of the formulas: OpenCV, "Camera Calibration and 3D Reconstruction" (`plumb_bob` and
`rational_polynomial`) and "Fisheye camera model" (`equidistant`), after Brown (1966) and Kannala
and Brandt (2006).

A lens maps the direction of a ray to a *distorted point*: that of the image at focal length 1,
centred on the optical axis. Arrays hold x, y (and z) in rows, (2, N) and (3, N).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray

__all__ = ['EquidistantLens', 'Lens', 'PolynomialLens', 'lens_of']

MODELS = ('plumb_bob', 'rational_polynomial', 'equidistant')
_MAX_ROUNDS = 15
# Newton's method starts close to the solution, from a table of radii up to 84 degrees off the axis.
_SAMPLES = 256
_WIDEST = 10.0
# Maximum error of a solution at focal length 1: 1e-9 pixels at a focal length of 100,000.
_TOLERANCE = 1e-14
# No calibration has a larger coefficient, and products of larger ones would overflow.
_MAX_COEFFICIENT = 1e9


class Lens(Protocol):
    """A model of distortion with its coefficients."""

    def rays(self, points: FloatArray) -> FloatArray:
        """
        Find the rays of distorted points.

        Parameters
        ----------
        points : ndarray, shape (2, N)
            Distorted points.

        Returns
        -------
        ndarray, shape (3, N)
            Directions in the optical frame, of any length. NaN where the lens has no such point,
            or only beyond the radius at which the model folds back.
        """

    def points(self, rays: FloatArray) -> FloatArray:
        """
        Compute the distorted points of rays.

        Parameters
        ----------
        rays : ndarray, shape (3, N)
            Directions in the optical frame, of any length.

        Returns
        -------
        ndarray, shape (2, N)
            NaN where a ray is beyond the radius at which the model folds back.
        """


def lens_of(model: str, coefficients: Sequence[float]) -> Lens:
    """
    Make the lens that a camera info states.

    Parameters
    ----------
    model : str
        One of `MODELS`; any other is taken if there is no distortion.
    coefficients : sequence of float
        k1 k2 p1 p2 k3 k4 k5 k6, or k1 k2 k3 k4 of `equidistant`; missing ones are 0.

    Raises
    ------
    ValueError
        If the model is not known, or a coefficient is not finite, beyond 1e9, or of a term that the
        model has not.

    Examples
    --------
    >>> lens = lens_of('plumb_bob', [-0.2, 0.0, 0.0, 0.0, 0.0])
    >>> lens.points(np.array([[1.0], [0.0], [2.0]])).tolist()
    [[0.475], [0.0]]
    >>> lens.rays(np.array([[0.475, 3.0], [0.0, 0.0]])).round(12).tolist()
    [[0.5, nan], [0.0, nan], [1.0, nan]]
    """
    numbers = np.array(coefficients, np.float64)
    if not (np.abs(numbers) <= _MAX_COEFFICIENT).all():
        raise ValueError('a coefficient of the distortion is not finite, or beyond 1e9')
    count = 4 if model == 'equidistant' else 8
    if model not in MODELS:
        count = 0
    if numbers[count:].any():
        known = f'{count} coefficients of {model}' if count else ', '.join(MODELS)
        given = f'distortion {model!r} with {len(numbers)} coefficients'
        raise ValueError(f'{given} is not supported; supported are {known}')
    padded = np.zeros(max(count, 8))
    padded[: len(numbers[:count])] = numbers[:count]
    return EquidistantLens(padded[:4]) if model == 'equidistant' else PolynomialLens(padded)


class PolynomialLens:
    """
    `plumb_bob` and `rational_polynomial`: a radial factor and a tangential shift.

    Parameters
    ----------
    coefficients : ndarray, shape (8,)
        k1 k2 p1 p2 k3 k4 k5 k6.
    """

    def __init__(self, coefficients: FloatArray) -> None:
        k1, k2, p1, p2, k3, k4, k5, k6 = coefficients.tolist()
        self._above, self._below, self._shift = (k1, k2, k3), (k4, k5, k6), (p1, p2)
        self._is_straight = not coefficients.any()
        above, below = (np.array((1.0, *ks)) for ks in (self._above, self._below))
        # Of r above(r²) / below(r²), in powers of r².
        slope = _sum(
            np.convolve(above, below),
            2 * np.convolve(_slope(above), below),
            -2 * np.convolve(above, _slope(below)),
        )
        self._limit = min(_first_root(slope), _first_root(below))
        self._radii = np.linspace(0.0, min(math.sqrt(self._limit), _WIDEST), _SAMPLES)
        with np.errstate(all='ignore'):
            s = self._radii**2
            bent = self._radii * _polynomial(above, s) / _polynomial(below, s)
        self._bent_radii = np.nan_to_num(bent)

    def points(self, rays: FloatArray) -> FloatArray:
        """Compute the distorted points, (2, N), of rays, (3, N)."""
        with np.errstate(all='ignore'):
            x, y = rays[:2] / np.where(rays[2] > 0.0, rays[2], np.nan)
            if self._is_straight:
                return np.array((x, y))
            bent_x, bent_y, *jacobian = self._bent(x, y)
            return np.where(self._is_before_fold(x, y, jacobian), (bent_x, bent_y), np.nan)

    def rays(self, points: FloatArray) -> FloatArray:
        """Find the rays, (3, N), of distorted points, (2, N), by Newton's method."""
        rays = np.ones((3, points.shape[1]))
        rays[:2] = points
        if not self._is_straight:
            with np.errstate(all='ignore'):
                radius = np.sqrt(points[0] * points[0] + points[1] * points[1])
                begin = np.interp(radius, self._bent_radii, self._radii)
                rays[:2] *= np.where(radius > 0.0, begin / radius, 1.0)
                self._straighten(rays[0], rays[1], points)
                rays[2] += 0.0 * rays[0]
        return rays

    def _straighten(self, x: FloatArray, y: FloatArray, points: FloatArray) -> None:
        """Replace x and y, (N,), with the nearby points that the lens bends to `points`, or NaN."""
        allowed = _TOLERANCE * (1.0 + np.abs(points[0]) + np.abs(points[1]))
        for left in range(_MAX_ROUNDS, -1, -1):
            bent_x, bent_y, *jacobian = self._bent(x, y)
            off_x, off_y = bent_x - points[0], bent_y - points[1]
            good = np.abs(off_x) + np.abs(off_y) <= allowed
            if not left or (good | np.isnan(off_x)).all():
                break
            along_x, across, along_y = jacobian
            scale = 1.0 / (along_x * along_y - across * across)
            x -= (along_y * off_x - across * off_y) * scale
            y -= (along_x * off_y - across * off_x) * scale
        bad = ~(good & self._is_before_fold(x, y, jacobian))
        x[bad] = y[bad] = np.nan

    def _is_before_fold(
        self, x: FloatArray, y: FloatArray, jacobian: list[FloatArray]
    ) -> NDArray[np.bool_]:
        """Tell which points of the plane, x and y, lie inside the radius where the model folds."""
        along_x, across, along_y = jacobian
        inside: NDArray[np.bool_] = x * x + y * y < self._limit
        return inside & (along_x + along_y > 0.0) & (along_x * along_y > across * across)

    def _bent(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, ...]:
        """
        Bend points of the plane z = 1, x and y.

        Returns x, y, and the Jacobian, which is symmetric: dx/dx, dx/dy, dy/dy.
        """
        (k1, k2, k3), (k4, k5, k6), (p1, p2) = self._above, self._below, self._shift
        xx, yy, xy = x * x, y * y, x * y
        s = xx + yy
        radial = ((k3 * s + k2) * s + k1) * s + 1.0
        # The derivative along x is x times this.
        slope = (6.0 * k3 * s + 4.0 * k2) * s + 2.0 * k1
        if k4 or k5 or k6:
            below = 1.0 / (((k6 * s + k5) * s + k4) * s + 1.0)
            radial *= below
            slope = (slope - radial * ((6.0 * k6 * s + 4.0 * k5) * s + 2.0 * k4)) * below
        bent = x * radial, y * radial
        jacobian = radial + slope * xx, slope * xy, radial + slope * yy
        if not p1 and not p2:
            return *bent, *jacobian
        return (
            bent[0] + 2.0 * p1 * xy + p2 * (s + 2.0 * xx),
            bent[1] + 2.0 * p2 * xy + p1 * (s + 2.0 * yy),
            jacobian[0] + 2.0 * p1 * y + 6.0 * p2 * x,
            jacobian[1] + 2.0 * (p1 * x + p2 * y),
            jacobian[2] + 6.0 * p1 * y + 2.0 * p2 * x,
        )


class EquidistantLens:
    """
    `equidistant`: the radius in the image is a polynomial of the angle from the optical axis.

    Parameters
    ----------
    coefficients : ndarray, shape (4,)
        k1 k2 k3 k4.
    """

    def __init__(self, coefficients: FloatArray) -> None:
        self._powers = np.array((1.0, *coefficients))
        self._slopes = self._powers * (1.0, 3.0, 5.0, 7.0, 9.0)
        self._limit = min(math.sqrt(_first_root(self._slopes)), math.pi)
        self._samples = np.linspace(0.0, self._limit, _SAMPLES)
        self._radii = self._samples * _polynomial(self._powers, self._samples**2)

    def points(self, rays: FloatArray) -> FloatArray:
        """Compute the distorted points, (2, N), of rays, (3, N)."""
        x, y, z = rays
        with np.errstate(all='ignore'):
            from_axis = np.hypot(x, y)
            angle = np.arctan2(from_axis, z)
            radius = angle * _polynomial(self._powers, angle * angle)
            scale = np.where(from_axis > 0.0, radius / from_axis, 0.0)
            return np.where(angle < self._limit, rays[:2] * scale, np.nan)

    def rays(self, points: FloatArray) -> FloatArray:
        """Find the rays, (3, N), of distorted points, (2, N), by Newton's method."""
        with np.errstate(all='ignore'):
            radius = np.hypot(*points)
            angle = self._angles(radius)
            scale = np.where(radius > 0.0, np.sin(angle) / radius, 1.0)
            return np.array((points[0] * scale, points[1] * scale, np.cos(angle)))

    def _angles(self, radius: FloatArray) -> FloatArray:
        """Find the angles from the axis, (N,), of distances from the centre, (N,), or NaN."""
        angle = np.interp(radius, self._radii, self._samples)
        for left in range(_MAX_ROUNDS, -1, -1):
            squared = angle * angle
            off = angle * _polynomial(self._powers, squared) - radius
            good = np.abs(off) <= _TOLERANCE * (1.0 + radius)
            if not left or (good | np.isnan(off)).all():
                break
            angle -= off / _polynomial(self._slopes, squared)
        return np.where(good & (angle >= 0.0) & (angle < self._limit), angle, np.nan)


def _polynomial(powers: FloatArray, s: FloatArray) -> FloatArray:
    """Evaluate a polynomial; the constant comes first."""
    value: FloatArray = np.full_like(s, powers[-1])
    for power in powers[-2::-1]:
        value = value * s + power
    return value


def _sum(*polynomials: FloatArray) -> FloatArray:
    """Add polynomials of different degree; the constant comes first."""
    total = np.zeros(max(map(len, polynomials)))
    for polynomial in polynomials:
        total[: len(polynomial)] += polynomial
    return total


def _slope(powers: FloatArray) -> FloatArray:
    """Differentiate a polynomial in s, and multiply it by s; the constant comes first."""
    return powers * np.arange(len(powers))


def _first_root(powers: FloatArray) -> float:
    """Find the smallest positive root of a polynomial that is 1 at 0; infinity without one."""
    # Of 1/s: the first coefficient is then 1 for certain, and no division overflows.
    roots = np.roots(powers)
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    # Roots beyond 1e300, of coefficients next to nothing, overflow.
    real = real[real > 1e-300]
    return float(1.0 / real.max()) if real.size else np.inf
