# SPDX-License-Identifier: Apache-2.0
"""Ids of tracks: the form of our own, and ids of others that are not ids of tracks."""

from __future__ import annotations

import re
import secrets
from collections import Counter
from collections.abc import Iterator
from collections.abc import Sequence
from typing import NamedTuple

__all__ = ['IdDoubt', 'IdWatch', 'is_tracker_id', 'new_session', 'repeated_ids', 'tracker_id']

_TRACKER_ID = re.compile('[0-9a-f]{8}-[0-9]+')
# Row numbers are reported after this many messages in a row, during which the number of detections
# has fallen this often: tracks also begin as 0 to n - 1, but do not stay that way when ships leave.
_ROW_NUMBERED = 20
_FALLS = 3
_ADVICE = 'node ship_tracker with ids: assign gives ids that follow the ships'


def new_session() -> str:
    """
    Draw the first half of the ids of a tracker at random, so that no other run has the same ids.

    Examples
    --------
    >>> is_tracker_id(tracker_id(new_session(), 7))
    True
    """
    return secrets.token_hex(4)


def tracker_id(session: str, number: int) -> str:
    """
    Write the id of a track.

    Examples
    --------
    >>> tracker_id('09af31bc', 12)
    '09af31bc-12'
    """
    return f'{session}-{number}'


def is_tracker_id(text: str) -> bool:
    """
    Tell whether an id comes from `ship_tracker`, and so has a session already.

    Examples
    --------
    >>> is_tracker_id('09af31bc-12'), is_tracker_id('12')
    (True, False)
    """
    return _TRACKER_ID.fullmatch(text) is not None


def repeated_ids(ids: Sequence[str]) -> frozenset[str]:
    """
    List the ids that several detections of one message share: they name no ship.

    Parameters
    ----------
    ids : sequence of str
        The ids of one message; empty where a detection has none.

    Examples
    --------
    >>> sorted(repeated_ids(['ship', '4', 'ship', '', '']))
    ['ship']
    """
    if len({*ids}) == len(ids):
        return frozenset()
    return frozenset(text for text, count in Counter(ids).items() if text and count > 1)


class IdDoubt(NamedTuple):
    """
    Ids of a message that name no ships.

    Attributes
    ----------
    key : str
        Their counter in the diagnostics.
    detections : int
        How many detections have such ids.
    text : str
        What is wrong, and the parameter that helps.
    """

    key: str
    detections: int
    text: str


class IdWatch:
    """
    Notices ids that are not those of tracks: class names, constants, and row numbers.

    Examples
    --------
    >>> watch = IdWatch()
    >>> [doubt.key for doubt in watch.note(['ship', 'ship', 'tug'])]
    ['ids_doubtful.repeated']
    >>> sizes = [3, 2] * 10
    >>> doubts = [[*watch.note([str(row) for row in range(size)])] for size in sizes]
    >>> [doubt.key for doubt in doubts[-1]]
    ['ids_doubtful.row_numbers']
    """

    def __init__(self) -> None:
        self._row_numbered = self._falls = self._size = 0

    def note(self, ids: Sequence[str]) -> Iterator[IdDoubt]:
        """
        Look at the ids of the next message, and list doubts.

        Parameters
        ----------
        ids : sequence of str
            The ids of its detections; empty where one has none.
        """
        if repeated := repeated_ids(ids):
            count = sum(text in repeated for text in ids)
            yield IdDoubt(
                'ids_doubtful.repeated',
                count,
                f'{count} of {len(ids)} detections share their id with another of the same '
                f'message, first {min(repeated)!r}, so it names no ship: {_ADVICE}',
            )
        if not any(ids):
            return
        self._count_row_numbers(ids)
        if self._row_numbered >= _ROW_NUMBERED and self._falls >= _FALLS:
            yield IdDoubt(
                'ids_doubtful.row_numbers',
                len(ids),
                f'the ids of the last {self._row_numbered} messages are row numbers, so they '
                f'name no ships: {_ADVICE}',
            )

    def _count_row_numbers(self, ids: Sequence[str]) -> None:
        """Count messages in a row whose ids are 0 to n - 1, or 1 to n, and how often n falls."""
        if not _are_row_numbers(ids):
            self._row_numbered = self._falls = self._size = 0
            return
        self._row_numbered += 1
        self._falls += len(ids) < self._size
        self._size = len(ids)


def _are_row_numbers(ids: Sequence[str]) -> bool:
    """Tell whether ids are 0 to n - 1, or 1 to n, in any order."""
    texts, count = {*ids}, len(ids)
    return any(
        str(first) in texts
        and str(first + count - 1) in texts
        and texts == {str(number) for number in range(first, first + count)}
        for first in (0, 1)
    )
