# SPDX-License-Identifier: Apache-2.0
"""
A ship list as gzipped GeoJSON (RFC 7946): a point for each ship.

Numbers have only the decimals that they are worth: 0.1 m in place and length, 0.1° in course, 1 ms,
two digits of an uncertainty. Unknown properties are left out.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from datetime import datetime
from datetime import timedelta
from datetime import timezone
from typing import Any
from typing import TypeVar

from obbhbb_ros.reports.ship_report import MAX_LIST_BYTES
from obbhbb_ros.reports.ship_report import ShipListError
from obbhbb_ros.reports.ship_report import ShipReport

__all__ = ['GZIP_MAGIC', 'read_ship_geojson', 'ship_geojson']

GZIP_MAGIC = b'\x1f\x8b'
"""How a gzipped file begins."""
# Of zlib: a gzip header, with the largest window.
_GZIP = 31
# Degrees: 0.1 m.
_DECIMALS = 6
_SIGMA_DIGITS = 2
_Value = TypeVar('_Value')

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_MILLISECOND, _MICROSECOND = timedelta(milliseconds=1), timedelta(microseconds=1)


def ship_geojson(ships: Iterable[ShipReport]) -> bytes:
    """
    Write a ship list as gzipped GeoJSON; equal lists give equal bytes.

    Parameters
    ----------
    ships : iterable of ShipReport
        The ships. Values that are not finite are left out; place, course and size must be finite.

    Raises
    ------
    ShipListError
        If it is larger than `MAX_LIST_BYTES`, so that nobody could read it.

    Examples
    --------
    >>> tug = ShipReport(
    ...     id='a-1', latitude=36.1, longitude=-5.4, course=12.0, course_ambiguous=True,
    ...     length_m=30.0, width_m=9.0, first=5_000_000_000, last=6_250_000_000, views=2,
    ... )
    >>> print(zlib.decompress(ship_geojson([tug]), _GZIP).decode())
    {"type":"FeatureCollection","features":[
    {"type":"Feature","id":"a-1","geometry":{"type":"Point","coordinates":[-5.4,36.1]},\
"properties":{"course":12,"course_ambiguous":true,"length_m":30,"width_m":9,\
"first":"1970-01-01T00:00:05.000Z","last":"1970-01-01T00:00:06.250Z","views":2}}
    ]}
    """
    features = ',\n'.join(
        json.dumps(_feature(ship), ensure_ascii=False, separators=(',', ':'), allow_nan=False)
        for ship in ships
    )
    text = f'{{"type":"FeatureCollection","features":[\n{features}\n]}}'
    content = text.encode(errors='replace')
    _check_size(content)
    packer = zlib.compressobj(9, zlib.DEFLATED, _GZIP, 9)
    return packer.compress(content) + packer.flush()


def read_ship_geojson(content: bytes) -> list[ShipReport]:
    """
    Read a ship list that `ship_geojson` has written, or one that is like it.

    Raises
    ------
    ShipListError
        If it is damaged, another file, or larger than `MAX_LIST_BYTES`.
    """
    text = _unpacked(content)
    try:
        document = json.loads(text.decode())
    except (ValueError, RecursionError) as error:
        raise ShipListError(f'not JSON: {error}') from None
    features = document.get('features') if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise ShipListError('not a FeatureCollection')
    return [_ship(number, feature) for number, feature in enumerate(features)]


def _unpacked(content: bytes) -> bytes:
    """Unpack a gzipped file within bounds."""
    unpacker = zlib.decompressobj(_GZIP)
    try:
        text = unpacker.decompress(content, MAX_LIST_BYTES + 1)
    except zlib.error as error:
        raise ShipListError(f'damaged: {error}') from None
    _check_size(text)
    if not unpacker.eof:
        raise ShipListError('damaged: its end is missing')
    return text


def _check_size(text: bytes) -> None:
    """Raise ShipListError if a list is too large."""
    if len(text) > MAX_LIST_BYTES:
        raise ShipListError(f'larger than the maximum of {MAX_LIST_BYTES} bytes')


def _feature(ship: ShipReport) -> dict[str, Any]:
    """Describe a ship as a feature."""
    sigma = ship.sigma_m if ship.sigma_m and all(map(math.isfinite, ship.sigma_m)) else None
    properties = {
        'course': _turned(ship.course, 180.0 if ship.course_ambiguous else 360.0),
        'course_ambiguous': ship.course_ambiguous,
        'length_m': _rounded(ship.length_m, 1),
        'width_m': _rounded(ship.width_m, 1),
        'sigma_m': None if sigma is None else [*map(_short, sigma[:2]), _rounded(sigma[2], 0)],
        'class': ship.class_id or None,
        'score': _rounded(ship.score, 2),
        'first': _time_text(ship.first),
        'last': _time_text(ship.last),
        'views': ship.views,
        'speed': _rounded(ship.speed, 1),
        'speed_sigma': _short(ship.speed_sigma),
        'course_over_ground': _turned(ship.course_over_ground, 360.0),
        'course_over_ground_sigma': _short(ship.course_over_ground_sigma),
    }
    place = [_rounded(ship.longitude, _DECIMALS), _rounded(ship.latitude, _DECIMALS)]
    return {
        'type': 'Feature',
        **({'id': ship.id} if ship.id else {}),
        'geometry': {'type': 'Point', 'coordinates': place},
        'properties': {key: value for key, value in properties.items() if value is not None},
    }


def _rounded(value: float | None, decimals: int) -> float | None:
    """Round a number, to an integer where it is one; None if it is not finite."""
    return None if value is None or not math.isfinite(value) else _plain(round(value, decimals))


def _turned(value: float | None, circle: float) -> float | None:
    """Round a course, so that it stays below a circle or half of one."""
    return None if value is None else _plain(round(value, 1) % circle)


def _short(value: float | None) -> float | None:
    """Round an uncertainty; None if it is not finite."""
    if value is None or not math.isfinite(value):
        return None
    return _plain(float(f'{value:.{_SIGMA_DIGITS}g}'))


def _plain(value: float) -> float:
    """Return an integer where a number is one."""
    return int(value) if value == int(value) else value


def _time_text(nanoseconds: int) -> str:
    """Write a time as RFC 3339 has it."""
    time = _EPOCH + round(nanoseconds / 1e6) * _MILLISECOND
    return time.replace(tzinfo=None).isoformat(timespec='milliseconds') + 'Z'


def _ship(number: int, feature: Any) -> ShipReport:
    """Read a ship from a feature."""
    try:
        place, properties = feature['geometry']['coordinates'], feature['properties']
        facts = _Facts({'id': feature.get('id', ''), **properties})
        longitude, latitude = (_number(value) for value in place[:2])
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            raise ValueError(f'its place, {latitude}, {longitude}, is not on Earth')
        sigma = facts.optional('sigma_m', _ellipse)
        return ShipReport(
            id=facts.optional('id', _text) or '',
            latitude=latitude,
            longitude=longitude,
            course=facts.read('course', _number),
            course_ambiguous=facts.read('course_ambiguous', _truth),
            length_m=facts.read('length_m', _size),
            width_m=facts.read('width_m', _size),
            sigma_m=sigma,
            class_id=facts.optional('class', _text) or '',
            score=facts.optional('score', _number),
            first=facts.read('first', _time),
            last=facts.read('last', _time),
            views=facts.read('views', _count),
            speed=facts.optional('speed', _number),
            speed_sigma=facts.optional('speed_sigma', _size),
            course_over_ground=facts.optional('course_over_ground', _number),
            course_over_ground_sigma=facts.optional('course_over_ground_sigma', _size),
        )
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f'{error} is missing' if isinstance(error, LookupError) else str(error)
        raise ShipListError(f'feature {number}: {reason}'[:200]) from None


class _Facts:
    """Properties of a ship that may be of any type."""

    def __init__(self, facts: Mapping[str, Any]) -> None:
        self._facts = facts

    def read(self, key: str, check: Callable[[Any], _Value]) -> _Value:
        """Read a property; LookupError or ValueError if it is missing or wrong."""
        try:
            return check(self._facts[key])
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f'{key}: {error}') from None

    def optional(self, key: str, check: Callable[[Any], _Value]) -> _Value | None:
        """Read a property; None if it is missing."""
        return None if self._facts.get(key) is None else self.read(key, check)


def _number(value: Any) -> float:
    """Check a number."""
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError('not a finite number')
    return float(value)


def _size(value: Any) -> float:
    """Check a number that is not negative."""
    if (number := _number(value)) < 0.0:
        raise ValueError('negative')
    return number


def _count(value: Any) -> int:
    """Check a number of views; the sum over many lists stays below 2**63."""
    if type(value) is not int or not 1 <= value <= 2**40:
        raise ValueError('not a number of views')
    return value


def _text(value: Any) -> str:
    """Check a text; other tools number their features."""
    if type(value) is int:
        return str(value)
    if not isinstance(value, str):
        raise ValueError('not a text')
    return value


def _truth(value: Any) -> bool:
    """Check true or false."""
    if not isinstance(value, bool):
        raise ValueError('neither true nor false')
    return value


def _ellipse(value: Any) -> tuple[float, float, float]:
    """Check an error ellipse."""
    major, minor, azimuth = (_size(number) for number in value)
    return major, minor, azimuth


def _time(value: Any) -> int:
    """Read a time, in nanoseconds."""
    time = datetime.fromisoformat(_text(value).replace('Z', '+00:00'))
    if time.tzinfo is None:
        raise ValueError('without a time zone')
    # OverflowError if UTC is not in a year from 1 to 9999.
    return (time.astimezone(timezone.utc) - _EPOCH) // _MICROSECOND * 1000
