# SPDX-License-Identifier: Apache-2.0
"""
A ship list as a short binary message, 16 bytes a ship; `doc/ship_list.md` describes every bit.

It is for links that carry some hundred bytes at a time, and holds the most valuable ships that fit.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Sequence
from typing import NamedTuple

from obbhbb_ros.reports.ship_report import MAX_LIST_BYTES
from obbhbb_ros.reports.ship_report import ShipListError
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.reports.ship_report import value_order

__all__ = ['MESSAGE_MAGIC', 'MIN_MESSAGE_BYTES', 'ShipMessage', 'read_ship_message', 'ship_message']

MESSAGE_MAGIC = b'SL\x01'
"""The first bytes of a message: two letters and the version."""
MIN_MESSAGE_BYTES = 120
"""A message of this size has room for at least one ship, whichever it is."""
# Seconds of the latest ship, seconds of a step of ages, least number of an id.
_HEADER = struct.Struct('>3siHI')
_CHECKSUM = struct.Struct('>I')
_SHIP_BYTES = 16
# Bits of the fields of a ship, the highest first.
_WIDTHS = {
    'latitude': 25,
    'longitude': 26,
    'number': 16,
    'course': 8,
    'ambiguous': 1,
    'length': 9,
    'width': 7,
    'major': 5,
    'minor': 5,
    'azimuth': 3,
    'class': 4,
    'score': 4,
    'views': 4,
    'age': 6,
    'speed': 5,
}
# The highest value of a field means: not known, or left out.
_UNKNOWN = {name: 2**width - 1 for name, width in _WIDTHS.items()}
_MAX_AGE, _MAX_AGE_STEP = 2 ** _WIDTHS['age'] - 1, 2**16 - 1
_MAX_VIEWS = 2 ** _WIDTHS['views'] - 1
_SCORE_STEPS = 14
_SECOND = 1_000_000_000
# Of the header, seconds.
_LATEST = 2**31 - 1
_MAX_NUMBER = 2**32 - 1
_ID = re.compile('(.*?)(0|[1-9][0-9]*)', re.DOTALL)
# Maximum bytes of the text before the number of an id, and of a class; longer ones are left out.
_MAX_TEXT = 32


class ShipMessage(NamedTuple):
    """
    A message, and the ships that are not in it.

    Attributes
    ----------
    content : bytes
        The message.
    left_out : list of ShipReport
        The ships that did not fit, the most valuable first.
    """

    content: bytes
    left_out: list[ShipReport]


def ship_message(ships: Iterable[ShipReport], max_bytes: int) -> ShipMessage:
    """
    Write the most valuable ships as a message.

    Parameters
    ----------
    ships : iterable of ShipReport
        The ships, with finite numbers.
    max_bytes : int
        Maximum size of the message, at least `MIN_MESSAGE_BYTES`.

    Examples
    --------
    >>> tug = ShipReport(
    ...     id='a-1', latitude=36.1, longitude=-5.4, course=12.0, course_ambiguous=True,
    ...     length_m=30.0, width_m=9.0, first=5_000_000_000, last=6_250_000_000, views=2,
    ... )
    >>> content, left_out = ship_message([tug] * 19, 340)
    >>> len(content), len(left_out), read_ship_message(content)[0].id
    (325, 0, 'a-1')
    """
    if max_bytes < MIN_MESSAGE_BYTES:
        raise ValueError(f'max_bytes must be at least {MIN_MESSAGE_BYTES}, not {max_bytes}')
    ranked = sorted(ships, key=value_order)
    names = [_split(ship.id) for ship in ranked]
    ((prefix, _),) = Counter(name[0] for name in names if name).most_common(1) or [(b'', 0)]
    size = _HEADER.size + 1 + len(prefix) + 1 + _CHECKSUM.size
    classes: list[bytes] = []
    taken = 0
    for ship in ranked:
        new = _new_class(ship.class_id.encode(errors='replace'), classes)
        size += _SHIP_BYTES + sum(1 + len(name) for name in new)
        if size > max_bytes:
            break
        classes += new
        taken += 1
    numbers = [name[1] if name and name[0] == prefix else None for name in names[:taken]]
    content = _message(ranked[:taken], prefix, numbers, classes)
    return ShipMessage(content, ranked[taken:])


def read_ship_message(content: bytes) -> list[ShipReport]:
    """
    Read a message that `ship_message` has written.

    A message does not have the first time of a ship: its last time takes that place.

    Raises
    ------
    ShipListError
        If it is damaged, or another file.
    """
    if len(content) > MAX_LIST_BYTES:
        raise ShipListError(f'larger than the maximum of {MAX_LIST_BYTES} bytes')
    body, checksum = content[: -_CHECKSUM.size], content[-_CHECKSUM.size :]
    if not body.startswith(MESSAGE_MAGIC):
        raise ShipListError('not a ship list of a known version')
    if checksum != _CHECKSUM.pack(zlib.crc32(body)):
        raise ShipListError('damaged: its checksum differs')
    try:
        _, newest, step, base = _HEADER.unpack_from(body)
        prefix, at = _text_at(body, _HEADER.size)
        classes = []
        at += 1
        for _ in range(body[at - 1]):
            name, at = _text_at(body, at)
            classes.append(name)
    except (struct.error, IndexError, UnicodeDecodeError):
        raise ShipListError('damaged: its head is not complete') from None
    if (len(body) - at) % _SHIP_BYTES:
        raise ShipListError('damaged: a ship is not complete')
    records = (body[start : start + _SHIP_BYTES] for start in range(at, len(body), _SHIP_BYTES))
    return [_ship(_fields(record), newest, step, prefix, base, classes) for record in records]


def _message(
    ships: Sequence[ShipReport],
    prefix: bytes,
    numbers: Sequence[int | None],
    classes: Sequence[bytes],
) -> bytes:
    """Write a message of ships, by the numbers of their ids and the table of classes."""
    times = [min(ship.last // _SECOND, _LATEST) for ship in ships]
    newest = max(times, default=0)
    step = min(max(1, -(-(newest - min(times, default=0)) // _MAX_AGE)), _MAX_AGE_STEP)
    known = [number for number in numbers if number is not None]
    base = max(0, max(known, default=0) - _UNKNOWN['number'] + 1)
    parts = [_HEADER.pack(MESSAGE_MAGIC, newest, step, base)]
    parts += (bytes([len(prefix)]), prefix, bytes([len(classes)]))
    parts += (bytes([len(name)]) + name for name in classes)
    for ship, time, number in zip(ships, times, numbers, strict=True):
        name = ship.class_id.encode(errors='replace')
        is_said = number is not None and number >= base
        codes = {
            'number': number - base if number is not None and is_said else _UNKNOWN['number'],
            'class': classes.index(name) if name in classes else _UNKNOWN['class'],
            'age': min(round((newest - time) / step), _MAX_AGE),
            **_codes(ship),
        }
        parts.append(_record(codes))
    body = b''.join(parts)
    return body + _CHECKSUM.pack(zlib.crc32(body))


def _split(ship_id: str) -> tuple[bytes, int] | None:
    """Split an id into a text and a number; None if a message cannot hold it."""
    match = _ID.fullmatch(ship_id)
    if match is None or len(match[2]) > len(str(_MAX_NUMBER)):
        return None
    prefix, number = match[1].encode(errors='replace'), int(match[2])
    return (prefix, number) if len(prefix) <= _MAX_TEXT and number <= _MAX_NUMBER else None


def _new_class(name: bytes, classes: Sequence[bytes]) -> list[bytes]:
    """Return the class in a list, if it is new to the table and fits into it."""
    is_said = name and len(name) <= _MAX_TEXT and len(classes) < _UNKNOWN['class']
    return [name] if is_said and name not in classes else []


def _text_at(body: bytes, at: int) -> tuple[str, int]:
    """Read a text behind its length; return it and where it ends."""
    end = at + 1 + body[at]
    if end > len(body):
        raise IndexError
    return body[at + 1 : end].decode(), end


def _record(codes: dict[str, int]) -> bytes:
    """Write the fields of a ship."""
    bits = 0
    for name, width in _WIDTHS.items():
        bits = bits << width | codes[name]
    return bits.to_bytes(_SHIP_BYTES, 'big')


def _fields(record: bytes) -> dict[str, int]:
    """Read the fields of a ship."""
    bits = int.from_bytes(record, 'big')
    codes = {}
    for name, width in reversed(_WIDTHS.items()):
        codes[name] = bits & (1 << width) - 1
        bits >>= width
    return codes


# The scales of the fields -----------------------------------------------------------------------

_LATITUDE = 2 ** _WIDTHS['latitude'] - 1
_LONGITUDE = 2 ** _WIDTHS['longitude']
_COURSE = 2 ** _WIDTHS['course']
_AZIMUTH = 2 ** _WIDTHS['azimuth']
# Smallest value and ratio of two steps.
_LENGTH, _WIDTH, _SIGMA = (0.5, 1.015), (0.5, 1.04), (0.1, 1.5)


def _codes(ship: ShipReport) -> dict[str, int]:
    """Turn a ship into the numbers of its fields."""
    circle = 180.0 if ship.course_ambiguous else 360.0
    major, minor, azimuth = ship.sigma_m or (math.nan,) * 3
    score, speed = ship.score, ship.speed
    return {
        'latitude': round((ship.latitude + 90.0) / 180.0 * _LATITUDE),
        'longitude': round((ship.longitude + 180.0) / 360.0 * _LONGITUDE) % _LONGITUDE,
        'course': round(ship.course / circle * _COURSE) % _COURSE,
        'ambiguous': int(ship.course_ambiguous),
        'length': _log_code(ship.length_m, _LENGTH, _UNKNOWN['length'], round),
        'width': _log_code(ship.width_m, _WIDTH, _UNKNOWN['width'], round),
        # Rounded up, so that it is never too small.
        'major': _log_code(major, _SIGMA, _UNKNOWN['major'] - 1, math.ceil),
        'minor': _log_code(minor, _SIGMA, _UNKNOWN['minor'] - 1, math.ceil),
        'azimuth': 0 if math.isnan(azimuth) else round(azimuth / 180.0 * _AZIMUTH) % _AZIMUTH,
        'score': _UNKNOWN['score']
        if score is None
        else round(min(max(score, 0.0), 1.0) * _SCORE_STEPS),
        'views': min(ship.views, _MAX_VIEWS),
        'speed': _UNKNOWN['speed']
        if speed is None
        else min(round(max(speed, 0.0)), _UNKNOWN['speed'] - 1),
    }


def _log_code(
    value: float, scale: tuple[float, float], top: int, rounded: Callable[[float], int]
) -> int:
    """Return the step of a logarithmic scale, at most `top`; the next one for NaN."""
    if math.isnan(value):
        return top + 1
    first, ratio = scale
    steps = math.log(max(value, first) / first) / math.log(ratio)
    # Slightly less, so that a value on the scale stays where it is.
    return min(rounded(steps - 1e-9), top)


def _log_value(code: int, scale: tuple[float, float]) -> float:
    """Return the value of a step of a logarithmic scale."""
    first, ratio = scale
    return float(first * ratio**code)


def _ship(
    codes: dict[str, int],
    newest: int,
    step: int,
    prefix: str,
    base: int,
    classes: Sequence[str],
) -> ShipReport:
    """Turn the numbers of its fields into a ship."""
    is_unknown = {name for name, code in codes.items() if code == _UNKNOWN[name]}
    if 'class' not in is_unknown and codes['class'] >= len(classes):
        raise ShipListError('damaged: a class is not in its table')
    circle = 180.0 if codes['ambiguous'] else 360.0
    time = (newest - codes['age'] * step) * _SECOND
    sigma = None
    if not is_unknown & {'major', 'minor'}:
        axes = _log_value(codes['major'], _SIGMA), _log_value(codes['minor'], _SIGMA)
        sigma = (*axes, codes['azimuth'] * 180.0 / _AZIMUTH)
    return ShipReport(
        id='' if 'number' in is_unknown else f'{prefix}{base + codes["number"]}',
        latitude=codes['latitude'] / _LATITUDE * 180.0 - 90.0,
        longitude=codes['longitude'] / _LONGITUDE * 360.0 - 180.0,
        course=codes['course'] * circle / _COURSE,
        course_ambiguous=bool(codes['ambiguous']),
        length_m=_log_value(codes['length'], _LENGTH),
        width_m=_log_value(codes['width'], _WIDTH),
        sigma_m=sigma,
        class_id='' if 'class' in is_unknown else classes[codes['class']],
        score=None if 'score' in is_unknown else codes['score'] / _SCORE_STEPS,
        first=time,
        last=time,
        views=max(codes['views'], 1),
        speed=None if 'speed' in is_unknown else float(codes['speed']),
    )
