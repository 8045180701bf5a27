# SPDX-License-Identifier: Apache-2.0
"""
The books of a spool, and the rules by which they balance.

Every change is one transaction that is on disk when it ends: a frame is planned, its chips are
stored, a chip is claimed, released, delivered. So at every instant

    planned = delivered + waiting + evicted + refused + in work,

where `in work` are the chips of frames that a running process has not stored yet.

Everything that a catalogue holds besides chips is one text, sealed with a digest and kept twice.
Damage to one copy costs nothing; damage to both costs the catalogue.
"""

from __future__ import annotations

import json
import secrets
import sqlite3
from collections import Counter
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import field
from typing import Any

from obbhbb_ros.spool.ranking import FADE
from obbhbb_ros.spool.seals import is_sealed
from obbhbb_ros.spool.seals import sealed

# They have tables, and so pages, of their own.
_COPIES = ('books', 'books_copy')


@dataclass
class Books:
    """
    What a catalogue holds besides chips; one transaction reads and writes it.

    Attributes
    ----------
    counts : Counter
        As in `Status`.
    held : list of list of int
        Number of chips, and bytes of their files, by `ChipState`.
    frames : dict of str to list of int
        Frames in work: for the number of each, its writer and how many chips it has.
    last_seq : int
        The last number of a chip.
    outbox : str
        Token of the outbox that chips are released into; empty before the first.
    fade : float
        `spool.fade`, for writers and releaser alike.
    objects : int
        Number of objects of which a chip waits or is claimed.
    turn : int
        Number of views of objects that were released.
    """

    counts: Counter[str] = field(default_factory=Counter)
    held: list[list[int]] = field(default_factory=lambda: [[0, 0] for _ in range(3)])
    frames: dict[str, list[int]] = field(default_factory=dict)
    last_seq: int = 0
    outbox: str = ''
    fade: float = FADE
    objects: int = 0
    turn: int = 0

    def count(self, name: str, number: int) -> None:
        """Add to a count."""
        if number:
            self.counts[name] += number

    def put(self, state: int, sizes: Iterable[Any]) -> int:
        """Add chips with files of some sizes to a state; return how many."""
        return self._add(state, 1, sizes)

    def take(self, state: int, sizes: Iterable[Any]) -> int:
        """Take chips with files of some sizes from a state; return how many."""
        return self._add(state, -1, sizes)

    def open_frame(self, writer: int, chips: int) -> int:
        """Add a frame in work; return its number."""
        number = secrets.randbits(48)
        self.frames[str(number)] = [writer, chips]
        return number

    def take_off_frame(self, number: int, chips: int) -> bool:
        """Take chips off a frame, and close it after the last; return whether it was in work."""
        frame = self.frames.get(str(number))
        if frame is None:
            return False
        frame[1] -= chips
        if frame[1] <= 0:
            del self.frames[str(number)]
        return True

    def close_frames_of(self, writer: int) -> None:
        """Refuse the frames of a writer that ended before it stored them."""
        ended = [name for name, frame in self.frames.items() if frame[0] == writer]
        self.count('refused.interrupted', sum(self.frames.pop(name)[1] for name in ended))

    def in_work(self) -> int:
        """Count the chips of the frames in work."""
        return sum(chips for _, chips in self.frames.values())

    def text(self) -> str:
        """Return the books as sealed JSON."""
        return sealed(json.dumps(vars(self)).encode('ascii')).decode('ascii')

    @classmethod
    def read(cls, rows: sqlite3.Cursor, on_restored: Callable[[], object] = lambda: None) -> Books:
        """
        Read the books of a catalogue; if they are damaged, use the copy and count that.

        Raises
        ------
        sqlite3.DatabaseError
            If both are damaged.
        """
        for table in _COPIES:
            with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
                (text,) = rows.execute(f'SELECT text FROM {table}').fetchone()
                if is_sealed(text.encode(errors='surrogatepass')):
                    values = json.loads(text)
                    del values['digest']
                    books = cls(**values)
                    books.counts = Counter(books.counts)
                    if table != _COPIES[0]:
                        books.count('restored', 1)
                        on_restored()
                    return books
        raise sqlite3.DatabaseError('its books and their copy are damaged')

    def write(self, rows: sqlite3.Cursor) -> None:
        """Write the books into a catalogue."""
        text = self.text()
        for table in _COPIES:
            # Damage may have changed the number and the keys of the rows.
            rows.execute(f'DELETE FROM {table}')
            rows.execute(f'INSERT INTO {table} VALUES (1, ?)', (text,))

    def _add(self, state: int, sign: int, sizes: Iterable[Any]) -> int:
        """Add or take chips; damage may have turned a size into anything."""
        numbers = [size if isinstance(size, int) else 0 for size in sizes]
        self.held[state][0] += sign * len(numbers)
        self.held[state][1] += sign * sum(numbers)
        return len(numbers)


@dataclass(frozen=True)
class Status:
    """
    The books of a spool at one instant.

    Attributes
    ----------
    waiting, waiting_bytes : int
        Chips in the spool, those on their way to the outbox included, and bytes of their files.
    in_outbox : int
        Chips in the outbox that the bus has not removed yet.
    in_work : int
        Chips of frames that are being cut.
    file_bytes : int
        Size of the catalogue in use.
    set_aside : int
        Damaged catalogues beside it.
    least_rank : float or None
        Least rank of the chips that wait, None if there are none; a full spool evicts these first.
    fade : float
        The fade in force.
    objects_waiting : int
        Number of known ships that the chips in the spool show.
    counts : mapping of str to int
        `planned`, `released`, `delivered`, `delivered_bytes`, `objects_released` (known ships of
        which a view was released), and `evicted.<reason>`, `refused.<reason>`.
    """

    waiting: int
    waiting_bytes: int
    in_outbox: int
    in_work: int
    file_bytes: int
    set_aside: int
    least_rank: float | None
    fade: float
    objects_waiting: int
    counts: Mapping[str, int]

    def total(self, kind: str) -> int:
        """Sum up `evicted` or `refused` over all reasons."""
        return sum(n for name, n in self.counts.items() if name.startswith(f'{kind}.'))

    @property
    def balance(self) -> int:
        """Number of chips planned that are unaccounted for; 0 if the books balance."""
        planned, delivered = (self.counts.get(name, 0) for name in ('planned', 'delivered'))
        gone = delivered + self.total('evicted') + self.total('refused')
        return planned - gone - self.waiting - self.in_outbox - self.in_work


def number(rows: sqlite3.Cursor, query: str, *values: object) -> int:
    """Read one number."""
    return int(rows.execute(query, values).fetchone()[0])
