# SPDX-License-Identifier: Apache-2.0
"""
A map of ships: their places on a graticule, with a scale bar.

Degrees of longitude are as long as at the middle latitude (equirectangular projection). Places are
percent of the width and of the height, from the upper left corner, so that a page of any width can
lay marks and labels over the drawing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from obbhbb_ros.earth.ellipsoid import to_ecef
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.reports.ship_report import ShipReport

# Ships may lie between this share of the width or height and the rest.
_MARGIN = 0.08
# Metres.
_MIN_EXTENT, _MAX_HALF_LENGTH = 400.0, 500.0
# Height over width.
_MIN_ASPECT, _MAX_ASPECT = 0.4, 0.8
# Steps of the graticule, arc seconds.
_STEPS = tuple(
    unit * step
    for unit, steps in (
        (1, (1, 2, 5, 10, 20, 30)),
        (60, (1, 2, 5, 10, 20, 30)),
        (3600, (1, 2, 5, 10, 20, 30, 45, 90)),
    )
    for step in steps
)
_MAX_LINES = 5
# Latitude of a pole, arc seconds.
_POLE = 90 * 3600
# Labels nearer to a side than this are left out, percent.
_BORDER = 9.0


class GraticuleLine(NamedTuple):
    """A meridian or parallel: its place, percent, and its label; empty close to a corner."""

    at: float
    label: str


class Hull(NamedTuple):
    """Where the two ends of a ship are, percent."""

    x0: float
    y0: float
    x1: float
    y1: float


@dataclass(frozen=True)
class ShipMap:
    """
    A map.

    Attributes
    ----------
    aspect : float
        Width over height.
    places : list of tuple of float
        Where the ships are, x and y in percent.
    hulls : list of Hull
        The ships at their lengths and courses.
    meridians, parallels : list of GraticuleLine
        The graticule.
    bar : float
        Length of the scale bar, percent of the width.
    bar_label : str
        What it stands for, at the middle latitude.
    """

    aspect: float
    places: list[tuple[float, float]]
    hulls: list[Hull]
    meridians: list[GraticuleLine]
    parallels: list[GraticuleLine]
    bar: float
    bar_label: str


def ship_map(ships: Sequence[ShipReport]) -> ShipMap:
    """
    Draw a map of one or more ships.

    Examples
    --------
    >>> tug = ShipReport(
    ...     id='a-1', latitude=36.1, longitude=-5.4, course=90.0, course_ambiguous=True,
    ...     length_m=40.0, width_m=9.0, first=5, last=5,
    ... )
    >>> drawn = ship_map([tug])
    >>> drawn.places, drawn.hulls[0], drawn.bar_label
    ([(50.0, 50.0)], Hull(x0=45.8, y0=50.0, x1=54.2, y1=50.0), '100 m')
    >>> [line.label for line in drawn.meridians]
    ['5°24′05″ W', '5°24′ W', '5°23′55″ W']
    """
    latitudes = np.array([ship.latitude for ship in ships])
    longitudes = _unwrapped(np.array([ship.longitude for ship in ships]))
    middle = np.array([_middle(longitudes), _middle(latitudes)])
    # Metres of a degree.
    scale = np.array(_degree_lengths(float(middle[1])))
    places = (np.stack([longitudes, latitudes], axis=1) - middle) * scale
    halves = np.minimum([ship.length_m / 2.0 for ship in ships], _MAX_HALF_LENGTH)
    spread = places.max(axis=0) - places.min(axis=0) + 2.0 * halves.max()
    width = max(float(spread[0]), float(spread[1]) / _MAX_ASPECT, _MIN_EXTENT)
    height = max(float(spread[1]), _MIN_ASPECT * width)
    size = np.array([width, height]) / (1.0 - 2.0 * _MARGIN)
    # Upwards is less.
    percent = 100.0 * np.array([1.0, -1.0]) / size
    at = 50.0 + places * percent
    courses = np.radians([ship.course for ship in ships])
    ends = halves[:, None] * np.stack([np.sin(courses), np.cos(courses)], axis=1) * percent
    hulls = np.concatenate([at - ends, at + ends], axis=1).round(3).tolist()
    half = size / 2.0 / scale
    meridians = _lines(middle[0] - half[0], middle[0] + half[0], 'EW')
    parallels = _lines(middle[1] - half[1], middle[1] + half[1], 'NS')
    metres = _round_length(float(size[0]) / 4.0)
    return ShipMap(
        float(size[0] / size[1]),
        [(x, y) for x, y in at.round(3).tolist()],
        [Hull(*ends) for ends in hulls],
        meridians,
        [line._replace(at=100.0 - line.at) for line in parallels],
        100.0 * metres / float(size[0]),
        f'{metres:g} m' if metres < 1000.0 else f'{metres / 1000.0:,.0f} km',
    )


def _unwrapped(longitudes: FloatArray) -> FloatArray:
    """Turn longitudes so that they are within the smallest range, across 180° if need be."""
    ordered = np.sort(longitudes)
    gaps = np.diff(ordered, append=ordered[0] + 360.0)
    start = ordered[(int(np.argmax(gaps)) + 1) % len(ordered)]
    return np.where(longitudes < start, longitudes + 360.0, longitudes)


def _middle(values: FloatArray) -> float:
    """Return the middle of the range of some values."""
    return float(values.min() + values.max()) / 2.0


def _degree_lengths(latitude: float) -> tuple[float, float]:
    """Measure a degree of longitude and one of latitude, metres."""
    # At a pole, a degree of longitude has no length.
    latitude = max(-89.0, min(latitude, 89.0))
    step = 0.01
    here = to_ecef(latitude, 0.0, 0.0)
    east, north = to_ecef(latitude, step, 0.0), to_ecef(latitude + step, 0.0, 0.0)
    return math.dist(here, east) / step, math.dist(here, north) / step


def _lines(low: float, high: float, sides: str) -> list[GraticuleLine]:
    """Lay lines of round degrees, minutes or seconds through a range of degrees."""
    span = (high - low) * 3600.0
    step = next((step for step in _STEPS if span / step <= _MAX_LINES), _STEPS[-1])
    numbers = range(math.ceil(low * 3600.0 / step), math.floor(high * 3600.0 / step) + 1)
    lines = []
    for seconds in (number * step for number in numbers):
        if sides == 'NS' and abs(seconds) > _POLE:
            continue
        at = 100.0 * (seconds - low * 3600.0) / span
        is_free = _BORDER <= at <= 100.0 - _BORDER
        lines.append(GraticuleLine(round(at, 3), _label(seconds, sides) if is_free else ''))
    return lines


def _label(seconds: int, sides: str) -> str:
    """
    Write an angle as short as it can be.

    Examples
    --------
    >>> [_label(seconds, 'EW') for seconds in (0, 19800, -19445, 190 * 3600, 180 * 3600)]
    ['0°', '5°30′ E', '5°24′05″ W', '170° W', '180°']
    """
    if sides == 'EW':
        seconds = (seconds + 648_000) % 1_296_000 - 648_000
    degrees, rest = divmod(abs(seconds), 3600)
    minutes, left = divmod(rest, 60)
    text = f'{degrees}°' + (f'{minutes:02d}′' if rest else '') + (f'{left:02d}″' if left else '')
    # Neither west nor east.
    return text if abs(seconds) in (0, 648_000) else f'{text} {sides[seconds < 0]}'


def _round_length(metres: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most a length."""
    power = 10.0 ** math.floor(math.log10(metres))
    return next(step * power for step in (5.0, 2.0, 1.0) if step * power <= metres * (1.0 + 1e-9))
