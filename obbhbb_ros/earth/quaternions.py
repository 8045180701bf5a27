# SPDX-License-Identifier: Apache-2.0
"""Unit quaternions x, y, z, w, as in the messages of ROS."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obbhbb_ros.geometry.boxes import FloatArray

__all__ = [
    'enu_quaternion',
    'matrices_of',
    'matrices_of_vectors',
    'matrix_of',
    'product',
    'slerp',
    'turn_about_up',
    'unit_quaternion',
]

# Single precision and a few products of it keep the length 1 to a millionth; other lengths are no
# rotation.
_MAX_OFF = 0.01
# Cosine of half a turn; above it, the shorter arc is practically straight.
_STRAIGHT = 1.0 - 1e-9


def unit_quaternion(numbers: ArrayLike) -> FloatArray:
    """
    Check a quaternion and make its length exactly 1.

    Parameters
    ----------
    numbers : array_like, shape (4,)
        x, y, z, w.

    Returns
    -------
    ndarray, shape (4,)

    Raises
    ------
    ValueError
        If it has another shape, or its length is more than a hundredth off 1: all zeros, as in a
        message that nobody filled, or NaN.

    Examples
    --------
    >>> unit_quaternion([0, 0, 0, 1.0001]).tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    quaternion = np.array(numbers, np.float64)
    if quaternion.shape != (4,):
        raise ValueError(f'a quaternion has four numbers, not shape {quaternion.shape}')
    length = math.hypot(*quaternion.tolist())
    # NaN compares as false.
    if not abs(length - 1.0) <= _MAX_OFF:
        raise ValueError(f'the quaternion has length {length:.6g}, not 1')
    unit: FloatArray = quaternion / length
    return unit


def product(left: ArrayLike, right: ArrayLike) -> FloatArray:
    """
    Multiply quaternions: the rotation `right`, then the rotation `left`.

    Parameters
    ----------
    left, right : array_like, shape (..., 4)

    Returns
    -------
    ndarray, shape (..., 4)

    Examples
    --------
    >>> product([1, 0, 0, 0], [0, 1, 0, 0]).tolist()
    [0.0, 0.0, 1.0, 0.0]
    """
    a, b, c, d = np.moveaxis(np.asarray(left, np.float64), -1, 0)
    x, y, z, w = np.moveaxis(np.asarray(right, np.float64), -1, 0)
    parts = (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )
    return np.stack(parts, axis=-1)


def matrix_of(quaternion: ArrayLike) -> FloatArray:
    """
    Turn a unit quaternion, shape (4,), into its rotation matrix, (3, 3).

    Examples
    --------
    >>> (matrix_of([0, 0, 0.5**0.5, 0.5**0.5]) @ [3, 2, 1]).round(9).tolist()
    [-2.0, 3.0, 1.0]
    """
    x, y, z, w = np.asarray(quaternion, np.float64).tolist()
    return np.array(_rotation(x, y, z, w))


def matrices_of(quaternions: FloatArray) -> FloatArray:
    """Turn unit quaternions, shape (N, 4), into their rotation matrices, (N, 3, 3)."""
    return np.moveaxis(np.array(_rotation(*quaternions.T)), -1, 0)


def _rotation(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Give the elements of the rotation matrix of a quaternion, or of several."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def turn_about_up(angle: ArrayLike) -> FloatArray:
    """
    Give the quaternions of turns about z, counter-clockwise from above.

    Parameters
    ----------
    angle : array_like, shape (...)
        Radians.

    Returns
    -------
    ndarray, shape (..., 4)

    Examples
    --------
    >>> turn_about_up(np.pi).round(9).tolist()
    [0.0, 0.0, 1.0, 0.0]
    """
    half = 0.5 * np.asarray(angle, np.float64)
    zero = np.zeros_like(half)
    return np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1)


def enu_quaternion(latitude: ArrayLike, longitude: ArrayLike) -> FloatArray:
    """
    Give the quaternions from east-north-up at places to ECEF.

    Parameters
    ----------
    latitude, longitude : array_like, shape (...)
        Degrees.

    Returns
    -------
    ndarray, shape (..., 4)

    Examples
    --------
    >>> (matrix_of(enu_quaternion(0.0, 0.0)) @ [1, 2, 3]).round(9).tolist()
    [3.0, 1.0, 2.0]
    """
    # Turn east to its longitude, then tilt north up from the plane of the equator.
    turn = turn_about_up(np.radians(longitude) + np.pi / 2)
    half = 0.5 * (np.pi / 2 - np.radians(latitude))
    zero = np.zeros_like(half)
    return product(turn, np.stack((np.sin(half), zero, zero, np.cos(half)), axis=-1))


def matrices_of_vectors(vectors: ArrayLike) -> FloatArray:
    """
    Turn rotation vectors, shape (K, 3), radians, into matrices, (K, 3, 3).

    Source: Rodrigues' formula.

    Examples
    --------
    >>> (matrices_of_vectors([[0, 0, np.pi / 2]])[0] @ [1, 0, 0]).round(9).tolist()
    [0.0, 1.0, 0.0]
    """
    rows = np.asarray(vectors, np.float64).reshape(-1, 3)
    with np.errstate(invalid='ignore', over='ignore'):
        angle = np.sqrt((rows * rows).sum(axis=1))[:, None, None]
        zero = np.zeros(len(rows))
        x, y, z = rows.T
        cross = np.array(((zero, -z, y), (z, zero, -x), (-y, x, zero))).transpose(2, 0, 1)
        # sin(t) / t and (1 - cos(t)) / t², also where t is 0.
        first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
        matrices: FloatArray = np.eye(3) + first * cross + second * (cross @ cross)
    return matrices


def slerp(before: FloatArray, after: FloatArray, fraction: float) -> FloatArray:
    """
    Turn evenly from one attitude to another, by the shorter way.

    Source: Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.

    Parameters
    ----------
    before, after : ndarray, shape (4,)
        Unit quaternions.
    fraction : float
        0 for `before`, 1 for `after`.

    Returns
    -------
    ndarray, shape (4,)
        A unit quaternion.

    Examples
    --------
    >>> half = slerp(np.array([0, 0, 0, 1.0]), np.array([0, 0, 1.0, 0]), 0.5)
    >>> half.round(6).tolist()
    [0.0, 0.0, 0.707107, 0.707107]
    """
    cosine = float(before @ after)
    if cosine < 0.0:
        after, cosine = -after, -cosine
    if cosine > _STRAIGHT:
        mixed = (1.0 - fraction) * before + fraction * after
    else:
        angle = math.acos(cosine)
        mixed = math.sin((1.0 - fraction) * angle) * before + math.sin(fraction * angle) * after
    unit: FloatArray = mixed / math.hypot(*mixed.tolist())
    return unit
