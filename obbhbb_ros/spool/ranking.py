# SPDX-License-Identifier: Apache-2.0
"""
The rank of a chip decides when it is released or evicted; repeated views of a ship come last.

    rank = worth * fade**k,

where worth is the value, less what the border of the image cuts off, and k counts the better views
of the same object that wait and those that were released; it stops at `MAX_K`. With that limit, a
view that comes or goes changes k of three others at most. Where k stops makes no difference to what
comes down, if it is not below 3.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence

MAX_K = 3
"""Where k stops."""
FADE = 0.1
"""The default of `fade`."""
# An id, and the number at its end.
_PARTS = re.compile('(.*?)([0-9]{0,9})', re.DOTALL)


def rank_of(worth: float, k: int, fade: float) -> float:
    """
    Return the rank of a chip; worth of 0 and less does not rise by repeating.

    Examples
    --------
    >>> rank_of(0.5, 1, 0.5), rank_of(-0.5, 1, 0.5)
    (0.25, -0.5)
    """
    return worth * fade ** min(k, MAX_K) if worth > 0.0 else worth


def worth_of(value: float, obb: Sequence[float] | None, image_size: Sequence[int]) -> float:
    """
    Return the worth of a chip: its value, times the share of its ship that the image shows.

    Parameters
    ----------
    value : float
        Value of the chip.
    obb : sequence of float or None
        Centre x and y, length and width (pixels), theta (radians) of its ship; None if unknown.
    image_size : sequence of int
        Width and height of the image, pixels.

    Returns
    -------
    float
        A value of 0 or less as it is.

    Examples
    --------
    >>> worth_of(0.8, (0.0, 50.0, 20.0, 10.0, 0.0), (640, 480))
    0.4
    """
    if obb is None or value <= 0.0:
        return value
    x, y, length, width, theta = obb
    cosine, sine = abs(math.cos(theta)), abs(math.sin(theta))
    share = 1.0
    for center, size, end in (
        (x, length * cosine + width * sine, image_size[0]),
        (y, length * sine + width * cosine, image_size[1]),
    ):
        start, stop = center - 0.5 * size, center + 0.5 * size
        if size > 0.0 and (start < 0.0 or stop > end):
            share *= max(min(stop, end) - max(start, 0.0), 0.0) / size
    return value * share


def key_of(object_id: str) -> int:
    """
    Return the number that stands for an object in the catalogue.

    Ids that differ in the number at their end get neighbours, so that what is stored together lies
    together on the disk.

    Examples
    --------
    >>> key_of('3fa9c2d1-18') - key_of('3fa9c2d1-17')
    1
    """
    parts = _PARTS.fullmatch(object_id)
    text, digits = parts.groups() if parts else (object_id, '')
    prefix = hashlib.blake2b(text.encode(errors='surrogatepass'), digest_size=4).digest()
    return (int.from_bytes(prefix, 'big', signed=True) << 32) + int(digits or 0)
