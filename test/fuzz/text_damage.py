# SPDX-License-Identifier: Apache-2.0
"""Damage to text files that their parsers are most likely to trip over."""

from __future__ import annotations

import gzip
import random
import re
from collections.abc import Callable

from wire import mutated

TOKENS = re.compile(rb'-?\d+(\.\d+)?|[A-Za-z_]\w*|[^\s\w]|\s+')
NUMBERS = re.compile(rb'-?\d+(\.\d+)?')
VALUES = (
    b'0', b'-0', b'-1', b'1', b'2', b'0.5', b'3', b'1e308', b'-1e308', b'1.7976931348623157e308',
    b'5e-324', b'1e16', b'1e15', b'1e400', b'NaN', b'nan', b'inf', b'-Infinity', b'9' * 20,
    b'9' * 400, b'9' * 5000, b'4294967296', b'2147483647', b'16777216', b'16777217', b'0x10',
    b'1_000', b'', b'+', b'1,5', '٣'.encode(), b'1e', b'true', b'null', b'""', b'[]', b'{}',
    b'[[]]', b'[1]', b'"a"', b'"\\ud800"', b'{"type": "Polygon", "coordinates": [[[1, 2]]]}',
    b'&lt;', b'&a;', b'POLYGON EMPTY', b'POINT (1 2)', b'SRID=4326;', b'EPSG:4326', b'../../a',
    b'a' * 3000, b'\x00', b'\xff', '\u2028'.encode(), b'"', b"'", b'"\n"', b'\r',
)  # fmt: skip
BOMBS = (
    b'[' * 200_000, b'{"a":' * 100_000, b'<a>' * 100_000, b'(' * 100_000, b'"' * 100_001,
    b',' * 100_000, b'\n' * 100_000, b' ' * 100_000, b'0 ' * 100_000, b'[[],' * 50_000,
    b'<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>',
    b'<?xml version="1.0" encoding="utf-7"?>', b'<?xml version="1.0" encoding="idna"?>',
    b'GEOMETRYCOLLECTION (' * 20_000, b'"a\n' * 20_000,
)  # fmt: skip


def damaged_text(data: bytearray, source: random.Random) -> bytes:
    """Damage a text by its tokens a few times, seldom with a bomb; sometimes as bytes."""
    if source.random() < 0.2:
        return mutated(data, source)
    text = bytes(data)
    for _ in range(source.choice([1, 1, 1, 2, 3, 6])):
        text = source.choice(DAMAGES)(text, source)
    chance = source.random()
    if chance < 0.005:
        at = source.randrange(len(text) + 1)
        text = text[:at] + source.choice(BOMBS) + text[at:]
    elif chance < 0.05:
        text = text[: source.randrange(len(text) + 1)]
    elif chance < 0.06:
        text = source.choice(PACKINGS)(text)
    return text


def _other_number(text: bytes, source: random.Random) -> bytes:
    return _replaced(text, NUMBERS, source)


def _other_token(text: bytes, source: random.Random) -> bytes:
    return _replaced(text, TOKENS, source)


def _replaced(text: bytes, pattern: re.Pattern[bytes], source: random.Random) -> bytes:
    places = list(pattern.finditer(text))
    if not places:
        return text
    place = source.choice(places)
    value = source.choice(VALUES) if source.random() < 0.8 else source.choice(places)[0]
    return text[: place.start()] + value + text[place.end() :]


def _part(text: bytes, source: random.Random) -> tuple[int, int]:
    """Choose a part of the text that begins and ends between tokens."""
    ends = [0, *(place.end() for place in TOKENS.finditer(text))]
    first, last = sorted(source.choices(range(len(ends)), k=2))
    return ends[first], ends[min(last, first + source.choice([1, 2, 8, 40]))]


def _left_out(text: bytes, source: random.Random) -> bytes:
    start, stop = _part(text, source)
    return text[:start] + text[stop:]


def _repeated(text: bytes, source: random.Random) -> bytes:
    start, stop = _part(text, source)
    return text[:stop] + text[start:stop] * source.choice([1, 1, 2, 50]) + text[stop:]


def _moved(text: bytes, source: random.Random) -> bytes:
    start, stop = _part(text, source)
    rest = text[:start] + text[stop:]
    at, _ = _part(rest, source)
    return rest[:at] + text[start:stop] + rest[at:]


Damage = Callable[[bytes, random.Random], bytes]
DAMAGES: tuple[Damage, ...] = (
    _other_number, _other_number, _other_token, _left_out, _repeated, _moved,
)  # fmt: skip
PACKINGS: tuple[Callable[[bytes], bytes], ...] = (
    gzip.compress,
    lambda text: text.decode(errors='replace').encode('utf-16'),
    lambda text: b'\xef\xbb\xbf' + text,
    lambda text: text.replace(b'\n', b'\r\n'),
    lambda text: text.replace(b'\n', b'\r'),
)
