# SPDX-License-Identifier: Apache-2.0
"""
Which views of an object are better: k of every chip that waits, kept right at once.

The views of an object have an order, by worth and then by age. k of a view is its place there, from
0, and one more for each view that was released. So releasing the best view, or deleting the last,
changes no other; everything else changes those within the first `MAX_K` places.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from collections.abc import Sequence

from obbhbb_ros.spool.books import Books
from obbhbb_ros.spool.chip_rows import ChipState
from obbhbb_ros.spool.chip_rows import StoredChip
from obbhbb_ros.spool.ranking import MAX_K

# Objects with released views are remembered in this share of the spool, or this many of them if the
# spool has no limit. Each takes this many bytes.
_SHARE, _MAX_OBJECTS, _OBJECT_BYTES = 0.02, 1_000_000, 60
# Objects to forget in one transaction.
_MAX_FORGOTTEN = 1000

# Values that can be a number of released views.
_COUNTS = range(2**31)

# Less its worth, and number.
_Place = tuple[float, int]


class ObjectViews:
    """
    The views of objects, in one transaction.

    Parameters
    ----------
    rows : sqlite3.Cursor
        Of the transaction.
    books : Books
        The books, as read in it.
    """

    def __init__(self, rows: sqlite3.Cursor, books: Books) -> None:
        self._rows, self._books = rows, books

    def admit(self, chips: Sequence[StoredChip]) -> list[StoredChip]:
        """Return new chips with their k, before they are inserted."""
        by_object: dict[int, list[_Place]] = {}
        for chip in chips:
            if chip.object is not None:
                by_object.setdefault(chip.object, []).append((-chip.worth, chip.seq))
        due: dict[int, int] = {}
        for key, views in by_object.items():
            first, released = self._first(key), self._released(key)
            self._books.objects += not first
            before = _numbered(first, released)
            now = _numbered(sorted(first + views), released)
            due |= {seq: k for seq, k in now.items() if before.get(seq) != k}
        self._set({seq: due.pop(seq) for seq in due.keys() - {chip.seq for chip in chips}})
        return [chip._replace(k=due.get(chip.seq, 0)) for chip in chips]

    def remove(self, keys: Iterable[int | None], k: int = 0) -> None:
        """Set k of what is left of objects, after chips of some k were deleted."""
        for key in _distinct(keys):
            first = self._first(key)
            self._books.objects -= not first
            if k != MAX_K:
                self._set(_numbered(first, self._released(key)))

    def change(self, chips: Sequence[StoredChip]) -> None:
        """Store chips that have another worth."""
        keys = _distinct(chip.object for chip in chips)
        before = {seq: MAX_K for key in keys for _, seq in self._first(key)}
        self._rows.executemany(
            'UPDATE chips SET value = ?, worth = ?, k = ?, digest = ? WHERE seq = ?',
            [
                (chip.value, chip.worth, 0 if chip.object is None else MAX_K, chip.digest, chip.seq)
                for chip in chips
            ],
        )
        for key in keys:
            before |= _numbered(self._first(key), self._released(key))
        self._set(before)

    def release(self, keys: Iterable[int | None]) -> None:
        """Count released views of objects, once for each time that an object is named."""
        known = [key for key in keys if isinstance(key, int)]
        for key in known:
            self._books.turn += 1
            self._rows.execute(
                'INSERT INTO objects VALUES (?1, 1, ?2) ON CONFLICT (object) DO UPDATE '
                'SET released = min(released, 1000000) + 1, turn = ?2 RETURNING released',
                (key, self._books.turn),
            )
            self._books.count('objects_released', int(self._rows.fetchall() == [(1,)]))
        self.remove(known)

    def take_back(self, keys: Iterable[int | None]) -> None:
        """Undo the count of released views that are lost."""
        known = [key for key in keys if isinstance(key, int)]
        for key in known:
            released = self._released(key)
            if released > 1:
                change = 'UPDATE objects SET released = released - 1 WHERE object = ?'
            else:
                change = 'DELETE FROM objects WHERE object = ?'
                self._books.count('objects_released', -released)
            self._rows.execute(change, (key,))
        self._renumber(known)

    def forget(self, max_bytes: float) -> None:
        """Forget the objects whose last released view is the oldest, in a spool of a size."""
        limit = int(_SHARE * max_bytes / _OBJECT_BYTES) if max_bytes else _MAX_OBJECTS
        self._rows.execute(
            'DELETE FROM objects WHERE object IN (SELECT object FROM objects WHERE turn <= ? '
            'ORDER BY turn LIMIT ?) RETURNING object',
            (self._books.turn - limit, _MAX_FORGOTTEN),
        )
        self._renumber([key for (key,) in self._rows.fetchall()])

    def counted(self, chips: Sequence[StoredChip]) -> list[StoredChip]:
        """Return chips that are being claimed, with the numbers of their views."""
        # By this index there are few, whatever there is of their objects.
        self._rows.execute(
            'SELECT object, view FROM chips INDEXED BY chips_in_order WHERE state = ?',
            (ChipState.CLAIMED,),
        )
        last: dict[int, int] = {}
        for key, view in self._rows.fetchall():
            if isinstance(key, int) and isinstance(view, int):
                last[key] = max(view, last.get(key, 0))

        def counted(chip: StoredChip) -> StoredChip:
            # A damaged chip keeps its damage: a new digest would hide it.
            if chip.view is not None or chip.object is None or not chip.is_intact():
                return chip
            view = max(self._released(chip.object), last.get(chip.object, 0)) + 1
            last[chip.object] = view
            return chip._replace(view=view).with_digest()

        return list(map(counted, chips))

    def _renumber(self, keys: Iterable[int]) -> None:
        """Set k of the first views of objects."""
        for key in _distinct(keys):
            self._set(_numbered(self._first(key), self._released(key)))

    def _first(self, key: int) -> list[_Place]:
        """List the first views of an object."""
        # Damage may have turned a worth into anything.
        return self._rows.execute(
            'SELECT -ifnull(CAST(worth AS REAL), 0.0), seq FROM chips '
            'WHERE object = ? AND state < 2 ORDER BY worth DESC, seq LIMIT ?',
            (key, MAX_K),
        ).fetchall()

    def _released(self, key: int) -> int:
        """Return how many views of an object were released, as far as that is remembered."""
        self._rows.execute('SELECT released FROM objects WHERE object = ?', (key,))
        released = [row[0] for row in self._rows.fetchall()]
        # Damage may have turned it into anything; a range is searched for what is not a number.
        is_count = released and isinstance(released[0], int) and released[0] in _COUNTS
        return released[0] if is_count else 0

    def _set(self, due: dict[int, int]) -> None:
        """Set k of chips by their numbers."""
        self._rows.executemany(
            'UPDATE chips SET k = ?1 WHERE seq = ?2 AND k IS NOT ?1',
            [(k, seq) for seq, k in due.items()],
        )


def _numbered(views: Sequence[_Place], released: int) -> dict[int, int]:
    """Return k of views in their order, by their numbers."""
    return {seq: max(min(place + released, MAX_K), 0) for place, (_, seq) in enumerate(views)}


def _distinct(keys: Iterable[int | None]) -> list[int]:
    """List each key once; damage may have turned one into anything."""
    return list(dict.fromkeys(key for key in keys if isinstance(key, int)))
